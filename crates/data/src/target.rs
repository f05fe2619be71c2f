//! A photograph in a file as a search for its pose takes it: a square, the object in it, and how much each pixel counts.

use crate::error::{Error, Result};
use crate::picture::read_mask;
use crate::pixels::open_with_opacity;
use crate::srn::Intrinsics;
use srn_photo::{BoundingBox, Known, Photo, Square};
use std::path::Path;

/// What of a photograph is the object.
#[derive(Clone, Copy)]
pub enum Cutout<'a> {
    /// By a mask, white or opaque where it is.
    Mask(&'a Path),
    /// By a box around it, and by what is known of it.
    Box(BoundingBox, Known<'a>),
}

/// Reads a picture that was cut before, as those of data sets are: its centre square (see [`crate::srn::load_square`]). Where the mask is
/// black, pixels do not count.
pub fn of_view(path: &Path, mask: Option<&Path>, intrinsics: &Intrinsics, side: usize) -> Result<Square> {
    let mut photo = photo(path)?;
    let size = photo.size();
    if let Some(mask) = mask {
        photo.mask(counts(mask, size)?);
    }
    Ok(photo.centre(whole(path, intrinsics, size)?, side))
}

/// Reads a photograph and cuts a square around what masks and transparency leave of it (see [`Photo::square`]); the intrinsics follow.
/// Pixels where the mask is black, or outside of the photograph, do not count; what the cutout leaves out is white background, as what is
/// transparent is, and does. Without any of these it is the centre square.
pub fn of_photo(
    path: &Path,
    cutout: Option<Cutout>,
    mask: Option<&Path>,
    intrinsics: &Intrinsics,
    side: usize,
) -> Result<Square> {
    let mut photo = photo(path)?;
    let size = photo.size();
    match cutout {
        None => {}
        Some(Cutout::Mask(mask)) => photo.cut_out(&counts(mask, size)?),
        Some(Cutout::Box(bounds, known)) => photo.cut_out_of(bounds, known).ok_or_else(|| nothing_in(path, bounds, size))?,
    }
    if let Some(mask) = mask {
        photo.mask(counts(mask, size)?);
    }
    photo.square(whole(path, intrinsics, size)?, side).ok_or_else(|| Error::Empty {
        path: mask.or(if let Some(Cutout::Mask(mask)) = cutout { Some(mask) } else { None }).unwrap_or(path).into(),
        field: "mask".into(),
        expected: "white, or opaque, where the object is".into(),
        found: format!("nothing of it, at most {:.0} of 255", 255.0 * photo.most_shown()),
    })
}

/// Reads a photograph.
pub fn photo(path: &Path) -> Result<Photo> {
    let (picture, opacity) = open_with_opacity(path)?;
    let found = format!("{}×{}", picture.width, picture.height);
    Photo::new(picture, opacity).ok_or_else(|| Error::field(path, "size", "pixels", found))
}

/// `fx, fy, cx, cy` of a picture of this size.
fn whole(path: &Path, intrinsics: &Intrinsics, size: [usize; 2]) -> Result<[f64; 4]> {
    let Intrinsics { focal: [fx, fy], centre: [cx, cy], .. } = intrinsics.of_picture(path, size)?;
    Ok([fx, fy, cx, cy])
}

/// Of a box in which no object is seen.
fn nothing_in(
    path: &Path,
    BoundingBox { corner: [x, y], size: [width, height] }: BoundingBox,
    [across, down]: [usize; 2],
) -> Error {
    Error::Empty {
        path: path.into(),
        field: format!("box {x},{y},{width},{height}"),
        expected: format!("an object in its {across}×{down} pixels, and some of what is around it"),
        found: "nothing that differs from what is around it, or nothing around it".into(),
    }
}

/// A mask as numbers from 0 to 1.
fn counts(mask: &Path, size: [usize; 2]) -> Result<Vec<f32>> {
    Ok(read_mask(mask, size.map(|s| s as u32))?.into_iter().map(|m| f32::from(m) / 255.0).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::srn::load_square;
    use image::{GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};

    const INTRINSICS: Intrinsics = Intrinsics { focal: [60.0, 60.0], centre: [30.0, 20.0], size: [60, 40] };

    /// A blue rectangle, 41 ≤ x < 51 and 6 ≤ y < 12, on red; the right half of it is green.
    fn colour(x: u32, y: u32) -> [u8; 3] {
        match (x, y) {
            (41..46, 6..12) => [0, 0, 255],
            (46..51, 6..12) => [0, 255, 0],
            _ => [255, 0, 0],
        }
    }

    fn saved(dir: &Path, name: &str, picture: impl Into<image::DynamicImage>) -> std::path::PathBuf {
        let path = dir.join(name);
        picture.into().save(&path).unwrap();
        path
    }

    #[test]
    fn a_photograph_is_cut_around_what_counts() {
        let dir = tempfile::tempdir().unwrap();
        let photo = saved(dir.path(), "photo.png", RgbImage::from_fn(60, 40, |x, y| Rgb(colour(x, y))));
        let object = |x: u32, y: u32| (41..51).contains(&x) && (6..12).contains(&y);
        let mask = GrayImage::from_fn(60, 40, |x, y| Luma([if object(x, y) { 255 } else { 0 }]));
        let mask = saved(dir.path(), "mask.png", mask);
        let target = of_photo(&photo, None, Some(&mask), &INTRINSICS, 6).unwrap();
        // 10 pixels and a tenth on each side: 12, two for each of the square's; rows 3 to 14.
        assert_eq!((target.corner, target.extent), ([40, 3], 12));
        let weights = target.weights.unwrap();
        let row = |y: usize| &weights[6 * y..][..6];
        assert_eq!(row(0), [0.0; 6]);
        assert_eq!((row(2), row(1)), (&[0.5, 1.0, 1.0, 1.0, 1.0, 0.5][..], &[0.25, 0.5, 0.5, 0.5, 0.5, 0.25][..]));
        let pixel = |x: usize, y: usize| &target.rgb[3 * (6 * y + x)..][..3];
        // In the mask all is opaque.
        assert!(target.coverage.unwrap().iter().zip(&weights).all(|(cover, weight)| *cover == 1.0 || *weight == 0.0));
        // No red comes in from around the object.
        assert_eq!((pixel(0, 2), pixel(5, 2)), (&[-1.0, -1.0, 1.0][..], &[-1.0, 1.0, -1.0][..]));
        assert_eq!(pixel(0, 0), [1.0; 3]);
        // Where the photograph has the pixel (43.5, 8.5), the square has (1.5, 2.5) - half a pixel of its own: the same ray.
        let [fx, fy, cx, cy] = target.intrinsics;
        let ray = [(1.5 - cx) / fx, (2.5 - cy) / fy];
        assert!((ray[0] - (43.5 - 30.0) / 60.0).abs() < 1e-6 && (ray[1] - (8.5 - 20.0) / 60.0).abs() < 1e-6, "{ray:?}");

        // Transparency is white background that counts, and cuts as well; the mask takes away from it.
        let cut = RgbaImage::from_fn(60, 40, |x, y| {
            let [r, g, b] = colour(x, y);
            Rgba([r, g, b, if object(x, y) { 255 } else { 0 }])
        });
        let cut = saved(dir.path(), "cut.png", cut);
        let alone = of_photo(&cut, None, None, &INTRINSICS, 6).unwrap();
        assert_eq!((alone.corner, alone.extent, alone.weights.is_none()), ([40, 3], 12, true));
        assert_eq!((&alone.rgb[..3], &alone.rgb[3 * 13..][..3]), (&[1.0; 3][..], &[-1.0, -1.0, 1.0][..]));
        let coverage = alone.coverage.as_ref().unwrap();
        assert_eq!((&coverage[..6], &coverage[12..18]), (&[0.0; 6][..], &[0.5, 1.0, 1.0, 1.0, 1.0, 0.5][..]));
        // A mask that cuts out is as good, and goes together with transparency.
        assert_eq!(of_photo(&photo, Some(Cutout::Mask(&mask)), None, &INTRINSICS, 6).unwrap(), alone);
        assert_eq!(of_photo(&cut, Some(Cutout::Mask(&mask)), None, &INTRINSICS, 6).unwrap(), alone);
        let left = GrayImage::from_fn(60, 40, |x, _| Luma([if x < 46 { 255 } else { 0 }]));
        let left = saved(dir.path(), "left.png", left);
        let both = of_photo(&cut, None, Some(&left), &INTRINSICS, 6).unwrap();
        assert_eq!((both.corner, both.extent), ([39, 5], 8));
        // 7 of its 8 columns are in the mask; the last of the square's takes in the last one and a third.
        assert_eq!(both.weights.unwrap()[..6], [1.0, 1.0, 1.0, 1.0, 1.0, 0.25]);
    }

    /// Of an object that the edge of the photograph cuts off nobody knows how far it reaches.
    #[test]
    fn beyond_the_edge_that_an_object_reaches_nothing_counts() {
        let dir = tempfile::tempdir().unwrap();
        let cut = |from: u32, to: u32| {
            let alpha = |x: u32, y: u32| if (from..to).contains(&x) && (10..20).contains(&y) { 255 } else { 0 };
            let path = saved(dir.path(), "cut.png", RgbaImage::from_fn(60, 40, |x, y| Rgba([255, 0, 0, alpha(x, y)])));
            of_photo(&path, None, None, &INTRINSICS, 12).unwrap()
        };
        // 10 pixels and one on each side; the last column is one beyond the edge.
        let target = cut(50, 60);
        assert_eq!((target.corner, target.extent), ([49, 9], 12));
        let expected: Vec<f32> = (0..144).map(|pixel| f32::from(pixel % 12 < 11)).collect();
        assert_eq!(target.weights, Some(expected));
        let coverage = target.coverage.unwrap();
        assert_eq!((&coverage[..11], coverage[12], coverage[13], coverage[22]), (&[0.0; 11][..], 0.0, 1.0, 1.0));
        assert_eq!(cut(49, 59).weights, None);
    }

    #[test]
    fn a_square_may_reach_out_of_the_photograph() {
        let dir = tempfile::tempdir().unwrap();
        let photo = saved(dir.path(), "photo.png", RgbImage::from_pixel(60, 40, Rgb([255, 0, 0])));
        let mask = saved(dir.path(), "mask.png", GrayImage::from_fn(60, 40, |x, _| Luma([if x < 20 { 255 } else { 0 }])));
        let target = of_photo(&photo, None, Some(&mask), &INTRINSICS, 12).unwrap();
        assert_eq!((target.corner, target.extent), ([-14, -4], 48));
        let weights = target.weights.unwrap();
        // Of the square's row, 14 pixels lie outside, 20 in the mask: 3.5 and 5 of its own.
        assert_eq!(weights[6 * 12..7 * 12], [0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0, 0.5, 0.0, 0.0, 0.0]);
        assert_eq!(weights[..12], [0.0; 12]);
    }

    #[test]
    fn views_stay_as_they_were_cut() {
        let dir = tempfile::tempdir().unwrap();
        let picture = RgbImage::from_fn(60, 40, |x, y| Rgb(colour(x, y)));
        let path = saved(dir.path(), "view.png", picture);
        let (pixels, intrinsics) = load_square(&path, &INTRINSICS, 8).unwrap();
        let plain = of_view(&path, None, &INTRINSICS, 8).unwrap();
        assert_eq!((&plain.rgb, plain.intrinsics, plain.weights, plain.coverage), (&pixels.data, intrinsics, None, None));
        assert_eq!((plain.corner, plain.extent), ([10, 0], 40));
        assert_eq!(of_photo(&path, None, None, &INTRINSICS, 8).unwrap().rgb, pixels.data);
        let top = saved(dir.path(), "top.png", GrayImage::from_fn(60, 40, |_, y| Luma([if y < 20 { 255 } else { 0 }])));
        let masked = of_view(&path, Some(&top), &INTRINSICS, 8).unwrap();
        assert_eq!(masked.intrinsics, intrinsics);
        assert_eq!(masked.weights.unwrap(), [[1.0; 32], [0.0; 32]].concat());
        assert!(masked.rgb[..96].iter().zip(&pixels.data).all(|(a, b)| (a - b).abs() < 1e-6));
        assert_eq!(masked.rgb[96..], [1.0; 96]);
    }

    /// Of 16 bits, too.
    #[test]
    fn a_mask_may_have_the_number_of_the_object() {
        let dir = tempfile::tempdir().unwrap();
        let object = |x: u32, y: u32| u16::from((41..51).contains(&x) && (6..12).contains(&y));
        let label = saved(dir.path(), "label.png", image::ImageBuffer::from_fn(60, 40, |x, y| Luma([object(x, y)])));
        let white = saved(dir.path(), "white.png", GrayImage::from_fn(60, 40, |x, y| Luma([255 * object(x, y) as u8])));
        let grey = saved(dir.path(), "grey.png", image::ImageBuffer::from_fn(60, 40, |x, y| Luma([(257 * x + y) as u16])));
        let [label, white, grey] = [label, white, grey].map(|mask| counts(&mask, [60, 40]).unwrap());
        assert_eq!(label, white);
        assert_eq!(grey[17], 17.0 / 255.0);
    }

    #[test]
    fn masks_that_do_not_fit_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let photo = saved(dir.path(), "photo.png", RgbImage::new(60, 40));
        let small = saved(dir.path(), "small.png", GrayImage::new(6, 4));
        let black = saved(dir.path(), "black.png", GrayImage::new(60, 40));
        let error = |mask: &Path| of_photo(&photo, None, Some(mask), &INTRINSICS, 6).unwrap_err().to_string();
        let (wrong, nothing) = (error(&small), error(&black));
        assert!(wrong.contains("small.png") && wrong.contains("60×40") && wrong.contains("6×4"), "{wrong}");
        assert!(nothing.contains("black.png") && nothing.contains("nothing"), "{nothing}");
        assert!(error(&dir.path().join("nowhere.png")).contains("nowhere.png"));
    }
}
