//! What is in sight of an object that something may hide a part of, by a box around it: template matching over sides, rolls, sizes and places at which an object reaches from edge to edge of the box. What speaks for
//! one is summed over the box: cells that it explains, less what is hidden in the box and beyond.

use glam::{Vec3, Vec4};
use rayon::prelude::*;

use super::looked::{BETTER, Looked, MOST, Match, Mean, Seen, best, lit_as, off};
use super::template::{ROLL, SIDE, Template, Templates, WIDER, near, roll};

/// Sizes that are tried, each so many times the one before; the first just fills the box.
const SIZES: i32 = 5;
const LARGER: f32 = 1.12;
/// Where it is larger than the box by more than this part of it, it is tried at these places, as parts of how much larger it is.
const LOOSE: f32 = 0.06;
const PLACES: [f32; 4] = [0.0, 0.33, 0.67, 1.0];
/// Of each template so many go on, and so many of all.
const OF_TEMPLATE: usize = 2;
const BEST: usize = 600;
/// What is in sight reaches out of its box by at most this part of its longer side.
const SLACK: f32 = 0.03;
/// How bright the object is tried to be lit, beside what least squares say, which go by what hides it, too.
const LIGHTS: [f32; 3] = [0.8, 1.0, 1.25];
/// What a cell costs that is hidden in the box, more where less surprises than the second; what one beyond costs; and what counts that surroundings differ.
const HIDDEN: f32 = 0.5;
const SURPRISES: f32 = 1.0;
const BEYOND: f32 = 0.5;
const AROUND: f32 = 0.2;
/// A cell of a template that has more than this of an object is a part of it.
const OWN: f32 = 0.3;
/// Where all channels are at least this (of [0, 1]) a view shows background, or its edge.
const WHITE: f32 = 0.9;

/// A box around what is in sight of an object, in pixels of the picture that is looked at.
pub(super) struct InSight {
    first: [f32; 2],
    size: [f32; 2],
}

impl InSight {
    /// By corner and size in the photograph, of which the picture is so many times as fine.
    pub fn of(corner: [f64; 2], size: [f64; 2], finer: f64) -> Self {
        let [first, size] = [corner, size].map(|of| of.map(|pixels| (finer * pixels) as f32));
        InSight { first, size }
    }

    fn slack(&self) -> f32 {
        SLACK * self.size[0].max(self.size[1])
    }

    fn has(&self, at: [f32; 2]) -> bool {
        (0..2).all(|k| (-self.slack()..=self.size[k] + self.slack()).contains(&(at[k] - self.first[k])))
    }

    fn area(&self) -> f32 {
        self.size[0] * self.size[1]
    }

    /// Where a template may be found whose object has these first and last places, 0 to 1 across and down.
    fn places(&self, [first, last]: [[f32; 2]; 2], template: usize) -> Vec<Match> {
        let extent = [0, 1].map(|k| last[k] - first[k]);
        let fills = (0..2).map(|k| self.size[k] / extent[k]).fold(0.0, f32::max);
        let at_size = |wide: f32| {
            // How much longer than the box the object is, and so how much of it may lie before the box.
            let before = [0, 1].map(|k| {
                let longer = wide * extent[k] - self.size[k];
                let parts: &[f32] = if longer < LOOSE * self.size[k] { &[0.5] } else { &PLACES };
                parts.iter().map(move |part| part * longer)
            });
            let [across, down] = before;
            let at = move |before: [f32; 2]| {
                let middle = [0, 1].map(|k| self.first[k] - before[k] + wide * (0.5 - first[k]));
                Match { middle, diagonal: wide / WIDER as f32, template, roll: roll(template), evidence: 0.0 }
            };
            across.flat_map(move |x| down.clone().map(move |y| at([x, y])))
        };
        (0..SIZES).flat_map(|size| at_size(fills * LARGER.powi(size))).collect()
    }
}

/// First and last place of a template's object, 0 to 1 across and down.
fn ends(template: &Template) -> Option<[[f32; 2]; 2]> {
    let own = template.cells.iter().enumerate().filter(|(_, cell)| cell.own.w > OWN);
    let cells = own.map(|(i, _)| [i % template.side, i / template.side].map(|at| at as f32));
    let around = |ends: Option<[[f32; 2]; 2]>, cell: [f32; 2]| {
        let [first, last] = ends.unwrap_or([cell; 2]);
        Some([[0, 1].map(|k| first[k].min(cell[k])), [0, 1].map(|k| last[k].max(cell[k] + 1.0))])
    };
    let [first, last] = cells.fold(None, around)?;
    // By as much as this sticks out more are sighted than where nothing does (`docs/tried.md`).
    let rim = 0.5 / SIDE as f32;
    let part = |at: f32| at / template.side as f32;
    Some([first.map(|at| part(at) - rim), last.map(|at| part(at) + rim)])
}

/// What a cell costs that is unlike the object, by how surprising its colour is: what hides an object is rarer in the picture than the ground is.
fn cost(surprise: f32) -> f32 {
    HIDDEN + (SURPRISES - surprise).max(0.0)
}

impl Looked {
    /// The most likely ones that reach from edge to edge of the box, the likeliest first.
    pub(super) fn matches_in_sight(&self, in_sight: &InSight, templates: &Templates) -> Vec<Match> {
        let half = |found: &Match| &templates.rolled[found.template][1];
        let of = |(template, [_, half]): (usize, &[Template; 2])| {
            let places = ends(half).map_or(vec![], |ends| in_sight.places(ends, template));
            best(places.into_iter().map(|found| self.judged(found, half)).collect(), OF_TEMPLATE)
        };
        let first: Vec<Match> = templates.rolled.par_iter().enumerate().flat_map_iter(of).collect();
        let better = best(first, BEST).into_par_iter().map(|found| self.nearby(found, half(&found), 0.05)).collect();
        let finest = self.finer(best(better, BETTER), templates, 0.03, ROLL / 3.0);
        best(self.finer(finest, templates, 0.015, ROLL / 6.0), BETTER)
    }

    /// What speaks for a template, and how bright it is lit by that.
    pub(super) fn judged_in_sight(&self, in_sight: &InSight, found: Match, template: &Template) -> (f32, f32) {
        let cells = self.cells(&found, template.side);
        let (mut own, mut around, mut beyond) = (Vec::new(), Vec::new(), 0.0);
        for (i, cell) in template.cells.iter().enumerate().filter(|(_, cell)| cell.own.w > 0.0 || cell.around.w > 0.0) {
            let place = cells.place(i);
            let seen = if in_sight.has(place) { cells.seen(place) } else { Seen::Outside };
            match seen {
                Seen::Pixel(seen) => {
                    own.extend((cell.own.w > 0.0).then_some((seen, cell.own)));
                    around.extend((cell.around.w > 0.0).then_some((seen, cell.around)));
                }
                Seen::Outside | Seen::Other => beyond += cell.own.w,
            }
        }
        let sum = |lit: f32| {
            let cell = |(seen, own): &(Vec4, Vec4)| own.w * (seen.w - off(seen, lit, own.truncate() / own.w)).max(-cost(seen.w));
            own.iter().map(cell).sum::<f32>()
        };
        let lights = LIGHTS.into_iter().chain([lit_as(own.iter().map(|(seen, own)| (seen, own)))]);
        let (lit, sum) = lights.map(|lit| (lit, sum(lit))).max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((1.0, 0.0));
        let mut of_around = Mean { weight: 1.0, ..Mean::default() };
        for (seen, around) in &around {
            of_around.add(around.w, || off(seen, lit, around.truncate() / around.w).min(MOST));
        }
        let evidence = (sum - BEYOND * beyond) * cells.pitch * cells.pitch / in_sight.area() + AROUND * of_around.mean();
        (evidence, lit)
    }

    /// Whether each cell of a view of [`SIDE`] pixels is seen where it was found.
    pub(super) fn likeness(&self, found: Match, view: &[f32]) -> Vec<bool> {
        let template = Template::of(view, self.own());
        let lit = self.in_sight.as_ref().map_or(1.0, |in_sight| self.judged_in_sight(in_sight, found, &template).1);
        let cells = self.cells(&found, SIDE);
        let colour = |i: usize| 0.5 * Vec3::from_slice(&view[3 * i..]) + 0.5;
        let is_object: Vec<bool> = (0..SIDE * SIDE).map(|i| colour(i).min_element() < WHITE).collect();
        let objects = |i: usize| near(i, 1).flatten().filter(|&i| is_object[i]);
        // An edge may be a cell off.
        let odds = |i: usize| match cells.seen(cells.place(i)) {
            Seen::Pixel(seen) => {
                let least = objects(i).map(|near| off(&seen, lit, colour(near))).fold(f32::INFINITY, f32::min);
                (seen.w - least).clamp(-MOST, MOST)
            }
            Seen::Outside | Seen::Other => -MOST,
        };
        let odds: Vec<f32> = (0..SIDE * SIDE).map(odds).collect();
        (0..SIDE * SIDE).map(|i| objects(i).map(|near| odds[near]).sum::<f32>() > 0.0).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::looked::tests::{object, picture, view};
    use super::super::template::{Own, ROLLS};
    use super::*;

    /// Of an object of which nearly half is behind something grey, by a box around the rest.
    #[test]
    fn what_is_in_sight_tells_where_the_object_is() {
        let templates = Templates::of(&[view(|at| object(at).map(|_| [0.7, -0.8, -0.6])), view(object)], Own::All);
        let (middle, diagonal) = ([120.0, 90.0], 50.0);
        let mut hidden = picture(middle, diagonal, 0.0);
        let is_hidden = |i: usize| (i % hidden.width) as f64 > middle[0] + 3.0;
        let hides: Vec<usize> = (0..hidden.data.len()).filter(|k| is_hidden(k / 3)).collect();
        hides.into_iter().for_each(|k| hidden.data[k] = -0.05);
        // The half disc is 50 pixels wide, and reaches from 5 above the middle to 25 below it.
        let in_sight = InSight::of([95.0, 85.0], [28.0, 30.0], 1.0);
        let looked = Looked::at(hidden, None, Some(in_sight));
        let found = looked.matches(&templates)[0];
        let off = [0, 1].map(|k| f64::from(found.middle[k]) - middle[k]);
        let larger = f64::from(found.diagonal) / diagonal;
        assert!(found.template / ROLLS == 1, "{}", found.template);
        assert!(off[0].hypot(off[1]) < 0.12 * diagonal && (0.85..1.15).contains(&larger), "{off:?} {larger}");
        // Nor does more speak for a larger one, or a smaller one, which have more of it or less.
        let right = Match { middle: middle.map(|at| at as f32), diagonal: diagonal as f32, ..found };
        let evidence = |larger: f32| {
            let found = Match { diagonal: larger * right.diagonal, ..right };
            looked.judged(found, &Template::of(&view(object), looked.own())).evidence
        };
        assert!([0.9, 1.1].iter().all(|&larger| evidence(larger) < evidence(1.0)), "{:?}", [0.9, 1.0, 1.1].map(evidence));
        // The left of it looks like the object, the right does not.
        let like = looked.likeness(right, &view(object));
        let cells = |columns: std::ops::Range<usize>| (16..22).flat_map(move |row| columns.clone().map(move |x| row * SIDE + x));
        assert!(cells(8..14).all(|i| like[i]) && !cells(20..26).any(|i| like[i]), "{like:?}");
    }
}
