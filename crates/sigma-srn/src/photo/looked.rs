//! A picture as it is looked at for an object. What is looked for is a thing whose colours are rare in the picture and are the object's, cell by cell, up to how bright it is lit, and are not those around it.

use std::f32::consts::TAU;
use std::iter::zip;

use glam::{Vec3, Vec4, Vec4Swizzles};
use rayon::prelude::*;
use srn_photo::{Pixels, Place};
use srn_shaders::LinearParams;

use super::in_sight::InSight;
use super::sightings::FINEST;
use super::template::{Cell, Own, ROLL, ROLLS, Template, Templates, WIDER, roll};

/// The smallest and the largest diagonals that are looked for, in longer and in shorter sides of the picture; and by which factor they grow.
const SMALLEST: f64 = 0.09375;
const LARGEST: f64 = 1.2;
const STEP: f64 = 1.19;

/// Deviation of a colour of the object from the model's, of [0, 1].
const NOISE: f32 = 0.08;
/// How many times as bright an object may be lit.
const LIT: [f32; 2] = [0.7, 1.4];
/// Logarithms of odds of a colour are no larger, those of the object's cells no less than the second, and what says that its surroundings differ is no more than that.
const SUREST: f32 = 5.0;
pub(super) const MOST: f32 = 4.0;
/// Logarithm of the odds beyond the picture's edge.
const OUTSIDE: f32 = -2.0;
/// A larger thing is less likely to look like the object by chance: the power of its area that counts.
const AREA: f32 = 0.15;

/// How many are left after each look: of each size, of all, and of these moved a little.
const OF_SIZE: usize = 900;
const BEST: usize = 500;
pub(super) const BETTER: usize = 200;
/// Templates at a place that go on.
const AT_PLACE: usize = 3;
/// By this part of its diagonal an object is moved that is looked at from another side.
const MOVED: f32 = 0.03;

/// Where a template fits.
#[derive(Clone, Copy)]
pub(super) struct Match {
    /// Of the view, in pixels of the picture that is looked at.
    pub middle: [f32; 2],
    /// The object's diagonal there.
    pub diagonal: f32,
    /// The view's number times [`ROLLS`], and its roll among these, and in radians.
    pub template: usize,
    pub roll: f32,
    /// How much speaks for it.
    pub evidence: f32,
}

/// A picture as it is looked at.
pub(super) struct Looked {
    /// Each half as fine as the one before; the colours of a pixel in [0, 1], and how surprising they are.
    levels: Vec<Level>,
    /// Where all that is in sight of the object is, if that is known.
    pub in_sight: Option<InSight>,
}

struct Level {
    width: usize,
    height: usize,
    pixels: Vec<Vec4>,
    /// How much of each pixel is another object; empty where there is none.
    others: Vec<f32>,
}

/// What a cell of a template sees.
pub(super) enum Seen {
    /// Nothing, beyond the picture's edge.
    Outside,
    /// Another object, which may hide the one that is looked for.
    Other,
    /// A colour in [0, 1], and how surprising that is.
    Pixel(Vec4),
}

impl Looked {
    /// `is_other`: where another object is, before the one that is looked for or behind it.
    pub(super) fn at(picture: Pixels, is_other: Option<Place>, in_sight: Option<InSight>) -> Self {
        let Pixels { width, height, data } = picture;
        let colours: Vec<Vec3> = data.chunks_exact(3).map(|c| 0.5 * Vec3::from_slice(c) + 0.5).collect();
        let pixels = zip(&colours, surprises(&colours)).map(|(colour, surprise)| colour.extend(surprise)).collect();
        let place = |i: usize| [i % width, i / width].map(|at| at as f64 + 0.5);
        let others = |is_other: Place| (0..colours.len()).map(|i| f32::from(u8::from(is_other(place(i))))).collect();
        let mut levels = vec![Level { width, height, pixels, others: is_other.map_or(vec![], others) }];
        while let Some(last) = levels.last().filter(|last| last.width.min(last.height) >= 16) {
            levels.push(last.resampled(last.width / 2, last.height / 2));
        }
        Looked { levels, in_sight }
    }

    /// What of an object is compared with the picture. Where what is in sight of it is summed, a larger one would have more of its edge.
    pub(super) fn own(&self) -> Own {
        if self.in_sight.is_some() { Own::All } else { Own::Inner }
    }

    /// The most likely ones, the likeliest first.
    pub(super) fn matches(&self, templates: &Templates) -> Vec<Match> {
        if let Some(in_sight) = &self.in_sight {
            return self.matches_in_sight(in_sight, templates);
        }
        let matrices = Matrices::of(&templates.rolled);
        let [width, height] = [self.levels[0].width, self.levels[0].height].map(|side| side as f64);
        let largest = LARGEST * width.min(height);
        let sizes = std::iter::successors(Some(SMALLEST * width.max(height)), |size| Some(size * STEP))
            .take_while(|size| *size <= largest);
        let first: Vec<Match> = sizes.flat_map(|size| matrices.everywhere(&self.levels[0], size)).collect();
        let half = |found: &Match| &templates.rolled[found.template][1];
        let first = best(first.into_par_iter().map(|found| self.judged(found, half(&found))).collect(), BEST);
        let better = first.into_par_iter().map(|found| self.nearby(found, half(&found), 0.06)).collect();
        let finest = self.finer(best(better, BETTER), templates, 0.03, ROLL / 3.0);
        best(self.finer(finest, templates, 0.015, ROLL / 6.0), BETTER)
    }

    /// The most likely ones at a place, by every template, the likeliest first.
    pub(super) fn all_around(&self, place: Match, templates: &Templates) -> Vec<Match> {
        let of = |(template, [_, half]): (usize, &[Template; 2])| {
            self.settled(Match { template, roll: roll(template), ..place }, half)
        };
        let all = templates.rolled.par_iter().enumerate().map(of).collect();
        best(self.finer(best(all, BETTER), templates, MOVED, ROLL / 3.0), BETTER)
    }

    /// The likeliest of each and what is next to it, by so much of the diagonal, and turned by so many radians.
    pub(super) fn finer(&self, found: Vec<Match>, templates: &Templates, step: f32, turn: f32) -> Vec<Match> {
        let turned = |found: Match, turn: f32| {
            let found = Match { roll: found.roll + turn, ..found };
            self.nearby(found, &templates.views[found.template / ROLLS].rolled(found.roll), step)
        };
        let of = |found: Match| [turned(found, -turn), turned(found, turn)].into_iter().fold(turned(found, 0.0), Match::or);
        found.into_par_iter().map(of).collect()
    }

    /// The likeliest of what is there, moved by a part of the diagonal, and so much larger and smaller.
    pub(super) fn nearby(&self, found: Match, template: &Template, step: f32) -> Match {
        let tried = found.nearby(step).map(|found| self.judged(found, template));
        tried.max_by(|a, b| a.evidence.total_cmp(&b.evidence)).unwrap_or(found)
    }

    /// Those of a view of so many cells to a side, where it was found.
    pub(super) fn cells(&self, Match { middle, diagonal, .. }: &Match, side: usize) -> Cells<'_> {
        let wide = WIDER as f32 * diagonal;
        let pitch = wide / side as f32;
        let level = (pitch / 1.4).log2().round().clamp(0.0, (self.levels.len() - 1) as f32) as usize;
        let corner = middle.map(|at| at - 0.5 * wide);
        Cells { level: &self.levels[level], fine: 0.5f32.powi(level as i32), side, corner, pitch }
    }

    /// Moved for as long as more speaks for it, some steps at most.
    pub(super) fn settled(&self, found: Match, template: &Template) -> Match {
        const STEPS: usize = 8;
        let mut best = self.judged(found, template);
        for _ in 0..STEPS {
            let nearby = self.nearby(best, template, MOVED);
            if nearby.evidence <= best.evidence {
                break;
            }
            best = nearby;
        }
        best
    }

    /// With what speaks for it, by this template.
    pub(super) fn judged(&self, found: Match, template: &Template) -> Match {
        if let Some(in_sight) = &self.in_sight {
            let (evidence, _) = self.judged_in_sight(in_sight, found, template);
            return Match { evidence, ..found };
        }
        let cells = self.cells(&found, template.side);
        let seen = |(i, Cell { own, around }): (usize, &Cell)| {
            let is_needed = own.w > 0.0 || around.w > 0.0;
            if is_needed { cells.seen(cells.place(i)) } else { Seen::Outside }
        };
        let seen: Vec<Seen> = template.cells.iter().enumerate().map(seen).collect();
        let each = || zip(&seen, &template.cells);
        let own =
            each().filter_map(|(seen, Cell { own, .. })| if let Seen::Pixel(seen) = seen { Some((seen, own)) } else { None });
        let lit = lit_as(own);
        let off = |seen: &Vec4, cell: &Vec4| off(seen, lit, cell.xyz() / cell.w);
        let (mut of_own, mut of_around) = (Mean::default(), Mean { weight: 1.0, ..Mean::default() });
        for (seen, Cell { own, around }) in each() {
            match seen {
                // It is as if an object had no more than is in sight.
                Seen::Other => {}
                Seen::Outside => of_own.add(own.w, || OUTSIDE),
                Seen::Pixel(seen) => {
                    of_own.add(own.w, || (seen.w - off(seen, own)).max(-MOST));
                    of_around.add(around.w, || off(seen, around).min(MOST));
                }
            }
        }
        // As if pictures were all as large.
        let side = cells.pitch * FINEST as f32 / self.levels[0].width.max(self.levels[0].height) as f32;
        let evidence = (of_own.mean() + of_around.mean()) * (of_own.weight * side * side).powf(AREA);
        Match { evidence, ..found }
    }
}

/// The same by cells of a template, and what they see.
pub(super) fn lit_as<'s>(cells: impl Iterator<Item = (&'s Vec4, &'s Vec4)>) -> f32 {
    let (both, square) = cells.filter(|(_, own)| own.w > 0.0).fold((0.0, 0.0), |(both, square), (seen, own)| {
        (both + seen.xyz().dot(own.xyz()), square + own.xyz().length_squared() / own.w)
    });
    lit(both, square)
}

/// How unlike a colour of the object, lit so, what is seen is: the logarithm of the odds that it costs.
pub(super) fn off(seen: &Vec4, lit: f32, own: Vec3) -> f32 {
    (seen.xyz() - lit * own).length_squared() / (2.0 * NOISE * NOISE)
}

/// How bright the object is lit, by least squares.
fn lit(both: f32, square: f32) -> f32 {
    (both / square.max(1e-6)).clamp(LIT[0], LIT[1])
}

/// A square of cells in the picture that is looked at, and how fine it is looked at there.
pub(super) struct Cells<'a> {
    level: &'a Level,
    /// So many pixels of the level are one of the picture.
    fine: f32,
    side: usize,
    /// Edge of the first cell, and the pixels of one, in the picture.
    corner: [f32; 2],
    pub pitch: f32,
}

impl Cells<'_> {
    /// The middle of a cell.
    pub fn place(&self, cell: usize) -> [f32; 2] {
        let at = [cell % self.side, cell / self.side];
        [0, 1].map(|k| self.corner[k] + (at[k] as f32 + 0.5) * self.pitch)
    }

    /// What is at a place of the picture.
    pub fn seen(&self, place: [f32; 2]) -> Seen {
        self.level.at(place.map(|at| at * self.fine))
    }
}

#[derive(Default)]
pub(super) struct Mean {
    pub sum: f32,
    pub weight: f32,
}

impl Mean {
    pub(super) fn add(&mut self, weight: f32, value: impl FnOnce() -> f32) {
        if weight > 0.0 {
            (self.sum, self.weight) = (self.sum + weight * value(), self.weight + weight);
        }
    }

    pub(super) fn mean(&self) -> f32 {
        self.sum / self.weight.max(1e-6)
    }
}

impl Match {
    /// As it is, moved by a part of the diagonal, and so much larger and smaller.
    fn nearby(self, step: f32) -> impl Iterator<Item = Self> {
        let offs = move |k: usize| [k % 3, k / 3 % 3, k / 9].map(|k| (k as f32 - 1.0) * step);
        (0..27).map(offs).map(move |[x, y, larger]| {
            let diagonal = self.diagonal * (1.0 + 1.4 * larger);
            Match { middle: [self.middle[0] + x * diagonal, self.middle[1] + y * diagonal], diagonal, ..self }
        })
    }

    /// The one for which more speaks.
    fn or(self, other: Self) -> Self {
        if other.evidence > self.evidence { other } else { self }
    }
}

/// Those for which the most speaks, in that order.
pub(super) fn best(mut sightings: Vec<Match>, most: usize) -> Vec<Match> {
    sightings.sort_by(|a, b| b.evidence.total_cmp(&a.evidence));
    sightings.truncate(most);
    sightings
}

/// The logarithm of the density of the model's colour itself.
fn sharpness() -> f32 {
    -1.5 * (TAU * NOISE * NOISE).ln()
}

/// How surprising each colour is: by how much the model's colours are denser where they are than the picture's own. Logarithms.
fn surprises(colours: &[Vec3]) -> Vec<f32> {
    const BINS: usize = 16;
    /// Density that every colour has, where it is 1 in the mean.
    const ANY: f32 = 0.05;
    let bin = |colour: &Vec3| colour.to_array().map(|c| ((c * BINS as f32) as usize).min(BINS - 1));
    let number = |[r, g, b]: [usize; 3]| (r * BINS + g) * BINS + b;
    let mut counts = vec![0.0f32; BINS.pow(3)];
    colours.iter().for_each(|colour| counts[number(bin(colour))] += 1.0);
    for step in [1, BINS, BINS * BINS] {
        let smooth = |i: usize| {
            let at = i / step % BINS;
            let (before, after) = (if at > 0 { i - step } else { i }, if at + 1 < BINS { i + step } else { i });
            0.25 * counts[before] + 0.5 * counts[i] + 0.25 * counts[after]
        };
        counts = (0..counts.len()).map(smooth).collect();
    }
    let dense = BINS.pow(3) as f32 / colours.len() as f32;
    let surprise = |colour: &Vec3| (sharpness() - (dense * counts[number(bin(colour))] + ANY).ln()).clamp(-SUREST, SUREST);
    colours.iter().map(surprise).collect()
}

impl Level {
    /// By the means of areas.
    fn resampled(&self, width: usize, height: usize) -> Level {
        let channels = |of: fn(&Vec4) -> Vec3| {
            let data = self.pixels.iter().flat_map(|pixel| of(pixel).to_array()).collect();
            Pixels { width: self.width, height: self.height, data }.area_resample(width, height).data
        };
        let (colours, surprises) = (channels(|pixel| pixel.xyz()), channels(|pixel| Vec3::splat(pixel.w)));
        let pixel = |(colour, surprise): (&[f32], &[f32])| Vec3::from_slice(colour).extend(surprise[0]);
        let pixels = zip(colours.chunks_exact(3), surprises.chunks_exact(3)).map(pixel).collect();
        let others = if self.others.is_empty() {
            vec![]
        } else {
            let data = self.others.iter().flat_map(|&other| [other; 3]).collect();
            let others = Pixels { width: self.width, height: self.height, data }.area_resample(width, height);
            others.data.into_iter().step_by(3).collect()
        };
        Level { width, height, pixels, others }
    }

    /// Whether a pixel is another object's.
    fn is_other(&self, x: usize, y: usize) -> bool {
        self.others.get(y * self.width + x).is_some_and(|&other| other > 0.5)
    }

    /// What is at a place, in pixels from the edge, between pixels.
    fn at(&self, place: [f32; 2]) -> Seen {
        let ends = [self.width, self.height];
        if (0..2).any(|k| !(0.0..ends[k] as f32).contains(&place[k])) {
            return Seen::Outside;
        }
        if self.is_other(place[0] as usize, place[1] as usize) {
            return Seen::Other;
        }
        let at = [0, 1].map(|k| (place[k] - 0.5).clamp(0.0, (ends[k] - 1) as f32));
        let ([x, y], [right, below]) = (at.map(|at| at as usize), at.map(f32::fract));
        let pixel = |x: usize, y: usize| self.pixels[y.min(self.height - 1) * self.width + x.min(self.width - 1)];
        let row = |y: usize| pixel(x, y).lerp(pixel(x + 1, y), right);
        Seen::Pixel(row(y).lerp(row(y + 1), below))
    }

    /// With so many pixels more on each side: colours as they are at the edge, which speak against an object, as those of others do.
    fn padded(&self, by: usize) -> Level {
        let [width, height] = [self.width, self.height].map(|side| side + 2 * by);
        let pixel = |i: usize| {
            let at = [i % width, i / width];
            let [x, y] = [0, 1].map(|k| at[k].saturating_sub(by).min([self.width, self.height][k] - 1));
            let is_inside = [x + by, y + by] == at && !self.is_other(x, y);
            let pixel = self.pixels[y * self.width + x];
            if is_inside { pixel } else { pixel.xyz().extend(OUTSIDE) }
        };
        Level { width, height, pixels: (0..width * height).map(pixel).collect(), others: vec![] }
    }
}

/// All templates in the fewest cells, as matrices: `[templates, cells]` and `[templates, cells · 3]`, each with as many zeros, for it is the weights of a linear layer.
struct Matrices {
    side: usize,
    count: usize,
    own: Vec<f32>,
    own_colours: Vec<f32>,
    around: Vec<f32>,
    around_colours: Vec<f32>,
    /// Of each template: how many cells are its own, and the sum of the squares of their colours; the same of what is around it.
    sums: Vec<[[f32; 2]; 2]>,
}

impl Matrices {
    fn of(templates: &[[Template; 2]]) -> Self {
        let count = templates.len();
        let matrix = |of: &dyn Fn(&Cell) -> Vec<f32>| -> Vec<f32> {
            let rows: Vec<f32> = templates.iter().flat_map(|[coarse, _]| coarse.cells.iter().flat_map(of)).collect();
            rows.into_iter().chain(std::iter::repeat_n(0.0, count)).collect()
        };
        let sums = |[coarse, _]: &[Template; 2]| {
            let sum = |part: fn(&Cell) -> Vec4| {
                let cells = coarse.cells.iter().map(part).filter(|part| part.w > 0.0);
                cells.fold([0.0; 2], |[share, square], part| [share + part.w, square + part.xyz().length_squared() / part.w])
            };
            [sum(|cell| cell.own), sum(|cell| cell.around)]
        };
        Matrices {
            side: templates[0][0].side,
            count,
            own: matrix(&|cell| vec![cell.own.w]),
            own_colours: matrix(&|cell| cell.own.xyz().to_array().into()),
            around: matrix(&|cell| vec![cell.around.w]),
            around_colours: matrix(&|cell| cell.around.xyz().to_array().into()),
            sums: templates.iter().map(sums).collect(),
        }
    }

    /// The best sightings of one size, with the view's middle on a grid of cells.
    fn everywhere(&self, picture: &Level, diagonal: f64) -> Vec<Match> {
        let (side, cell) = (self.side, WIDER * diagonal / self.side as f64);
        let cells = [picture.width, picture.height].map(|pixels| (pixels as f64 / cell).round() as usize);
        if cells[0].min(cells[1]) < side / 2 {
            return vec![];
        }
        let padding = side / 4;
        let padded = picture.resampled(cells[0], cells[1]).padded(padding);
        let [columns, rows] = [padded.width, padded.height].map(|cells| cells + 1 - side);
        let row = |y: usize| {
            let found = self.row(&padded, y, columns);
            found.map(move |(x, template, evidence)| {
                let middle = |at: usize, pixels: usize, cells: usize| {
                    (at as f32 + 0.5 * side as f32 - padding as f32) * pixels as f32 / cells as f32
                };
                let middle = [middle(x, picture.width, cells[0]), middle(y, picture.height, cells[1])];
                Match { middle, diagonal: diagonal as f32, template, roll: roll(template), evidence }
            })
        };
        best((0..rows).into_par_iter().flat_map_iter(row).collect(), OF_SIZE)
    }

    /// Of each place in a row the templates for which the most speaks, by number, and how much.
    fn row(&self, picture: &Level, y: usize, columns: usize) -> impl Iterator<Item = (usize, usize, f32)> + use<> {
        let side = self.side;
        let patch = |x: usize| (0..side * side).map(move |i| picture.pixels[(y + i / side) * picture.width + x + i % side]);
        let all = || (0..columns).flat_map(patch);
        let twice = 2.0 * NOISE * NOISE;
        let square = |pixel: &Vec4| pixel.xyz().length_squared() / twice;
        let colours: Vec<f32> = all().flat_map(|pixel| pixel.xyz().to_array()).collect();
        let odds: Vec<f32> = all().map(|pixel| pixel.w - square(&pixel)).collect();
        let squares: Vec<f32> = all().map(|pixel| square(&pixel)).collect();
        let product = |x: &[f32], weights: &[f32]| {
            let mut y = vec![0.0f32; columns * self.count];
            let p = LinearParams {
                groups: 1,
                rows_per_group: columns as u32,
                in_features: (x.len() / columns) as u32,
                out_features: self.count as u32,
                ..LinearParams::default()
            };
            srn_cpu::ops::linear::forward(p, x, weights, &[], &mut y);
            y
        };
        let own = zip(product(&odds, &self.own), product(&colours, &self.own_colours));
        let around = zip(product(&squares, &self.around), product(&colours, &self.around_colours));
        let sums = self.sums.iter().cycle();
        let evidence = zip(zip(own, around), sums).map(|(((odds, both), (square, other)), [own, around])| {
            let lit = lit(both, own[1]);
            let of_own = (odds + (2.0 * lit * both - lit * lit * own[1]) / twice) / own[0].max(1e-3);
            let of_around = (square + (lit * lit * around[1] - 2.0 * lit * other) / twice) / around[0].max(1e-3);
            of_own + of_around.clamp(0.0, MOST)
        });
        let evidence: Vec<f32> = evidence.collect();
        let at_place = |(x, evidence): (usize, &[f32])| {
            let mut best = [(0, f32::NEG_INFINITY); AT_PLACE];
            for (template, &evidence) in evidence.iter().enumerate() {
                if evidence > best[AT_PLACE - 1].1 {
                    best[AT_PLACE - 1] = (template, evidence);
                    best.sort_by(|a, b| b.1.total_cmp(&a.1));
                }
            }
            best.map(|(template, evidence)| (x, template, evidence))
        };
        evidence.chunks_exact(self.count).enumerate().flat_map(at_place).collect::<Vec<_>>().into_iter()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::template::SIDE;
    use super::*;

    const SIDE_OF_PICTURE: [usize; 2] = [200, 150];

    /// A half disc of two colours, of which the view shows [`WIDER`] times as much as it is wide.
    pub fn object(at: [f64; 2]) -> Option<[f32; 3]> {
        let is_object = at[0].hypot(at[1]) < 0.5 && at[1] > -0.1;
        is_object.then_some(if at[0] < 0.0 { [0.7, -0.8, -0.6] } else { [-0.8, -0.6, 0.8] })
    }

    pub fn view(of: impl Fn([f64; 2]) -> Option<[f32; 3]>) -> Vec<f32> {
        let at = |i: usize| [i % SIDE, i / SIDE].map(|k| ((k as f64 + 0.5) / SIDE as f64 - 0.5) * WIDER);
        (0..SIDE * SIDE).flat_map(|i| of(at(i)).unwrap_or([1.0; 3])).collect()
    }

    /// Grey squares, and the object so wide, turned, and lit less; beside it a thing of one of its colours.
    pub fn picture(middle: [f64; 2], diagonal: f64, turn: f64) -> Pixels {
        let [width, height] = SIDE_OF_PICTURE;
        let colour = |i: usize| {
            let [x, y] = [i % width, i / width];
            let off = [x as f64 + 0.5 - middle[0], y as f64 + 0.5 - middle[1]].map(|off| off / diagonal);
            let (sin, cos) = turn.sin_cos();
            let grey = if (x / 13 + y / 13).is_multiple_of(2) { -0.2 } else { 0.1 };
            let noise = [0.04, -0.06, 0.02, 0.0, -0.03][(3 * x + 7 * y) % 5];
            let darker = |colour: f32| 0.85 * (colour + 1.0) - 1.0;
            let other = ((8..60).contains(&x) && (8..40).contains(&y)).then_some([0.7, -0.8, -0.6]);
            let object = object([cos * off[0] - sin * off[1], sin * off[0] + cos * off[1]]).map(|colour| colour.map(darker));
            object.or(other).unwrap_or([grey; 3]).map(|colour: f32| (colour + noise).clamp(-1.0, 1.0))
        };
        Pixels { width, height, data: (0..width * height).flat_map(colour).collect() }
    }

    #[test]
    fn a_thing_is_found_where_it_is_as_large_and_turned_as_it_is() {
        let of_one_colour = view(|at| object(at).map(|_| [0.7, -0.8, -0.6]));
        let templates = Templates::of(&[of_one_colour, view(object)], Own::Inner);
        for (middle, diagonal, turn) in [([120.0, 90.0], 50.0, 0.4), ([70.0, 100.0], 80.0, 2.9), ([150.0, 60.0], 33.0, -1.5)] {
            let looked = Looked::at(picture(middle, diagonal, turn), None, None);
            let found = looked.matches(&templates)[0];
            // From another side, beside it and larger.
            let other = Match { template: 0, roll: 0.0, diagonal: 1.2 * found.diagonal, ..found };
            let beside = Match { middle: found.middle.map(|at| at + 0.1 * found.diagonal), ..other };
            for found in [found, looked.all_around(beside, &templates)[0]] {
                let off = (0..2).map(|k| (f64::from(found.middle[k]) - middle[k]).abs()).fold(0.0, f64::max);
                let larger = f64::from(found.diagonal) / diagonal;
                let turned = (f64::from(found.roll) - turn).rem_euclid(std::f64::consts::TAU);
                let turned = turned.min(std::f64::consts::TAU - turned);
                assert!(found.template / ROLLS == 1 && off < 0.06 * diagonal, "{middle:?}: {:?}", found.middle);
                assert!((0.9..1.12).contains(&larger) && turned < 0.2, "{middle:?}: {larger} {turned}");
            }
        }
    }

    /// Of an object of which a third is behind something grey, as much speaks for it as for what is left of it, where that is known; else less.
    #[test]
    fn what_hides_an_object_says_nothing() {
        let (middle, diagonal, template) = ([120.0, 90.0], 50.0, Template::of(&view(object), Own::Inner));
        let is_hidden = |at: [f64; 2]| at[0] > middle[0] + 0.1 * diagonal;
        let mut hidden = picture(middle, diagonal, 0.0);
        let hides = |i: usize| is_hidden([i % SIDE_OF_PICTURE[0], i / SIDE_OF_PICTURE[0]].map(|at| at as f64 + 0.5));
        (0..hidden.data.len()).filter(|k| hides(k / 3)).for_each(|k| hidden.data[k] = -0.05);
        let evidence = |picture: Pixels, is_other: Option<Place>| {
            let middle = middle.map(|at| at as f32);
            let at = Match { middle, diagonal: diagonal as f32, template: 0, roll: 0.0, evidence: 0.0 };
            Looked::at(picture, is_other, None).judged(at, &template).evidence
        };
        let all = evidence(picture(middle, diagonal, 0.0), None);
        let [known, unknown] = [Some(&is_hidden as Place), None].map(|is_other| evidence(hidden.clone(), is_other));
        assert!(known > 0.9 * all && unknown < 0.75 * all, "{all} {known} {unknown}");
    }

    #[test]
    fn pictures_of_any_size_and_of_one_colour_have_places_or_none() {
        for [width, height] in [[1, 1], [3, 200], [40, 30]] {
            let pixels = Pixels { width, height, data: vec![0.3; 3 * width * height] };
            let found = Looked::at(pixels, None, None).matches(&Templates::of(&[view(object), view(|_| None)], Own::Inner));
            assert!(found.iter().all(|found| found.evidence.is_finite()), "{width} × {height}");
        }
    }
}
