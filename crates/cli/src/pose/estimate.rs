//! `sigma-pose estimate`: poses of pictures.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use clap::Args;
use glam::DMat4;
use indicatif::ProgressBar;
use serde::Serialize;
use sigma_srn::photo::{All, Anywhere, Boxed, Known, Outcome, Place, Shot, Sighting, Sightings};
use sigma_srn::{Confidence, Doubt, Engine, Error, Found, Light, Model, Pose6, Progress, Search};
use srn_data::camera::Axes;
use srn_data::target::photo;

use super::files::{
    Bounds, ObjectArgs, Picture, PoseSource, bounds, instance_of, lines_on_stdin, model_side, path_of, srn_instance,
    warn_of_turned,
};
use super::given::Given;
use super::mask::MadeRight;
use super::notation::{Notation, NotationArgs, ObjectPose};
use super::outline;
use super::record::Log;
use super::saved::SavedViews;
use super::search::{On, PoseError, SearchArgs, Starts, deviation, run as search, within_95};
use crate::common::{EngineArgs, Result, about_model, create_dir, load_model, lossy, print, refuse_existing, refuse_to_write};
use crate::progress;

/// Pictures that are searched for side by side, enough to fill a large GPU. What was found of them is printed before the next ones are looked at.
const AT_ONCE: usize = 32;

/// Flags of `sigma-pose estimate`.
#[derive(Args, Debug)]
pub struct Estimate {
    /// Pictures (PNG, JPEG, BMP, TIFF, WebP) of any size and colour type; transparency becomes white. A photograph that lies in no SRN folder is cut to a square
    /// around what transparency, --cutout and --mask leave of it; with neither, to its middle. Several are searched for side by side, 32 at a time; those of
    /// them in which no object is, as a box or a mask has it, are told. `-`: each line on stdin is a picture, whose pose is printed before the next one is read, with
    /// `--json` in a line of its own: a path, or, with what flags say otherwise, JSON like {"image": "a.png", "instance": "seat", "box": [120, 80, 200, 160]}; also
    /// `cutout`, `mask` and `rough` (4 × 4).
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
    #[command(flatten)]
    object: ObjectArgs,
    /// An experiment. The object is none of the model's, but of their kind: a latent code is fitted to each picture together with the pose, beginning with
    /// those of the objects that look most alike.
    #[arg(long, conflicts_with_all = ["instance", "record", "save_views", "preset", "effort", "loss", "steps", "lr", "cull", "no_cull", "stride"])]
    unseen: bool,
    /// With --unseen and one picture: write the model with this object, for further pictures of it.
    #[arg(long, value_name = "FILE")]
    save_model: Option<PathBuf>,
    /// What of a picture is the object, as a segmentation says: white, or opaque. What is black becomes background, as what is transparent does, so that the
    /// object's outline helps. A file, once or once per picture, or a folder with files called like the pictures.
    #[arg(long, value_name = "FILE|DIR")]
    cutout: Vec<PathBuf>,
    /// A box around the object, as detectors give it, instead of a segmentation: left edge, top edge, width and height in pixels of the picture. What in it is the
    /// object is found by its colours, and then by the pose that was found with these, from where the search is done once more; something may hide a part of it. `auto`: it is looked for in all of the
    /// picture, by how the model shows it from all around, and a pose is searched for at up to two places, until one is to be trusted; where nobody says which object it
    /// is, all of the model's are looked for, and those that are there for sure are told. Once, or once per picture.
    #[arg(long = "box", value_name = "X,Y,W,H|auto", value_parser = bounds, allow_hyphen_values = true, conflicts_with_all = ["cutout", "unseen"])]
    boxes: Vec<Bounds>,
    /// What counts in a picture: white, or opaque. What is black (something before the object) has no part in the search: the object may go on there.
    /// Like --cutout.
    #[arg(long, value_name = "FILE|DIR")]
    mask: Vec<PathBuf>,
    /// Where to start: `around2016`, all around, with every roll; `around84`, all around, the camera upright and the object standing as in training, in two thirds of
    /// the time; `fixed24`, the paper's fewer; `neighbor4`, 30° to four sides of --rough; or a file with 16 numbers per line, or in four lines, a `world_from_camera`
    /// each. Default: `neighbor4` with --rough, `fixed24` with --preset paper, `around84` with --unseen or --no-cull, else `around2016`. Where there are fewer than 84, six more
    /// are tried around each, turned by 40° about the object; numbers of starts count from 0, the given ones first.
    #[arg(long, value_name = "around2016|around84|fixed24|neighbor4|FILE")]
    starts: Option<Starts>,
    /// Roughly known pose: a pose file, or `auto`, the one in the picture's SRN folder. Once, or once per picture.
    #[arg(long, value_name = "POSE")]
    rough: Vec<PoseSource>,
    /// True pose, to report errors; like --rough. It has no influence on the search.
    #[arg(long, value_name = "POSE")]
    truth: Vec<PoseSource>,
    /// Print everything as JSON.
    #[arg(long)]
    json: bool,
    /// Write to this folder, of each search, a picture, an animation, and the found object's outline on the picture as it was given; where all objects are looked for, their
    /// outlines.
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Write the pictures whose poses are trusted to this folder, as views of a data set that is as the model's was: for `sigma-train adapt --more`.
    #[arg(long, value_name = "DIR")]
    save_views: Option<PathBuf>,
    /// Overwrite pictures in the folder of --record, the file of --save-model, and objects in the folder of --save-views.
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

/// What `--json` prints.
#[derive(Serialize)]
struct Report {
    /// `cpu`, or the adapter's name.
    executor: String,
    /// Seconds of the search for all pictures.
    seconds: f64,
    /// Axes of the cameras in all poses.
    convention: Axes,
    images: Vec<Entry>,
}

#[derive(Serialize)]
#[serde(untagged)]
enum Entry {
    Found(Box<ImageReport>),
    Failed(Failed),
}

/// One of several pictures in which no object is.
#[derive(Serialize)]
struct Failed {
    /// Among those that were given.
    #[serde(skip)]
    number: usize,
    #[serde(serialize_with = "lossy")]
    image: PathBuf,
    trusted: bool,
    failure: String,
}

#[derive(Serialize)]
struct ImageReport {
    #[serde(serialize_with = "lossy")]
    image: PathBuf,
    instance: String,
    /// Rows of the 4×4 matrix, in the data set's frame and object units.
    world_from_camera: [[f64; 4]; 4],
    /// The same in frame and units of the photographs that were imported: by --frame, or the frame.json of the picture's instance.
    source_from_camera: Option<[[f64; 4]; 4]>,
    /// In frame and units of `source_from_camera` where that is known, else of `world_from_camera`.
    camera_from_object: ObjectPose,
    /// θ1, θ2, θ3 of `R = Rx(θ1)·Ry(θ2)·Rz(θ3)` of `world_from_camera`.
    euler_rad: [f64; 3],
    /// Its camera centre, object units.
    translation: [f64; 3],
    loss: f64,
    /// See [`Found::unexplained`].
    unexplained: f64,
    trusted: bool,
    /// Why it is not to be trusted.
    doubt: Option<Doubt>,
    /// If the model is calibrated.
    confidence: Option<Confidence>,
    /// Of a picture that is cut out: what takes the object's colours there to the model's.
    light: Option<Light>,
    /// How its mask was made right.
    #[serde(flatten)]
    mask: MadeRight,
    /// The best pose elsewhere that the search followed to the end.
    rival: Option<Rival>,
    /// 2 if a second, exhaustive search has found it, for the first one's pose was not to be trusted.
    searches: usize,
    /// Number of the winning start.
    start: usize,
    error: Option<PoseError>,
    /// Whether the true pose lies within the stated 95 % ellipsoid.
    within_95: Option<bool>,
    /// The starts that went on after the first phase, the winner first.
    ranking: Vec<RankedReport>,
    seconds: f64,
}

#[derive(Serialize)]
struct Rival {
    start: usize,
    /// By which part its loss is higher.
    higher: f64,
    /// Rows, like those of the estimate.
    world_from_camera: [[f64; 4]; 4],
}

#[derive(Serialize)]
struct RankedReport {
    start: usize,
    loss: f64,
    phases: usize,
    error: Option<PoseError>,
}

/// A picture to search for, and where its poses are told, if it was imported.
struct Asked {
    /// Among those that were given.
    number: usize,
    given: Given,
    picture: Picture,
    source: Option<Notation>,
}

/// Runs the command; false where a pose is not to be trusted.
pub fn run(args: &Estimate) -> Result<bool> {
    let model = load_model(&args.object.model)?;
    if args.unseen {
        model.hypernetwork().map_err(|error| about_model(&args.object.model, error))?;
    }
    let notation = args.poses.open()?;
    if args.images == [Path::new("-")] {
        return on_stdin(args, &model, &notation);
    }
    let side = model_side(&model, &args.images[0])?;
    let starts = starts(args, !args.rough.is_empty())?;
    let (asked, failures) = pictures(args, &model, side, &notation)?;
    let looking = Looking { args, model: &model, starts: &starts, notation: &notation };
    let all = asked.iter().map(|asked| looking.starts_of(&asked.picture.shot, &asked.given)).collect::<Result<Vec<_>>>()?;
    if let Some(dir) = &args.record {
        let of = |end: &'static str| asked.iter().map(move |asked| dir.join(format!("{}{end}", asked.picture.name)));
        let files = [".png", ".gif", "-outline.png"].into_iter().flat_map(of);
        refuse_existing(files, args.force)?;
        create_dir(dir)?;
    }
    if let Some(path) = &args.save_model {
        // Not by clap, whose `requires` is silent where something else conflicts with what is required.
        if !args.unseen || args.images.len() > 1 {
            return Err("--save-model is for --unseen and one picture".into());
        }
        refuse_to_write(path, args.force)?;
    }
    let is_for_all = asked.iter().any(|asked| args.is_for_all(&asked.given, &model));
    let every = if is_for_all { 0..model.layout.instances } else { 0..0 };
    let instances = asked.iter().map(|asked| asked.picture.shot.instance).chain(every);
    let saved = args.save_views.as_ref().map(|dir| SavedViews::create(dir, &model, instances, args.force)).transpose()?;
    let engine = args.search.open(&args.engine)?;
    let on = On { engine: &engine, model: &model, side };
    let mut output = Output { args, on, notation: &notation, failures, images: vec![] };
    let done = match args.unseen {
        true => unseen(&asked, &all, &mut output),
        false => searched(&looking, &asked, saved, &mut output),
    };
    // Poses that were found are told, also where a picture of them could not be written.
    if done.is_err() && output.images.is_empty() {
        return done.map(|()| false);
    }
    let is_trusted = output.end()?;
    done.map(|()| is_trusted)
}

/// Where searches start, as flags have it.
fn starts(args: &Estimate, is_rough: bool) -> Result<Starts> {
    let default = if is_rough {
        Starts::Neighbor4
    } else if args.unseen {
        // As many as otherwise, for each known object, would take minutes.
        Starts::Around84
    } else {
        args.search.all_around()
    };
    let starts = args.starts.clone().unwrap_or(default);
    if is_rough && starts != Starts::Neighbor4 {
        return Err(format!("--rough is what --starts neighbor4 turns; {starts} does without it").into());
    }
    Ok(starts)
}

/// How pictures are looked at.
struct Looking<'a> {
    args: &'a Estimate,
    model: &'a Model,
    starts: &'a Starts,
    notation: &'a Notation,
}

/// What was noted of a search, and the number of a picture in there.
type Noted = (Rc<Log>, usize);
/// Searches for pictures as they stand, each from its own starts.
type Pass<'a> = &'a mut dyn FnMut(&[Picture], &[Vec<DMat4>]) -> Result<Vec<Outcome<Noted>>>;

impl Estimate {
    /// A picture; if it has a box, with what is `known` of the object in it.
    fn open(&self, given: &Given, model: &Model, side: u32, known: Known) -> Result<Picture> {
        // Of an object that the model does not know the number says nothing, nor where all are looked for.
        let any = (self.unseen || self.is_for_all(given, model)).then(|| model.instance_name(0));
        let instance = any.as_deref().or(self.object.instance.as_deref());
        let picture = given.open(model, side, instance, &self.object.camera, known)?;
        let stem = || given.image.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(if self.is_for_all(given, model) { Picture { name: stem(), ..picture } } else { picture })
    }

    /// Whether nobody says which object is in a picture, nor where.
    fn is_for_all(&self, given: &Given, model: &Model) -> bool {
        let is_named = given.instance.is_some() || self.object.instance.is_some() || srn_instance(&given.image).is_some();
        given.bounds == Some(Bounds::Anywhere) && !is_named && model.layout.instances > 1
    }
}

impl Looking<'_> {
    fn starts_of(&self, shot: &Shot, given: &Given) -> Result<Vec<DMat4>> {
        self.args.search.starts(self.starts, self.model, shot, given.rough.as_ref(), self.notation)
    }

    /// Searches for pictures, all of which have boxes, or none. What was found of each: of all objects of the model those that are to be trusted.
    fn find(&self, on: On, asked: &[Asked], look: &dyn Fn(u32), pass: Pass) -> Result<Vec<Vec<Outcome<Noted>>>> {
        if asked.iter().all(|asked| asked.given.bounds.is_none()) {
            let starts = asked.iter().map(|Asked { picture, given, .. }| self.starts_of(&picture.shot, given));
            let pictures: Vec<_> = asked.iter().map(|asked| asked.picture.clone()).collect();
            return Ok(one_each(pass(&pictures, &starts.collect::<Result<Vec<_>>>()?)?));
        }
        let is_anywhere = |asked: &Asked| asked.given.bounds == Some(Bounds::Anywhere);
        if asked.iter().any(is_anywhere) {
            if let [asked] = asked {
                return Ok(vec![self.anywhere(on, asked, look, pass)?]);
            }
            let each = asked.iter().map(|asked| Ok(self.find(on, std::slice::from_ref(asked), look, pass)?.remove(0)));
            return each.collect();
        }
        let open = |i: usize, known: Known| Ok(self.args.open(&asked[i].given, on.model, on.side, known)?.shot);
        let starts = |i: usize, shot: &Shot| self.starts_of(shot, &asked[i].given);
        let box_of = |i: usize| if let Some(Bounds::Box(bounds)) = asked[i].given.bounds { Some(bounds) } else { None };
        let sightings = |i: usize, instance: u32| {
            let Given { image, rough, .. } = &asked[i].given;
            let (Some(bounds), None) = (box_of(i), rough) else { return Ok(None) };
            Ok(Some(Sightings::in_box(on.engine, on.model, instance, &photo(image)?, bounds)?))
        };
        let boxed =
            Boxed { engine: on.engine, model: on.model, open: &open, starts: &starts, given: &box_of, sightings: &sightings };
        let shots = asked.iter().map(|asked| asked.picture.shot.clone()).collect();
        let numbers: Vec<usize> = (0..asked.len()).collect();
        let found = boxed.search(&numbers, shots, &mut |numbers: &[usize], shots, starts: &[_]| {
            let named = |(&i, shot): (&usize, _)| Picture { shot, ..asked[i].picture.clone() };
            pass(&numbers.iter().zip(shots).map(named).collect::<Vec<_>>(), starts)
        });
        Ok(one_each(found?))
    }

    /// Searches for the object in a picture where it seems to be, or for all of the model's.
    fn anywhere(
        &self,
        on: On,
        Asked { given, picture, .. }: &Asked,
        look: &dyn Fn(u32),
        pass: Pass,
    ) -> Result<Vec<Outcome<Noted>>> {
        let On { engine, model, side } = on;
        let photo = photo(&given.image)?;
        let starts = |shot: &Shot| self.starts_of(shot, given);
        let mut named = |_: &[usize], shots: Vec<Shot>, starts: &[_]| {
            pass(&shots.into_iter().map(|shot| Picture { shot, ..picture.clone() }).collect::<Vec<_>>(), starts)
        };
        let mut search = |instance: u32, sightings: &Sightings, place: Option<Sighting>, others: Option<Place>| {
            let open = |bounds, known: Known| {
                let (instance, bounds) = (Some(model.instance_name(instance)), Some(Bounds::Box(bounds)));
                let given = Given { instance, bounds, ..given.clone() };
                Ok(self.args.open(&given, model, side, known)?.shot)
            };
            let anywhere = Anywhere { engine, model, open: &open, starts: &starts, others };
            match place {
                Some(place) => anywhere.search_at(sightings, place, &mut named),
                None => anywhere.search(sightings, &mut named),
            }
        };
        if self.args.is_for_all(given, model) {
            let at = |instance: u32, sightings: &Sightings, place, others: Option<Place>| {
                search(instance, sightings, Some(place), others)
            };
            return All { engine, model, photo: &photo }.search(0..model.layout.instances, look, at);
        }
        let instance = picture.shot.instance;
        let found = search(instance, &Sightings::of(engine, model, instance, &photo, &[])?, None, None)?;
        // Where nothing differs from anything, it is the picture as it is.
        match found {
            Some(found) => Ok(vec![found]),
            None => named(&[0], vec![picture.shot.clone()], &[starts(&picture.shot)?]),
        }
    }

    /// The settings of a search; those of pictures with boxes follow one another as they do.
    fn settings(&self, is_boxed: bool) -> Result<Search> {
        let search = &self.args.search;
        if is_boxed { Ok(search.single(search.options()?)) } else { search.search() }
    }
}

fn one_each<T>(all: Vec<T>) -> Vec<Vec<T>> {
    all.into_iter().map(|one| vec![one]).collect()
}

/// Searches for pictures, and tells what was noted of each.
fn pass(
    settings: &Search,
    on: On,
    pictures: &[Picture],
    starts: &[Vec<DMat4>],
    mut observe: impl FnMut(&mut Log, Progress) -> std::result::Result<(), Error>,
) -> Result<Vec<Outcome<Noted>>> {
    let mut log = Log::default();
    let found = search(settings, on, pictures, starts, |progress| observe(&mut log, progress))?;
    let log = Rc::new(log);
    let outcome =
        |(i, (picture, found)): (_, (&Picture, _))| Outcome { shot: picture.shot.clone(), found, log: (log.clone(), i) };
    Ok(pictures.iter().zip(found).enumerate().map(outcome).collect())
}

/// Poses of pictures of objects in the model.
fn searched(looking: &Looking, all: &[Asked], mut saved: Option<SavedViews>, output: &mut Output) -> Result<()> {
    let &mut Output { args, on, .. } = output;
    let is_boxed = !args.boxes.is_empty();
    let settings = looking.settings(is_boxed)?;
    let bar = progress::bar(0, "steps");
    let portions = if args.boxes.contains(&Bounds::Anywhere) { all.len() } else { all.len().div_ceil(AT_ONCE) };
    let (mut left, mut before) = (portions as u64 * if is_boxed { 2 } else { 1 }, 0);
    let mut pass = |pictures: &[Picture], starts: &[Vec<DMat4>]| {
        let outcomes = pass(&settings, on, pictures, starts, |log, mut progress| {
            bar.set_length(before + left * u64::from(progress.steps));
            if progress.search > 0 && progress.step == 0 {
                bar.set_message(format!("{}, once more", pictures[progress.hypotheses[0].0].name));
            }
            bar.set_position(before + u64::from(progress.step));
            if args.record.is_some() { log.note(&mut progress) } else { Ok(()) }
        })?;
        // Pictures with boxes may need more than was thought.
        (left, before) = ((left - 1).max(1), bar.position());
        bar.set_message("");
        Ok(outcomes)
    };
    let look = |instance| bar.set_message(format!("looking for {}", on.model.instance_name(instance)));
    for asked in all.chunks(AT_ONCE) {
        let outcomes = looking.find(on, asked, &look, &mut pass)?;
        for (asked, outcomes) in asked.iter().zip(&outcomes) {
            for (number, Outcome { shot, found, .. }) in outcomes.iter().enumerate() {
                let name = &asked.picture.name;
                let name = if number > 0 { format!("{name}-{number}") } else { name.clone() };
                let picture = Picture { name, shot: shot.clone(), ..asked.picture };
                output.add(asked, &picture, found, found.estimate.ranking.len(), &bar)?;
                saved.iter_mut().try_for_each(|saved| saved.add(&picture, found, on.side))?;
            }
            if outcomes.is_empty() {
                output.nothing(asked, &bar)?;
            }
        }
        let Some(dir) = &args.record else { continue };
        for (Asked { given, picture, .. }, outcomes) in asked.iter().zip(&outcomes) {
            let found: Vec<_> = outcomes.iter().map(|Outcome { shot, found, .. }| (shot, found)).collect();
            outline::write(dir, &given.image, &picture.name, &found, on)?;
            if args.is_for_all(given, on.model) {
                continue;
            }
            for Outcome { shot, found, log: (log, i) } in outcomes {
                log.write(dir, *i, &Picture { shot: shot.clone(), ..picture.clone() }, found, on)?;
            }
        }
    }
    bar.finish_and_clear();
    if let Some(dir) = &args.record {
        eprintln!("pictures in {}", dir.display());
    }
    if let (Some(saved), Some(dir)) = (saved, &args.save_views) {
        let (written, all) = (saved.finish()?, all.len());
        eprintln!("{written} of {all} pictures, those with poses to be trusted, written to {}", dir.display());
    }
    let is_hidden = |entry: &Entry| matches!(entry, Entry::Found(image) if image.doubt == Some(Doubt::Hidden));
    if args.cutout.is_empty() && !is_boxed && output.images.iter().any(is_hidden) {
        eprintln!("--mask says nothing of what it hides; a segmentation of the object is for --cutout, and its outline counts");
    }
    Ok(())
}

/// Poses of objects that are not in the model.
fn unseen(all: &[Asked], starts: &[Vec<DMat4>], output: &mut Output) -> Result<()> {
    let &mut Output { args, on, .. } = output;
    let bar = progress::bar(0, "turns");
    for (i, (asked, starts)) in all.iter().zip(starts).enumerate() {
        let observe = |turn: usize, turns: usize| {
            bar.set_length((turns * all.len()) as u64);
            bar.set_position((turns * i + turn) as u64);
            Ok(())
        };
        let (found, fitted) = args.search.run_unseen(on, &asked.picture, starts, observe)?;
        output.add(asked, &asked.picture, &found, starts.len(), &bar)?;
        if let Some(path) = &args.save_model {
            fitted.save(path)?;
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// A pose for each line on stdin, before the next one is read. What is wrong with a line is told in its place.
fn on_stdin(args: &Estimate, model: &Model, notation: &Notation) -> Result<bool> {
    let said = [
        ("--unseen", args.unseen),
        ("--cutout", !args.cutout.is_empty()),
        ("--box", !args.boxes.is_empty()),
        ("--mask", !args.mask.is_empty()),
        ("--rough", !args.rough.is_empty()),
        ("--truth", !args.truth.is_empty()),
        ("--record", args.record.is_some()),
        ("--save-views", args.save_views.is_some()),
    ];
    if let Some((flag, _)) = said.iter().find(|(_, is_given)| *is_given) {
        return Err(format!("{flag} does not go together with pictures on stdin: what is said of each stands in its line").into());
    }
    let engine = args.search.open(&args.engine)?;
    let mut is_trusted = true;
    for line in lines_on_stdin() {
        let line = line?;
        let given = Given::parse(&line, notation);
        let image = given.as_ref().map_or_else(|_| path_of(&line), |given| given.image.clone());
        let told = match given.and_then(|given| of_line(args, model, &engine, notation, given)) {
            Ok((is_sure, told)) => {
                is_trusted &= is_sure;
                told
            }
            Err(error) => {
                is_trusted = false;
                let failed = Failed { number: 0, image, trusted: false, failure: error.to_string() };
                if args.json { serde_json::to_string(&failed)? } else { failed.line() }
            }
        };
        print(&told)?;
    }
    Ok(is_trusted)
}

/// Whether the pose of a picture is to be trusted, and all of it as it is printed.
fn of_line(args: &Estimate, model: &Model, engine: &Engine, notation: &Notation, given: Given) -> Result<(bool, String)> {
    let side = model_side(model, &given.image)?;
    let on = On { engine, model, side };
    let looking = Looking { args, model, starts: &starts(args, given.rough.is_some())?, notation };
    warn_of_turned(&given.image);
    if args.is_for_all(&given, model) {
        // One line for each line.
        instance_of(model, None)?;
    }
    let picture = args.open(&given, model, side, Known::default())?;
    let source = args.poses.source(srn_instance(&given.image).as_deref())?;
    let settings = looking.settings(given.bounds.is_some())?;
    let asked = Asked { number: 0, given, picture, source };
    let bar = progress::bar(0, "steps");
    let mut pass = |pictures: &[Picture], starts: &[Vec<DMat4>]| {
        pass(&settings, on, pictures, starts, |_, progress| {
            bar.set_length(progress.steps.into());
            bar.set_position(progress.step.into());
            Ok(())
        })
    };
    let found = looking.find(on, std::slice::from_ref(&asked), &|_| (), &mut pass);
    bar.finish_and_clear();
    let Outcome { shot, found, .. } = found?.remove(0).remove(0);
    let picture = Picture { shot, ..asked.picture.clone() };
    let image = Output { args, on, notation, failures: vec![], images: vec![] }.image(&asked, &picture, &found);
    let line = || image.line(&found, found.estimate.ranking.len(), notation);
    Ok((image.trusted, if args.json { serde_json::to_string(&image)? } else { line() }))
}

/// One of `things` per image, of which there are none, one or as many.
fn each<'a, T>(flag: &str, what: &str, things: &'a [T], images: &'a [PathBuf]) -> Result<Vec<(&'a PathBuf, Option<&'a T>)>> {
    if ![0, 1, images.len()].contains(&things.len()) {
        return Err(format!("{flag}: {} {what} for {} pictures; give one, or one for each", things.len(), images.len()).into());
    }
    Ok(images.iter().enumerate().map(|(i, image)| (image, things.get(i % things.len().max(1)))).collect())
}

fn poses(flag: &str, sources: &[PoseSource], images: &[PathBuf], notation: &Notation) -> Result<Vec<Option<DMat4>>> {
    let read = |(image, source): (&PathBuf, Option<&PoseSource>)| source.map(|s| s.read(image, notation)).transpose();
    each(flag, "poses", sources, images)?.into_iter().map(read).collect()
}

/// What flags say of each picture.
fn given(args: &Estimate, notation: &Notation) -> Result<Vec<Given>> {
    let Estimate { images, .. } = args;
    let rough = poses("--rough", &args.rough, images, notation)?;
    let truths = poses("--truth", &args.truth, images, notation)?;
    let cutouts = each("--cutout", "masks", &args.cutout, images)?;
    let masks = each("--mask", "masks", &args.mask, images)?;
    let boxes = each("--box", "boxes", &args.boxes, images)?;
    let of = |i: usize| Given {
        image: images[i].clone(),
        instance: None,
        cutout: cutouts[i].1.cloned(),
        bounds: boxes[i].1.copied(),
        mask: masks[i].1.cloned(),
        rough: rough[i],
        truth: truths[i],
    };
    Ok((0..images.len()).map(of).collect())
}

/// The pictures; and of several those in which no object is, with why.
fn pictures(args: &Estimate, model: &Model, side: u32, notation: &Notation) -> Result<(Vec<Asked>, Vec<Failed>)> {
    let (mut names, mut asked, mut failures) = (HashSet::new(), Vec::new(), Vec::new());
    for (number, given) in given(args, notation)?.into_iter().enumerate() {
        warn_of_turned(&given.image);
        if args.is_for_all(&given, model) && given.rough.or(given.truth).is_some() {
            return Err("--rough and --truth are of one object: give --instance".into());
        }
        let mut picture = match args.open(&given, model, side, Known::default()) {
            Ok(picture) => picture,
            // A detector may see what is not there, which says nothing of the other pictures.
            Err(error) if args.images.len() > 1 && matches!(error.downcast_ref(), Some(srn_data::Error::Empty { .. })) => {
                failures.push(Failed { number, image: given.image, trusted: false, failure: error.to_string() });
                continue;
            }
            Err(error) => return Err(error),
        };
        while !names.insert(picture.name.clone()) {
            picture.name += "-again";
        }
        let source = args.poses.source(srn_instance(&given.image).as_deref())?;
        asked.push(Asked { number, given, picture, source });
    }
    match failures.first() {
        Some(Failed { failure, .. }) if asked.is_empty() => Err(failure.as_str().into()),
        _ => Ok((asked, failures)),
    }
}

/// What was found so far.
struct Output<'a> {
    args: &'a Estimate,
    on: On<'a>,
    notation: &'a Notation,
    /// Pictures in which no object is.
    failures: Vec<Failed>,
    images: Vec<Entry>,
}

impl Output<'_> {
    /// Takes what was found of the next picture, and prints it, unless all is to be one JSON document.
    fn add(&mut self, asked: &Asked, picture: &Picture, found: &Found, starts: usize, bar: &ProgressBar) -> Result<()> {
        bar.suspend(|| self.fail(asked.number))?;
        let image = self.image(asked, picture, found);
        if !self.args.json {
            bar.suspend(|| print(&image.line(found, starts, self.notation)))?;
        }
        self.images.push(Entry::Found(Box::new(image)));
        Ok(())
    }

    /// Tells that no object is in a picture.
    fn nothing(&mut self, Asked { number, given, .. }: &Asked, bar: &ProgressBar) -> Result<()> {
        let failure = "none of the model's objects is there for sure".into();
        bar.suspend(|| {
            self.fail(*number)?;
            self.failures.insert(0, Failed { number: *number, image: given.image.clone(), trusted: false, failure });
            self.fail(number + 1)
        })
    }

    /// Tells of those pictures before this number in which no object is.
    fn fail(&mut self, before: usize) -> Result<()> {
        let count = self.failures.iter().take_while(|failed| failed.number < before).count();
        for failed in self.failures.drain(..count) {
            if !self.args.json {
                print(&failed.line())?;
            }
            self.images.push(Entry::Failed(failed));
        }
        Ok(())
    }

    /// Prints the document, if there is to be one; whether all poses are to be trusted.
    fn end(mut self) -> Result<bool> {
        self.fail(usize::MAX)?;
        let is_trusted = self.images.iter().all(|entry| matches!(entry, Entry::Found(image) if image.trusted));
        let seconds = |entry: &Entry| if let Entry::Found(image) = entry { image.seconds } else { 0.0 };
        if self.args.json {
            let report = Report {
                executor: self.on.engine.to_string(),
                seconds: self.images.iter().map(seconds).sum(),
                convention: self.args.poses.convention,
                images: self.images,
            };
            print(&serde_json::to_string_pretty(&report)?)?;
        }
        Ok(is_trusted)
    }

    fn image(&self, Asked { given, source, .. }: &Asked, picture: &Picture, found: &Found) -> ImageReport {
        let instance = if self.args.unseen { "unseen".into() } else { self.on.model.instance_name(picture.shot.instance) };
        let convention = self.args.poses.convention;
        let world_from_camera = convention.of_ours(found.world_from_camera);
        let [a, b, c, x, y, z] = Pose6::from_matrix(&world_from_camera).0;
        let error = |pose: &DMat4| picture.truth.map(|truth| PoseError::of(pose, &truth));
        let ranked = |r: &sigma_srn::Ranked| RankedReport {
            start: r.start,
            loss: r.loss,
            phases: r.phases,
            error: error(&r.pose.to_matrix()),
        };
        let phases = found.estimate.ranking[0].phases;
        let went_on = |r: &&sigma_srn::Ranked| r.phases > 1 || r.phases == phases;
        let rival = |(r, higher): (&sigma_srn::Ranked, f64)| Rival {
            start: r.start,
            higher,
            world_from_camera: convention.of_ours(r.pose.to_matrix()).transpose().to_cols_array_2d(),
        };
        ImageReport {
            image: given.image.clone(),
            instance,
            world_from_camera: world_from_camera.transpose().to_cols_array_2d(),
            source_from_camera: source.map(|source| source.rows(&found.world_from_camera)),
            camera_from_object: source.as_ref().unwrap_or(self.notation).object(&found.world_from_camera, found.confidence),
            euler_rad: [a, b, c],
            translation: [x, y, z],
            loss: found.estimate.loss,
            unexplained: found.unexplained,
            trusted: found.is_trusted(),
            doubt: found.doubt,
            confidence: found.confidence,
            light: found.estimate.light,
            mask: MadeRight::of(&found.estimate, picture.shot.pixels_of_photo()),
            rival: found.estimate.rival().map(rival),
            searches: found.searches,
            start: found.estimate.ranking[0].start,
            error: error(&found.world_from_camera),
            within_95: picture.truth.and_then(|truth| within_95(self.on.model, picture.shot.instance, found, &truth)),
            ranking: found.estimate.ranking.iter().filter(went_on).map(ranked).collect(),
            seconds: found.seconds,
        }
    }
}

impl Failed {
    fn line(&self) -> String {
        format!("{}  DO NOT TRUST: {}", self.image.display(), self.failure)
    }
}

impl ImageReport {
    /// What is printed without `--json`, the pose as it was asked for.
    fn line(&self, found: &Found, starts: usize, notation: &Notation) -> String {
        let [a, b, c, x, y, z] = Pose6::from_matrix(&notation.written(&found.world_from_camera)).0;
        let [a, b, c] = [a, b, c].map(f64::to_degrees);
        let verdict = self.doubt.map_or(String::new(), |doubt| format!("  DO NOT TRUST: {doubt}"));
        let deviation = deviation(self.confidence.map(|confidence| notation.confidence(confidence)));
        let error = self.error.map_or(String::new(), |error| format!("  error {}", notation.error(error)));
        format!(
            "{}  {}  rotation {a:.2}° {b:.2}° {c:.2}°  centre {x:.4} {y:.4} {z:.4}{deviation}  loss {:.4}  unexplained {:.0} %  \
             start {} of {starts}  {:.1} s{error}{verdict}",
            self.image.display(),
            self.instance,
            self.loss,
            100.0 * self.unexplained,
            self.start,
            self.seconds,
        )
    }
}
