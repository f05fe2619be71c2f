//! Masks of photographs that nobody has cut out, by their cameras and by what they agree on ([`srn_photo::silhouettes`]).

use crate::capture::{Bounds, Capture, Frame};
use crate::error::{At, Error, Result};
use crate::pixels::{open, rgb8};
use crate::sheet;
use glam::DVec3;
use image::imageops::{self, FilterType};
use image::{GrayImage, Luma, RgbImage};
use srn_photo::silhouettes::{Ball, Found, Projection, STEPS, Sight, find};
use std::path::{Path, PathBuf};

/// The ball that is looked at in the second turn, beside what just holds what the first one found.
const ROOM: f64 = 1.2;
/// Fewer photographs say little about what they agree on.
const FEWEST: usize = 6;
/// On the sheet: pixels of a side, and how many stand side by side.
const THUMBNAIL: u32 = 160;
const COLUMNS: usize = 8;
/// Around a mask's box, as a share of its longer side.
const MARGIN: f64 = 0.3;

/// What was written.
#[derive(Debug)]
pub struct Written {
    /// How many masks.
    pub masks: usize,
    /// What has none, one line each.
    pub skipped: Vec<String>,
    /// Where the object is, in the units of the source.
    pub bounds: Bounds,
    /// What it stands on, in words.
    pub ground: String,
    /// Photographs without what is not the object.
    pub sheet: RgbImage,
}

/// How often [`write()`] tells that it goes on, at most.
pub fn steps(capture: &Capture) -> u64 {
    (2 * capture.frames.len() + STEPS[0] + STEPS[1]) as u64
}

/// Finds what photographs show within these bounds, and writes a mask of each to `out`, `NAME.png` after the photograph's whole name, in folders as those lie in. Nothing is written
/// where they agree on nothing.
pub fn write(capture: &Capture, bounds: Bounds, out: &Path, told: &mut dyn FnMut()) -> Result<Written> {
    let frames = &capture.frames;
    let place = || frames.first().map(|frame| frame.image.clone()).unwrap_or_default();
    if frames.len() < FEWEST {
        return Err(Error::field(&place(), "photographs", format!("{FEWEST} or more of the same object"), frames.len()));
    }
    let seen_by = |frame: &'_ Frame| {
        let camera = frame.camera.with_pixel_centre(0.0);
        move |place: DVec3| {
            let (pixel, depth) = camera.project(place);
            // Edges of pixels are whole numbers there.
            (depth > 0.0).then_some([pixel.x + 0.5, pixel.y + 0.5])
        }
    };
    let projections: Vec<_> = frames.iter().map(seen_by).collect();
    let ups = [frames.iter().map(|frame| -frame.camera.world_from_camera.y_axis.truncate()).sum(), DVec3::Z];
    let first = Ball { centre: bounds.centre, radius: 0.5 * bounds.diagonal };
    let nothing = |ball: Ball| {
        let Ball { centre: c, radius } = ball;
        let field = format!("ball of radius {radius:.4} around {:.4} {:.4} {:.4}", c.x, c.y, c.z);
        Error::field(
            &place(),
            field,
            "an object that differs from what is around it, where the cameras look (`sigma-data inspect`) or is said to be",
            "nothing that the photographs agree on",
        )
    };
    let look = |ball: Ball, before: Option<Found>, told: &mut dyn FnMut()| -> Result<_> {
        let (mut sights, mut which, mut skipped) = (vec![], vec![], vec![]);
        for (k, (frame, projection)) in frames.iter().zip(&projections).enumerate() {
            let picture = open(&frame.image);
            told();
            match picture.map(|picture| Sight::of(&picture, projection as Projection, ball)) {
                Ok(Some(sight)) => {
                    sights.push(sight);
                    which.push(k);
                }
                Ok(None) => skipped.push(format!("{}: the object is not in the picture, or fills it", frame.image.display())),
                Err(error) => skipped.push(error.to_string()),
            }
        }
        let found = find(&mut sights, ball, &ups, before, told).ok_or_else(|| nothing(ball))?;
        Ok((found, sights, which, skipped))
    };
    let (found, ..) = look(first, None, told)?;
    let nearer = Ball { radius: ROOM * found.ball.radius, ..found.ball };
    let (found, sights, which, mut skipped) = look(nearer, Some(found), told)?;
    let common = common_folder(frames);
    let path_of = |frame: &Frame| {
        let name = frame.image.strip_prefix(&common).unwrap_or(&frame.image);
        out.join(format!("{}.png", name.display()))
    };
    // What an earlier call has left of photographs that get none now would be read instead.
    for path in frames.iter().map(path_of).filter(|path| path.is_file()) {
        std::fs::remove_file(&path).at(&path)?;
    }
    let mut cells = vec![];
    for (sight, frame) in sights.iter().zip(which).map(|(sight, k)| (sight, &frames[k])) {
        if !sight.is_seen() {
            skipped.push(format!("{}: nothing of the object is seen", frame.image.display()));
            continue;
        }
        let [width, height] = frame.camera.size.map(|size| size as u32);
        let share = sight.on(frame.camera.size[0], frame.camera.size[1]);
        let mask = GrayImage::from_fn(width, height, |x, y| Luma([(255.0 * share[(y * width + x) as usize]).round() as u8]));
        let path = path_of(frame);
        let folder = path.parent().unwrap_or(out);
        std::fs::create_dir_all(folder).at(folder)?;
        mask.save(&path).at(&path)?;
        cells.push((thumbnail(frame, &mask)?, frame.name.clone()));
    }
    let masks = cells.len();
    let cells: Vec<_> = cells.iter().map(|(picture, name)| (picture, name.as_str())).collect();
    let ground = match found.ground {
        Some(plane) => {
            let n = plane.normal;
            format!("a pattern at {:.4} along {:.3} {:.3} {:.3}", plane.offset, n.x, n.y, n.z)
        }
        None => "nothing with a pattern".into(),
    };
    let bounds = Bounds { centre: found.ball.centre, diagonal: 2.0 * found.ball.radius };
    Ok(Written { masks, skipped, bounds, ground, sheet: sheet::grid(&cells, COLUMNS) })
}

/// The folder that all photographs lie in, directly or deeper.
fn common_folder(frames: &[Frame]) -> PathBuf {
    let folders = frames.iter().map(|frame| frame.image.parent().unwrap_or(Path::new("")).to_path_buf());
    let common =
        |a: PathBuf, b: PathBuf| a.components().zip(b.components()).take_while(|(a, b)| a == b).map(|(a, _)| a).collect();
    folders.reduce(common).unwrap_or_default()
}

/// What is around the mask, and what is not in it dark.
fn thumbnail(frame: &Frame, mask: &GrayImage) -> Result<RgbImage> {
    let picture = open(&frame.image)?;
    let mut picture = rgb8(&picture.data, picture.width, picture.height);
    let (mut low, mut high) = ([u32::MAX; 2], [0; 2]);
    for (x, y, _) in mask.enumerate_pixels().filter(|(.., share)| share[0] > 127) {
        low = [low[0].min(x), low[1].min(y)];
        high = [high[0].max(x + 1), high[1].max(y + 1)];
    }
    for (pixel, share) in picture.pixels_mut().zip(mask.pixels()).filter(|(_, share)| share[0] <= 127) {
        let part = 0.25 + 0.75 * f32::from(share[0]) / 255.0;
        pixel.0 = pixel.0.map(|value| (f32::from(value) * part) as u8);
    }
    let middle = [0, 1].map(|k| 0.5 * (f64::from(low[k].min(high[k])) + f64::from(high[k])));
    let longer = (0..2).map(|k| f64::from(high[k].saturating_sub(low[k]))).fold(1.0, f64::max) * (1.0 + 2.0 * MARGIN);
    let sides = [picture.width(), picture.height()];
    let side = (longer as u32).clamp(1, sides[0].min(sides[1]));
    let corner = [0, 1].map(|k| ((middle[k] - 0.5 * f64::from(side)).max(0.0) as u32).min(sides[k] - side));
    let part = imageops::crop_imm(&picture, corner[0], corner[1], side, side).to_image();
    Ok(imageops::resize(&part, THUMBNAIL, THUMBNAIL, FilterType::Triangle))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, spiral};
    use glam::DVec2;
    use image::Rgb;

    const SIDE: u32 = 96;
    const CENTRE: DVec3 = DVec3::new(0.05, -0.04, 0.03);
    const RADIUS: f64 = 0.3;

    /// A red ball before stripes, and whether a pixel shows it.
    fn photograph(camera: &Camera) -> (RgbImage, Vec<bool>) {
        let centre = camera.world_from_camera.inverse().transform_point3(CENTRE);
        let edge = (RADIUS / centre.length()).asin();
        let is_ball = |x: u32, y: u32| camera.plane(DVec2::new(x.into(), y.into())).extend(1.0).angle_between(centre) < edge;
        let noise = |x: u32, y: u32| ((7 * x + 5 * y * y) % 11) as u8;
        let colour = |x, y| match is_ball(x, y) {
            true => [190 + noise(x, y), 40, 30 + noise(y, x)],
            false if (x / 9 + y / 13).is_multiple_of(2) => [60, 120 + noise(x, y), 90],
            false => [150, 160 + noise(y, x), 170],
        };
        let pixels = (0..SIDE * SIDE).map(|i| is_ball(i % SIDE, i / SIDE)).collect();
        (RgbImage::from_fn(SIDE, SIDE, |x, y| Rgb(colour(x, y))), pixels)
    }

    /// So many photographs of it in a folder, and one that does not exist.
    fn capture(dir: &Path, views: usize) -> (Capture, Vec<Vec<bool>>) {
        let (mut frames, mut truths) = (vec![], vec![]);
        std::fs::create_dir_all(dir.join("low")).unwrap();
        for (i, world_from_camera) in spiral(views, 1.4).into_iter().enumerate() {
            let camera = Camera {
                world_from_camera,
                intrinsics: [110.0, 110.0, 48.0, 48.0],
                size: [SIDE as usize; 2],
                pixel_centre: 0.5,
                distortion: [0.0; 5],
            };
            let (picture, truth) = photograph(&camera);
            let image = dir.join(if i == 0 { "low/0.jpg".into() } else { format!("{i}.png") });
            // What its ending says is nothing to go by.
            picture.save_with_format(&image, image::ImageFormat::Png).unwrap();
            truths.push(truth);
            frames.push(Frame { name: i.to_string(), image, mask: None, camera });
        }
        let missing = Frame { image: dir.join("gone.png"), name: "gone".into(), ..frames[0].clone() };
        frames.push(missing);
        (Capture { name: "ball".into(), frames, ..Capture::default() }, truths)
    }

    #[test]
    fn photographs_that_nobody_has_cut_out_get_masks() {
        let dir = tempfile::tempdir().unwrap();
        let (capture, truths) = capture(dir.path(), 10);
        let (out, mut told) = (dir.path().join("masks"), 0);
        // Twice as large as it is, and elsewhere.
        let written = write(&capture, Bounds { centre: DVec3::ZERO, diagonal: 1.1 }, &out, &mut || told += 1).unwrap();
        assert_eq!(written.masks, 10);
        assert!((steps(&capture) - 1..=steps(&capture)).contains(&told), "{told}");
        assert!(written.skipped.iter().any(|why| why.contains("gone.png")), "{:?}", written.skipped);
        assert!(written.bounds.centre.distance(CENTRE) < 0.05, "{:?}", written.bounds);
        assert!((written.bounds.diagonal / (2.0 * RADIUS) - 1.0).abs() < 0.2, "{:?}", written.bounds);
        for (frame, truth) in capture.frames.iter().zip(&truths) {
            // As `import --mask` looks for it.
            let mask = crate::formats::mask_in(&out, &frame.image).unwrap();
            let mask = image::open(mask).unwrap().into_luma8();
            let of = |both: fn(bool, bool) -> bool| {
                mask.iter().zip(truth).filter(|(share, truth)| both(**share > 127, **truth)).count()
            };
            let (inside, all) = (of(|a, b| a && b), of(|a, b| a || b));
            assert!(10 * inside > 9 * all, "{}: {inside} of {all}", frame.name);
        }
    }

    #[test]
    fn too_few_and_nothing_are_told_and_nothing_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("masks");
        let (few, _) = capture(&dir.path().join("few"), FEWEST - 2);
        let bounds = Bounds { centre: DVec3::ZERO, diagonal: 1.1 };
        let error = write(&few, bounds, &out, &mut || ()).unwrap_err().to_string();
        assert!(error.contains("6 or more") && error.contains('5'), "{error}");
        // Where the cameras see nothing but stripes.
        let (many, _) = capture(&dir.path().join("many"), 8);
        let aside = Bounds { centre: DVec3::new(0.0, 0.0, 40.0), diagonal: 0.2 };
        let error = write(&many, aside, &out, &mut || ()).unwrap_err().to_string();
        assert!(error.contains("40.0") && error.contains("agree on"), "{error}");
        assert!(!out.exists());
    }
}
