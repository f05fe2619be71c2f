//! The outline of the found object on the picture as it was given: what a person believes at a glance, or does not.

use std::path::Path;

use image::{Rgb, RgbImage};
use sigma_srn::{Engine, Intrinsics, Model};
use srn_data::pixels::Pixels;
use srn_data::sheet::{self, BLACK, Colour};

use super::files::{Picture, write_png};
use super::search::{Found, render};
use crate::common::Result;

/// Colour of the line; its rim is black.
const LINE: Colour = [60, 255, 90];
/// The view is rendered at most at this many times the side that the model takes.
const FINEST: usize = 4;
/// Shorter pictures are enlarged until they have this height, pixels.
const LEAST_HEIGHT: u32 = 320;

/// Writes `NAME-outline.png` of the picture at `path` to `dir`.
pub fn write(dir: &Path, path: &Path, picture: &Picture, found: &Found, engine: &Engine, model: &Model, side: u32) -> Result<()> {
    let (corner, extent) = picture.square;
    let times = extent.div_ceil(side as usize).clamp(1, FINEST) as u32;
    let k = f64::from(times);
    let Intrinsics { fx, fy, cx, cy, pixel_center } = picture.intrinsics;
    // Edges of pixels stay where they are, half a pixel before the centres.
    let [cx, cy] = [cx, cy].map(|c| k * (c + 0.5) - 0.5);
    let finer = Intrinsics { fx: k * fx, fy: k * fy, cx, cy, pixel_center };
    let view = &render(engine, model, times * side, &[(picture.instance, found.world_from_camera, finer)])?[0];
    let silhouette = Silhouette::of(&view.rgb, (times * side) as usize);

    let photo = Pixels::open(path)?.to_rgb8();
    let factor = LEAST_HEIGHT.div_ceil(photo.height());
    let mut page = sheet::enlarge(&photo, factor);
    let inside = |[x, y]: [i64; 2]| {
        let place = [(x, corner[0]), (y, corner[1])];
        let at = place.map(|(x, first)| ((x as f64 + 0.5) / f64::from(factor) - first as f64) / extent as f64);
        silhouette.covers(at)
    };
    draw(&mut page, inside);
    write_png(&dir.join(format!("{}-outline.png", picture.name)), &page)
}

/// Where a view shows the object.
struct Silhouette {
    side: usize,
    /// How far from white each pixel is.
    darkness: Vec<f32>,
    /// Half as dark as the object is, by its median: between object and background pixels are of both.
    limit: f32,
}

impl Silhouette {
    fn of(rgb: &[f32], side: usize) -> Self {
        let far = |pixel: &[f32]| pixel.iter().map(|c| 1.0 - c.clamp(-1.0, 1.0)).fold(0.0, f32::max);
        let darkness: Vec<f32> = rgb.chunks_exact(3).map(far).collect();
        let mut object: Vec<f32> = darkness.iter().copied().filter(|&d| d > 0.2).collect();
        object.sort_by(f32::total_cmp);
        let limit = object.get(object.len() / 2).map_or(f32::INFINITY, |median| 0.5 * median);
        Silhouette { side, darkness, limit }
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
        let row = |y: usize| (1.0 - fx) * self.darkness[y * self.side + x0] + fx * self.darkness[y * self.side + x1];
        (1.0 - fy) * row(y0) + fy * row(y1) > self.limit
    }
}

/// Draws the border of a region, as thick as the picture is large.
fn draw(page: &mut RgbImage, inside: impl Fn([i64; 2]) -> bool) {
    let [width, height] = [page.width(), page.height()].map(i64::from);
    let region: Vec<bool> = (0..height).flat_map(|y| (0..width).map(move |x| [x, y])).map(inside).collect();
    let at = |x: i64, y: i64| region[(y * width + x) as usize];
    let border: Vec<[i64; 2]> = (1..height)
        .flat_map(|y| (1..width).map(move |x| [x, y]))
        .filter(|&[x, y]| at(x, y) != at(x - 1, y) || at(x, y) != at(x, y - 1))
        .collect();
    let radius = width.max(height) / 640;
    for (radius, colour) in [(radius + 1, BLACK), (radius, LINE)] {
        for [x, y] in &border {
            for (dx, dy) in (-radius..=radius).flat_map(|dy| (-radius..=radius).map(move |dx| (dx, dy))) {
                let near = dx * dx + dy * dy <= radius * radius;
                if near && (0..width).contains(&(x + dx)) && (0..height).contains(&(y + dy)) {
                    page.put_pixel((x + dx) as u32, (y + dy) as u32, Rgb(colour));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_lies_on_the_edge() {
        // Grey from the middle on to the right, white before; the limit lies half-way, and so does the line.
        let rgb: Vec<f32> = (0..64).flat_map(|i| [if i % 8 < 4 { 1.0 } else { 0.0 }; 3]).collect();
        let silhouette = Silhouette::of(&rgb, 8);
        assert!(!silhouette.covers([0.49, 0.3]) && silhouette.covers([0.51, 0.3]));
        assert!(!silhouette.covers([1.2, 0.3]) && !silhouette.covers([0.9, -0.1]));
        let mut page = sheet::blank(100, 50);
        draw(&mut page, |[x, y]| silhouette.covers([x as f64 / 100.0, y as f64 / 50.0]));
        let green: Vec<u32> = page.enumerate_pixels().filter(|(.., p)| p.0 == LINE).map(|(x, ..)| x).collect();
        assert!(green.len() >= 49 && green.iter().all(|x| (50..=51).contains(x)), "{green:?}");
        // A white view has no outline.
        assert!(!Silhouette::of(&[1.0; 192], 8).covers([0.5, 0.5]));
    }
}
