//! Photographs: masks, lenses undone, the object cut out.

use crate::camera::Camera;
use crate::error::{Error, Result};
use crate::pixels::decode;
use glam::DVec2;
use image::{RgbImage, Rgba, RgbaImage};
use std::path::Path;

/// A picture whose transparency tells the object from its background.
#[derive(Debug, Clone)]
pub(crate) struct Picture(RgbaImage);

/// Colours from here on are white background, where nothing else tells it.
const WHITE: u8 = 250;
/// What is more opaque than this is the object.
const OPAQUE: u8 = 127;

impl Picture {
    /// Reads a picture; its transparency and the mask say what is background.
    pub fn open(path: &Path, mask: Option<&Path>) -> Result<Self> {
        let mut picture = decode(path)?.into_rgba8();
        if let Some(path) = mask {
            let mask = read_mask(path, [picture.width(), picture.height()])?;
            for (pixel, mask) in picture.pixels_mut().zip(mask) {
                pixel[3] = ((u32::from(pixel[3]) * u32::from(mask) + 127) / 255) as u8;
            }
        }
        Ok(Self(picture))
    }

    /// A mask as a picture.
    pub fn from_luma(mask: image::GrayImage) -> Self {
        Self(image::DynamicImage::from(mask).into_rgba8())
    }

    /// Takes white for background in a picture that has none yet and whose edge is white.
    pub fn guess_background(&mut self) {
        let white = |pixel: &Rgba<u8>| pixel.0[..3].iter().all(|&c| c >= WHITE);
        let [all, bright] = [true, false].map(|all| self.edge().filter(|pixel| all || white(pixel)).count());
        if !self.is_masked() && 10 * bright >= 8 * all {
            self.0.pixels_mut().filter(|pixel| white(pixel)).for_each(|pixel| pixel[3] = 0);
        }
    }

    fn edge(&self) -> impl Iterator<Item = &Rgba<u8>> {
        let (width, height) = self.0.dimensions();
        let rows = (0..width).flat_map(move |x| [(x, 0), (x, height - 1)]);
        rows.chain((0..height).flat_map(move |y| [(0, y), (width - 1, y)])).map(|(x, y)| self.0.get_pixel(x, y))
    }

    /// Whether anything is known to be background.
    pub fn is_masked(&self) -> bool {
        self.0.pixels().any(|pixel| pixel[3] <= OPAQUE)
    }

    /// How much of the picture's edge is the object: where any, part of it is cut off; where most, the mask is inverted.
    pub fn edge_share(&self) -> f64 {
        let inside = self.edge().filter(|pixel| pixel[3] > OPAQUE).count();
        inside as f64 / self.edge().count() as f64
    }

    /// The first and last pixel of the object in each row, on the camera's image plane at depth 1, the lens undone.
    pub fn contour(&self, camera: &Camera) -> Vec<DVec2> {
        let ends = self.0.rows().enumerate().flat_map(|(y, row)| {
            let mut inside = row.enumerate().filter(|(_, pixel)| pixel[3] > OPAQUE).map(|(x, _)| x);
            let first = inside.next();
            let ends = first.map(|first| [first, inside.next_back().unwrap_or(first)]);
            ends.into_iter().flatten().map(move |x| DVec2::new(x as f64, y as f64))
        });
        ends.filter_map(|pixel| camera.undistort(camera.plane(pixel))).collect()
    }

    /// The picture that the camera `to`, a pinhole in the same pose, would have taken, over white. Each pixel is the mean of
    /// the area that it covers here.
    pub fn resample(&self, from: &Camera, to: &Camera) -> RgbImage {
        let [reach, n] = [from.lens_radius(), (from.intrinsics[0] / to.intrinsics[0]).ceil().clamp(1.0, 16.0)];
        let n = n as usize;
        let offset = |i: usize| (i as f64 + 0.5) / n as f64 - 0.5;
        RgbImage::from_fn(to.size[0] as u32, to.size[1] as u32, |u, v| {
            let mut sum = [0.0f32; 3];
            for (i, j) in (0..n).flat_map(|j| (0..n).map(move |i| (i, j))) {
                let plane = to.plane(DVec2::new(f64::from(u) + offset(i), f64::from(v) + offset(j)));
                let seen = (plane.length() < reach).then(|| self.over_white(from.pixel(from.distort(plane))));
                let colour = seen.flatten().unwrap_or([255.0; 3]);
                (0..3).for_each(|c| sum[c] += colour[c]);
            }
            image::Rgb(sum.map(|s| (s / (n * n) as f32).round() as u8))
        })
    }

    /// The colour between pixels over white, up to 255; `None` outside.
    fn over_white(&self, at: DVec2) -> Option<[f32; 3]> {
        let (width, height) = self.0.dimensions();
        let last = DVec2::new(f64::from(width - 1), f64::from(height - 1));
        if !(at.cmpge(DVec2::splat(-0.5)) & at.cmple(last + 0.5)).all() {
            return None;
        }
        let DVec2 { x, y } = at.clamp(DVec2::ZERO, last);
        let [x0, y0] = [x as u32, y as u32];
        let [x1, y1] = [(x0 + 1).min(width - 1), (y0 + 1).min(height - 1)];
        let [fx, fy] = [x.fract() as f32, y.fract() as f32];
        let mut sum = [0.0; 3];
        for (x, y, weight) in
            [(x0, y0, (1.0 - fx) * (1.0 - fy)), (x1, y0, fx * (1.0 - fy)), (x0, y1, (1.0 - fx) * fy), (x1, y1, fx * fy)]
        {
            let [r, g, b, a] = self.0.get_pixel(x, y).0.map(f32::from);
            let over = [r, g, b].map(|c| 255.0 + (c - 255.0) * a / 255.0);
            (0..3).for_each(|c| sum[c] += weight * over[c]);
        }
        Some(sum)
    }
}

/// Reads the mask of a picture of this size, row by row: 255 where the object is. A mask is white there; one that is transparent,
/// as background removers write it, is opaque there. A mask of black and one other value says the same, whatever that is: segmentations are also written with
/// the number of the object, or in a colour.
pub(crate) fn read_mask(path: &Path, [width, height]: [u32; 2]) -> Result<Vec<u8>> {
    // Of 16 bits all count: there, too, a segmentation may have the number of the object.
    let mask = decode(path)?.into_luma_alpha16();
    if mask.dimensions() != (width, height) {
        let expected = format!("{width}×{height}, as its picture");
        return Err(Error::field(path, "size", expected, format!("{}×{}", mask.width(), mask.height())));
    }
    let channel = usize::from(mask.pixels().any(|mask| mask[1] < u16::MAX));
    let values = || mask.pixels().map(|mask| mask[channel]);
    let white = values().max().unwrap_or(0);
    let is_label = values().all(|value| value == 0 || value == white);
    Ok(values().map(|value| if is_label { 255 * u8::from(value > 0) } else { (value / 257) as u8 }).collect())
}

/// The corners of the box around points; `None` without points.
fn extent(points: &[DVec2]) -> Option<[DVec2; 2]> {
    let corner = |pick: fn(DVec2, DVec2) -> DVec2| points.iter().copied().reduce(pick);
    Some([corner(DVec2::min)?, corner(DVec2::max)?])
}

/// The middle of the box around points; `None` without points.
pub(crate) fn middle(points: &[DVec2]) -> Option<DVec2> {
    extent(points).map(|[low, high]| 0.5 * (low + high))
}

/// The camera of a square cut around points of the image plane: `side` pixels, the points within it but for a margin of this
/// share of their extent on each side. `None` without points.
pub(crate) fn cut(camera: &Camera, points: &[DVec2], margin: f64, side: usize) -> Option<Camera> {
    let [low, high] = extent(points)?;
    let extent = (high - low).max_element() * (1.0 + 2.0 * margin);
    (extent > 0.0 && extent.is_finite()).then(|| {
        let focal = side as f64 / extent;
        let centre = 0.5 * DVec2::splat(side as f64) - focal * 0.5 * (low + high);
        let intrinsics = [focal, focal, centre.x, centre.y];
        // Edges of pixels are whole numbers where their centres are at one half.
        let square = Camera { intrinsics, size: [side; 2], pixel_centre: 0.5, distortion: [0.0; 5], ..*camera };
        square.with_pixel_centre(0.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat4, DVec3};
    use image::Rgb;

    const CAMERA: Camera = Camera {
        world_from_camera: DMat4::IDENTITY,
        intrinsics: [80.0, 80.0, 32.0, 24.0],
        size: [64, 48],
        pixel_centre: 0.5,
        distortion: [0.0; 5],
    };

    fn saved(picture: impl Into<image::DynamicImage>) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("picture.png");
        picture.into().save(&path).unwrap();
        (dir, path)
    }

    #[test]
    fn the_same_camera_sees_the_same_picture() {
        let picture = RgbImage::from_fn(64, 48, |x, y| Rgb([(3 * x) as u8, (5 * y) as u8, ((x * y) % 251) as u8]));
        let (_dir, path) = saved(picture.clone());
        let read = Picture::open(&path, None).unwrap();
        assert!(!read.is_masked());
        assert_eq!(read.resample(&CAMERA, &CAMERA), picture);
        assert_eq!(read.resample(&CAMERA, &CAMERA.with_pixel_centre(0.0)), picture);
    }

    #[test]
    fn masks_and_transparency_become_white_and_bound_the_object() {
        // A black rectangle, x 20..30 and y 10..18, on grey: by a mask, by transparency, by a mask that is transparent.
        let object = |x: u32, y: u32| (20..30).contains(&x) && (10..18).contains(&y);
        let alpha = RgbaImage::from_fn(64, 48, |x, y| if object(x, y) { Rgba([0, 0, 0, 255]) } else { Rgba([99, 99, 99, 0]) });
        let grey = RgbImage::from_fn(64, 48, |x, y| Rgb(if object(x, y) { [0; 3] } else { [99; 3] }));
        let mask = image::GrayImage::from_fn(64, 48, |x, y| image::Luma([if object(x, y) { 255 } else { 0 }]));
        let [(_a, alpha), (_b, grey)] = [saved(alpha), saved(grey)];
        let (_c, mask) = saved(mask);
        let [first, second] = [Picture::open(&alpha, None).unwrap(), Picture::open(&grey, Some(&mask)).unwrap()];
        let third = Picture::open(&grey, Some(&alpha)).unwrap();
        for picture in [&first, &second, &third] {
            assert!(picture.is_masked() && picture.edge_share() == 0.0);
            let points = picture.contour(&CAMERA);
            let square = cut(&CAMERA, &points, 0.1, 24).unwrap();
            let cropped = picture.resample(&CAMERA, &square);
            assert_eq!((cropped.dimensions(), cropped.get_pixel(12, 12).0), ((24, 24), [0; 3]));
            assert!([(0, 0), (23, 0), (0, 23), (23, 23), (12, 1)].iter().all(|&(x, y)| cropped.get_pixel(x, y).0 == [255; 3]));
            // The object's middle, (24.5, 13.5), is the middle of the cut, and projects there too.
            let ray = CAMERA.plane(DVec2::new(24.5, 13.5)).extend(1.0);
            assert!((square.project(3.0 * ray).0 - DVec2::splat(11.5)).length() < 1e-9, "{:?}", square.project(ray));
        }
        let (_d, small) = saved(RgbImage::new(3, 2));
        let wrong = Picture::open(&alpha, Some(&small)).unwrap_err().to_string();
        assert!(wrong.contains("64×48") && wrong.contains("3×2"), "{wrong}");
    }

    #[test]
    fn a_mask_of_two_values_is_black_and_white() {
        let read = |values: [u8; 3]| {
            let (_dir, path) = saved(image::GrayImage::from_raw(3, 1, values.to_vec()).unwrap());
            read_mask(&path, [3, 1]).unwrap()
        };
        // Numbers of objects; all of it, and nothing; with edges in between.
        let all = [[0, 1, 1], [7, 0, 7], [200, 0, 0], [9; 3], [0; 3], [0, 128, 255], [0, 3, 200]];
        let expected = [[0, 255, 255], [255, 0, 255], [255, 0, 0], [255; 3], [0; 3], [0, 128, 255], [0, 3, 200]];
        assert_eq!(all.map(read), expected);
        // As a palette has it.
        let (_dir, path) = saved(RgbImage::from_fn(3, 1, |x, _| Rgb([if x == 1 { 128 } else { 0 }, 0, 0])));
        assert_eq!(read_mask(&path, [3, 1]).unwrap(), [0, 255, 0]);
    }

    #[test]
    fn a_cut_and_its_camera_agree() {
        // A dark dot in a distorted picture: it must appear where the cut's camera projects its ray.
        let lens = Camera { distortion: [-0.2, 0.05, 0.002, -0.001, 0.0], ..CAMERA };
        let dot = DVec3::new(0.31, -0.17, 1.0);
        let (at, _) = lens.project(dot);
        let blob = |x: u32, y: u32| (DVec2::new(x.into(), y.into()) - at).length_squared();
        let picture = RgbImage::from_fn(64, 48, |x, y| Rgb([(255.0 * (1.0 - (-blob(x, y) / 4.0).exp())) as u8; 3]));
        let (_dir, path) = saved(picture);
        let picture = Picture::open(&path, None).unwrap();
        let corners = [DVec2::new(-0.1, -0.3), DVec2::new(0.38, 0.1)];
        for to in [cut(&lens, &corners, 0.0, 64).unwrap(), Camera { distortion: [0.0; 5], ..lens }] {
            let seen = picture.resample(&lens, &to);
            let (mut sum, mut weight) = (DVec2::ZERO, 0.0);
            for (x, y, pixel) in seen.enumerate_pixels() {
                let dark = f64::from(255 - pixel[0]) * f64::from(u8::from(pixel[0] < 200));
                sum += dark * DVec2::new(x.into(), y.into());
                weight += dark;
            }
            let expected = to.project(dot).0;
            assert!((sum / weight - expected).length() < 0.15, "{} {expected}", sum / weight);
        }
        assert!((lens.project(dot).0 - CAMERA.project(dot).0).length() > 0.3, "the lens does nothing");
    }

    #[test]
    fn white_is_background_only_where_the_edge_is_white() {
        let dot = |x: u32, y: u32| x.abs_diff(30) < 5 && y.abs_diff(20) < 5;
        for (background, masked) in [([255; 3], true), ([200; 3], false)] {
            let (_dir, path) = saved(RgbImage::from_fn(64, 48, |x, y| Rgb(if dot(x, y) { [9; 3] } else { background })));
            let mut picture = Picture::open(&path, None).unwrap();
            picture.guess_background();
            assert_eq!(picture.is_masked(), masked);
        }
    }
}
