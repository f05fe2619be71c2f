//! `sigma-pose track`: an object's pose from frame to frame.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args;
use glam::DMat4;
use image::RgbImage;
use indicatif::ProgressBar;
use serde::Serialize;
use sigma_srn::photo::{Anywhere, BoundingBox, Follower, FoundObject, Known, Looking, Open, Outcome, Shot, Sightings};
use sigma_srn::{Confidence, Doubt, Found, Pose6, Progress, Search, Tracked, Tracker};
use srn_data::pixels::{ENDINGS, is_picture};
use srn_data::target::{Cutout, photo};

use super::draw;
use super::files::{
    Animation, Bounds, Masks, ObjectArgs, Picture, PoseSource, bounds, lines_on_stdin, model_side, path_of, warn_of_turned,
};
use super::mask::MadeRight;
use super::notation::{NotationArgs, ObjectPose};
use super::outline;
use super::search::{On, PoseError, SearchArgs, Starts, deviation, with_cooperative_said};
use crate::common::{EngineArgs, Result, load_model, lossy, print, refuse_to_write};
use crate::progress;

/// Side of a frame in the animation, pixels.
const SHOWN: u32 = 192;
/// Seconds that it stays.
const STAY: f64 = 0.1;

/// Time after which a frame's search is shown.
const PATIENCE: Duration = Duration::from_secs(1);

/// Flags of `sigma-pose track`.
#[derive(Args, Debug)]
pub struct Track {
    /// Frames in order, as `estimate` takes them; or a folder, whose pictures are taken by name and number; or `-`: their paths come on stdin, one per
    /// line, and each is answered before the next is read. One after the first that is no picture, shows another object, or nothing of it, is said to
    /// be so, and the next is taken.
    #[arg(required = true, value_name = "FRAME|DIR|-")]
    frames: Vec<PathBuf>,
    #[command(flatten)]
    object: ObjectArgs,
    /// Folder with masks called like the frames, of what is the object; see `estimate`.
    #[arg(long, value_name = "DIR")]
    cutout: Option<PathBuf>,
    /// A box around the object in the first frame, as a detector gives it; see `estimate`. Frames need not be cut out then: what in each of them is the object is found
    /// by its colours, and by where the poses before lead one to expect it. `auto`: it is looked for in all of the first frame.
    #[arg(long = "box", value_name = "X,Y,W,H|auto", value_parser = bounds, allow_hyphen_values = true, conflicts_with = "cutout")]
    bounds: Option<Bounds>,
    /// Folder with masks called like the frames, of what counts; see `estimate`.
    #[arg(long, value_name = "DIR")]
    mask: Option<PathBuf>,
    /// Pose in the first frame. Default: searched for all around.
    #[arg(long, value_name = "POSE")]
    rough: Option<PoseSource>,
    /// True pose of every frame, to report errors; `auto`: the one in the frame's SRN folder.
    #[arg(long, value_name = "auto")]
    truth: Option<PoseSource>,
    /// Print a line of JSON per frame; one that is no picture has `frame`, `trusted` and `failure` alone.
    #[arg(long)]
    json: bool,
    /// Write an animation as it grows: each frame beside the view from its pose; with --box the outline of what was found on the whole frame, too.
    #[arg(long, value_name = "GIF")]
    record: Option<PathBuf>,
    /// Overwrite the file of --record.
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    engine: EngineArgs,
    #[command(flatten)]
    poses: NotationArgs,
    // Last, for its heading holds for all flags that follow.
    #[command(flatten)]
    search: SearchArgs,
}

/// A line of `--json`.
#[derive(Serialize)]
struct FrameReport<'a> {
    #[serde(serialize_with = "lossy")]
    frame: &'a Path,
    /// Rows of the 4×4 matrix, as the flags for poses want it.
    world_from_camera: [[f64; 4]; 4],
    /// In the same frame and units.
    camera_from_object: ObjectPose,
    loss: f64,
    unexplained: f64,
    trusted: bool,
    /// Why it is not to be trusted.
    doubt: Option<Doubt>,
    confidence: Option<Confidence>,
    /// The pose is not from that of the frame before, but was searched for all around.
    searched: bool,
    /// How its mask was made right.
    #[serde(flatten)]
    mask: MadeRight,
    error: Option<PoseError>,
    /// From the picture on disk to its pose.
    seconds: f64,
}

/// Runs the command; false where the last pose is not to be trusted.
pub fn run(args: &Track) -> Result<bool> {
    let model = load_model(&args.object.model)?;
    let is_single = matches!(&args.frames[..], [only] if only.is_file());
    if matches!(args.truth, Some(PoseSource::File(_))) && !is_single {
        return Err("--truth: a file has the pose of one frame; `auto` takes that in each frame's SRN folder".into());
    }
    let mut frames = frames(&args.frames)?;
    let notation = args.poses.open()?;
    if let Some(path) = &args.record {
        if path.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("gif")) {
            return Err(format!("{}: --record writes an animation, a .gif", path.display()).into());
        }
        refuse_to_write(path, args.force)?;
    }
    let engine = args.search.open(&args.engine)?;
    // Whoever waits for a frame is ready for it.
    let first = frames.next().ok_or("stdin: no frame's path on it")??;
    let side = model_side(&model, &first)?;
    warn_of_turned(&first);
    let on = On { engine: &engine, model: &model, side };
    let open = |path: &Path, cutout: Option<Cutout>| {
        let masks = Masks { cutout, mask: args.mask.as_deref() };
        Picture::open(path, masks, &model, side, args.object.instance.as_deref(), &args.object.camera)
    };
    let search = args.search.single(args.search.options()?);
    let mut animation = None;
    let (mut tracker, mut followed) = (None::<Tracker>, None);
    let place = args.bounds.map(|bounds| match bounds {
        Bounds::Box(bounds) => Ok(bounds),
        Bounds::Anywhere => {
            let starts = |shot: &Shot| args.search.starts(&args.search.all_around(), &model, shot, None, &notation);
            let boxed = |bounds, known: Known| Ok(open(&first, Some(Cutout::Box(bounds, known)))?.shot);
            looked_for(on, &search, &first, open(&first, None)?.shot.instance, &boxed, &starts)
        }
    });
    let mut follower = place.transpose()?.map(Follower::new);
    let (mut errors, mut searches, mut trusted, mut count) = (Vec::new(), 0, true, 0);
    for path in std::iter::once(Ok(first)).chain(frames) {
        let path = path?;
        let (began, mut bar) = (Instant::now(), None::<ProgressBar>);
        let boxed = |bounds: BoundingBox, known: Known| Ok(open(&path, Some(Cutout::Box(bounds, known)))?.shot);
        let shot = match &follower {
            Some(follower) => follower.open(&boxed),
            None => open(&path, args.cutout.as_deref().map(Cutout::Mask)).map(|picture| picture.shot),
        };
        let name = |number| model.instance_name(number);
        let shot = shot.and_then(|shot| match followed {
            Some(followed) if shot.instance != followed => {
                Err(format!("{}: shows {}, but {} is followed", path.display(), name(shot.instance), name(followed)).into())
            }
            _ => Ok(shot),
        });
        let failed = |failure: &str| {
            let frame = path.display().to_string();
            print(&if args.json {
                serde_json::json!({ "frame": frame, "trusted": false, "failure": failure }).to_string()
            } else {
                format!("{frame}  DO NOT TRUST: {failure}")
            })
        };
        let mut failure = String::new();
        let shot = match shot {
            Ok(shot) => Some(shot),
            // The first says whether the flags are right; later ones come from a camera that may have lost the object.
            Err(error) if tracker.is_some() => {
                failure = error.to_string();
                None
            }
            Err(error) => return Err(error),
        };
        // It may be elsewhere in a frame, if there is one.
        if shot.is_none() && (follower.is_none() || photo(&path).is_err()) {
            (trusted, count) = (false, count + 1);
            failed(&failure)?;
            continue;
        }
        let truth = match args.truth.as_ref().map(|truth| truth.read(&path, &notation)).transpose() {
            Err(error) if tracker.is_some() => {
                eprintln!("warning: {error}");
                None
            }
            truth => truth?,
        };
        followed = followed.or(shot.as_ref().map(|shot| shot.instance));
        let Some(instance) = followed else { return Err(failure.into()) };
        let rough = args.rough.as_ref().filter(|_| tracker.is_none()).map(|rough| rough.read(&path, &notation)).transpose()?;
        let is_boxed = follower.is_some();
        let starts = |shot: &Shot| {
            let (starts, rough) = match &rough {
                Some(rough) if is_boxed => (Starts::Neighbor4, Some(rough)),
                _ => (args.search.all_around(), None),
            };
            args.search.starts(&starts, &model, shot, rough, &notation)
        };
        let tracker = match &mut tracker {
            Some(tracker) => tracker,
            none => none.insert(Tracker::new(&engine, &model, instance, search.clone(), rough)?),
        };
        count += 1;
        let mut observe = |seen: Progress| {
            // Most frames are done before anyone wonders.
            if began.elapsed() > PATIENCE {
                let bar = bar.get_or_insert_with(|| progress::bar(0, "steps"));
                bar.set_length(seen.steps.into());
                bar.set_position(seen.step.into());
            }
            Ok(())
        };
        let sightings = || Ok(Sightings::of(&engine, &model, instance, &photo(&path)?, &[])?);
        let tracked = with_cooperative_said(&engine, || match (&mut follower, shot) {
            (Some(follower), shot) => {
                let (search, starts, open, sightings) = (&search, &starts, &boxed, &sightings);
                let looking = Looking { engine: &engine, model: &model, search, starts, open, sightings };
                follower.next(shot, tracker, &looking, &mut observe)
            }
            (None, Some(shot)) => {
                let tracked = tracker.next(shot.query(starts(&shot)?), &mut observe)?;
                Ok(Some((shot, tracked)))
            }
            (None, None) => Ok(None),
        });
        bar.iter().for_each(ProgressBar::finish_and_clear);
        let Some((shot, Tracked { found, is_searched: searched })) = tracked? else {
            trusted = false;
            failed(&failure)?;
            continue;
        };
        trusted = found.is_trusted();
        let mask = MadeRight::of(&found.estimate, shot.pixels_of_photo());
        let error = truth.map(|truth| notation.error(PoseError::of(&found.world_from_camera, &truth)));
        errors.extend(error);
        searches += usize::from(searched);
        if let Some(file) = &args.record {
            let animation = match &mut animation {
                Some(animation) => animation,
                none => none.insert(Animation::create(file)?),
            };
            // What is cut out is best seen on the frame that it was cut out of.
            let whole = follower.as_ref().map(|_| outline::shown(&path, &shot, &found, on, SHOWN)).transpose()?;
            animation.push(side_by_side(whole, &shot, &found), STAY)?;
        }
        let written = notation.written(&found.world_from_camera);
        let report = FrameReport {
            frame: &path,
            world_from_camera: written.transpose().to_cols_array_2d(),
            camera_from_object: notation.object(&found.world_from_camera, found.confidence),
            loss: found.estimate.loss,
            unexplained: found.unexplained,
            trusted,
            doubt: found.doubt,
            confidence: found.confidence.map(|confidence| notation.confidence(confidence)),
            searched,
            mask,
            error,
            seconds: began.elapsed().as_secs_f64(),
        };
        print(&if args.json { serde_json::to_string(&report)? } else { report.line(&Pose6::from_matrix(&written)) })?;
    }
    if let Some(path) = &args.record {
        eprintln!("{}", path.display());
    }
    if !errors.is_empty() {
        let mean = |of: fn(&PoseError) -> f64| errors.iter().map(of).sum::<f64>() / errors.len() as f64;
        let (turn, shift) = (mean(|error| error.rotation_deg), mean(|error| error.translation));
        let worst = errors.iter().map(|error| error.rotation_deg).fold(0.0, f64::max);
        eprintln!(
            "{count} frames, {searches} searched all around; error {turn:.2}° {shift:.3} in the mean, {worst:.2}° at worst"
        );
    }
    Ok(trusted)
}

/// A box around the object in a frame in which nobody knows where it is.
fn looked_for(
    on: On,
    search: &Search,
    frame: &Path,
    instance: u32,
    open: Open<Box<dyn std::error::Error + Send + Sync>>,
    starts: &dyn Fn(&Shot) -> Result<Vec<DMat4>>,
) -> Result<BoundingBox> {
    let On { engine, model, .. } = on;
    let bar = progress::bar(0, "steps");
    let mut observe = |seen: Progress| {
        bar.set_length(seen.steps.into());
        bar.set_position(seen.step.into());
        Ok(())
    };
    let mut pass = |_: &[usize], shots: Vec<Shot>, starts: &[_]| Ok(search.shots(engine, model, shots, starts, &mut observe)?);
    let sightings = Sightings::of(engine, model, instance, &photo(frame)?, &[])?;
    let found = Anywhere { engine, model, open, starts, others: None }.search(&sightings, &mut pass);
    bar.finish_and_clear();
    let nothing = || format!("{}: nothing in it looks like {}", frame.display(), model.instance_name(instance));
    let Outcome { shot, found, .. } = found?.ok_or_else(nothing)?;
    let object = FoundObject::of(&shot, &found.world_from_camera, engine, model, 1)?;
    Ok(object.bounds().ok_or_else(nothing)?)
}

/// Paths of frames, as they come.
type Frames = Box<dyn Iterator<Item = Result<PathBuf>>>;

/// The pictures in a folder in order, those that stdin names, or the frames as they were given.
fn frames(given: &[PathBuf]) -> Result<Frames> {
    let paths = match given {
        [dash] if dash.as_os_str() == "-" => return Ok(Box::new(lines_on_stdin().map(|line| Ok(path_of(&line?))))),
        [dir] if dir.is_dir() => pictures_in(dir)?,
        _ => given.to_vec(),
    };
    Ok(Box::new(paths.into_iter().map(Ok)))
}

fn pictures_in(dir: &Path) -> Result<Vec<PathBuf>> {
    let files = std::fs::read_dir(dir).map_err(|error| format!("{}: {error}", dir.display()))?;
    let mut frames = files.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
    let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    // macOS leaves `._NAME.png` beside pictures, which is none.
    frames.retain(|path| is_picture(path) && !name(path).starts_with('.'));
    let stem = |path: &Path| path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    frames.sort_by_cached_key(|path| (numbered(&stem(path)), path.clone()));
    if frames.is_empty() {
        return Err(format!("{}: no pictures (.{}) in it", dir.display(), ENDINGS.join(", .")).into());
    }
    Ok(frames)
}

/// A name as its texts and the numbers after each: frame2 comes before frame10.
fn numbered(name: &str) -> Vec<(String, u128)> {
    let (mut parts, mut rest) = (Vec::new(), name);
    while !rest.is_empty() {
        let (text, from) = rest.split_at(rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len()));
        let (number, after) = from.split_at(from.find(|c: char| !c.is_ascii_digit()).unwrap_or(from.len()));
        parts.push((text.into(), number.parse().unwrap_or(0)));
        rest = after;
    }
    parts
}

fn side_by_side(whole: Option<RgbImage>, shot: &Shot, found: &Found) -> RgbImage {
    let side = shot.side;
    let views = [
        draw::view(&shot.rgb, side, SHOWN),
        draw::view(&found.view, side, SHOWN),
        draw::difference(&found.estimate.target, &found.view, side, SHOWN),
    ];
    let panels: Vec<RgbImage> = whole.into_iter().chain(views).collect();
    let mut row = RgbImage::new(panels.iter().map(RgbImage::width).sum(), SHOWN);
    let mut left = 0;
    for panel in panels {
        image::imageops::replace(&mut row, &panel, left, 0);
        left += i64::from(panel.width());
    }
    row
}

impl FrameReport<'_> {
    fn line(&self, pose: &Pose6) -> String {
        let [a, b, c, x, y, z] = pose.0;
        let [a, b, c] = [a, b, c].map(f64::to_degrees);
        let deviation = deviation(self.confidence);
        let error = self.error.map_or(String::new(), |error| format!("  error {error}"));
        let searched = if self.searched { "  searched all around" } else { "" };
        let verdict = self.doubt.map_or(String::new(), |doubt| format!("  DO NOT TRUST: {doubt}"));
        format!(
            "{}  rotation {a:.2}° {b:.2}° {c:.2}°  centre {x:.4} {y:.4} {z:.4}{deviation}  unexplained {:.0} %  {:.2} s{error}{searched}{verdict}",
            self.frame.display(),
            100.0 * self.unexplained,
            self.seconds
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_a_folder_come_in_the_order_of_their_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let names = [
            "frame10.png",
            "frame9.JPG",
            "frame.png",
            "b2.tif",
            "frame009.png",
            "._frame1.png",
            "notes.txt",
            "b10x1.png",
            "b10.png",
        ];
        names.iter().for_each(|name| std::fs::write(dir.path().join(name), "").unwrap());
        let found = pictures_in(dir.path()).unwrap();
        let found: Vec<_> = found.iter().map(|path| path.file_name().unwrap().to_str().unwrap()).collect();
        assert_eq!(found, ["b2.tif", "b10.png", "b10x1.png", "frame.png", "frame009.png", "frame9.JPG", "frame10.png"]);
    }
}
