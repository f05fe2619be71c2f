//! The outline of the found object on the picture as it was given: what a person believes at a glance, or does not.

use std::path::Path;

use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage};
use sigma_srn::Found;
use sigma_srn::photo::{FoundObject, Shot};
use srn_data::pixels::{open, rgb8};
use srn_data::sheet::{self, BLACK, Colour};

use super::search::On;
use crate::common::{Result, write_picture};

/// Colour of the line; its rim is black.
const LINE: Colour = [60, 255, 90];
/// For a line the view is rendered at most at this many times the side that the model takes.
const FINEST: usize = 4;
/// Shorter pictures are enlarged until they have this height, pixels.
const LEAST_HEIGHT: u32 = 320;

/// Writes `NAME-outline.png` of the picture at `path` to `dir`, with what was found in it.
pub fn write(dir: &Path, path: &Path, name: &str, found: &[(&Shot, &Found)], on: On) -> Result<()> {
    let photo = photograph(path)?;
    let mut page = sheet::enlarge(&photo, LEAST_HEIGHT.div_ceil(photo.height()));
    for (shot, found) in found {
        let object = FoundObject::of(shot, &found.world_from_camera, on.engine, on.model, FINEST)?;
        page = outlined(page, photo.height(), &object);
    }
    write_picture(&dir.join(format!("{name}-outline.png")), &page)
}

/// The picture at `path`, so many pixels high, with the outline on it, which is as fine as the model's own view.
pub fn shown(path: &Path, shot: &Shot, found: &Found, on: On, height: u32) -> Result<RgbImage> {
    let photo = photograph(path)?;
    let page = imageops::resize(&photo, (photo.width() * height).div_ceil(photo.height()), height, FilterType::Triangle);
    Ok(outlined(page, photo.height(), &FoundObject::of(shot, &found.world_from_camera, on.engine, on.model, 1)?))
}

fn photograph(path: &Path) -> Result<RgbImage> {
    let picture = open(path)?;
    Ok(rgb8(&picture.data, picture.width, picture.height))
}

/// A page that shows a picture of this height.
fn outlined(mut page: RgbImage, height: u32, object: &FoundObject) -> RgbImage {
    let pixel = f64::from(height) / f64::from(page.height());
    draw(&mut page, |at| object.covers(at.map(|x| (x as f64 + 0.5) * pixel)));
    page
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
        let mut page = sheet::blank(100, 50);
        draw(&mut page, |[x, _]| x >= 50);
        let green: Vec<u32> = page.enumerate_pixels().filter(|(.., p)| p.0 == LINE).map(|(x, ..)| x).collect();
        assert!(green.len() >= 49 && green.iter().all(|x| (50..=51).contains(x)), "{green:?}");
    }
}
