//! `robustness [TABLE…] [--seed N]`: pictures like photographs of the asset objects, spoiled in known ways, and how far off `sigma-pose estimate` ends: tables
//! of `docs/accuracy.md`. The pictures are left in `demo/robustness`.

use std::error::Error;
use std::f64::consts::TAU;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};

use image::imageops::{self, FilterType};
use image::{GrayImage, ImageBuffer, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde_json::Value;
use srn_data::sheet;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

const USAGE: &str = "usage: robustness [distance] [near] [light] [masks] [hidden] [others] [--seed N]";

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
/// Their width and height in pixels.
const SIDE: u32 = 256;
/// Number of the picture of each row that is shown, and how many stand side by side.
const SHOWN: usize = 17;
const COLUMNS: usize = 6;
/// Focal length of most, and of those from so near that they are 90° across.
const FOCAL: f64 = 297.6;
const WIDE: f64 = 128.0;

/// Colour of the table that objects lie on, how bright it is in a shadow, and what is before them.
const TABLE: [f64; 3] = [115.0, 89.0, 64.0];
const SHADOW: f64 = 0.45;
const BAR: Rgb<u8> = Rgb([90, 96, 104]);

/// What is known of the pose, and how hard the search tries.
#[derive(Clone, Copy)]
struct How {
    rough: bool,
    effort: &'static str,
}

const AROUND: How = How { rough: false, effort: "normal" };
const AROUND_FAST: How = How { rough: false, effort: "fast" };
const NEAR_FAST: How = How { rough: true, effort: "fast" };

/// What is wrong with a picture. Lengths are pixels of [`SIDE`].
#[derive(Clone, Copy)]
enum Spoil {
    /// Cut out exactly, in the light of the training.
    Nothing,
    /// Other light: a colour in [0, 1], and how far to the right it is, in [0, 1].
    Light(fn([f64; 3], f64) -> [f64; 3]),
    /// The mask, so much too large.
    Larger(f64),
    /// The mask, off by this standard deviation at random, alike over 8.
    Ragged(f64),
    /// A disc of this radius beside the object taken for it.
    Disc(f64),
    /// A shadow taken for it: the outline, moved.
    Shadow([i64; 2]),
    /// This part of its height missing in the mask, below.
    Missing(f64),
    /// The segmentation says what counts; around the object there is anything.
    Alone,
    /// A bar over this part of it, from one of four sides.
    Bar(f64),
    /// This part of it beyond the picture's edge, on one of four sides.
    Edge(f64),
    /// Given as another of the objects, so many further on.
    Another(usize),
}

struct Row {
    what: &'static str,
    distance: f64,
    focal: f64,
    spoil: Spoil,
}

/// From 1.3 away.
const fn row(what: &'static str, spoil: Spoil) -> Row {
    Row { what, distance: 1.3, focal: FOCAL, spoil }
}

const fn from(what: &'static str, distance: f64, focal: f64) -> Row {
    Row { what, distance, focal, spoil: Spoil::Nothing }
}

struct Table {
    name: &'static str,
    searches: &'static [How],
    rows: &'static [Row],
}

const TABLES: [Table; 6] = [
    Table {
        name: "distance",
        searches: &[AROUND, AROUND_FAST],
        rows: &[from("1.3", 1.3, FOCAL), from("2", 2.0, FOCAL), from("3", 3.0, FOCAL), from("5", 5.0, FOCAL)],
    },
    Table {
        name: "near", searches: &[AROUND], rows: &[from("1, 90° across", 1.0, WIDE), from("0.75, 90° across", 0.75, WIDE)]
    },
    Table {
        name: "light",
        searches: &[AROUND],
        rows: &[
            row("the model's", Spoil::Nothing),
            row("1 stop less", Spoil::Light(|colour, _| exposed(colour, [0.5; 3]))),
            row("1 stop more", Spoil::Light(|colour, _| exposed(colour, [2.0; 3]))),
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
        ],
    },
    Table {
        name: "hidden",
        searches: &[AROUND, AROUND_FAST, NEAR_FAST],
        rows: &[
            row("object alone", Spoil::Alone),
            row("3/10 hidden", Spoil::Bar(0.3)),
            row("half hidden", Spoil::Bar(0.5)),
            row("3/10 cut off", Spoil::Edge(0.3)),
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
    let (mut wanted, mut seed) = (Vec::new(), 23);
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--seed" => seed = arguments.next().and_then(|text| text.parse().ok()).ok_or(USAGE)?,
            name => wanted.push(TABLES.iter().find(|table| table.name == name).ok_or(USAGE)?),
        }
    }
    if wanted.is_empty() {
        wanted.extend(&TABLES);
    }
    let programs = Programs { folder: std::env::current_exe()?.parent().ok_or("no folder")?.into() };
    let mut shown = Vec::new();
    for table in wanted {
        println!("\n{}, seed {seed}, {} pictures each, made in {OUT}\n", table.name, VIEWS * OBJECTS.len());
        println!(
            "| | starts | effort | rotation, mean / median / worst | translation, mean / median | more than 5° off | trusted, of these wrong | \
             truth in the stated 95 %, of these |\n|---|---|---|---|---|---|---|---|"
        );
        for row in table.rows {
            let views = programs.rendered(row.distance, row.focal, seed)?;
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
    let cells: Vec<_> = shown.iter().map(|(picture, what)| (picture, *what)).collect();
    sheet::grid(&cells, COLUMNS).save(Path::new(OUT).join("sheet.png"))?;
    Ok(())
}

/// A picture and what is given with it.
struct Picture {
    picture: PathBuf,
    mask: Option<PathBuf>,
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
}

impl Programs {
    fn command(&self, name: &str) -> Command {
        let mut command = Command::new(self.folder.join(format!("{name}{}", std::env::consts::EXE_SUFFIX)));
        command.stderr(Stdio::piped());
        command
    }

    /// Views of all objects from this distance, as a data set.
    fn rendered(&self, distance: f64, focal: f64, seed: u64) -> Result<PathBuf> {
        let folder = Path::new(OUT).join(format!("views-{distance}"));
        let mesh = |(name, file): (&str, &str)| {
            format!("{name}={}", if file.ends_with(".dat") { format!("{LDRAW}/{file}") } else { file.into() })
        };
        let mut render = self.command("sigma-data");
        render.arg("render").args(OBJECTS.map(mesh)).args(["--cameras", "sphere", "--force", "--out"]).arg(&folder);
        for (flag, value) in [
            ("--views", VIEWS.to_string()),
            ("--radius", distance.to_string()),
            ("--side", SIDE.to_string()),
            ("--focal", focal.to_string()),
            ("--seed", seed.to_string()),
        ] {
            render.args([flag, &value]);
        }
        let output = render.output()?;
        match output.status.success() {
            true => Ok(folder),
            false => Err(String::from_utf8_lossy(&output.stderr).into()),
        }
    }

    /// What the search finds of an object's pictures.
    fn estimated(&self, row: &Row, how: How, object: usize, pictures: &[Picture]) -> Result<Vec<Found>> {
        let claimed = if let Spoil::Another(further) = row.spoil { object + further } else { object };
        let mut found = Vec::new();
        for picture in pictures {
            let mut estimate = self.command("sigma-pose");
            estimate.args(["estimate", "--json", "--executor", "cpu", "--model", MODEL, "--effort", how.effort]);
            estimate.args(["--instance", OBJECTS[claimed % OBJECTS.len()].0]);
            estimate.arg(&picture.picture).arg("--intrinsics").arg(&picture.intrinsics).arg("--truth").arg(&picture.truth);
            if how.rough {
                estimate.arg("--rough").arg(&picture.truth);
            }
            if let Some(mask) = &picture.mask {
                estimate.arg("--mask").arg(mask);
            }
            let output = estimate.output()?;
            let report: Value =
                serde_json::from_slice(&output.stdout).map_err(|_| String::from_utf8_lossy(&output.stderr).into_owned())?;
            let of_picture = &report["images"][0];
            let number = |value: &Value| value.as_f64().ok_or("sigma-pose printed no number");
            found.push(Found {
                rotation_deg: number(&of_picture["error"]["rotation_deg"])?,
                translation_percent: number(&of_picture["error"]["translation_percent"])?,
                is_trusted: of_picture["trusted"] == true,
                within_95: of_picture["within_95"] == true,
            });
        }
        Ok(found)
    }
}

/// The cells of a table.
fn line(how: How, found: &[Found]) -> String {
    let sorted = |value: fn(&Found) -> f64| {
        let mut values: Vec<f64> = found.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let median = |values: &[f64]| 0.5 * (values[(values.len() - 1) / 2] + values[values.len() / 2]);
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
    for (name, _) in OBJECTS {
        for view in 0..VIEWS {
            let file = |kind: &str| views.join(name).join(kind).join(format!("{view:06}"));
            let rendered = image::open(file("rgb").with_extension("png"))?.to_rgb8();
            let Spoiled { picture, mask, corner } = Photo::new(&rendered, &mut random).spoiled(row.spoil, view, &mut random);
            let path = |end: &str| folder.join(format!("{name}-{view}{end}"));
            picture.save(path(".png"))?;
            let mask = mask.map(|mask| mask.save(path("-mask.png")).map(|()| path("-mask.png"))).transpose()?;
            let [x, y] = corner.map(|pixels| f64::from(SIDE) / 2.0 - f64::from(pixels));
            let [width, height] = [picture.width(), picture.height()];
            std::fs::write(path(".txt"), format!("{} {x} {y} 0.\n0. 0. 0.\n1.\n{height} {width}\n", row.focal))?;
            pictures.push(Picture {
                picture: path(".png"),
                mask,
                intrinsics: path(".txt"),
                truth: file("pose").with_extension("txt"),
            });
        }
    }
    Ok(pictures)
}

/// A picture of an object on a table.
struct Photo {
    picture: RgbImage,
    /// What of it is the object.
    object: GrayImage,
}

struct Spoiled {
    /// Opaque where the object is, as far as is said.
    picture: RgbaImage,
    mask: Option<GrayImage>,
    /// Where in the whole picture its first pixel was.
    corner: [u32; 2],
}

const INSIDE: Luma<u8> = Luma([255]);
const OUTSIDE: Luma<u8> = Luma([0]);

impl Photo {
    /// Of a rendered object on white.
    fn new(rendered: &RgbImage, random: &mut Pcg64Mcg) -> Self {
        let texture = smooth_noise(4, random);
        let colour = |x, y| match *rendered.get_pixel(x, y) {
            Rgb([255, 255, 255]) => Rgb(TABLE.map(|v| (v * (1.0 + 0.08 * f64::from(texture.get_pixel(x, y)[0]))) as u8)),
            object => object,
        };
        let object = |x, y| if rendered.get_pixel(x, y).0 == [255; 3] { OUTSIDE } else { INSIDE };
        Photo { picture: RgbImage::from_fn(SIDE, SIDE, colour), object: GrayImage::from_fn(SIDE, SIDE, object) }
    }

    fn spoiled(&mut self, spoil: Spoil, view: usize, random: &mut Pcg64Mcg) -> Spoiled {
        let [[_, right], [top, bottom]] = self.extent();
        let (mut seen, mut mask, mut frame) = (self.object.clone(), None, [[0, SIDE]; 2]);
        match spoil {
            Spoil::Nothing | Spoil::Another(_) => {}
            Spoil::Light(lit) => {
                for (x, _, pixel) in self.picture.enumerate_pixels_mut() {
                    let colour = lit(pixel.0.map(|v| f64::from(v) / 255.0), f64::from(x) / f64::from(SIDE));
                    pixel.0 = colour.map(|v| (255.0 * v).round() as u8);
                }
            }
            Spoil::Larger(by) => seen = self.moved(|_, _| by),
            Spoil::Ragged(by) => {
                let noise = smooth_noise(8, random);
                seen = self.moved(|x, y| by * f64::from(noise.get_pixel(x, y)[0]));
            }
            Spoil::Disc(radius) => {
                let middle = [f64::from(right), 0.5 * f64::from(top + bottom)];
                let is_in = |x: u32, y: u32| (f64::from(x) - middle[0]).hypot(f64::from(y) - middle[1]) <= radius;
                fill(&mut seen, is_in, INSIDE);
            }
            Spoil::Shadow([dx, dy]) => {
                let from = |at: u32, by: i64| u32::try_from(i64::from(at) - by).unwrap_or(SIDE);
                let object = &self.object;
                let is_shadow = |x: u32, y: u32| {
                    let lit_by = object.get_pixel_checked(from(x, dx), from(y, dy));
                    *object.get_pixel(x, y) == OUTSIDE && lit_by == Some(&INSIDE)
                };
                fill(&mut seen, is_shadow, INSIDE);
                let shadows = self.picture.enumerate_pixels_mut().filter(|(x, y, _)| is_shadow(*x, *y));
                shadows.for_each(|(.., pixel)| pixel.0 = pixel.0.map(|v| (SHADOW * f64::from(v)) as u8));
            }
            Spoil::Missing(part) => {
                let first = bottom - (part * f64::from(bottom - top)) as u32;
                fill(&mut seen, |_, y| y >= first, OUTSIDE);
            }
            Spoil::Alone => mask = Some(std::mem::replace(&mut seen, GrayImage::from_pixel(SIDE, SIDE, INSIDE))),
            Spoil::Bar(part) => {
                let bar = self.side(part, view);
                let is_bar = |x: u32, y: u32| [x, y].iter().zip(bar).all(|(at, [first, end])| (first..end).contains(at));
                let mut counts = GrayImage::from_pixel(SIDE, SIDE, INSIDE);
                fill(&mut counts, is_bar, OUTSIDE);
                fill(&mut seen, is_bar, OUTSIDE);
                fill(&mut self.picture, is_bar, BAR);
                mask = Some(counts);
            }
            Spoil::Edge(part) => {
                let rest = |[first, end]: [u32; 2]| match (first, end) {
                    (0, SIDE) => [0, SIDE],
                    (0, _) => [end, SIDE],
                    _ => [0, first],
                };
                frame = self.side(part, view).map(rest);
            }
        }
        let [[left, end], [top, below]] = frame;
        let pixel = |x, y| {
            let (Rgb([r, g, b]), Luma([a])) = (self.picture.get_pixel(left + x, top + y), seen.get_pixel(left + x, top + y));
            Rgba([*r, *g, *b, *a])
        };
        Spoiled { picture: RgbaImage::from_fn(end - left, below - top, pixel), mask, corner: [left, top] }
    }

    /// The object's first and last column, and row.
    fn extent(&self) -> [[u32; 2]; 2] {
        let mut extent = [[SIDE, 0]; 2];
        for (x, y, _) in self.object.enumerate_pixels().filter(|(.., pixel)| **pixel == INSIDE) {
            for ([first, last], at) in extent.iter_mut().zip([x, y]) {
                (*first, *last) = (at.min(*first), at.max(*last));
            }
        }
        extent
    }

    /// Columns and rows, from and up to, of `part` of the object and all that is beyond, from one of four sides.
    fn side(&self, part: f64, view: usize) -> [[u32; 2]; 2] {
        let (axis, is_last) = (view % 2, view % 4 >= 2);
        let [first, last] = self.extent()[axis];
        let wide = (part * f64::from(last + 1 - first)).round() as u32;
        let mut side = [[0, SIDE]; 2];
        side[axis] = if is_last { [last + 1 - wide, SIDE] } else { [0, first + wide] };
        side
    }

    /// The outline, so many pixels farther out.
    fn moved(&self, by: impl Fn(u32, u32) -> f64) -> GrayImage {
        let is_in = |x: i64, y: i64| {
            let at = |v: i64| u32::try_from(v).unwrap_or(SIDE);
            self.object.get_pixel_checked(at(x), at(y)) == Some(&INSIDE)
        };
        let pixel = |x: u32, y: u32| {
            let (own, reach) = (is_in(x.into(), y.into()), -8..=8);
            let others = reach.clone().flat_map(|dy| reach.clone().map(move |dx| (dx, dy)));
            let others = others.filter(|(dx, dy)| is_in(i64::from(x) + dx, i64::from(y) + dy) != own);
            let nearest = others.map(|(dx, dy)| ((dx * dx + dy * dy) as f64).sqrt()).fold(f64::INFINITY, f64::min);
            let inwards = if own { nearest - 0.5 } else { 0.5 - nearest };
            if inwards + by(x, y) > 0.0 { INSIDE } else { OUTSIDE }
        };
        GrayImage::from_fn(SIDE, SIDE, pixel)
    }
}

fn fill<P: image::Pixel>(picture: &mut ImageBuffer<P, Vec<P::Subpixel>>, is_in: impl Fn(u32, u32) -> bool, with: P) {
    picture.enumerate_pixels_mut().filter(|(x, y, _)| is_in(*x, *y)).for_each(|(.., pixel)| *pixel = with);
}

/// Normal numbers with mean 0 and deviation 1, alike over so many pixels.
fn smooth_noise(over: u32, random: &mut Pcg64Mcg) -> ImageBuffer<Luma<f32>, Vec<f32>> {
    let coarse = ImageBuffer::from_fn(SIDE / over, SIDE / over, |_, _| {
        let (u, v): (f64, f64) = (1.0 - random.random::<f64>(), random.random());
        // Resizing keeps to [0, 1].
        Luma([(0.5 + 0.1 * (-2.0 * u.ln()).sqrt() * (TAU * v).cos()) as f32])
    });
    let mut noise = imageops::resize(&coarse, SIDE, SIDE, FilterType::CatmullRom);
    let mean = |values: &mut dyn Iterator<Item = f32>| values.sum::<f32>() / (SIDE * SIDE) as f32;
    let middle = mean(&mut noise.pixels().map(|pixel| pixel[0]));
    let deviation = mean(&mut noise.pixels().map(|pixel| (pixel[0] - middle).powi(2))).sqrt();
    noise.pixels_mut().for_each(|pixel| pixel[0] = (pixel[0] - middle) / deviation);
    noise
}

/// A colour (sRGB, in [0, 1]) with each channel so many times as bright.
fn exposed(colour: [f64; 3], factors: [f64; 3]) -> [f64; 3] {
    let linear = |v: f64| if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    let coded = |v: f64| if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    std::array::from_fn(|k| coded((factors[k] * linear(colour[k])).min(1.0)))
}
