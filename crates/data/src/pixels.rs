//! Images as the network sees them: RGB in [-1, 1], square, area-resampled.

use crate::error::{At, Error, Result, read_bytes};
use image::error::DecodingError;
use image::{DynamicImage, ImageFormat, RgbImage};
use std::path::{Path, PathBuf};

/// How names of pictures end that are read, in lower case. What they are is told by their first bytes.
pub const ENDINGS: [&str; 7] = ["png", "jpg", "jpeg", "bmp", "tif", "tiff", "webp"];

/// Whether the name of a file ends like that of a picture.
pub fn is_picture(path: &Path) -> bool {
    ends_like(path, &ENDINGS)
}

/// Whether the name of a file has one of these endings, in any case.
pub(crate) fn ends_like(path: &Path, endings: &[&str]) -> bool {
    path.extension().is_some_and(|ending| endings.iter().any(|known| ending.eq_ignore_ascii_case(known)))
}

/// The picture without its ending, if there is one with any of them.
pub(crate) fn with_ending(path: &Path) -> Option<PathBuf> {
    ENDINGS.map(|ending| PathBuf::from(format!("{}.{ending}", path.display()))).into_iter().find(|path| path.is_file())
}

/// A float image: `data` is row-major `[height · width, 3]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Pixels {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// RGB triples in [-1, 1], row-major.
    pub data: Vec<f32>,
}

impl Pixels {
    /// Reads an image file of any colour type and depth; transparency is laid over white.
    pub fn open(path: &Path) -> Result<Self> {
        Ok(Self::open_with_opacity(path)?.0)
    }

    /// The same, with the opacity of each pixel, 0 to 1.
    pub(crate) fn open_with_opacity(path: &Path) -> Result<(Self, Vec<f32>)> {
        let rgba = decode(path)?.into_rgba32f();
        let data = rgba.pixels().flat_map(|p| [0, 1, 2].map(|c| 2.0 * (p[c] * p[3] + (1.0 - p[3])) - 1.0)).collect();
        let opacity = rgba.pixels().map(|p| p[3]).collect();
        Ok((Self { width: rgba.width() as usize, height: rgba.height() as usize, data }, opacity))
    }

    /// The centred square.
    pub fn centre_square(&self) -> Self {
        let side = self.width.min(self.height);
        let corner = [(self.width - side) / 2, (self.height - side) / 2];
        self.square(corner.map(|x| x as i64), side, 1.0)
    }

    /// The square of `side` pixels from `corner` on, `outside` where it reaches out of the image.
    pub(crate) fn square(&self, corner: [i64; 2], side: usize, outside: f32) -> Self {
        let mut data = vec![outside; 3 * side * side];
        for (y, row) in (corner[1]..).zip(data.chunks_exact_mut(3 * side)) {
            let there = usize::try_from(y).ok().filter(|&y| y < self.height);
            for (x, pixel) in (corner[0]..).zip(row.chunks_exact_mut(3)) {
                if let (Some(y), Some(x)) = (there, usize::try_from(x).ok().filter(|&x| x < self.width)) {
                    pixel.copy_from_slice(&self.data[3 * (y * self.width + x)..][..3]);
                }
            }
        }
        Self { width: side, height: side, data }
    }

    /// A `width × height` image in which each pixel is the mean of the area that it covers here.
    pub fn area_resample(&self, width: usize, height: usize) -> Self {
        if [width, height] == [self.width, self.height] {
            return self.clone();
        }
        let across = resample_rows(&self.data, self.width, width);
        let turned = transpose(&across, width, self.height);
        let data = transpose(&resample_rows(&turned, self.height, height), height, width);
        Self { width, height, data }
    }

    /// The image in 8 bits, rounded to nearest.
    pub fn to_rgb8(&self) -> RgbImage {
        rgb8(&self.data, self.width, self.height)
    }
}

/// Reads an image file, all of it.
pub(crate) fn decode(path: &Path) -> Result<DynamicImage> {
    let bytes = read_bytes(path)?;
    let reader = image::ImageReader::new(std::io::Cursor::new(&bytes)).with_guessed_format().at(path)?;
    if reader.format() == Some(ImageFormat::Jpeg) && ends_early(&bytes) {
        let source = DecodingError::new(ImageFormat::Jpeg.into(), "the picture ends early");
        return Err(Error::Image { path: path.into(), source: image::ImageError::Decoding(source) });
    }
    let picture = reader.decode().at(path)?;
    let floats: &[f32] = match &picture {
        DynamicImage::ImageRgb32F(picture) => picture,
        DynamicImage::ImageRgba32F(picture) => picture,
        _ => &[],
    };
    match floats.iter().find(|value| !(0.0..=1.0).contains(*value)) {
        Some(value) => Err(Error::field(path, "pixels", "values from 0 to 1", value)),
        None => Ok(picture),
    }
}

/// Whether a JPEG has no end: the decoder would make up what is missing, in grey. Looked for from segment to segment, since a
/// preview among them has an end of its own; what follows the end is no part of the picture.
fn ends_early(jpeg: &[u8]) -> bool {
    let mut at = 2;
    loop {
        match jpeg.get(at..) {
            Some([0xff, 0xd9, ..]) => return false,
            Some([0xff, 0xc0..=0xcf | 0xda..=0xfe, high, low, ..]) => at += 2 + usize::from(u16::from_be_bytes([*high, *low])),
            Some([_, ..]) => at += 1,
            _ => return true,
        }
    }
}

/// RGB triples in [-1, 1] as an 8-bit image, clamped and rounded to nearest. Missing pixels are black, surplus ones ignored.
pub fn rgb8(data: &[f32], width: usize, height: usize) -> RgbImage {
    let byte = |x: f32| ((x * 0.5 + 0.5).clamp(0.0, 1.0) * 255.0).round() as u8;
    RgbImage::from_fn(width as u32, height as u32, |x, y| {
        let at = 3 * (y as usize * width + x as usize);
        image::Rgb([0, 1, 2].map(|c| data.get(at + c).map_or(0, |&v| byte(v))))
    })
}

/// Each row of `from` pixels becomes `to` pixels; partly covered pixels count by their share.
fn resample_rows(data: &[f32], from: usize, to: usize) -> Vec<f32> {
    let step = from as f64 / to as f64;
    let mut out = Vec::with_capacity(data.len() / from.max(1) * to);
    for row in data.chunks_exact(3 * from) {
        for i in 0..to {
            let (start, end) = (i as f64 * step, (i + 1) as f64 * step);
            let mut sum = [0.0f64; 3];
            for k in start as usize..(end.ceil() as usize).min(from) {
                let share = end.min(k as f64 + 1.0) - start.max(k as f64);
                (0..3).for_each(|c| sum[c] += share * f64::from(row[3 * k + c]));
            }
            out.extend(sum.map(|s| (s / step) as f32));
        }
    }
    out
}

fn transpose(data: &[f32], width: usize, height: usize) -> Vec<f32> {
    let pixel = |i: usize| &data[3 * ((i % height) * width + i / height)..][..3];
    (0..width * height).flat_map(pixel).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: usize, height: usize, values: &[f32]) -> Pixels {
        Pixels { width, height, data: values.iter().flat_map(|&v| [v; 3]).collect() }
    }

    #[test]
    fn area_resample_takes_means() {
        let half = grey(4, 2, &[0.0, 1.0, 0.5, 0.5, 1.0, 0.0, -1.0, 0.0]).area_resample(2, 1);
        assert_eq!(half, grey(2, 1, &[0.5, 0.0]));
        // 3 → 2: each new pixel covers one and a half old ones.
        let thirds = grey(3, 1, &[0.0, 0.6, 0.9]).area_resample(2, 1);
        let expected = [0.3 / 1.5, (0.3 + 0.9) / 1.5];
        assert!(thirds.data.iter().step_by(3).zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{thirds:?}");
        let column = grey(1, 3, &[0.0, 0.6, 0.9]).area_resample(1, 2);
        assert_eq!(column.data, thirds.data);
        let same = grey(2, 2, &[0.1, 0.2, 0.3, 0.4]);
        assert_eq!(same.area_resample(2, 2), same);
    }

    #[test]
    fn channels_stay_apart() {
        let image = Pixels { width: 2, height: 1, data: vec![1.0, 0.0, -1.0, 0.0, 1.0, -1.0] };
        assert_eq!(image.area_resample(1, 1).data, [0.5, 0.5, -1.0]);
    }

    #[test]
    fn the_square_is_centred() {
        let square = grey(4, 2, &[0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]).centre_square();
        assert_eq!(square, grey(2, 2, &[0.1, 0.2, 0.5, 0.6]));
    }

    #[test]
    fn a_jpeg_that_ends_early_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("photo.jpg");
        RgbImage::from_fn(64, 64, |x, y| image::Rgb([(x * y) as u8, (3 * x) as u8, y as u8])).save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Pixels::open(&path).map_err(|error| error.to_string())
        };
        let picture = read(&whole).unwrap();
        assert_eq!(read(&[&whole[..], b"more, as phones append\xff"].concat()).unwrap(), picture);
        // A segment with a preview, whose end is not that of the picture.
        let preview = [&[0xff, 0xd8, 0xff, 0xe1, 0, 8][..], &[0xff, 0xd8, 7, 7, 0xff, 0xd9]].concat();
        let with_preview = [&preview, &whole[2..]].concat();
        assert_eq!(read(&with_preview).unwrap(), picture);
        for early in [&whole[..whole.len() / 2], &whole[..whole.len() - 2], &with_preview[..with_preview.len() * 3 / 4]] {
            let error = read(early).unwrap_err();
            assert!(error.contains("photo.jpg") && error.contains("the picture ends early"), "{error}");
        }
    }

    #[test]
    fn pictures_are_read_whatever_their_format() {
        let dir = tempfile::tempdir().unwrap();
        let drawn = RgbImage::from_fn(16, 8, |x, y| image::Rgb([(16 * x) as u8, (32 * y) as u8, 90]));
        for ending in ENDINGS {
            let path = dir.path().join("frame").with_extension(ending.to_uppercase());
            drawn.save(&path).unwrap();
            let read = Pixels::open(&path).unwrap().to_rgb8();
            let most = read.iter().zip(drawn.iter()).map(|(a, b)| a.abs_diff(*b)).max();
            let is_lossy = ["jpg", "jpeg"].contains(&ending);
            assert!(most <= Some(if is_lossy { 40 } else { 0 }) && is_picture(&path), "{ending}: {most:?}");
        }
        assert!(!is_picture(Path::new("png")) && !is_picture(Path::new("pose.txt")));
        let named = |name: &str| with_ending(&dir.path().join(name));
        std::fs::write(dir.path().join("v1.2.webp"), "").unwrap();
        assert_eq!([named("v1.2"), named("v1")], [Some(dir.path().join("v1.2.webp")), None]);
    }

    #[test]
    fn values_that_are_no_shares_of_white_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("linear.tiff");
        let read = |white: f32| {
            DynamicImage::from(image::Rgb32FImage::from_pixel(2, 2, image::Rgb([0.0, 0.5, white]))).save(&path).unwrap();
            Pixels::open(&path).map(|read| read.data[..3].to_vec()).map_err(|error| error.to_string())
        };
        assert_eq!(read(1.0).unwrap(), [-1.0, 0.0, 1.0]);
        let errors = [255.0, f32::NAN].map(|white| read(white).unwrap_err());
        assert!(errors.iter().all(|error| error.contains("linear.tiff") && error.contains("from 0 to 1")), "{errors:?}");
    }

    #[test]
    fn every_colour_type_is_read_and_transparency_is_white() {
        let dir = tempfile::tempdir().unwrap();
        let cases: [(&str, DynamicImage, [f32; 3]); 3] = [
            ("grey", image::GrayImage::from_pixel(2, 2, image::Luma([51])).into(), [-0.6; 3]),
            ("deep", image::ImageBuffer::from_pixel(2, 2, image::Rgb([0u16, 65535, 13107])).into(), [-1.0, 1.0, -0.6]),
            ("alpha", image::RgbaImage::from_pixel(2, 2, image::Rgba([0, 0, 255, 51])).into(), [0.6, 0.6, 1.0]),
        ];
        for (name, picture, expected) in cases {
            let path = dir.path().join(name).with_extension("png");
            picture.save(&path).unwrap();
            let read = Pixels::open(&path).unwrap();
            assert!(read.data[..3].iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{name}: {:?}", &read.data[..3]);
        }
    }
}
