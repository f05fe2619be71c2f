//! Objects in boxes that something hides a part of, of which nobody knows what it is: from sides from which what is in sight may be seen, and what is not like the object there is hidden.

use glam::DMat4;
use srn_photo::{BoundingBox, Known};

use super::boxed::{Boxed, Outcome, Pass, is_inside, likelier};
use super::{Shot, Sightings};
use crate::camera::pose_error;
use crate::confidence::ELSEWHERE_DEG;
use crate::{Doubt, Error, Found};

/// So many sides are tried in half as many pixels, and so many poses that the best of these led to in all.
const SIDES: usize = 9;
const FINE: usize = 3;
/// A pose elsewhere leaves at least so many times as much unexplained, or what was found before: each has a mask of its own. For a wrong one it was 1.3 times, and for some right ones it is less than this (`docs/tried.md`).
const RIVAL: f64 = 1.5;

/// In parts of the longer side of what a pose covers. What is missing along an edge says that the pose is off, not that something hides it there: as near to what is in sight as this, or as narrow as twice the second.
const RIM: f64 = 0.04;
const NARROW: f64 = 0.02;
/// What hides a part of an object goes on beyond it by at least so much.
const BEYOND: f64 = 0.06;
/// Room around what a pose covers.
const ROOM: f64 = 0.2;
/// Cells along the longer side.
const CELLS: f64 = 72.0;

impl<E: From<Error>> Boxed<'_, E> {
    /// What was found in a box but is not to be trusted once more, as if something hid a part of it: from the sides that are likeliest in half as many pixels, then from where these lead, and once more from the best. A
    /// pose counts that is to be trusted, or explains so much more; where one elsewhere explains what is in sight from there nearly as well it is not to be trusted.
    pub(super) fn behind<L>(&self, number: usize, mut outcome: Outcome<L>, pass: Pass<L, E>) -> Result<Outcome<L>, E> {
        let Some(sightings) = (self.sightings)(number, outcome.shot.instance)? else { return Ok(outcome) };
        let mut seconds = outcome.found.seconds;
        let mut from = |poses: &[DMat4], as_fine: fn(Shot) -> Shot| {
            let mut found = self.tried_from(number, &sightings, &outcome.shot, poses, as_fine, &mut *pass)?;
            seconds += found.iter().map(|outcome| outcome.found.seconds).sum::<f64>();
            found.sort_by(|a, b| likelier(&a.found, &b.found));
            Ok::<_, E>(found)
        };
        let sides: Vec<DMat4> = sightings.apart(SIDES).iter().map(|side| sightings.pose(&outcome.shot, side)).collect();
        let coarse = from(&sides, Shot::halved)?;
        let likeliest = elsewhere(&coarse, FINE);
        let mut fine = from(&likeliest, |shot| shot)?.into_iter();
        if let Some(mut best) = fine.next() {
            // Where a coarse one led to counts, not the coarse one.
            let is_left = |coarse: &&Outcome<L>| likeliest.iter().all(|pose| is_elsewhere(pose, &coarse.found.world_from_camera));
            if best.found.is_trusted() {
                if has_rival(&best.found, fine.as_slice().iter().chain(coarse.iter().filter(is_left))) {
                    best.found.doubt = Some(Doubt::Rival);
                } else if let Some(again) = from(&[best.found.world_from_camera], |shot| shot)?.pop() {
                    best = if again.found.is_trusted() { again } else { best };
                }
            }
            let [is_no_better, is_better] = [&best, &outcome].map(|outcome| is_inside(&outcome.found));
            let explains_more = RIVAL * best.found.unexplained < outcome.found.unexplained;
            if best.found.is_trusted() || !is_no_better && (is_better || explains_more) {
                outcome = best;
            }
        }
        outcome.found.seconds = seconds;
        Ok(outcome)
    }

    /// Searched for from each of these poses, by what is in sight there. `shot`: any part of the photograph.
    fn tried_from<L>(
        &self,
        number: usize,
        sightings: &Sightings,
        shot: &Shot,
        poses: &[DMat4],
        as_fine: fn(Shot) -> Shot,
        pass: Pass<L, E>,
    ) -> Result<Vec<Outcome<L>>, E> {
        let (mut shots, mut starts) = (Vec::new(), Vec::new());
        for pose in poses {
            let Some(likeness) = sightings.likeness(shot, pose)? else { continue };
            let shows = |at| likeness.shows(at);
            // Nothing may be in sight.
            let Ok(in_sight) = (self.open)(number, Known { place: Some(&shows), ..Known::default() }) else { continue };
            let hidden = hidden(likeness.bounds, |at| likeness.object.covers(at), |at| in_sight.shows(at));
            let is_hidden = |at| hidden.has(at);
            let known = Known { place: Some(&shows), others: Some(&is_hidden), ..Known::default() };
            let Ok(shot) = (self.open)(number, known) else { continue };
            shots.push(as_fine(shot));
            starts.push(vec![*pose]);
        }
        if shots.is_empty() {
            return Ok(vec![]);
        }
        let found = pass(&vec![number; shots.len()], shots, &starts)?;
        found.into_iter().map(|outcome| self.judged(number, outcome, Some(sightings))).collect()
    }
}

/// The first of their poses, at most so many, without those that are where another is.
fn elsewhere<L>(outcomes: &[Outcome<L>], most: usize) -> Vec<DMat4> {
    apart(outcomes.iter().map(|outcome| outcome.found.world_from_camera), most)
}

fn apart(poses: impl IntoIterator<Item = DMat4>, most: usize) -> Vec<DMat4> {
    let mut first: Vec<DMat4> = Vec::new();
    for pose in poses {
        if first.len() < most && first.iter().all(|other| is_elsewhere(other, &pose)) {
            first.push(pose);
        }
    }
    first
}

/// Whether another pose elsewhere explains what is in sight from there nearly as well.
fn has_rival<'a, L: 'a>(found: &Found, mut tried: impl Iterator<Item = &'a Outcome<L>>) -> bool {
    let nearly = |other: &Found| !is_inside(other) && other.unexplained < RIVAL * found.unexplained;
    tried.any(|Outcome { found: other, .. }| is_elsewhere(&found.world_from_camera, &other.world_from_camera) && nearly(other))
}

fn is_elsewhere(pose: &DMat4, other: &DMat4) -> bool {
    pose_error(pose, other).0 > ELSEWHERE_DEG
}

/// Where something hides what a pose shows, around which there are these bounds: what is not in sight of it there, but for rims, and somewhat beyond.
fn hidden(bounds: BoundingBox, is_shown: impl Fn([f64; 2]) -> bool, is_in_sight: impl Fn([f64; 2]) -> bool) -> Cells {
    let longer = bounds.size[0].max(bounds.size[1]);
    let cells = |is: &dyn Fn([f64; 2]) -> bool| Cells::of(bounds.with_room(ROOM), longer / CELLS, is);
    let seen = cells(&is_in_sight);
    let near = cells(&is_in_sight).grown(RIM * longer);
    let missing = cells(&|at| is_shown(at) && !near.has(at));
    let wide = missing.inverse().grown(NARROW * longer).inverse().grown((NARROW + BEYOND) * longer);
    cells(&|at| wide.has(at) && !seen.has(at))
}

/// Places of a part of a photograph, in square cells.
struct Cells {
    corner: [f64; 2],
    pitch: f64,
    columns: usize,
    are: Vec<bool>,
}

impl Cells {
    /// Those whose middles are.
    fn of(BoundingBox { corner, size }: BoundingBox, pitch: f64, is: impl Fn([f64; 2]) -> bool) -> Self {
        let [columns, rows] = size.map(|pixels| (pixels / pitch).ceil() as usize);
        let place = |i: usize| [0, 1].map(|k| corner[k] + ([i % columns, i / columns][k] as f64 + 0.5) * pitch);
        Cells { corner, pitch, columns, are: (0..columns * rows).map(|i| is(place(i))).collect() }
    }

    /// Whether the cell is that a place lies in; none is beside them.
    fn has(&self, at: [f64; 2]) -> bool {
        let [x, y] = [0, 1].map(|k| ((at[k] - self.corner[k]) / self.pitch).floor());
        let is_in = x >= 0.0 && y >= 0.0 && x < self.columns as f64;
        is_in && self.are.get(y as usize * self.columns + x as usize).is_some_and(|is| *is)
    }

    fn inverse(self) -> Self {
        Cells { are: self.are.iter().map(|is| !is).collect(), ..self }
    }

    /// And those that are so near to one of them, in pixels.
    fn grown(self, by: f64) -> Self {
        let (columns, reach) = (self.columns as i64, (by / self.pitch).round() as i64);
        let disc = || (-reach..=reach).flat_map(move |y| (-reach..=reach).map(move |x| [x, y]));
        let disc: Vec<[i64; 2]> = disc().filter(|[x, y]| x * x + y * y <= reach * reach).collect();
        let is_near = |i: usize| {
            let [x, y] = [i as i64 % columns, i as i64 / columns];
            let cell = |[dx, dy]: &[i64; 2]| {
                let is_in = (0..columns).contains(&(x + dx)) && y + dy >= 0;
                is_in && self.are.get(((y + dy) * columns + x + dx) as usize).is_some_and(|is| *is)
            };
            disc.iter().any(cell)
        };
        Cells { are: (0..self.are.len()).map(is_near).collect(), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of 40 pixels at (10, 10).
    const SQUARE: BoundingBox = BoundingBox { corner: [10.0; 2], size: [40.0; 2] };

    fn is_in([x, y]: [f64; 2], [first, end]: [[f64; 2]; 2]) -> bool {
        (first[0]..end[0]).contains(&x) && (first[1]..end[1]).contains(&y)
    }

    #[test]
    fn what_is_missing_hides_an_object_but_along_its_edge() {
        let all = |at| is_in(at, [[10.0; 2], [50.0; 2]]);
        let hides = |seen: &dyn Fn([f64; 2]) -> bool| hidden(SQUARE, all, seen);
        // Its right half, and beyond that, but not what is in sight, nor around that.
        let half = hides(&|at| is_in(at, [[10.0; 2], [30.0, 50.0]]));
        let at = [[40.0, 30.0], [33.0, 30.0], [51.5, 30.0], [40.0, 51.5], [28.0, 30.0], [20.0, 51.5], [57.0, 30.0]];
        assert_eq!(at.map(|at| half.has(at)), [true, true, true, true, false, false, false]);
        // Where the pose is off by 2 pixels.
        let moved = hides(&|at| is_in(at, [[12.0, 10.0], [52.0, 50.0]]));
        assert!(!moved.are.contains(&true));
        assert!(!half.has([-3.0, 30.0]) && !half.has([30.0, 500.0]));
    }

    #[test]
    fn poses_elsewhere_are_tried_and_doubted() {
        let pose = |degrees: f64| DMat4::from_rotation_z(degrees.to_radians());
        assert_eq!(apart([0.0, 5.0, 40.0, 44.0, 90.0].map(pose), 2), [0.0, 40.0].map(pose));
        assert_eq!(apart([0.0, 5.0].map(pose), 2), [pose(0.0)]);
    }
}
