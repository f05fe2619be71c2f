//! Videos of an object before a table with other things, past which the camera goes, and how far off `sigma-pose track` ends in each frame.

use std::path::{Path, PathBuf};

use image::{GenericImage, GenericImageView, Rgb, RgbImage};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::Value;

use crate::photo::{Photo, SIDE};
use crate::{MODEL, OBJECTS, OUT, Programs, Result, mean, median, said};

/// Views of a spiral around each object, and which of them are frames: some ten degrees apart.
pub const VIEWS: usize = 240;
const FRAMES: std::ops::Range<usize> = 100..160;
/// What lies behind moves by so many pixels from frame to frame, and has so many other objects in each width of a frame.
const PAN: u32 = 12;
const OTHERS: u32 = 7;

/// Frames of an object, in a data set of its own with their poses.
pub struct Video {
    name: &'static str,
    folder: PathBuf,
    /// Left edge, top edge, width and height of a box around it in the first one.
    bounds: [u32; 4],
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
        Ok(Video { name, folder, bounds: bounds.unwrap_or_default() })
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

/// Follows the object by the box in the first frame; a line of a table.
pub fn tracked(programs: &Programs, video: &Video, effort: &str) -> Result<String> {
    let Video { name, ref folder, bounds: [x, y, width, height] } = *video;
    let mut track = programs.command("sigma-pose");
    track.args([
        "track",
        "--json",
        "--executor",
        "cpu",
        "--model",
        MODEL,
        "--effort",
        effort,
        "--truth",
        "auto",
        "--instance",
        name,
    ]);
    let output = track.arg(folder.join("rgb")).arg(format!("--box={x},{y},{width},{height}")).output()?;
    let (mut frames, mut failed) = (Vec::new(), 0);
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let report: Value = serde_json::from_str(line)?;
        let number = |value: &Value| value.as_f64().ok_or("sigma-pose printed no number");
        if report["failure"].is_string() {
            failed += 1;
            continue;
        }
        frames.push(Frame {
            rotation_deg: number(&report["error"]["rotation_deg"])?,
            translation_percent: number(&report["error"]["translation_percent"])?,
            is_trusted: report["trusted"] == true,
            is_searched: report["searched"] == true,
            seconds: number(&report["seconds"])?,
        });
    }
    if frames.is_empty() {
        return Err(said(&output));
    }
    let sorted = |value: fn(&Frame) -> f64| {
        let mut values: Vec<f64> = frames.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (rotation, translation, seconds) = (sorted(|f| f.rotation_deg), sorted(|f| f.translation_percent), sorted(|f| f.seconds));
    let is_wrong = |f: &&Frame| f.rotation_deg > 5.0;
    let trusted = || frames.iter().filter(|f| f.is_trusted);
    Ok(format!(
        "| {name} | {effort} | {} | {:.2}° / {:.2}° / {:.1}° | {:.2} % / {:.2} % | {} | {}, {} | {} | {:.2} s |",
        frames.len() + failed,
        mean(&rotation),
        median(&rotation),
        rotation[rotation.len() - 1],
        mean(&translation),
        median(&translation),
        frames.iter().filter(is_wrong).count() + failed,
        trusted().count(),
        trusted().filter(is_wrong).count(),
        frames.iter().filter(|f| f.is_searched).count(),
        median(&seconds),
    ))
}
