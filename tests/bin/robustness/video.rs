//! Videos of an object before a table with other things, past which the camera goes, and how far off `sigma-pose track` ends in each frame.

use std::path::{Path, PathBuf};

use glam::DMat4;
use image::{GenericImage, GenericImageView, Rgb, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::Value;
use srn_data::srn;

use crate::photo::{Photo, SIDE};
use crate::scene::{self, draw, towards};
use crate::{FOCAL_OF_ROOM, IN_ROOM, MODEL, OBJECTS, OUT, Programs, Result, mean, median, said};

/// Views of a spiral around each object, and which of them are frames: some ten degrees apart.
pub const VIEWS: usize = 240;
const FRAMES: std::ops::Range<usize> = 100..160;
/// What lies behind moves by so many pixels from frame to frame, and has so many other objects in each width of a frame.
const PAN: u32 = 12;
const OTHERS: u32 = 7;

/// Of a video in which the object leaves: the frame in which it is gone, that in which it is back, and that in which the video ends.
const LEAVES: usize = 12;
const BACK: usize = 24;
const ENDS: usize = 40;
/// Where it is before and after, and how far it moves from frame to frame, in pixels.
const PLACES: [[u32; 2]; 2] = [[150, 180], [470, 290]];
const SPEED: u32 = 5;

/// Frames of an object, in a data set of its own with their poses.
pub struct Video {
    name: &'static str,
    folder: PathBuf,
    /// As `--box` has it: left edge, top edge, width and height of a box around it in the first one, or `auto`.
    bounds: String,
}

impl Video {
    /// Of the object with this number, by rendered `views` of all.
    pub fn new(object: usize, views: &Path, random: &mut Pcg64Mcg) -> Result<Self> {
        let (name, folder) = (OBJECTS[object].0, Path::new(OUT).join("video").join(OBJECTS[object].0));
        let of = |name: &str, kind: &str, view: usize| views.join(name).join(kind).join(format!("{view:06}"));
        let rendered =
            |name: &str, view: usize| image::open(of(name, "rgb", view).with_extension("png")).map(|view| view.to_rgb8());
        // A strip of table, with others on it.
        let (frames, white) = (FRAMES.len() as u32, RgbImage::from_pixel(SIDE, SIDE, Rgb([255; 3])));
        let mut behind = RgbImage::new(SIDE + PAN * frames, SIDE);
        for left in (0..behind.width()).step_by(SIDE as usize) {
            let table = Photo::new(&white, random).picture;
            behind.copy_from(&*table.view(0, 0, SIDE.min(behind.width() - left), SIDE), left, 0)?;
        }
        for _ in 0..OTHERS * behind.width() / SIDE {
            let (other, _) = OBJECTS[(object + random.random_range(1..OBJECTS.len())) % OBJECTS.len()];
            let picture = rendered(other, random.random_range(0..VIEWS))?;
            let [dx, dy] = [random.random_range(0..behind.width()), random.random_range(0..SIDE)]
                .map(|middle| i64::from(middle) - i64::from(SIDE / 2));
            for (x, y, colour) in picture.enumerate_pixels().filter(|(.., colour)| colour.0 != [255; 3]) {
                let at = [(x, dx), (y, dy)].map(|(at, by)| u32::try_from(i64::from(at) + by).unwrap_or(u32::MAX));
                if let Some(pixel) = behind.get_pixel_mut_checked(at[0], at[1]) {
                    *pixel = *colour;
                }
            }
        }
        for kind in ["rgb", "pose"] {
            std::fs::create_dir_all(folder.join(kind))?;
        }
        std::fs::copy(views.join(name).join("intrinsics.txt"), folder.join("intrinsics.txt"))?;
        let mut bounds = None;
        for (k, view) in FRAMES.enumerate() {
            let object = rendered(name, view)?;
            let seen = |x, y| object.get_pixel(x, y).0 != [255; 3];
            let colour = |x, y| if seen(x, y) { *object.get_pixel(x, y) } else { *behind.get_pixel(x + PAN * k as u32, y) };
            let file = |kind: &str, end: &str| folder.join(kind).join(format!("{view:06}.{end}"));
            RgbImage::from_fn(SIDE, SIDE, colour).save(file("rgb", "png"))?;
            std::fs::copy(of(name, "pose", view).with_extension("txt"), file("pose", "txt"))?;
            let places = object.enumerate_pixels().filter(|(x, y, _)| seen(*x, *y)).map(|(x, y, _)| [x, y]);
            let around = |[low, high]: [[u32; 2]; 2], at: [u32; 2]| {
                [[0, 1].map(|k| low[k].min(at[k])), [0, 1].map(|k| high[k].max(at[k] + 1))]
            };
            let [[left, top], [right, bottom]] = places.fold([[SIDE; 2], [0; 2]], around);
            bounds.get_or_insert([left, top, right - left, bottom - top]);
        }
        let bounds = bounds.unwrap_or_default().map(|pixels: u32| pixels.to_string()).join(",");
        Ok(Video { name, folder, bounds })
    }

    /// Of one that leaves a room and comes back elsewhere, by views from three diagonals away.
    pub fn leaving(object: usize, views: &Path, random: &mut Pcg64Mcg) -> Result<Self> {
        let (name, folder) = (OBJECTS[object].0, Path::new(OUT).join("leaving").join(OBJECTS[object].0));
        let of = |name: &str, kind: &str, view: usize| views.join(name).join(kind).join(format!("{view:06}"));
        let rendered =
            |name: &str, view: usize| image::open(of(name, "rgb", view).with_extension("png")).map(|view| view.to_rgb8());
        let other = |_| {
            let (other, _) = OBJECTS[(object + random.random_range(1..OBJECTS.len())) % OBJECTS.len()];
            rendered(other, random.random_range(0..VIEWS))
        };
        let others: Vec<RgbImage> = (0..IN_ROOM).map(other).collect::<std::result::Result<_, _>>()?;
        let table = scene::table(&others, random)?;
        for kind in ["rgb", "pose"] {
            std::fs::create_dir_all(folder.join(kind))?;
        }
        std::fs::write(folder.join("intrinsics.txt"), scene::intrinsics(FOCAL_OF_ROOM))?;
        for k in 0..ENDS {
            let view = FRAMES.start + k;
            let (since, [x, y]) = if k < LEAVES { (k, PLACES[0]) } else { (k.saturating_sub(BACK), PLACES[1]) };
            let (turn, mut frame) = (towards([x + SPEED * since as u32, y]), table.clone());
            if !(LEAVES..BACK).contains(&k) {
                draw(&rendered(name, view)?, turn, &mut frame);
            }
            let file = |kind: &str, end: &str| folder.join(kind).join(format!("{view:06}.{end}"));
            frame.save(file("rgb", "png"))?;
            let pose = srn::read_pose(&of(name, "pose", view).with_extension("txt"))? * DMat4::from_mat3(turn);
            std::fs::write(file("pose", "txt"), scene::pose(&pose))?;
        }
        Ok(Video { name, folder, bounds: "auto".into() })
    }
}

/// What was found in a frame.
struct Frame {
    rotation_deg: f64,
    translation_percent: f64,
    is_trusted: bool,
    is_searched: bool,
    seconds: f64,
}

/// What was found in each frame; `None` where nothing was.
fn followed(programs: &Programs, video: &Video, effort: &str) -> Result<Vec<Option<Frame>>> {
    let mut track = programs.command("sigma-pose");
    track.args(["track", "--json", "--executor", "cpu", "--model", MODEL, "--effort", effort, "--truth", "auto"]);
    track.args(["--instance", video.name]).arg(video.folder.join("rgb")).arg(format!("--box={}", video.bounds));
    let output = track.output()?;
    let mut frames = Vec::new();
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let report: Value = serde_json::from_str(line)?;
        let number = |value: &Value| value.as_f64().ok_or("sigma-pose printed no number");
        if report["failure"].is_string() {
            frames.push(None);
            continue;
        }
        frames.push(Some(Frame {
            rotation_deg: number(&report["error"]["rotation_deg"])?,
            translation_percent: number(&report["error"]["translation_percent"])?,
            is_trusted: report["trusted"] == true,
            is_searched: report["searched"] == true,
            seconds: number(&report["seconds"])?,
        }));
    }
    if frames.iter().all(Option::is_none) { Err(said(&output)) } else { Ok(frames) }
}

/// Follows the object by the box in the first frame; a line of a table.
pub fn tracked(programs: &Programs, video: &Video, effort: &str) -> Result<String> {
    let all = followed(programs, video, effort)?;
    let (count, frames) = (all.len(), all.into_iter().flatten().collect::<Vec<_>>());
    let sorted = |value: fn(&Frame) -> f64| {
        let mut values: Vec<f64> = frames.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (rotation, translation, seconds) = (sorted(|f| f.rotation_deg), sorted(|f| f.translation_percent), sorted(|f| f.seconds));
    let trusted = || frames.iter().filter(|f| f.is_trusted);
    Ok(format!(
        "| {} | {effort} | {count} | {:.2}° / {:.2}° / {:.1}° | {:.2} % / {:.2} % | {} | {}, {} | {} | {:.2} s |",
        video.name,
        mean(&rotation),
        median(&rotation),
        rotation[rotation.len() - 1],
        mean(&translation),
        median(&translation),
        count - frames.iter().filter(|f| !f.is_wrong()).count(),
        trusted().count(),
        trusted().filter(|f| f.is_wrong()).count(),
        frames.iter().filter(|f| f.is_searched).count(),
        median(&seconds),
    ))
}

impl Frame {
    fn is_wrong(&self) -> bool {
        self.rotation_deg > 5.0
    }
}

/// Follows an object that leaves, and comes back elsewhere; a line of a table.
pub fn back(programs: &Programs, video: &Video, effort: &str) -> Result<String> {
    let frames = followed(programs, video, effort)?;
    let trusted = |from: usize, to: usize| frames[from..to].iter().flatten().filter(|frame| frame.is_trusted);
    let is_found = |frame: &Option<Frame>| frame.as_ref().is_some_and(|frame| frame.is_trusted && !frame.is_wrong());
    let after = frames[BACK..].iter().position(is_found);
    let away: Vec<f64> = frames[LEAVES..BACK].iter().flatten().map(|frame| frame.seconds).collect();
    let wrong = |from: usize, to: usize| trusted(from, to).filter(|frame| frame.is_wrong()).count();
    Ok(format!(
        "| {} | {effort} | {}, {} of {LEAVES} | {} of {} | {} | {}, {} of {} | {:.1} s |",
        video.name,
        trusted(0, LEAVES).count(),
        wrong(0, LEAVES),
        trusted(LEAVES, BACK).count(),
        BACK - LEAVES,
        after.map_or("never".into(), |after| after.to_string()),
        trusted(BACK, ENDS).count(),
        wrong(BACK, ENDS),
        ENDS - BACK,
        away.into_iter().fold(0.0, f64::max),
    ))
}
