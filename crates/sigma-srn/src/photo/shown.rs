//! Where in a photograph a found object is.

use glam::DMat4;
use srn_photo::BoundingBox;

use super::Shot;
use crate::renderer::render_views;
use crate::{Engine, Error, Intrinsics, Model};

/// The view shows this many times the square's width: an object of which only a part counts reaches out of its square.
const WIDER: usize = 2;

/// Where the model shows an object in the photograph.
#[derive(Clone)]
pub struct FoundObject {
    silhouette: Silhouette,
    square: ([i64; 2], usize),
}

impl FoundObject {
    /// By a view from `world_from_camera`, at most so many times as fine as the square.
    pub fn of(shot: &Shot, world_from_camera: &DMat4, engine: &Engine, model: &Model, finest: usize) -> Result<Self, Error> {
        let side = shot.side;
        let times = shot.square.1.div_ceil(side.max(1) as usize).min(finest).max(1) as u32;
        let (k, before) = (f64::from(times), 0.5 * (WIDER - 1) as f64 * f64::from(side));
        let Intrinsics { fx, fy, cx, cy, pixel_center } = shot.intrinsics;
        // Edges of pixels stay where they are, half a pixel before the centres.
        let [cx, cy] = [cx, cy].map(|c| k * (c + before + 0.5) - 0.5);
        let view_side = WIDER as u32 * times * side;
        let camera = Intrinsics { fx: k * fx, fy: k * fy, cx, cy, pixel_center };
        let view = &render_views(engine, model, [view_side; 2], &[(shot.instance, *world_from_camera, camera)])?[0];
        Ok(FoundObject { silhouette: Silhouette::of(&view.rgb, view_side as usize), square: shot.square })
    }

    /// By a view of `side` pixels that shows this square of the picture, in pixels.
    pub(super) fn in_square(rgb: &[f32], side: usize, corner: [f64; 2], size: f64) -> Self {
        let extent = (size / WIDER as f64).round().max(1.0);
        let corner = corner.map(|at| (at + 0.5 * (size - extent)).round() as i64);
        FoundObject { silhouette: Silhouette::of(rgb, side), square: (corner, extent as usize) }
    }

    /// A box around it, in pixels; `None` where the view shows nothing.
    pub fn bounds(&self) -> Option<BoundingBox> {
        let (corner, extent) = self.square;
        let [first, last] = self.silhouette.bounds()?;
        let in_picture = |k: usize, at: f64| corner[k] as f64 + extent as f64 * (WIDER as f64 * (at - 0.5) + 0.5);
        let size = [0, 1].map(|k| (WIDER * extent) as f64 * (last[k] - first[k]));
        Some(BoundingBox { corner: [0, 1].map(|k| in_picture(k, first[k])), size })
    }

    /// The part of what it covers, or another does, that both cover; 0 where that is nothing.
    pub fn overlap(&self, other: &Self) -> f64 {
        const CELLS: usize = 64;
        let Some([a, b]) = self.bounds().zip(other.bounds()).map(<[_; 2]>::from) else { return 0.0 };
        let first = [0, 1].map(|k| a.corner[k].min(b.corner[k]));
        let end = [0, 1].map(|k| (a.corner[k] + a.size[k]).max(b.corner[k] + b.size[k]));
        let place = |cell: [usize; 2]| [0, 1].map(|k| first[k] + (cell[k] as f64 + 0.5) / CELLS as f64 * (end[k] - first[k]));
        let cells = (0..CELLS * CELLS).map(|i| place([i % CELLS, i / CELLS])).map(|at| (self.covers(at), other.covers(at)));
        let (both, any) = cells.fold((0, 0), |(both, any), (a, b)| (both + usize::from(a && b), any + usize::from(a || b)));
        f64::from(both as u32) / f64::from(any.max(1) as u32)
    }

    /// Whether it covers a place, in pixels; their edges are whole numbers.
    pub fn covers(&self, at: [f64; 2]) -> bool {
        self.silhouette.covers(self.in_view(at))
    }

    /// Whether it covers a place, or one so many pixels off.
    pub(super) fn covers_near(&self, at: [f64; 2], pixels: f64) -> bool {
        let off = |k: u32| pixels * (f64::from(k) - 1.0);
        (0..9).any(|k| self.covers([at[0] + off(k % 3), at[1] + off(k / 3)]))
    }

    /// Whether a place shows it; of white within its outline nobody knows.
    pub fn shows(&self, at: [f64; 2]) -> Option<bool> {
        let at = self.in_view(at);
        (!self.silhouette.is_enclosed(at)).then(|| self.silhouette.covers(at))
    }

    /// In which of its view's cells a place lies, of so many to a side; `None` beside the view.
    pub(super) fn cell_of(&self, at: [f64; 2], side: usize) -> Option<usize> {
        let [x, y] = self.in_view(at).map(|x| (x * side as f64).floor());
        let is_in = [x, y].iter().all(|x| (0.0..side as f64).contains(x));
        is_in.then(|| y as usize * side + x as usize)
    }

    /// A place of the picture in the view, 0 to 1 across and down.
    fn in_view(&self, at: [f64; 2]) -> [f64; 2] {
        let (corner, extent) = self.square;
        let in_square = [0, 1].map(|k| (at[k] - corner[k] as f64) / extent as f64);
        in_square.map(|x| (x - 0.5) / WIDER as f64 + 0.5)
    }
}

/// Where a view shows the object.
#[derive(Clone)]
pub(super) struct Silhouette {
    side: usize,
    /// How far from white each pixel is, of the farthest beside it: an object has pale parts and dark ones, and each ends where half of its own is left.
    share: Vec<f32>,
    /// White that no way leads to from the edge: print on the object, or what is seen through it.
    enclosed: Vec<bool>,
}

/// Between object and background pixels are of both.
const HALF: f32 = 0.5;
/// What is no farther from white than this (channels span 2) is background that a network does not show quite white.
const FAINT: f32 = 0.2;

impl Silhouette {
    pub(super) fn of(rgb: &[f32], side: usize) -> Self {
        // How far each pixel is from white.
        let far = |pixel: &[f32]| pixel.iter().map(|c| 1.0 - c.clamp(-1.0, 1.0)).fold(0.0, f32::max);
        let far: Vec<f32> = rgb.chunks_exact(3).map(far).collect();
        let beside = |at: usize| at.saturating_sub(1)..(at + 2).min(side);
        let farthest =
            |[x, y]: [usize; 2]| beside(y).flat_map(|y| &far[y * side..][beside(x)]).copied().fold(2.0 * FAINT, f32::max);
        let mut share: Vec<f32> = far.iter().enumerate().map(|(i, own)| own / farthest([i % side, i / side])).collect();
        // Where a dark part goes over into a pale one the object does not end.
        let inner = (1..side.saturating_sub(1)).flat_map(|y| (1..side - 1).map(move |x| y * side + x));
        let is_between = |&i: &usize| {
            let is_on = |step: usize| {
                let [before, after] = [i - step, i + step];
                share[before].min(share[after]) > HALF && far[i] > HALF * far[before].min(far[after])
            };
            [1, side - 1, side, side + 1].into_iter().any(is_on)
        };
        let between: Vec<usize> = inner.filter(is_between).collect();
        between.into_iter().for_each(|i| share[i] = 1.0);
        Silhouette { side, share, enclosed: vec![] }.filled()
    }

    /// What is enclosed counts as object.
    fn filled(mut self) -> Self {
        let n = self.side;
        let mut reached = vec![false; n * n];
        let mut next: Vec<usize> = (0..n).flat_map(|i| [i, n * (n - 1) + i, n * i, n * i + n - 1]).collect();
        while let Some(pixel) = next.pop() {
            if self.share[pixel] > HALF || std::mem::replace(&mut reached[pixel], true) {
                continue;
            }
            let (x, y) = (pixel % n, pixel / n);
            let around = [(x > 0).then(|| pixel - 1), (x + 1 < n).then_some(pixel + 1)];
            let above = [(y > 0).then(|| pixel - n), (y + 1 < n).then_some(pixel + n)];
            next.extend(around.into_iter().chain(above).flatten());
        }
        self.enclosed = self.share.iter().zip(reached).map(|(share, reached)| !reached && *share <= HALF).collect();
        let enclosed = self.share.iter_mut().zip(&self.enclosed).filter(|(_, is_enclosed)| **is_enclosed);
        enclosed.for_each(|(share, _)| *share = 1.0);
        self
    }

    /// First and last place that the object covers, 0 to 1 across and down.
    fn bounds(&self) -> Option<[[f64; 2]; 2]> {
        let covered = self.share.iter().enumerate().filter(|(_, share)| **share > HALF);
        let cells = covered.map(|(i, _)| [i % self.side, i / self.side]);
        let around = |bounds: Option<[[usize; 2]; 2]>, cell: [usize; 2]| {
            let [low, high] = bounds.unwrap_or([cell; 2]);
            Some([[0, 1].map(|k| low[k].min(cell[k])), [0, 1].map(|k| high[k].max(cell[k] + 1))])
        };
        let ends = cells.fold(None, around)?;
        Some(ends.map(|end| end.map(|cells| cells as f64 / self.side as f64)))
    }

    /// Whether a pixel shows the object, and not white within it.
    pub(super) fn is_object(&self, pixel: usize) -> bool {
        self.share[pixel] > HALF && !self.enclosed[pixel]
    }

    fn is_enclosed(&self, at: [f64; 2]) -> bool {
        let [x, y] = at.map(|x| (x * self.side as f64).floor());
        let is_in = [x, y].iter().all(|x| (0.0..self.side as f64).contains(x));
        is_in && self.enclosed[y as usize * self.side + x as usize]
    }

    /// Whether the object covers a place of the view, 0 to 1 across and down; smooth between pixels.
    fn covers(&self, at: [f64; 2]) -> bool {
        if !at.iter().all(|x| (0.0..1.0).contains(x)) {
            return false;
        }
        let last = self.side - 1;
        let [x, y] = at.map(|x| (x * self.side as f64 - 0.5).clamp(0.0, last as f64));
        let ([x0, y0], [fx, fy]) = ([x as usize, y as usize], [x.fract() as f32, y.fract() as f32]);
        let [x1, y1] = [x0, y0].map(|i| (i + 1).min(last));
        let row = |y: usize| (1.0 - fx) * self.share[y * self.side + x0] + fx * self.share[y * self.side + x1];
        (1.0 - fy) * row(y0) + fy * row(y1) > HALF
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_is_where_its_view_is_dark() {
        // Grey from the middle on to the right, white before; the limit lies half-way.
        let rgb: Vec<f32> = (0..64).flat_map(|i| [if i % 8 < 4 { 1.0 } else { 0.0 }; 3]).collect();
        let silhouette = Silhouette::of(&rgb, 8);
        assert!(!silhouette.covers([0.49, 0.3]) && silhouette.covers([0.51, 0.3]));
        assert!(!silhouette.covers([1.2, 0.3]) && !silhouette.covers([0.9, -0.1]));
        // Black, and a pale part beside it that is much less dark: it ends where half of its own is left.
        let rgb: Vec<f32> = (0..64).flat_map(|i| [[-1.0, -1.0, 0.2, 0.5, 0.5, 0.8, 1.0, 1.0][i % 8]; 3]).collect();
        let silhouette = Silhouette::of(&rgb, 8);
        let covered: Vec<bool> = (0..8).map(|x| silhouette.covers([(x as f64 + 0.5) / 8.0, 0.3])).collect();
        assert_eq!(covered, [true, true, true, true, true, false, false, false]);
        // What is so faint is none of it.
        assert_eq!(Silhouette::of(&rgb.iter().map(|c| 0.92 + 0.08 * c).collect::<Vec<_>>(), 8).bounds(), None);
        // White that is enclosed belongs to the object.
        let ring = |i: usize| (2..=5).contains(&(i % 8)) && (2..=5).contains(&(i / 8));
        let hole = |i: usize| (3..=4).contains(&(i % 8)) && (3..=4).contains(&(i / 8));
        let rgb: Vec<f32> = (0..64).flat_map(|i| [if ring(i) && !hole(i) { -1.0 } else { 1.0 }; 3]).collect();
        let silhouette = Silhouette::of(&rgb, 8);
        assert!(silhouette.covers([0.5, 0.5]) && silhouette.covers([0.3, 0.5]) && !silhouette.covers([0.1, 0.5]));
        assert!(silhouette.is_enclosed([0.5, 0.5]) && !silhouette.is_enclosed([0.3, 0.5]) && !silhouette.is_enclosed([0.1, 0.5]));
        assert_eq!(silhouette.bounds(), Some([[0.25; 2], [0.75; 2]]));
        // In a square that begins at (10, 20) and is 4 pixels wide, of which the view shows twice as much.
        let object = |x: i64| FoundObject { silhouette: Silhouette::of(&rgb, 8), square: ([x, 20], 4) };
        let bounds = object(10).bounds().unwrap();
        assert_eq!((bounds.corner, bounds.size), ([10.0, 20.0], [4.0; 2]));
        assert_eq!(
            (object(10).shows([10.3, 22.0]), object(10).shows([12.0, 22.0]), object(10).shows([9.0, 22.0])),
            (Some(true), None, Some(false))
        );
        let by_a_quarter = object(10).overlap(&object(11));
        assert!(object(10).overlap(&object(10)) == 1.0 && (by_a_quarter - 0.6).abs() < 0.05, "{by_a_quarter}");
        assert_eq!(object(10).overlap(&object(30)), 0.0);
        // A white view has no outline.
        let nothing = Silhouette::of(&[1.0; 192], 8);
        assert!(!nothing.covers([0.5, 0.5]) && nothing.bounds().is_none());
    }
}
