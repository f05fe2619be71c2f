//! Pictures of the network's output, large enough to look at.

use image::RgbImage;
use srn_data::pixels::rgb8;
use srn_data::sheet::{self, Colour, GREY, HEAT};

/// The colour scale of differences ends at this part of the range from black to white.
const DIFFERENCE_RANGE: f32 = 0.5;

/// Colours in [-1, 1] of a square view, enlarged by a whole factor to at least `shown` pixels, framed.
pub fn view(rgb: &[f32], side: u32, shown: u32) -> RgbImage {
    framed(sheet::enlarge(&rgb8(rgb, side as usize, side as usize), shown.div_ceil(side)))
}

/// Where two views differ: from white, not at all, by yellow and red to black, half the range of colours and more.
pub fn difference(a: &[f32], b: &[f32], side: u32, shown: u32) -> RgbImage {
    let mean = |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(a, b)| (a - b.clamp(-1.0, 1.0)).abs()).sum::<f32>() / 6.0;
    let values: Vec<_> = a.chunks_exact(3).zip(b.chunks_exact(3)).map(|pair| mean(pair) / DIFFERENCE_RANGE).collect();
    framed(sheet::enlarge(&mapped(&values, side, &HEAT, [0.0, 1.0]), shown.div_ceil(side)))
}

/// Numbers as colours, from the first of `stops` at `range[0]` to the last at `range[1]`.
pub fn mapped(values: &[f32], side: u32, stops: &[Colour], range: [f64; 2]) -> RgbImage {
    let [low, high] = range;
    let colour = |value: f32| sheet::ramp(stops, (f64::from(value) - low) / (high - low));
    RgbImage::from_fn(side, side, |x, y| image::Rgb(colour(values[(y * side + x) as usize])))
}

/// A white background must not run into the page.
fn framed(mut picture: RgbImage) -> RgbImage {
    let (right, bottom) = (picture.width() - 1, picture.height() - 1);
    for (x, y, pixel) in picture.enumerate_pixels_mut() {
        if x == 0 || y == 0 || x == right || y == bottom {
            pixel.0 = GREY;
        }
    }
    picture
}
