//! Rooms: a table with an object and others anywhere on it, of which nobody says where they are.

use glam::{DMat3, DMat4, DQuat, DVec3};
use image::{GenericImage, GenericImageView, Rgb, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use crate::photo::{Photo, SIDE};
use crate::{FOCAL_OF_ROOM, Result};

/// Width and height in pixels.
pub const SIZE: [u32; 2] = [640, 480];
/// How far from the edges the middle of the object is.
const INSIDE: u32 = 110;
/// Less than this, of 255, in some channel is no background; the lightest edges are.
const WHITE: f64 = 250.0;

/// A camera's intrinsics, as data sets have them.
pub fn intrinsics(focal: f64) -> String {
    let [width, height] = SIZE;
    format!("{focal} {} {} 0.\n0. 0. 0.\n1.\n{height} {width}\n", width / 2, height / 2)
}

/// A pose, likewise.
pub fn pose(world_from_camera: &DMat4) -> String {
    world_from_camera.transpose().to_cols_array().map(|value| value.to_string()).join(" ")
}

/// A room as a camera sees it, and how that is turned against the one that sees the object in the middle: from the new axes to the old ones.
pub fn room(object: &RgbImage, others: &[RgbImage], random: &mut Pcg64Mcg) -> Result<(RgbImage, DMat3)> {
    let mut room = table(others, random)?;
    let turn = towards(SIZE.map(|size| random.random_range(INSIDE..size - INSIDE)));
    draw(object, turn, &mut room);
    Ok((room, turn))
}

/// The table, with others on it.
pub fn table(others: &[RgbImage], random: &mut Pcg64Mcg) -> Result<RgbImage> {
    let (white, mut room) = (RgbImage::from_pixel(SIDE, SIDE, Rgb([255; 3])), RgbImage::new(SIZE[0], SIZE[1]));
    for (left, top) in (0..SIZE[0]).step_by(SIDE as usize).flat_map(|x| (0..SIZE[1]).step_by(SIDE as usize).map(move |y| (x, y)))
    {
        let table = Photo::new(&white, random).picture;
        room.copy_from(&*table.view(0, 0, SIDE.min(SIZE[0] - left), SIDE.min(SIZE[1] - top)), left, top)?;
    }
    for other in others {
        let at = SIZE.map(|size| random.random_range(0..size));
        draw(other, towards(at), &mut room);
    }
    Ok(room)
}

/// How a camera is turned that sees at this pixel what was in the middle.
pub fn towards(at: [u32; 2]) -> DMat3 {
    let [x, y] = [0, 1].map(|k| (f64::from(at[k]) - 0.5 * f64::from(SIZE[k])) / FOCAL_OF_ROOM);
    DMat3::from_quat(DQuat::from_rotation_arc(DVec3::new(x, y, 1.0).normalize(), DVec3::Z))
}

/// What a view on white, with the object in its middle, shows through a camera that is turned.
pub fn draw(view: &RgbImage, turn: DMat3, room: &mut RgbImage) {
    for (u, v, pixel) in room.enumerate_pixels_mut() {
        let [x, y] = [(u, SIZE[0]), (v, SIZE[1])].map(|(at, size)| (f64::from(at) - 0.5 * f64::from(size)) / FOCAL_OF_ROOM);
        let ray = turn * DVec3::new(x, y, 1.0);
        let at = [ray.x, ray.y].map(|at| FOCAL_OF_ROOM * at / ray.z + 0.5 * f64::from(SIDE));
        if ray.z > 0.0 && at.iter().all(|at| (0.0..f64::from(SIDE - 1)).contains(at)) {
            let colour = between(view, at);
            if colour.iter().any(|&value| value < WHITE) {
                *pixel = Rgb(colour.map(|value| value.round() as u8));
            }
        }
    }
}

fn between(view: &RgbImage, at: [f64; 2]) -> [f64; 3] {
    let ([x, y], [right, below]) = (at.map(|at| at as u32), at.map(f64::fract));
    let mix = |a: [f64; 3], b: [f64; 3], part: f64| [0, 1, 2].map(|c: usize| a[c] + part * (b[c] - a[c]));
    let row = |y: u32| mix(view.get_pixel(x, y).0.map(f64::from), view.get_pixel(x + 1, y).0.map(f64::from), right);
    mix(row(y), row(y + 1), below)
}
