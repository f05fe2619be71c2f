//! Rooms with several objects of the model, of which nobody says which they are, nor where.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::Instant;

use glam::DMat4;
use image::{Rgb, RgbImage};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde_json::Value;
use sigma_srn::camera::pose_error;
use srn_data::srn;

use crate::photo::Spoil;
use crate::scene::{self, SIZE};
use crate::{FOCAL_OF_ROOM, MODEL, OBJECTS, OUT, Picture, Programs, Result, VIEWS, in_room, mean, median, said};

/// Rooms in all, and objects in each, beside each other in so many columns.
const ROOMS: usize = 12;
const COUNT: u32 = 6;
const COLUMNS: u32 = 3;
/// Objects are so many pixels off the middles of their places, at most, across and down.
const OFF: u32 = 40;
/// In a heap they are anywhere, but so far from the edges.
const INSIDE: u32 = 80;
/// Objects of which less than this part is in sight are not asked for.
const IN_SIGHT: f64 = 0.5;
/// Poses that are further off are of something else, degrees.
const RIGHT_DEG: f64 = 5.0;
/// A colour that no object has.
const NOTHING: Rgb<u8> = Rgb([255, 0, 255]);

/// How objects lie in a room.
#[derive(Clone, Copy, PartialEq)]
pub enum Lying {
    /// Beside each other, each at most once.
    Apart,
    /// Anywhere, before each other, and some more than once.
    Heaped,
}

/// A picture, and what is in it.
pub struct Room {
    picture: PathBuf,
    objects: Vec<Object>,
}

struct Object {
    name: &'static str,
    world_from_camera: DMat4,
    /// How much of it is in sight, and left edge, top edge, width and height of a box around that.
    in_sight: f64,
    bounds: [u32; 4],
}

/// Objects in rooms.
pub fn rooms(programs: &Programs, lying: Lying, seed: u64) -> Result<Vec<Room>> {
    let views = programs.views(&in_room("several", 3.0, Spoil::Nothing), seed)?;
    let random = &mut Pcg64Mcg::seed_from_u64(seed);
    let folder = Path::new(OUT).join(if lying == Lying::Apart { "several" } else { "heaped" });
    std::fs::create_dir_all(&folder)?;
    let room = |number: usize| {
        let mut names = OBJECTS.map(|(name, _)| name);
        names.shuffle(random);
        let mut picture = scene::table(&[], random)?;
        let (mut objects, mut owners) = (Vec::new(), vec![None; (SIZE[0] * SIZE[1]) as usize]);
        for place in 0..COUNT {
            let (name, at) = match lying {
                Lying::Apart => {
                    let (cell, cells) = ([place % COLUMNS, place / COLUMNS], [COLUMNS, COUNT / COLUMNS]);
                    let middle = [0, 1].map(|k| (2 * cell[k] + 1) * SIZE[k] / (2 * cells[k]));
                    (names[place as usize], middle.map(|middle| middle - OFF + random.random_range(0..2 * OFF)))
                }
                Lying::Heaped => {
                    (names[random.random_range(0..names.len())], SIZE.map(|size| random.random_range(INSIDE..size - INSIDE)))
                }
            };
            let (view, turn) = (random.random_range(0..VIEWS), scene::towards(at));
            let of = |kind: &str, end: &str| views.join(name).join(kind).join(format!("{view:06}.{end}"));
            let object = image::open(of("rgb", "png"))?.to_rgb8();
            scene::draw(&object, turn, &mut picture);
            let mut alone = RgbImage::from_pixel(SIZE[0], SIZE[1], NOTHING);
            scene::draw(&object, turn, &mut alone);
            let own = || alone.pixels().enumerate().filter(|(_, pixel)| **pixel != NOTHING).map(|(i, _)| i);
            own().for_each(|i| owners[i] = Some(place));
            let world_from_camera = srn::read_pose(&of("pose", "txt"))? * DMat4::from_mat3(turn);
            objects.push((name, world_from_camera, own().count()));
        }
        let in_sight = |(place, (name, world_from_camera, pixels)): (u32, (_, _, usize))| {
            let is_seen = |(i, owner): (u32, &Option<u32>)| (*owner == Some(place)).then_some([i % SIZE[0], i / SIZE[0]]);
            let seen: Vec<[u32; 2]> = (0..).zip(&owners).filter_map(is_seen).collect();
            let ends = [0, 1].map(|k| {
                let along = || seen.iter().map(|at| at[k]);
                [along().min().unwrap_or(0), along().max().map_or(0, |last| last + 1)]
            });
            let bounds = [ends[0][0], ends[1][0], ends[0][1] - ends[0][0], ends[1][1] - ends[1][0]];
            Object { name, world_from_camera, in_sight: seen.len() as f64 / pixels as f64, bounds }
        };
        let objects: Vec<Object> = (0..).zip(objects).map(in_sight).collect();
        let path = folder.join(format!("{number}.png"));
        picture.save(&path)?;
        let line = |object: &Object| format!("{} {}\n", object.name, scene::pose(&object.world_from_camera));
        std::fs::write(path.with_extension("txt"), objects.iter().map(line).collect::<String>())?;
        Ok(Room { picture: path, objects })
    };
    (0..ROOMS).map(room).collect()
}

/// Those of which so much is in sight, with boxes around that.
pub fn boxed(rooms: &[Room], in_sight: &Range<f64>) -> Result<Vec<(&'static str, Picture)>> {
    let mut pictures = Vec::new();
    for Room { picture, objects } in rooms {
        let intrinsics = picture.with_extension("intrinsics");
        std::fs::write(&intrinsics, scene::intrinsics(FOCAL_OF_ROOM))?;
        for (number, object) in objects.iter().enumerate().filter(|(_, object)| in_sight.contains(&object.in_sight)) {
            let truth = picture.with_extension(format!("{number}.pose"));
            std::fs::write(&truth, scene::pose(&object.world_from_camera))?;
            let bounds = Some(object.bounds.map(|pixels| pixels.to_string()).join(","));
            let (picture, intrinsics) = (picture.clone(), intrinsics.clone());
            pictures.push((object.name, Picture { picture, mask: None, bounds, intrinsics, truth }));
        }
    }
    Ok(pictures)
}

/// Looks for all objects in all rooms; a line of a table.
pub fn found(programs: &Programs, rooms: Vec<Room>, what: &str, effort: &str) -> Result<String> {
    let (mut rotations, mut translations, mut seconds) = (Vec::new(), Vec::new(), Vec::new());
    let (mut told, mut wrong, mut right) = (0, 0, 0);
    let is_asked_for = |object: &Object| object.in_sight >= IN_SIGHT;
    let asked = rooms.iter().map(|room| room.objects.iter().filter(|object| is_asked_for(object)).count()).sum::<usize>();
    for Room { picture, mut objects } in rooms {
        let mut estimate = programs.command("sigma-pose");
        estimate.args(["estimate", "--json", "--executor", "cpu", "--box", "auto", "--model", MODEL, "--effort", effort]);
        let began = Instant::now();
        let output = estimate.arg(picture).arg("--focal").arg(FOCAL_OF_ROOM.to_string()).output()?;
        seconds.push(began.elapsed().as_secs_f64());
        let report: Value = serde_json::from_slice(&output.stdout).map_err(|_| said(&output))?;
        for entry in report["images"].as_array().ok_or("sigma-pose printed no list")? {
            let Some(name) = entry["instance"].as_str() else { continue };
            let rows: [[f64; 4]; 4] = serde_json::from_value(entry["world_from_camera"].clone())?;
            let pose = DMat4::from_cols_array_2d(&rows).transpose();
            told += 1;
            let is_it = |object: &Object| object.name == name && pose_error(&pose, &object.world_from_camera).0 <= RIGHT_DEG;
            let Some(number) = objects.iter().position(is_it) else {
                wrong += 1;
                continue;
            };
            // Each is there once.
            let object = objects.swap_remove(number);
            let (rotation, translation) = pose_error(&pose, &object.world_from_camera);
            right += usize::from(is_asked_for(&object));
            rotations.push(rotation);
            translations.push(100.0 * translation / object.world_from_camera.w_axis.truncate().length());
        }
    }
    for values in [&mut rotations, &mut translations, &mut seconds] {
        values.sort_by(f64::total_cmp);
    }
    let worst = *rotations.last().ok_or("nothing was found")?;
    Ok(format!(
        "| {what} | {effort} | {right} of {asked} | {told}, {wrong} | {:.2}° / {:.2}° / {worst:.1}° | {:.2} % / {:.2} % | {:.0} s |",
        mean(&rotations),
        median(&rotations),
        mean(&translations),
        median(&translations),
        median(&seconds),
    ))
}
