//! A photograph, what counts in it, and the square that a search for its pose takes of it.

use crate::pixels::Pixels;
use crate::segment::{BoundingBox, Known, object_in};

/// Room around the object on each side of a square that is cut around it, as a share of its extent.
pub const MARGIN: f64 = 0.1;

/// A photograph: colours over white, how opaque each pixel is, and how much it counts.
#[derive(Debug, Clone, PartialEq)]
pub struct Photo {
    pixels: Pixels,
    /// 0 to 1 `[height · width]`: what is transparent is known to be background.
    opacity: Vec<f32>,
    /// 0 to 1 `[height · width]`; `None` where all counts.
    counts: Option<Vec<f32>>,
}

/// A square of a photograph, resampled.
#[derive(Debug, Clone, PartialEq)]
pub struct Square {
    /// Pixels to a side.
    pub side: usize,
    /// Colours in [-1, 1], row-major `[side · side, 3]`; white where the picture is transparent.
    pub rgb: Vec<f32>,
    /// How much each pixel counts, 0 to 1, `[side · side]`; `None` where all do.
    pub weights: Option<Vec<f32>>,
    /// How much of each pixel is opaque, 0 to 1, `[side · side]`: of what counts, the rest is white. `None` where the picture was not cut.
    pub coverage: Option<Vec<f32>>,
    /// `fx, fy, cx, cy` in pixels of the square; integer coordinates are pixel centres.
    pub intrinsics: [f32; 4],
    /// Whether the square was cut around the object.
    pub cut: bool,
    /// The first pixel of the square in the picture, across and down; outside of it where the square reaches out.
    pub corner: [i64; 2],
    /// Width and height of the square in pixels of the picture.
    pub extent: usize,
}

impl Photo {
    /// Colours that are laid over white, and the opacity of each pixel, 0 to 1; `None` where these are not as many.
    pub fn new(pixels: Pixels, opacity: Vec<f32>) -> Option<Self> {
        let count = pixels.width * pixels.height;
        let fits = count > 0 && opacity.len() == count && pixels.data.len() == 3 * count;
        fits.then_some(Photo { pixels, opacity, counts: None })
    }

    /// Of bytes, four for each pixel; `None` where they are not as many as `width` × `height` pixels have.
    pub fn from_rgba8(width: usize, height: usize, rgba: &[u8]) -> Option<Self> {
        let pixels = rgba.chunks_exact(4).map(|pixel| (pixel, f32::from(pixel[3]) / 255.0));
        let over_white = |(pixel, opaque): (&[u8], f32)| [0, 1, 2].map(|c| 1.0 - opaque * (2.0 - f32::from(pixel[c]) / 127.5));
        let opacity = pixels.clone().map(|(_, opaque)| opaque).collect();
        Photo::new(Pixels { width, height, data: pixels.flat_map(over_white).collect() }, opacity)
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [usize; 2] {
        [self.pixels.width, self.pixels.height]
    }

    /// Its colours, over white.
    pub fn pixels(&self) -> &Pixels {
        &self.pixels
    }

    /// Leaves so much of each pixel, 0 to 1 `[height · width]`, and nothing of those that are missing there; the rest becomes white background, as what is transparent is.
    pub fn cut_out(&mut self, object: &[f32]) {
        let object = object.iter().chain(std::iter::repeat(&0.0));
        for ((colours, opacity), object) in self.pixels.data.chunks_exact_mut(3).zip(&mut self.opacity).zip(object) {
            colours.iter_mut().for_each(|colour| *colour = object * *colour + (1.0 - object));
            *opacity *= object;
        }
    }

    /// Leaves what in a box is the object, by its colours and what is known of it, and where something else is seen nothing counts; `None`, with nothing changed, where nothing in the box differs from
    /// what is around it, or nothing is around it.
    pub fn cut_out_of(&mut self, bounds: BoundingBox, known: Known) -> Option<()> {
        let object = object_in(&self.pixels, bounds, known)?;
        self.cut_out(&object);
        if known.others.is_some() {
            let [width, height] = self.size();
            let centre = |i: usize| [i % width, i / width].map(|at| at as f64 + 0.5);
            self.mask((0..width * height).map(|i| if known.is_other(centre(i)) { 0.0 } else { 1.0 }).collect());
        }
        Some(())
    }

    /// How much each pixel counts at most, 0 to 1 `[height · width]`, those that are missing there not at all: what does not may be anything.
    pub fn mask(&mut self, mut counts: Vec<f32>) {
        counts.resize(self.opacity.len(), 0.0);
        let before = self.counts.take().into_iter().flatten();
        counts.iter_mut().zip(before).for_each(|(counts, before)| *counts = counts.min(before));
        self.counts = Some(counts);
    }

    /// How much of a pixel is seen and counts.
    fn shown(&self, pixel: usize) -> f32 {
        self.opacity[pixel].min(self.counts.as_ref().map_or(1.0, |counts| counts[pixel]))
    }

    /// The most that any pixel is seen and counts, 0 to 1.
    pub fn most_shown(&self) -> f32 {
        (0..self.opacity.len()).map(|pixel| self.shown(pixel)).fold(0.0, f32::max)
    }

    /// The square around what masks and transparency leave, with [`MARGIN`], of `side` × `side` pixels; `None` where they leave nothing. What lies outside of the photograph
    /// does not count. Where they leave all of it this is [`Photo::centre`]. `intrinsics`: `fx, fy, cx, cy` in pixels of the photograph, whose centres are whole numbers.
    pub fn square(&self, intrinsics: [f64; 4], side: usize) -> Option<Square> {
        let size = self.size();
        let points = (0..self.opacity.len()).filter(|&i| self.shown(i) > 0.5).map(|i| [i % size[0], i / size[0]]);
        let [low, high] = points.clone().fold(None, |bounds: Option<[[usize; 2]; 2]>, p| {
            let [low, high] = bounds.unwrap_or([p; 2]);
            Some([[0, 1].map(|k| low[k].min(p[k])), [0, 1].map(|k| high[k].max(p[k]))])
        })?;
        if points.count() == self.opacity.len() {
            return Some(Photo { counts: None, ..self.clone() }.centre(intrinsics, side));
        }
        // Where the object reaches the edge of the photograph, what lies beyond is not white but unknown.
        let is_cut_off = [0, 1].into_iter().any(|k| low[k] == 0 || high[k] + 1 == size[k]);
        let all = is_cut_off.then(|| vec![1.0; size[0] * size[1]]);
        let counts = self.counts.as_ref().or(all.as_ref());
        let across = [0, 1].map(|k| high[k] - low[k] + 1);
        let extent = (across[0].max(across[1]) as f64 * (1.0 + 2.0 * MARGIN)).ceil() as usize;
        let corner = [0, 1].map(|k| (low[k] + high[k] + 1) as i64 / 2 - extent as i64 / 2);
        let scale = side as f64 / extent as f64;
        let [fx, fy, centre @ ..] = intrinsics;
        // Edges of pixels are whole numbers half a pixel before the centres.
        let [cx, cy] = [0, 1].map(|k| (centre[k] + 0.5 - corner[k] as f64) * scale - 0.5);
        let intrinsics = [fx * scale, fy * scale, cx, cy].map(|x| x as f32);
        let opaque = Pixels { data: self.opacity.iter().flat_map(|&share| [share; 3]).collect(), ..self.pixels };
        let (rgb, opaque, weights) = match counts {
            Some(counts) => {
                let (rgb, weights) = weighted(&self.pixels, counts, corner, extent, side);
                (rgb, weighted(&opaque, counts, corner, extent, side).0, Some(weights))
            }
            None => {
                let cut = |of: &Pixels, outside| of.square(corner, extent, outside).area_resample(side, side).data;
                (cut(&self.pixels, 1.0), cut(&opaque, 0.0), None)
            }
        };
        let coverage = Some(opaque.into_iter().step_by(3).map(|share| share.clamp(0.0, 1.0)).collect());
        Some(Square { side, rgb, weights, coverage, intrinsics, cut: true, corner, extent })
    }

    /// The square in the middle, as of pictures that were cut before. The intrinsics follow as SRN has them: all four are scaled, which leaves the half-pixel shift of pixel
    /// centres.
    pub fn centre(&self, intrinsics: [f64; 4], side: usize) -> Square {
        let size = self.size();
        let extent = size[0].min(size[1]);
        let corner = size.map(|s| ((s - extent) / 2) as i64);
        let scale = side as f64 / extent as f64;
        let [fx, fy, cx, cy] = intrinsics;
        let intrinsics = [fx, fy, cx - corner[0] as f64, cy - corner[1] as f64].map(|x| (x * scale) as f32);
        let (rgb, weights) = match &self.counts {
            Some(counts) => {
                let (rgb, weights) = weighted(&self.pixels, counts, corner, extent, side);
                (rgb, Some(weights))
            }
            None => (self.pixels.centre_square().area_resample(side, side).data, None),
        };
        Square { side, rgb, weights, coverage: None, intrinsics, cut: false, corner, extent }
    }
}

/// Colours and weights of a square: a pixel's weight is the share of its area that counts, its colour the mean of that share, so
/// that nothing of what is masked out bleeds in.
fn weighted(picture: &Pixels, counts: &[f32], corner: [i64; 2], extent: usize, side: usize) -> (Vec<f32>, Vec<f32>) {
    let square = |data: Vec<f32>| Pixels { data, ..*picture }.square(corner, extent, 0.0).area_resample(side, side);
    let weights = square(counts.iter().flat_map(|&w| [w; 3]).collect()).data;
    let times = |(colour, weight): (&[f32], &f32)| [0, 1, 2].map(|c| colour[c] * weight);
    let colours = square(picture.data.chunks_exact(3).zip(counts).flat_map(times).collect()).data;
    let mean = |(sum, weight): (f32, &f32)| if *weight > 0.0 { (sum / weight).clamp(-1.0, 1.0) } else { 1.0 };
    let rgb = colours.into_iter().zip(&weights).map(mean).collect();
    (rgb, weights.into_iter().step_by(3).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_laid_over_white() {
        let rgba = [[0, 255, 51, 255], [0, 0, 0, 0], [0, 255, 0, 51]].concat();
        let photo = Photo::from_rgba8(3, 1, &rgba).unwrap();
        assert_eq!(photo.opacity, [1.0, 0.0, 0.2]);
        let expected = [-1.0, 1.0, -0.6, 1.0, 1.0, 1.0, 0.6, 1.0, 0.6];
        assert!(photo.pixels.data.iter().zip(expected).all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6), "{photo:?}");
        for (width, height) in [(2, 1), (3, 2), (0, 0)] {
            assert_eq!(Photo::from_rgba8(width, height, &rgba), None);
        }
        assert_eq!(Photo::from_rgba8(0, 0, &[]), None);
    }

    #[test]
    fn nothing_is_cut_out_of_a_box_around_nothing() {
        let grey = Photo::from_rgba8(40, 30, &[128, 128, 128, 255].repeat(1200)).unwrap();
        let mut cut = grey.clone();
        assert_eq!(cut.cut_out_of(BoundingBox { corner: [10.0; 2], size: [9.0; 2] }, Known::default()), None);
        assert_eq!(cut, grey);
        cut.cut_out(&[0.2; 1200]);
        assert_eq!(cut.square([50.0, 50.0, 20.0, 15.0], 8), None);
        assert!((cut.most_shown() - 0.2).abs() < 1e-6);
        // Of a mask that is too short the rest is none.
        let [mut cut, mut masked] = [grey.clone(), grey];
        cut.cut_out(&[1.0; 400]);
        masked.mask(vec![1.0; 400]);
        for photo in [&cut, &masked] {
            let square = photo.square([50.0, 50.0, 20.0, 15.0], 8).unwrap();
            assert!(square.cut && square.corner == [-4, -19] && square.extent == 48, "{square:?}");
        }
    }
}
