//! `robustness [TABLE…] [--seed N] [--starts STARTS]`: pictures like photographs of the asset objects, spoiled in known ways, and how far off `sigma-pose` ends: tables
//! of `docs/accuracy.md`. The pictures are left in `demo/robustness`.

mod capture;
mod photo;
mod scene;
mod several;
mod sides;
mod video;

use std::error::Error;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Output};

use glam::DMat4;
use image::imageops::{self, FilterType};
use image::{Rgb, RgbImage, Rgba};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde_json::Value;
use srn_data::{sheet, srn};

use crate::photo::{Lit, OUTSIDE, Photo, SIDE, Spoil, Spoiled, exposed};
use crate::several::Lying;
use crate::video::Video;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

const USAGE: &str = "usage: robustness [distance] [rolled] [near] [light] [masks] [alone] [hidden] [boxes] [rooms] [several] [behind] [others] [sides] [video] [leaving] [captures] [--seed N] [--starts STARTS]";

const OUT: &str = "demo/robustness";
const MODEL: &str = "assets/models/compact.safetensors";
const LDRAW: &str = "assets/meshes/ldraw/parts";
/// The objects of the asset model; LDraw parts without a folder.
const OBJECTS: [(&str, &str); 9] = [
    ("bucket", "32030.dat"),
    ("chicken", "assets/meshes/chicken/chicken.obj"),
    ("forklift", "assets/meshes/forklift/forklift.obj"),
    ("mudguard", "98835.dat"),
    ("seat", "2717.dat"),
    ("sensor", "53792.dat"),
    ("steering", "3829c01.dat"),
    ("turret", "6072.dat"),
    ("valve", "4694c02.dat"),
];
/// Pictures of each object.
const VIEWS: usize = 4;
/// Number of the picture of each row that is shown, and how many stand side by side.
const SHOWN: usize = 17;
const COLUMNS: usize = 6;
/// Focal length of most, and of those from so near that they are 90° across.
const FOCAL: f64 = 297.6;
const WIDE: f64 = 128.0;
const FOCAL_OF_ROOM: f64 = 600.0;
/// Other things in a room.
const IN_ROOM: usize = 9;

const STOP_LESS: Lit = |colour, _| exposed(colour, [0.5; 3]);
const STOP_MORE: Lit = |colour, _| exposed(colour, [2.0; 3]);

/// What is known of the pose, and how hard the search tries.
#[derive(Clone, Copy)]
struct How {
    rough: bool,
    effort: &'static str,
}

const AROUND: How = How { rough: false, effort: "normal" };
const AROUND_FAST: How = How { rough: false, effort: "fast" };
const NEAR_FAST: How = How { rough: true, effort: "fast" };

struct Row {
    what: &'static str,
    distance: f64,
    focal: f64,
    spoil: Spoil,
    /// Whether cameras are turned about their optical axes, where they else are upright.
    is_rolled: bool,
}

/// From 1.3 away.
const fn row(what: &'static str, spoil: Spoil) -> Row {
    Row { what, distance: 1.3, focal: FOCAL, spoil, is_rolled: false }
}

const fn from(what: &'static str, distance: f64, focal: f64) -> Row {
    Row { distance, focal, ..row(what, Spoil::Nothing) }
}

const fn in_room(what: &'static str, distance: f64, spoil: Spoil) -> Row {
    Row { what, distance, focal: FOCAL_OF_ROOM, spoil, is_rolled: distance > 4.0 }
}

const fn rolled(what: &'static str, spoil: Spoil) -> Row {
    Row { is_rolled: true, ..row(what, spoil) }
}

struct Table {
    name: &'static str,
    searches: &'static [How],
    rows: &'static [Row],
}

const TABLES: [Table; 10] = [
    Table {
        name: "distance",
        searches: &[AROUND_FAST],
        rows: &[from("1.3", 1.3, FOCAL), from("2", 2.0, FOCAL), from("3", 3.0, FOCAL), from("5", 5.0, FOCAL)],
    },
    Table {
        name: "rolled",
        searches: &[AROUND, AROUND_FAST],
        rows: &[
            rolled("cut out", Spoil::Nothing),
            rolled("1 stop less", Spoil::Light(STOP_LESS)),
            rolled("3/10 hidden", Spoil::Bar(0.3)),
            rolled("half hidden", Spoil::Bar(0.5)),
        ],
    },
    Table {
        name: "near", searches: &[AROUND], rows: &[from("1, 90° across", 1.0, WIDE), from("0.75, 90° across", 0.75, WIDE)]
    },
    Table {
        name: "light",
        searches: &[AROUND_FAST],
        rows: &[
            row("the model's", Spoil::Nothing),
            row("1 stop less", Spoil::Light(STOP_LESS)),
            row("1 stop more", Spoil::Light(STOP_MORE)),
            row("redder", Spoil::Light(|colour, _| exposed(colour, [1.4, 1.0, 1.0 / 1.4]))),
            row("less contrast", Spoil::Light(|colour, _| colour.map(|v| 0.5 + 0.6 * (v - 0.5)))),
            row("from the right", Spoil::Light(|colour, right| exposed(colour, [0.4 + 1.2 * right; 3]))),
        ],
    },
    Table {
        name: "masks",
        searches: &[NEAR_FAST],
        rows: &[
            row("exact", Spoil::Nothing),
            row("1 too large", Spoil::Larger(1.0)),
            row("2 too large", Spoil::Larger(2.0)),
            row("4 too large", Spoil::Larger(4.0)),
            row("1 too small", Spoil::Larger(-1.0)),
            row("2 too small", Spoil::Larger(-2.0)),
            row("4 too small", Spoil::Larger(-4.0)),
            row("ragged by 2", Spoil::Ragged(2.0)),
            row("disc of 16", Spoil::Disc(8.0)),
            row("shadow of 5", Spoil::Shadow([0, 5])),
            row("shadow of 10", Spoil::Shadow([0, 10])),
            row("shadow of 16", Spoil::Shadow([0, 16])),
            row("shadow of 8, 8", Spoil::Shadow([8, 8])),
            row("a tenth missing", Spoil::Missing(0.1)),
            row("a fifth missing, four sides", Spoil::Lacking(0.2)),
        ],
    },
    Table {
        name: "alone",
        searches: &[AROUND, AROUND_FAST],
        rows: &[
            row("the model's", Spoil::Alone(|colour, _| colour)),
            row("1 stop less", Spoil::Alone(STOP_LESS)),
            row("1 stop more", Spoil::Alone(STOP_MORE)),
        ],
    },
    Table {
        name: "hidden",
        searches: &[AROUND, AROUND_FAST],
        rows: &[row("3/10 hidden", Spoil::Bar(0.3)), row("half hidden", Spoil::Bar(0.5)), row("3/10 cut off", Spoil::Edge(0.3))],
    },
    Table {
        name: "boxes",
        searches: &[AROUND, AROUND_FAST],
        rows: &[
            row("on a table", Spoil::Among(0, 0)),
            row("seven others behind it", Spoil::Among(7, 0)),
            row("the next object", Spoil::Among(7, 1)),
        ],
    },
    Table {
        name: "rooms",
        searches: &[AROUND_FAST],
        rows: &[
            in_room("from 3", 3.0, Spoil::Room(0)),
            in_room("from 4.5, rolled", 4.5, Spoil::Room(0)),
            in_room("the next object", 3.0, Spoil::Room(1)),
        ],
    },
    Table {
        name: "others",
        searches: &[AROUND_FAST],
        rows: &[row("the next object", Spoil::Another(1)), row("the one after", Spoil::Another(2))],
    },
];

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<()> {
    let (mut wanted, mut has_sides, mut has_video, mut has_captures) = (Vec::new(), false, false, false);
    let (mut has_leaving, mut has_several, mut has_behind) = (false, false, false);
    let (mut seed, mut starts) = (23, "around2016".to_string());
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--seed" => seed = arguments.next().and_then(|text| text.parse().ok()).ok_or(USAGE)?,
            "--starts" => starts = arguments.next().ok_or(USAGE)?,
            "sides" => has_sides = true,
            "video" => has_video = true,
            "leaving" => has_leaving = true,
            "several" => has_several = true,
            "behind" => has_behind = true,
            "captures" => has_captures = true,
            name => wanted.push(TABLES.iter().find(|table| table.name == name).ok_or(USAGE)?),
        }
    }
    if wanted.is_empty() && ![has_several, has_behind, has_sides, has_video, has_leaving, has_captures].contains(&true) {
        (wanted, has_several, has_behind) = (TABLES.iter().collect(), true, true);
        (has_sides, has_video, has_leaving, has_captures) = (true, true, true, true);
    }
    let programs = Programs { folder: std::env::current_exe()?.parent().ok_or("no folder")?.into(), starts };
    let mut shown = Vec::new();
    for table in wanted {
        println!("\n{}, seed {seed}, {} pictures each, made in {OUT}\n", table.name, VIEWS * OBJECTS.len());
        println!("{HEAD}");
        for row in table.rows {
            let views = programs.views(row, seed)?;
            let folder = Path::new(OUT).join(table.name).join(row.what.replace([' ', ',', '°', '/'], "-"));
            let pictures = spoiled(row, &views, &folder, seed)?;
            shown.push((pictures[SHOWN].small()?, row.what));
            for how in table.searches {
                let mut found = Vec::new();
                for (object, own) in pictures.chunks(VIEWS).enumerate() {
                    if std::io::stderr().is_terminal() {
                        eprint!(
                            "\r{}, {}, {}: {} of {} pictures ",
                            table.name,
                            row.what,
                            how.effort,
                            found.len(),
                            pictures.len()
                        );
                    }
                    found.extend(programs.estimated(row, *how, object, own)?);
                }
                if std::io::stderr().is_terminal() {
                    eprint!("\r{:79}\r", "");
                }
                println!("| {} | {} |", row.what, line(*how, &found));
            }
        }
    }
    if has_several {
        several(&programs, seed)?;
    }
    if has_behind {
        behind(&programs, seed)?;
    }
    if has_sides {
        sides(&programs, seed)?;
    }
    if has_video {
        videos(&programs, seed)?;
    }
    if has_leaving {
        leaving(&programs, seed)?;
    }
    if has_captures {
        captures(&programs, seed)?;
    }
    if shown.is_empty() {
        return Ok(());
    }
    let cells: Vec<_> = shown.iter().map(|(picture, what)| (picture, *what)).collect();
    sheet::grid(&cells, COLUMNS).save(Path::new(OUT).join("sheet.png"))?;
    Ok(())
}

/// The table of rooms with several objects.
fn several(programs: &Programs, seed: u64) -> Result<()> {
    println!("\nseveral, seed {seed}, made in {OUT}\n");
    println!(
        "| | effort | found within 5°, of those half in sight | told, of these wrong | rotation, mean / median / worst | \
         translation, mean / median | a picture, median |\n|---|---|---|---|---|---|---|"
    );
    for (what, lying) in [("beside each other", Lying::Apart), ("in a heap", Lying::Heaped)] {
        println!("{}", several::found(programs, several::rooms(programs, lying, seed)?, what, "fast")?);
    }
    Ok(())
}

/// The table of objects behind others in heaps, by boxes around what is in sight of them.
fn behind(programs: &Programs, seed: u64) -> Result<()> {
    println!("\nbehind, seed {seed}, made in {OUT}\n{HEAD}");
    let rooms = several::rooms(programs, Lying::Heaped, seed)?;
    for (what, in_sight) in [("3 to 5 tenths in sight", 0.3..0.5), ("5 to 7 tenths", 0.5..0.7), ("7 to 9.7 tenths", 0.7..0.97)] {
        let pictures = several::boxed(&rooms, &in_sight)?;
        let found = pictures.iter().map(|(name, picture)| programs.found(name, AROUND_FAST, picture));
        let found = found.collect::<Result<Vec<_>>>()?;
        println!("| {what}, {} pictures | {} |", found.len(), line(AROUND_FAST, &found));
    }
    Ok(())
}

/// The table of models that know an object from some sides only.
fn sides(programs: &Programs, seed: u64) -> Result<()> {
    println!("\nsides, seed {seed}, made in {OUT}\n");
    println!(
        "| | effort | trusted within 5° | trusted of those up to 10° off | trusted of those further off |\n|---|---|---|---|---|"
    );
    let walks = sides::walks(programs, seed)?;
    let mut all = Vec::new();
    for ((name, _), walk) in OBJECTS.iter().zip(&walks) {
        let told = sides::told(programs, walk, name, "fast")?;
        println!("| {name} | fast | {} |", sides::cells(told));
        all.push(told);
    }
    println!("| all | fast | {} |", sides::cells(sides::sum(&all)));
    Ok(())
}

/// The table of videos.
fn videos(programs: &Programs, seed: u64) -> Result<()> {
    println!("\nvideo, seed {seed}, made in {OUT}\n");
    println!(
        "| | effort | frames | rotation, mean / median / worst | translation, mean / median | more than 5° off | trusted, of these wrong | \
         searched all around | a frame, median |\n|---|---|---|---|---|---|---|---|---|"
    );
    let folder = Path::new(OUT).join("views-of-video");
    let [views, focal] = [video::VIEWS.to_string(), FOCAL.to_string()];
    programs.rendered(&folder, SIDE, &[("--cameras", "spiral"), ("--views", &views), ("--focal", &focal)])?;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    for object in 0..OBJECTS.len() {
        let video = Video::new(object, &folder, &mut random)?;
        println!("{}", video::tracked(programs, &video, "normal")?);
    }
    Ok(())
}

/// The table of videos that an object leaves.
fn leaving(programs: &Programs, seed: u64) -> Result<()> {
    println!("\nleaving, seed {seed}, made in {OUT}\n");
    println!(
        "| | effort | trusted, of these wrong, before | trusted while it is away | found so many frames after it is back | \
         trusted, of these wrong, since it is back | longest frame while away |\n|---|---|---|---|---|---|---|"
    );
    let folder = Path::new(OUT).join("views-of-leaving");
    let [views, focal] = [video::VIEWS.to_string(), FOCAL_OF_ROOM.to_string()];
    let flags = [("--cameras", "spiral"), ("--views", &*views), ("--focal", &*focal), ("--radius", "3")];
    programs.rendered(&folder, SIDE, &flags)?;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    for object in 0..OBJECTS.len() {
        let video = Video::leaving(object, &folder, &mut random)?;
        println!("{}", video::back(programs, &video, "fast")?);
    }
    Ok(())
}

/// The table of masks that are made of photographs.
fn captures(programs: &Programs, seed: u64) -> Result<()> {
    println!("\ncaptures, seed {seed}, made in {OUT}\n");
    println!("| | photographs | of both masks in both, mean / median / worst | below 0.9 | time |\n|---|---|---|---|---|");
    for capture in capture::taken(&mut Pcg64Mcg::seed_from_u64(seed))? {
        println!("{}", capture::masked(programs, &capture)?);
    }
    Ok(())
}

/// A picture and what is given with it.
struct Picture {
    picture: PathBuf,
    mask: Option<PathBuf>,
    /// As `--box` has it.
    bounds: Option<String>,
    intrinsics: PathBuf,
    truth: PathBuf,
}

impl Picture {
    /// For people: on white, and grey where it does not count.
    fn small(&self) -> Result<RgbImage> {
        let picture = image::open(&self.picture)?.to_rgba8();
        let mask = self.mask.as_ref().map(image::open).transpose()?.map(|mask| mask.to_luma8());
        let colour = |x, y| match (*picture.get_pixel(x, y), mask.as_ref().map(|mask| *mask.get_pixel(x, y))) {
            (_, Some(OUTSIDE)) => Rgb([160; 3]),
            (Rgba([.., 0]), _) => Rgb([255; 3]),
            (Rgba([r, g, b, _]), _) => Rgb([r, g, b]),
        };
        let whole = RgbImage::from_fn(picture.width(), picture.height(), colour);
        Ok(imageops::resize(&whole, picture.width() / 2, picture.height() / 2, FilterType::Triangle))
    }
}

/// What was found of one.
struct Found {
    rotation_deg: f64,
    translation_percent: f64,
    is_trusted: bool,
    within_95: bool,
}

/// The programs, which lie beside this one.
struct Programs {
    folder: PathBuf,
    /// Where nothing is known of the pose.
    starts: String,
}

impl Programs {
    fn command(&self, name: &str) -> Command {
        Command::new(self.folder.join(format!("{name}{}", std::env::consts::EXE_SUFFIX)))
    }

    /// Views of all objects for a row, as a data set.
    fn views(&self, row: &Row, seed: u64) -> Result<PathBuf> {
        let &Row { distance, focal, is_rolled, .. } = row;
        let folder = Path::new(OUT).join(format!("views-{distance}{}", if is_rolled { "-rolled" } else { "" }));
        let [views, radius, focal, seed] = [VIEWS.to_string(), distance.to_string(), focal.to_string(), seed.to_string()];
        let mut flags =
            vec![("--cameras", "sphere"), ("--views", &*views), ("--radius", &radius), ("--focal", &focal), ("--seed", &seed)];
        flags.extend(is_rolled.then_some(("--roll", "")));
        self.rendered(&folder, SIDE, &flags)?;
        Ok(folder)
    }

    /// Renders all objects into a folder.
    fn rendered(&self, folder: &Path, side: u32, flags: &[(&str, &str)]) -> Result<()> {
        let mesh = |(name, file): (&str, &str)| {
            format!("{name}={}", if file.ends_with(".dat") { format!("{LDRAW}/{file}") } else { file.into() })
        };
        let mut render = self.command("sigma-data");
        render.arg("render").args(OBJECTS.map(mesh)).args(["--side", &side.to_string(), "--force", "--out"]).arg(folder);
        render.args(flags.iter().flat_map(|(flag, value)| [*flag, *value]).filter(|word| !word.is_empty()));
        let output = render.output()?;
        if output.status.success() { Ok(()) } else { Err(said(&output)) }
    }

    /// What the search finds of an object's pictures.
    fn estimated(&self, row: &Row, how: How, object: usize, pictures: &[Picture]) -> Result<Vec<Found>> {
        let claimed = if let Spoil::Another(further) | Spoil::Among(_, further) | Spoil::Room(further) = row.spoil {
            object + further
        } else {
            object
        };
        pictures.iter().map(|picture| self.found(OBJECTS[claimed % OBJECTS.len()].0, how, picture)).collect()
    }

    /// What it finds of an object that is said to be in a picture.
    fn found(&self, name: &str, how: How, picture: &Picture) -> Result<Found> {
        let mut estimate = self.command("sigma-pose");
        estimate.args(["estimate", "--json", "--executor", "cpu", "--model", MODEL, "--effort", how.effort, "--instance", name]);
        estimate.arg(&picture.picture).arg("--intrinsics").arg(&picture.intrinsics).arg("--truth").arg(&picture.truth);
        match how.rough {
            true => estimate.arg("--rough").arg(&picture.truth),
            false => estimate.arg("--starts").arg(&self.starts),
        };
        if let Some(mask) = &picture.mask {
            estimate.arg("--mask").arg(mask);
        }
        if let Some(bounds) = &picture.bounds {
            estimate.arg(format!("--box={bounds}"));
        }
        let output = estimate.output()?;
        let report: Value = serde_json::from_slice(&output.stdout).map_err(|_| said(&output))?;
        let of_picture = &report["images"][0];
        let number = |value: &Value| value.as_f64().ok_or("sigma-pose printed no number");
        Ok(Found {
            rotation_deg: number(&of_picture["error"]["rotation_deg"])?,
            translation_percent: number(&of_picture["error"]["translation_percent"])?,
            is_trusted: of_picture["trusted"] == true,
            within_95: of_picture["within_95"] == true,
        })
    }
}

/// The error of a program that failed.
fn said(output: &Output) -> Box<dyn Error> {
    String::from_utf8_lossy(&output.stderr).trim().trim_start_matches("error: ").into()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Of values in order.
fn median(values: &[f64]) -> f64 {
    0.5 * (values[(values.len() - 1) / 2] + values[values.len() / 2])
}

/// Above the lines of most tables.
const HEAD: &str = "\
| | starts | effort | rotation, mean / median / worst | translation, mean / median | more than 5° off | trusted, of these wrong | \
truth in the stated 95 %, of these |
|---|---|---|---|---|---|---|---|";

/// The cells of a table.
fn line(how: How, found: &[Found]) -> String {
    let sorted = |value: fn(&Found) -> f64| {
        let mut values: Vec<f64> = found.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (rotation, translation) = (sorted(|f| f.rotation_deg), sorted(|f| f.translation_percent));
    let is_wrong = |f: &&Found| f.rotation_deg > 5.0;
    let trusted = || found.iter().filter(|f| f.is_trusted);
    format!(
        "{} | {} | {:.2}° / {:.2}° / {:.1}° | {:.2} % / {:.2} % | {} | {}, {} | {}",
        if how.rough { "30° off" } else { "all around" },
        how.effort,
        mean(&rotation),
        median(&rotation),
        rotation[rotation.len() - 1],
        mean(&translation),
        median(&translation),
        found.iter().filter(is_wrong).count(),
        trusted().count(),
        trusted().filter(is_wrong).count(),
        trusted().filter(|f| f.within_95).count(),
    )
}

/// Writes the pictures of a row.
fn spoiled(row: &Row, views: &Path, folder: &Path, seed: u64) -> Result<Vec<Picture>> {
    std::fs::create_dir_all(folder)?;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut pictures = Vec::new();
    let of = |name: &str, view: usize, kind: &str| views.join(name).join(kind).join(format!("{view:06}"));
    let rendered = |name: &str, view: usize| image::open(of(name, view, "rgb").with_extension("png")).map(|view| view.to_rgb8());
    for (object, (name, _)) in OBJECTS.into_iter().enumerate() {
        for view in 0..VIEWS {
            let others = match row.spoil {
                Spoil::Among(count, _) => count,
                Spoil::Room(_) => IN_ROOM,
                _ => 0,
            };
            let mut behind = Vec::new();
            while behind.len() < others {
                let further = random.random_range(1..OBJECTS.len());
                let (other, _) = OBJECTS[(object + further) % OBJECTS.len()];
                let other = rendered(other, random.random_range(0..VIEWS))?;
                // Anywhere in a room it would be the one that is looked for.
                if !matches!(row.spoil, Spoil::Room(claimed) if claimed == further) {
                    behind.push(other);
                }
            }
            let path = |end: &str| folder.join(format!("{name}-{view}{end}"));
            let truth = of(name, view, "pose").with_extension("txt");
            if let Spoil::Room(_) = row.spoil {
                pictures.push(in_a_room(row, &rendered(name, view)?, &truth, &behind, &path, &mut random)?);
                continue;
            }
            let Spoiled { picture, mask, bounds, corner } =
                Photo::new(&rendered(name, view)?, &mut random).among(&behind, &mut random).spoiled(row.spoil, view, &mut random);
            picture.save(path(".png"))?;
            let mask = mask.map(|mask| mask.save(path("-mask.png")).map(|()| path("-mask.png"))).transpose()?;
            let [x, y] = corner.map(|pixels| f64::from(SIDE) / 2.0 - f64::from(pixels));
            let [width, height] = [picture.width(), picture.height()];
            std::fs::write(path(".txt"), format!("{} {x} {y} 0.\n0. 0. 0.\n1.\n{height} {width}\n", row.focal))?;
            pictures.push(Picture {
                picture: path(".png"),
                mask,
                bounds: bounds.map(|[x, y, width, height]| format!("{x},{y},{width},{height}")),
                intrinsics: path(".txt"),
                truth,
            });
        }
    }
    Ok(pictures)
}

/// Writes an object in a room, whose `pose` is of a camera that has it in the middle.
fn in_a_room(
    row: &Row,
    object: &RgbImage,
    pose: &Path,
    others: &[RgbImage],
    path: &dyn Fn(&str) -> PathBuf,
    random: &mut Pcg64Mcg,
) -> Result<Picture> {
    let (picture, turn) = scene::room(object, others, random)?;
    picture.save(path(".png"))?;
    std::fs::write(path(".txt"), scene::intrinsics(row.focal))?;
    std::fs::write(path(".pose"), scene::pose(&(srn::read_pose(pose)? * DMat4::from_mat3(turn))))?;
    Ok(Picture { picture: path(".png"), mask: None, bounds: Some("auto".into()), intrinsics: path(".txt"), truth: path(".pose") })
}
