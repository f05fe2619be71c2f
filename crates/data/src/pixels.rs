//! Image files: RGB in [-1, 1].

use crate::error::{At, Error, Result, read_bytes};
use image::error::DecodingError;
use image::{DynamicImage, ImageFormat, RgbImage};
use srn_photo::Pixels;
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

/// Reads an image file of any colour type and depth; transparency is laid over white.
pub fn open(path: &Path) -> Result<Pixels> {
    Ok(open_with_opacity(path)?.0)
}

/// The same, with the opacity of each pixel, 0 to 1.
pub(crate) fn open_with_opacity(path: &Path) -> Result<(Pixels, Vec<f32>)> {
    let rgba = decode(path)?.into_rgba32f();
    let data = rgba.pixels().flat_map(|p| [0, 1, 2].map(|c| 2.0 * (p[c] * p[3] + (1.0 - p[3])) - 1.0)).collect();
    let opacity = rgba.pixels().map(|p| p[3]).collect();
    Ok((Pixels { width: rgba.width() as usize, height: rgba.height() as usize, data }, opacity))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jpeg_that_ends_early_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("photo.jpg");
        RgbImage::from_fn(64, 64, |x, y| image::Rgb([(x * y) as u8, (3 * x) as u8, y as u8])).save(&path).unwrap();
        let whole = std::fs::read(&path).unwrap();
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            open(&path).map_err(|error| error.to_string())
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
            let read = open(&path).unwrap();
            let read = rgb8(&read.data, read.width, read.height);
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
            open(&path).map(|read| read.data[..3].to_vec()).map_err(|error| error.to_string())
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
            let read = open(&path).unwrap();
            assert!(read.data[..3].iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{name}: {:?}", &read.data[..3]);
        }
    }
}
