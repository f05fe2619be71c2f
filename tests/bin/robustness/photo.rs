//! Photographs of an object on a table, and what may be wrong with them and their masks.

use std::f64::consts::TAU;

use image::imageops::{self, FilterType};
use image::{GrayImage, ImageBuffer, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

/// Their width and height in pixels.
pub const SIDE: u32 = 256;
/// Colour of the table that objects lie on, how bright it is in a shadow, and what is before them.
const TABLE: [f64; 3] = [115.0, 89.0, 64.0];
const SHADOW: f64 = 0.45;
const BAR: Rgb<u8> = Rgb([90, 96, 104]);

/// What light makes of a colour in [0, 1] that is so far to the right, in [0, 1].
pub type Lit = fn([f64; 3], f64) -> [f64; 3];

/// What is wrong with a picture. Lengths are pixels of [`SIDE`].
#[derive(Clone, Copy)]
pub enum Spoil {
    /// Cut out exactly, in the light of the training.
    Nothing,
    /// Other light.
    Light(Lit),
    /// The mask, so much too large.
    Larger(f64),
    /// The mask, off by this standard deviation at random, alike over 8.
    Ragged(f64),
    /// A disc of this radius beside the object taken for it.
    Disc(f64),
    /// A shadow taken for it: the outline, moved.
    Shadow([i64; 2]),
    /// This part of its height missing in the mask, below.
    Missing(f64),
    /// This part of it missing in the mask, on one of four sides.
    Lacking(f64),
    /// The segmentation says what counts; around the object there is anything. In other light.
    Alone(Lit),
    /// A bar over this part of it, from one of four sides.
    Bar(f64),
    /// This part of it beyond the picture's edge, on one of four sides.
    Edge(f64),
    /// Given as another of the objects, so many further on.
    Another(usize),
    /// Not cut out: on the table, so many others behind it, and a box around it; then given as another, so many further on.
    Among(usize, usize),
    /// In a room with others, nobody knows where; given as another, so many further on.
    Room(usize),
}

/// A picture of an object on a table.
pub struct Photo {
    pub picture: RgbImage,
    /// What of it is the object.
    object: GrayImage,
}

pub struct Spoiled {
    /// Opaque where the object is, as far as is said.
    pub picture: RgbaImage,
    /// What counts, if not all.
    pub mask: Option<GrayImage>,
    /// Left edge, top edge, width and height of a box around the object.
    pub bounds: Option<[u32; 4]>,
    /// Where in the whole picture its first pixel was.
    pub corner: [u32; 2],
}

const INSIDE: Luma<u8> = Luma([255]);
pub const OUTSIDE: Luma<u8> = Luma([0]);

impl Photo {
    /// Of a rendered object on white.
    pub fn new(rendered: &RgbImage, random: &mut Pcg64Mcg) -> Self {
        let texture = smooth_noise(4, random);
        let colour = |x, y| match *rendered.get_pixel(x, y) {
            Rgb([255, 255, 255]) => Rgb(TABLE.map(|v| (v * (1.0 + 0.08 * f64::from(texture.get_pixel(x, y)[0]))) as u8)),
            object => object,
        };
        let object = |x, y| if rendered.get_pixel(x, y).0 == [255; 3] { OUTSIDE } else { INSIDE };
        Photo { picture: RgbImage::from_fn(SIDE, SIDE, colour), object: GrayImage::from_fn(SIDE, SIDE, object) }
    }

    /// With other rendered objects behind it, anywhere.
    pub fn among(mut self, others: &[RgbImage], random: &mut Pcg64Mcg) -> Self {
        for other in others {
            let [dx, dy] = [(); 2].map(|()| random.random_range(-110..=110));
            for (x, y, pixel) in self.picture.enumerate_pixels_mut() {
                let at = |at: u32, by: i64| u32::try_from(i64::from(at) - by).unwrap_or(SIDE);
                let behind = other.get_pixel_checked(at(x, dx), at(y, dy)).filter(|colour| colour.0 != [255; 3]);
                if let (OUTSIDE, Some(colour)) = (*self.object.get_pixel(x, y), behind) {
                    *pixel = *colour;
                }
            }
        }
        self
    }

    /// With something wrong; bars, edges and what is lacking come from another side in each `view`.
    pub fn spoiled(&mut self, spoil: Spoil, view: usize, random: &mut Pcg64Mcg) -> Spoiled {
        let [[left, right], [top, bottom]] = self.extent();
        let (mut seen, mut mask, mut frame) = (self.object.clone(), None, [[0, SIDE]; 2]);
        let mut bounds = None;
        match spoil {
            Spoil::Nothing | Spoil::Another(_) | Spoil::Room(_) => {}
            Spoil::Light(lit) => self.lit_by(lit),
            Spoil::Larger(by) => seen = self.moved(|_, _| by),
            Spoil::Ragged(by) => {
                let noise = smooth_noise(8, random);
                seen = self.moved(|x, y| by * f64::from(noise.get_pixel(x, y)[0]));
            }
            Spoil::Disc(radius) => {
                let middle = [f64::from(right), 0.5 * f64::from(top + bottom)];
                let is_in = |x: u32, y: u32| (f64::from(x) - middle[0]).hypot(f64::from(y) - middle[1]) <= radius;
                fill(&mut seen, is_in, INSIDE);
            }
            Spoil::Shadow([dx, dy]) => {
                let from = |at: u32, by: i64| u32::try_from(i64::from(at) - by).unwrap_or(SIDE);
                let object = &self.object;
                let is_shadow = |x: u32, y: u32| {
                    let lit_by = object.get_pixel_checked(from(x, dx), from(y, dy));
                    *object.get_pixel(x, y) == OUTSIDE && lit_by == Some(&INSIDE)
                };
                fill(&mut seen, is_shadow, INSIDE);
                let shadows = self.picture.enumerate_pixels_mut().filter(|(x, y, _)| is_shadow(*x, *y));
                shadows.for_each(|(.., pixel)| pixel.0 = pixel.0.map(|v| (SHADOW * f64::from(v)) as u8));
            }
            Spoil::Missing(part) => {
                let first = bottom - (part * f64::from(bottom - top)) as u32;
                fill(&mut seen, |_, y| y >= first, OUTSIDE);
            }
            Spoil::Lacking(part) => {
                let side = self.side(part, view);
                fill(&mut seen, |x, y| [x, y].iter().zip(side).all(|(at, [first, end])| (first..end).contains(at)), OUTSIDE);
            }
            Spoil::Among(..) => {
                bounds = Some([left, top, right + 1 - left, bottom + 1 - top]);
                seen = GrayImage::from_pixel(SIDE, SIDE, INSIDE);
            }
            Spoil::Alone(lit) => {
                self.lit_by(lit);
                mask = Some(std::mem::replace(&mut seen, GrayImage::from_pixel(SIDE, SIDE, INSIDE)));
            }
            Spoil::Bar(part) => {
                let bar = self.side(part, view);
                let is_bar = |x: u32, y: u32| [x, y].iter().zip(bar).all(|(at, [first, end])| (first..end).contains(at));
                let mut counts = GrayImage::from_pixel(SIDE, SIDE, INSIDE);
                fill(&mut counts, is_bar, OUTSIDE);
                fill(&mut seen, is_bar, OUTSIDE);
                fill(&mut self.picture, is_bar, BAR);
                mask = Some(counts);
            }
            Spoil::Edge(part) => {
                let rest = |[first, end]: [u32; 2]| match (first, end) {
                    (0, SIDE) => [0, SIDE],
                    (0, _) => [end, SIDE],
                    _ => [0, first],
                };
                frame = self.side(part, view).map(rest);
            }
        }
        let [[left, end], [top, below]] = frame;
        let pixel = |x, y| {
            let (Rgb([r, g, b]), Luma([a])) = (self.picture.get_pixel(left + x, top + y), seen.get_pixel(left + x, top + y));
            Rgba([*r, *g, *b, *a])
        };
        Spoiled { picture: RgbaImage::from_fn(end - left, below - top, pixel), mask, bounds, corner: [left, top] }
    }

    /// The object's first and last column, and row.
    fn extent(&self) -> [[u32; 2]; 2] {
        let mut extent = [[SIDE, 0]; 2];
        for (x, y, _) in self.object.enumerate_pixels().filter(|(.., pixel)| **pixel == INSIDE) {
            for ([first, last], at) in extent.iter_mut().zip([x, y]) {
                (*first, *last) = (at.min(*first), at.max(*last));
            }
        }
        extent
    }

    /// Columns and rows, from and up to, of `part` of the object and all that is beyond, from one of four sides.
    fn side(&self, part: f64, view: usize) -> [[u32; 2]; 2] {
        let (axis, is_last) = (view % 2, view % 4 >= 2);
        let [first, last] = self.extent()[axis];
        let wide = (part * f64::from(last + 1 - first)).round() as u32;
        let mut side = [[0, SIDE]; 2];
        side[axis] = if is_last { [last + 1 - wide, SIDE] } else { [0, first + wide] };
        side
    }

    fn lit_by(&mut self, lit: Lit) {
        for (x, _, pixel) in self.picture.enumerate_pixels_mut() {
            let colour = lit(pixel.0.map(|v| f64::from(v) / 255.0), f64::from(x) / f64::from(SIDE));
            pixel.0 = colour.map(|v| (255.0 * v).round() as u8);
        }
    }

    /// The outline, so many pixels farther out.
    fn moved(&self, by: impl Fn(u32, u32) -> f64) -> GrayImage {
        let is_in = |x: i64, y: i64| {
            let at = |v: i64| u32::try_from(v).unwrap_or(SIDE);
            self.object.get_pixel_checked(at(x), at(y)) == Some(&INSIDE)
        };
        let pixel = |x: u32, y: u32| {
            let (own, reach) = (is_in(x.into(), y.into()), -8..=8);
            let others = reach.clone().flat_map(|dy| reach.clone().map(move |dx| (dx, dy)));
            let others = others.filter(|(dx, dy)| is_in(i64::from(x) + dx, i64::from(y) + dy) != own);
            let nearest = others.map(|(dx, dy)| ((dx * dx + dy * dy) as f64).sqrt()).fold(f64::INFINITY, f64::min);
            let inwards = if own { nearest - 0.5 } else { 0.5 - nearest };
            if inwards + by(x, y) > 0.0 { INSIDE } else { OUTSIDE }
        };
        GrayImage::from_fn(SIDE, SIDE, pixel)
    }
}

fn fill<P: image::Pixel>(picture: &mut ImageBuffer<P, Vec<P::Subpixel>>, is_in: impl Fn(u32, u32) -> bool, with: P) {
    picture.enumerate_pixels_mut().filter(|(x, y, _)| is_in(*x, *y)).for_each(|(.., pixel)| *pixel = with);
}

/// Normal numbers with mean 0 and deviation 1, alike over so many pixels.
fn smooth_noise(over: u32, random: &mut Pcg64Mcg) -> ImageBuffer<Luma<f32>, Vec<f32>> {
    let coarse = ImageBuffer::from_fn(SIDE / over, SIDE / over, |_, _| {
        let (u, v): (f64, f64) = (1.0 - random.random::<f64>(), random.random());
        // Resizing keeps to [0, 1].
        Luma([(0.5 + 0.1 * (-2.0 * u.ln()).sqrt() * (TAU * v).cos()) as f32])
    });
    let mut noise = imageops::resize(&coarse, SIDE, SIDE, FilterType::CatmullRom);
    let mean = |values: &mut dyn Iterator<Item = f32>| values.sum::<f32>() / (SIDE * SIDE) as f32;
    let middle = mean(&mut noise.pixels().map(|pixel| pixel[0]));
    let deviation = mean(&mut noise.pixels().map(|pixel| (pixel[0] - middle).powi(2))).sqrt();
    noise.pixels_mut().for_each(|pixel| pixel[0] = (pixel[0] - middle) / deviation);
    noise
}

/// A colour (sRGB, in [0, 1]) with each channel so many times as bright.
pub fn exposed(colour: [f64; 3], factors: [f64; 3]) -> [f64; 3] {
    let linear = |v: f64| if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    let coded = |v: f64| if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    std::array::from_fn(|k| coded((factors[k] * linear(colour[k])).min(1.0)))
}
