//! What of a picture is the object, by a box around it, as detectors give one: colours of the object and of what surrounds it, in turns with the outline that
//! parts them best (GrabCut, Rother et al. 2004, with its cut through a graph as one through the plane: Chan, Esedoglu and Nikolova 2006).

use glam::DVec3;
use image::imageops;
use image::{ImageBuffer, Luma};

use crate::colours::Mixture;
use crate::pixels::Pixels;

/// A rectangle in a picture, in pixels; their edges are whole numbers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoundingBox {
    /// Left edge and top edge.
    pub corner: [f64; 2],
    /// Width and height.
    pub size: [f64; 2],
}

/// Whether a place of the picture, across and down in pixels, is thought to show the object; `None`: that is not known.
pub type Guess<'a> = &'a dyn Fn([f64; 2]) -> Option<bool>;

/// Whether a place of the picture, likewise, is in a region.
pub type Place<'a> = &'a dyn Fn([f64; 2]) -> bool;

/// Room around the box from which the surroundings are learnt, as a share of its longer side.
const SURROUNDINGS: f64 = 0.3;
/// How far the object may reach out of the box, likewise; and where it is guessed.
const SLACK: f64 = 0.02;
const SLACK_OF_GUESS: f64 = 0.15;
/// The longer side of what is looked at has at most this many cells.
const FINEST: f64 = 256.0;
/// Turns of colours and outline.
const ROUNDS: usize = 6;
/// What a cell's colour counts, beside a cell's length of outline.
pub(crate) const COLOUR: f32 = 0.01;
/// One cell's logarithm of odds is at most this.
pub(crate) const SUREST: f64 = 20.0;
/// Logarithm of the density of any colour at all.
const ANYTHING: f64 = -5.0;
/// Logarithm of the odds far within, or outside of, what is guessed; and how wide the doubt about its edge is, as a share of the box's longer side.
const TRUST: f64 = 6.0;
const DOUBT: f64 = 0.08;

/// What is known of the object in a box.
#[derive(Clone, Copy, Default)]
pub struct Known<'a> {
    /// Colours that it has, in [-1, 1], as many of each as there is of it.
    pub colours: &'a [[f32; 3]],
    /// Where it is thought to be, as by a pose; what colours say of its edge goes before.
    pub place: Option<Guess<'a>>,
    /// Where something else is seen, before the object or beside it.
    pub others: Option<Place<'a>>,
}

impl Known<'_> {
    /// Whether something else is seen at a place.
    pub(crate) fn is_other(&self, at: [f64; 2]) -> bool {
        self.others.is_some_and(|is_other| is_other(at))
    }
}

/// How much of each pixel is the object, 0 to 1, `[height · width]`. `None` where nothing of the box differs from what is around it, or nothing is around it.
pub(crate) fn object_in(picture: &Pixels, bounds: BoundingBox, known: Known) -> Option<Vec<f32>> {
    let grid = Grid::around(picture, bounds)?;
    let longer = bounds.size[0].max(bounds.size[1]);
    let slack = longer * if known.place.is_some() { SLACK_OF_GUESS } else { SLACK };
    let is_other = grid.each(|at| known.is_other(at));
    let may_be = grid.each(|at| bounds.is_within(at, slack) && !known.is_other(at));
    let guess = match known.place {
        Some(place) => grid.each(|at| if bounds.is_within(at, slack) { place(at) } else { Some(false) }),
        None => grid.each(|at| Some(bounds.is_within(at, 0.0))),
    };
    let prior = if known.place.is_some() { grid.prior(&guess, DOUBT * longer) } else { vec![0.0; guess.len()] };
    let mut object: Vec<bool> = guess.iter().map(|guess| *guess == Some(true)).collect();
    let palette: Vec<DVec3> = known.colours.iter().map(|colour| DVec3::from(colour.map(f64::from))).collect();
    let edges = grid.edges();
    for round in 0..ROUNDS {
        // What nobody knows yet says nothing of either.
        let is_on = |i: usize, of: bool| !is_other[i] && if round == 0 { guess[i] == Some(of) } else { object[i] == of };
        let side = |of: bool| grid.colours.iter().enumerate().filter(move |(i, _)| is_on(*i, of)).map(|(_, colour)| *colour);
        let mut own = side(true).collect::<Vec<_>>();
        // At first the box has other things in it, too.
        let is_first = round == 0 && known.place.is_none() && !palette.is_empty();
        if is_first {
            own.clone_from(&palette);
        }
        let (own, other) = (Mixture::of(&own)?, Mixture::of(&side(false).collect::<Vec<_>>())?);
        let cost = |((&colour, &may_be), prior): ((&DVec3, &bool), &f64)| {
            // Nor is it what neither has, as long as that is all there is to go by.
            let other = other.log_density(colour).max(if is_first { ANYTHING } else { f64::NEG_INFINITY });
            let odds = (other - own.log_density(colour)).clamp(-SUREST, SUREST) - prior;
            if may_be { COLOUR * odds as f32 } else { f32::MAX.sqrt() }
        };
        let costs: Vec<f32> = grid.colours.iter().zip(&may_be).zip(&prior).map(cost).collect();
        let cut = cut(&costs, &edges, grid.size[0], &object);
        if std::mem::replace(&mut object, cut) == object {
            break;
        }
    }
    object.contains(&true).then(|| grid.on(picture.width, picture.height, &object))
}

impl BoundingBox {
    /// With room on each side, so large a share of the longer side.
    pub fn with_room(&self, share: f64) -> Self {
        let room = share * self.size[0].max(self.size[1]);
        BoundingBox { corner: self.corner.map(|first| first - room), size: self.size.map(|size| size + 2.0 * room) }
    }

    /// The part of what it covers, or another does, that both cover.
    pub fn overlap(&self, other: &Self) -> f64 {
        let end = |of: &Self, k: usize| of.corner[k] + of.size[k];
        let both = [0, 1].map(|k| (end(self, k).min(end(other, k)) - self.corner[k].max(other.corner[k])).max(0.0));
        let [both, own, others] = [both, self.size, other.size].map(|[width, height]| width * height);
        both / (own + others - both)
    }

    /// How far it ends inside another at most, on one of four sides, as a part of that one's width or height; negative where it reaches beyond all of them.
    pub fn ends_inside(&self, other: &Self) -> f64 {
        let inside = |k: usize| {
            let before = self.corner[k] - other.corner[k];
            before.max(other.size[k] - self.size[k] - before) / other.size[k]
        };
        inside(0).max(inside(1))
    }

    /// Whether a place is in it, or so near.
    fn is_within(&self, at: [f64; 2], slack: f64) -> bool {
        (0..2).all(|k| (self.corner[k] - slack..=self.corner[k] + self.size[k] + slack).contains(&at[k]))
    }
}

/// A part of a picture in cells of equal size.
pub(crate) struct Grid {
    /// Columns and rows.
    pub size: [usize; 2],
    /// Edge of the first cell in the picture, and the pixels of one across and down.
    corner: [f64; 2],
    pitch: [f64; 2],
    /// Means in [-1, 1], row-major.
    pub colours: Vec<DVec3>,
}

impl Grid {
    /// The box and its surroundings, as far as the picture goes; `None` where the box lies outside of it.
    pub fn around(picture: &Pixels, bounds: BoundingBox) -> Option<Self> {
        let room = SURROUNDINGS * bounds.size[0].max(bounds.size[1]);
        let ends = [0, 1].map(|k| {
            let whole = [picture.width, picture.height][k] as f64;
            let (first, end) = (bounds.corner[k] - room, bounds.corner[k] + bounds.size[k] + room);
            [first.floor().clamp(0.0, whole), end.ceil().clamp(0.0, whole)]
        });
        let [across, down] = ends.map(|[first, end]| (end - first) as usize);
        let finer = (FINEST / across.max(down) as f64).min(1.0);
        let size = [across, down].map(|pixels| (pixels as f64 * finer).round() as usize);
        if size.contains(&0) {
            return None;
        }
        let rows = picture.data.chunks_exact(3 * picture.width).skip(ends[1][0] as usize).take(down);
        let data = rows.flat_map(|row| &row[3 * ends[0][0] as usize..][..3 * across]).copied().collect();
        let cells = Pixels { width: across, height: down, data }.area_resample(size[0], size[1]);
        Some(Grid {
            size,
            corner: ends.map(|[first, _]| first),
            pitch: [across as f64 / size[0] as f64, down as f64 / size[1] as f64],
            colours: cells.data.chunks_exact(3).map(|c| DVec3::new(c[0].into(), c[1].into(), c[2].into())).collect(),
        })
    }

    /// The colours of the cells that are, or are not.
    pub fn colours_where(&self, are: &[bool], they: bool) -> Vec<DVec3> {
        self.colours.iter().zip(are).filter(|(_, is)| **is == they).map(|(colour, _)| *colour).collect()
    }

    /// Something of the middle of each cell, in pixels of the picture.
    pub fn each<T>(&self, of: impl Fn([f64; 2]) -> T) -> Vec<T> {
        let place = |i: usize| {
            let cell = [i % self.size[0], i / self.size[0]];
            [0, 1].map(|k| self.corner[k] + (cell[k] as f64 + 0.5) * self.pitch[k])
        };
        (0..self.colours.len()).map(|i| of(place(i))).collect()
    }

    /// Logarithm of the odds that a cell is the object, by a guess whose edge is off by some `pixels`; never against the guess, which of a narrow part is nothing but edge.
    fn prior(&self, guess: &[Option<bool>], pixels: f64) -> Vec<f64> {
        let [width, height] = self.size.map(|cells| cells as u32);
        let shares = guess.iter().map(|guess| guess.map_or(0.5, |is_object| f32::from(u8::from(is_object)))).collect();
        let shares: ImageBuffer<Luma<f32>, Vec<f32>> = ImageBuffer::from_vec(width, height, shares).unwrap_or_default();
        let smooth = imageops::blur(&shares, (pixels / self.pitch[0]) as f32);
        let odds = |(share, guess): (&f32, &Option<bool>)| match (TRUST * (2.0 * f64::from(*share) - 1.0), guess) {
            (odds, Some(true)) => odds.max(0.0),
            (odds, Some(false)) => odds.min(0.0),
            (odds, None) => odds,
        };
        smooth.iter().zip(guess).map(odds).collect()
    }

    /// What a length of outline costs in each cell: little where the picture has an edge.
    pub fn edges(&self) -> Vec<f32> {
        let width = self.size[0];
        let step = |i: usize, on: usize| self.colours.get(on).map_or(0.0, |next| next.distance_squared(self.colours[i]));
        let steps = |i: usize| if (i + 1).is_multiple_of(width) { 0.0 } else { step(i, i + 1) } + step(i, i + width);
        let steps: Vec<f64> = (0..self.colours.len()).map(steps).collect();
        let mean = 0.5 * steps.iter().sum::<f64>() / steps.len() as f64;
        steps.into_iter().map(|step| (0.02 + (-step / (2.0 * mean + 1e-12)).exp()) as f32).collect()
    }

    /// What cells say of the pixels of the picture; smooth between cells.
    pub fn on(&self, width: usize, height: usize, object: &[bool]) -> Vec<f32> {
        let share = |pixel: usize| {
            let at = [pixel % width, pixel / width];
            let [x, y] = [0, 1].map(|k| (at[k] as f64 + 0.5 - self.corner[k]) / self.pitch[k] - 0.5);
            let is_out = |at: f64, cells: usize| at <= -1.0 || at >= cells as f64;
            if is_out(x, self.size[0]) || is_out(y, self.size[1]) {
                return 0.0;
            }
            let near = |at: f64, cells: usize| {
                let (first, second) = (at.max(0.0) as usize, (at + 1.0) as usize);
                [(first.min(cells - 1), 1.0 - at.max(0.0).fract()), (second.min(cells - 1), at.max(0.0).fract())]
            };
            let row = |y: usize| {
                let in_row = near(x, self.size[0]).map(|(x, part)| if object[y * self.size[0] + x] { part } else { 0.0 });
                in_row[0] + in_row[1]
            };
            near(y, self.size[1]).map(|(y, part)| part * row(y)).iter().sum::<f64>() as f32
        };
        (0..width * height).map(share).collect()
    }

    /// The cell that a place of the picture lies in.
    pub fn cell_of(&self, at: [f64; 2]) -> Option<u32> {
        let cell = [0, 1].map(|k| (at[k] - self.corner[k]) / self.pitch[k]);
        let is_in = (0..2).all(|k| (0.0..self.size[k] as f64).contains(&cell[k]));
        is_in.then(|| (cell[1] as usize * self.size[0] + cell[0] as usize) as u32)
    }
}

/// The region with the least sum of its costs and the lengths of its outline, near `start`: a program that is convex where cells may belong to it by
/// shares, by the steps of Chambolle and Pock (2011).
pub(crate) fn cut(costs: &[f32], edges: &[f32], width: usize, start: &[bool]) -> Vec<bool> {
    const STEPS: usize = 150;
    // Both steps, for differences whose norm is at most the root of eight.
    const STEP: f32 = 0.353;
    let mut share: Vec<f32> = start.iter().map(|&is_in| f32::from(u8::from(is_in))).collect();
    let mut ahead = share.clone();
    let (mut across, mut down) = (vec![0.0f32; share.len()], vec![0.0f32; share.len()]);
    for _ in 0..STEPS {
        for row in 0..share.len() / width {
            let (own, next) = ahead[row * width..].split_at(width);
            let (across, down) = (&mut across[row * width..][..width], &mut down[row * width..][..width]);
            for x in 0..width - 1 {
                across[x] += STEP * (own[x + 1] - own[x]);
            }
            // Nothing lies below the last row.
            for ((down, next), own) in down.iter_mut().zip(next).zip(own) {
                *down += STEP * (next - own);
            }
            for ((across, down), edge) in across.iter_mut().zip(down).zip(&edges[row * width..]) {
                let longer = ((*across * *across + *down * *down).sqrt() / edge).max(1.0);
                (*across, *down) = (*across / longer, *down / longer);
            }
        }
        for i in 0..share.len() {
            // The last of a row has no flow to the next one's first.
            let before = if i == 0 { 0.0 } else { across[i - 1] };
            let above = if i < width { 0.0 } else { down[i - width] };
            let flow = across[i] - before + down[i] - above;
            let next = (share[i] + STEP * (flow - costs[i])).clamp(0.0, 1.0);
            ahead[i] = 2.0 * next - share[i];
            share[i] = next;
        }
    }
    share.into_iter().map(|share| share > 0.5).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 120;
    const BOX: BoundingBox = BoundingBox { corner: [40.0, 25.0], size: [40.0, 30.0] };

    /// A red disc with a blue middle on green squares; what differs from pixel to pixel is no edge.
    fn picture() -> Pixels {
        let colour = |i: usize| {
            let (x, y) = (i % WIDTH, i / WIDTH);
            let noise = [0.05, -0.03, 0.08, 0.0, -0.06][(7 * x + 3 * y) % 5];
            let [r, g, b] = match from_middle(i) {
                off if off < 0.4 => [-0.8, -0.6, 0.7],
                off if off < 1.0 => [0.6, -0.6, -0.5],
                _ if (x / 15 + y / 15).is_multiple_of(2) => [-0.4, 0.5, -0.3],
                _ => [-0.6, 0.2, -0.4],
            };
            [r + noise, g + noise, b - noise]
        };
        Pixels { width: WIDTH, height: 80, data: (0..80 * WIDTH).flat_map(colour).collect() }
    }

    /// How far a pixel is from the middle of the box, of the ellipse in it.
    fn from_middle(i: usize) -> f64 {
        let place = [(i % WIDTH) as f64 + 0.5, (i / WIDTH) as f64 + 0.5];
        let off = [0, 1].map(|k| (place[k] - BOX.corner[k]) / BOX.size[k] * 2.0 - 1.0);
        off[0].hypot(off[1])
    }

    #[test]
    fn a_box_ends_inside_another() {
        let moved = |by: [f64; 4]| BoundingBox {
            corner: [40.0 + by[0], 25.0 + by[1]],
            size: [40.0 + by[2] - by[0], 30.0 + by[3] - by[1]],
        };
        let inside = |by| moved(by).ends_inside(&BOX);
        assert_eq!([inside([0.0; 4]), inside([-4.0, -6.0, 2.0, 30.0])], [0.0, -0.05]);
        // Of its width left and right, of its height above and below.
        let each = [[4.0, 0.0, 0.0, 0.0], [-9.0, 6.0, 9.0, 9.0], [0.0, 0.0, -8.0, 0.0], [0.0, 1.5, 0.0, -3.0]];
        assert_eq!(each.map(inside), [0.1, 0.2, 0.2, 0.1]);
    }

    /// How many pixels are taken for what they are not.
    fn wrong(object: &[f32], is_object: impl Fn(usize) -> bool) -> usize {
        object.iter().enumerate().filter(|(i, share)| (**share > 0.5) != is_object(*i)).count()
    }

    #[test]
    fn what_is_in_a_box_is_found_by_its_colours() {
        let picture = picture();
        let found = |bounds| object_in(&picture, bounds, Known::default()).unwrap();
        let is_object = |i| from_middle(i) < 1.0;
        let area = (0..picture.width * picture.height).filter(|&i| is_object(i)).count();
        assert!(wrong(&found(BOX), is_object) < area / 50, "{} of {area}", wrong(&found(BOX), is_object));
        // Boxes of detectors are not tight.
        let loose = BoundingBox { corner: [34.0, 22.0], size: [50.0, 38.0] };
        assert!(wrong(&found(loose), is_object) < area / 50);
        let tight = BoundingBox { corner: [40.4, 25.3], size: [39.2, 29.4] };
        assert!(wrong(&found(tight), is_object) < area / 50);
    }

    #[test]
    fn what_is_known_of_the_object_takes_the_rest_out_of_the_box() {
        let picture = picture();
        let is_middle = |i| from_middle(i) < 0.4;
        let area = (0..picture.width * picture.height).filter(|&i| is_middle(i)).count();
        // The ring goes around the middle as the middle's own surroundings do not: by colours alone both are the object.
        let found = |known| object_in(&picture, BOX, known).unwrap();
        assert!(wrong(&found(Known::default()), is_middle) > area);
        let place = |[x, y]: [f64; 2]| Some(from_middle(y as usize * WIDTH + x as usize) < 0.45);
        let by_place = found(Known { place: Some(&place), ..Known::default() });
        assert!(wrong(&by_place, is_middle) < area / 10, "{} of {area}", wrong(&by_place, is_middle));
        let blue = [[-0.8, -0.6, 0.7], [-0.75, -0.55, 0.65], [-0.85, -0.65, 0.75]].repeat(20);
        let by_colours = found(Known { colours: &blue, ..Known::default() });
        assert!(wrong(&by_colours, is_middle) < area / 10, "{} of {area}", wrong(&by_colours, is_middle));
    }

    #[test]
    fn what_something_else_covers_says_nothing() {
        let picture = picture();
        // The middle is of another thing, which hides it, and the box ends where that does.
        let is_other = |[x, y]: [f64; 2]| from_middle(y as usize * WIDTH + x as usize) < 0.45;
        let found = object_in(&picture, BOX, Known { others: Some(&is_other), ..Known::default() }).unwrap();
        let is_object = |i| (0.45..1.0).contains(&from_middle(i));
        let area = (0..found.len()).filter(|&i| is_object(i)).count();
        assert!(wrong(&found, is_object) < area / 20, "{} of {area}", wrong(&found, is_object));
    }

    #[test]
    fn a_narrow_part_stays_with_what_it_is_a_part_of() {
        let mut picture = picture();
        // A blue stalk below the disc, and things as blue to the left and the right of it.
        let is_stalk = |i: usize| (58..62).contains(&(i % WIDTH)) && (54..66).contains(&(i / WIDTH));
        let is_other = |i: usize| (24..32).contains(&(i % WIDTH).min(WIDTH - i % WIDTH)) && (50..70).contains(&(i / WIDTH));
        for i in (0..WIDTH * picture.height).filter(|&i| is_stalk(i) || is_other(i)) {
            let from = 3 * ((40 - i / WIDTH % 6) * WIDTH + 56 + i % 8);
            picture.data.copy_within(from..from + 3, 3 * i);
        }
        for i in (0..WIDTH * picture.height).filter(|&i| from_middle(i) < 0.5) {
            let from = 3 * (40 * WIDTH + 71 + i % 5);
            picture.data.copy_within(from..from + 3, 3 * i);
        }
        let is_object = |i: usize| from_middle(i) < 1.0 || is_stalk(i);
        let place = |[x, y]: [f64; 2]| Some(is_object(y as usize * WIDTH + x as usize));
        let bounds = BoundingBox { corner: BOX.corner, size: [40.0, 41.0] };
        let found = object_in(&picture, bounds, Known { place: Some(&place), ..Known::default() }).unwrap();
        let lost = (0..found.len()).filter(|&i| is_stalk(i) && found[i] < 0.5).count();
        assert!(lost < 10 && wrong(&found, is_object) < 40, "{lost} of 48, {} in all", wrong(&found, is_object));
    }

    #[test]
    fn what_is_seen_through_an_object_is_none_of_it() {
        let mut picture = picture();
        let is_window = |i: usize| from_middle(i) < 0.4;
        for i in (0..WIDTH * picture.height).filter(|&i| is_window(i)) {
            // Surroundings of the same row.
            let from = 3 * (i - i % WIDTH + (i + 7) % 20);
            picture.data.copy_within(from..from + 3, 3 * i);
        }
        let is_object = |i: usize| (0.4..1.0).contains(&from_middle(i));
        let area = (0..WIDTH * picture.height).filter(|&i| is_window(i)).count();
        let by = |within: Option<bool>| {
            let place = |[x, y]: [f64; 2]| match from_middle(y as usize * WIDTH + x as usize) {
                far if far < 0.4 => within,
                far => Some(far < 1.0),
            };
            wrong(&object_in(&picture, BOX, Known { place: Some(&place), ..Known::default() }).unwrap(), is_object)
        };
        assert!(by(None) < area / 5, "{} of {area}", by(None));
        assert!(by(Some(true)) > by(None), "{} {}", by(Some(true)), by(None));
    }

    #[test]
    fn an_object_that_fills_the_picture_or_lies_outside_is_none() {
        let picture = picture();
        for (corner, size) in [([0.0; 2], [120.0, 80.0]), ([200.0, 10.0], [30.0; 2]), ([-90.0, 10.0], [30.0; 2])] {
            assert_eq!(object_in(&picture, BoundingBox { corner, size }, Known::default()), None, "{corner:?}");
        }
        let grey = Pixels { data: vec![0.0; picture.data.len()], ..picture };
        assert_eq!(object_in(&grey, BOX, Known::default()), None);
    }
}
