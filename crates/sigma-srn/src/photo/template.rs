//! What an object looks like from all around, in few cells: what is compared with places of a picture.

use std::f32::consts::TAU;

use glam::Vec4;
use rayon::prelude::*;

use super::shown::Silhouette;

/// Cells to a side of the views that templates are made of, and of the finest ones.
pub(super) const SIDE: usize = 32;
/// How many times as wide a view is as the object's diagonal.
pub(super) const WIDER: f64 = 1.1;
/// Rolls of each view, evenly over a turn.
pub(super) const ROLLS: usize = 24;
pub(super) const ROLL: f32 = TAU / ROLLS as f32;

/// Around an object, from the second of these cells of [`SIDE`] up to the last, its surroundings differ from it: next to it cells are of both.
const GAP: usize = 1;
const REACH: usize = 4;

/// A part of the object's own, and of what is around it: how much of each a cell has, behind its colours, in [0, 1], times that. Around it the colours are those of the
/// object nearby, which it would have if the object went on.
#[derive(Clone, Copy, Default)]
pub(super) struct Cell {
    pub own: Vec4,
    pub around: Vec4,
}

impl Cell {
    fn sum(self, other: Self, by: f32) -> Self {
        Cell { own: self.own + by * other.own, around: self.around + by * other.around }
    }
}

/// A template of `side` × `side` cells, row-major.
#[derive(Clone)]
pub(super) struct Template {
    pub side: usize,
    pub cells: Vec<Cell>,
}

/// Which of the object's cells are a template's own.
#[derive(Clone, Copy)]
pub(super) enum Own {
    /// Those within its edge, where cells are of both; but a thin thing is nothing but edge.
    Inner,
    All,
}

impl Template {
    /// Of a view of [`SIDE`] pixels, colours in [-1, 1]; without an object, if it shows none.
    pub fn of(rgb: &[f32], own: Own) -> Self {
        let silhouette = Silhouette::of(rgb, SIDE);
        let is_object: Vec<bool> = (0..SIDE * SIDE).map(|i| silhouette.is_object(i)).collect();
        let object = |i: usize| if is_object[i] { colour(&rgb[3 * i..]).extend(1.0) } else { Vec4::ZERO };
        let object: Vec<Vec4> = (0..SIDE * SIDE).map(object).collect();
        let inner: Vec<bool> = (0..SIDE * SIDE).map(|i| near(i, 1).all(|near| near.is_some_and(|i| is_object[i]))).collect();
        let count = |are: &[bool]| are.iter().filter(|is| **is).count();
        let own = match own {
            Own::Inner if 5 * count(&inner) >= 2 * count(&is_object) => &inner,
            Own::Inner | Own::All => &is_object,
        };
        let nearby = blurred(&blurred(&object));
        let is_near = |i: usize, reach: usize| near(i, reach).flatten().any(|i| is_object[i]);
        let cell = |i: usize| Cell {
            own: if own[i] { object[i] } else { Vec4::ZERO },
            around: if is_near(i, REACH) && !is_near(i, GAP) { nearby[i] / nearby[i].w.max(1e-4) } else { Vec4::ZERO },
        };
        Template { side: SIDE, cells: (0..SIDE * SIDE).map(cell).collect() }
    }

    /// Turned about its middle, radians.
    pub fn rolled(&self, roll: f32) -> Self {
        let at = turned(self.side, roll);
        let cell = |i: usize| between(self.side, at(i), |i| self.cells[i], |sum, cell, by| sum.sum(cell, by));
        Template { cells: (0..self.cells.len()).map(cell).collect(), ..*self }
    }

    /// In half as many cells.
    pub fn halved(&self) -> Self {
        let side = self.side / 2;
        let cell = |i: usize| {
            let first = 2 * (i / side) * self.side + 2 * (i % side);
            let four = [first, first + 1, first + self.side, first + self.side + 1];
            four.into_iter().fold(Cell::default(), |sum, i| sum.sum(self.cells[i], 0.25))
        };
        Template { side, cells: (0..side * side).map(cell).collect() }
    }
}

/// A view on white, turned likewise.
pub(super) fn rolled_view(rgb: &[f32], roll: f32) -> Vec<f32> {
    let at = turned(SIDE, roll);
    let dark = |i: usize| Vec4::ONE - colour(&rgb[3 * i..]).extend(0.0);
    let pixel = |i: usize| between(SIDE, at(i), dark, |sum, dark, by| sum + by * dark);
    (0..SIDE * SIDE).flat_map(|i| (2.0 * (Vec4::ONE - pixel(i)) - Vec4::ONE).truncate().to_array()).collect()
}

fn colour(rgb: &[f32]) -> glam::Vec3 {
    0.5 * glam::Vec3::from_slice(rgb).clamp(glam::Vec3::NEG_ONE, glam::Vec3::ONE) + 0.5
}

/// Where a cell of a turned square lies in the square as it was, in cells from the middle of the first.
fn turned(side: usize, roll: f32) -> impl Fn(usize) -> [f32; 2] {
    let (sin, cos) = roll.sin_cos();
    let middle = 0.5 * (side - 1) as f32;
    move |i| {
        let [x, y] = [(i % side) as f32 - middle, (i / side) as f32 - middle];
        [cos * x - sin * y + middle, sin * x + cos * y + middle]
    }
}

/// What is between the cells of a square; nothing beside it.
fn between<T: Default>(side: usize, at: [f32; 2], cell: impl Fn(usize) -> T, add: impl Fn(T, T, f32) -> T) -> T {
    let (first, part) = (at.map(f32::floor), at.map(|at| at - at.floor()));
    let mut sum = T::default();
    for [right, below] in [[0, 0], [1, 0], [0, 1], [1, 1]] {
        let [x, y] = [first[0] as i64 + right, first[1] as i64 + below];
        let share = |step: i64, part: f32| if step == 0 { 1.0 - part } else { part };
        if (0..side as i64).contains(&x) && (0..side as i64).contains(&y) {
            sum = add(sum, cell(y as usize * side + x as usize), share(right, part[0]) * share(below, part[1]));
        }
    }
    sum
}

/// The cells of [`SIDE`] at most so far away across and down; `None` beyond the edge.
pub(super) fn near(i: usize, reach: usize) -> impl Iterator<Item = Option<usize>> {
    let (at, reach) = ([i % SIDE, i / SIDE].map(|at| at as i64), reach as i64);
    let cell = move |dx: i64, dy: i64| {
        let [x, y] = [at[0] + dx, at[1] + dy].map(|at| usize::try_from(at).ok().filter(|at| *at < SIDE));
        Some(y? * SIDE + x?)
    };
    (-reach..=reach).flat_map(move |dy| (-reach..=reach).map(move |dx| cell(dx, dy)))
}

/// Sums over all that is near.
fn blurred(values: &[Vec4]) -> Vec<Vec4> {
    let (side, reach) = (SIDE, REACH);
    let along = |values: &[Vec4], step: usize, place: fn(usize) -> usize| -> Vec<Vec4> {
        let sum = |i: usize| {
            let at = place(i);
            (at.saturating_sub(reach)..=(at + reach).min(side - 1)).map(|other| values[i + other * step - at * step]).sum()
        };
        (0..values.len()).map(sum).collect()
    };
    along(&along(values, 1, |i| i % SIDE), SIDE, |i| i / SIDE)
}

/// What an object looks like from all around.
pub(super) struct Templates {
    /// From each side.
    pub views: Vec<Template>,
    /// Of each view, in each roll: in a quarter and half as many cells.
    pub rolled: Vec<[Template; 2]>,
}

impl Templates {
    /// Of views of [`SIDE`] pixels, colours in [-1, 1].
    pub fn of(views: &[Vec<f32>], own: Own) -> Self {
        let views: Vec<Template> = views.iter().map(|rgb| Template::of(rgb, own)).collect();
        let rolled = |number: usize| {
            let half = views[number / ROLLS].rolled(roll(number)).halved();
            [half.halved(), half]
        };
        let rolled = (0..views.len() * ROLLS).into_par_iter().map(rolled).collect();
        Templates { views, rolled }
    }
}

/// In radians, that of a template by its number among [`Templates::rolled`].
pub(super) fn roll(number: usize) -> f32 {
    (number % ROLLS) as f32 * ROLL
}
