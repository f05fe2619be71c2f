//! `sigma-pose` as a user runs it: results, pictures, exit codes, what is never overwritten. The model is untrained and tiny.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use glam::DMat4;
use serde_json::Value;
use sigma_srn::camera::pose_error;
use sigma_srn::{Metadata, Model, ModelConfig};
use tempfile::TempDir;

const TEST: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/dataset/test");
const NAMES: [&str; 3] = ["bucket", "chicken", "seat"];
const CHICKEN: &str = "chicken/rgb/000003.png";

/// A folder with `model.safetensors`, which knows three objects at 16×16.
fn home() -> TempDir {
    let config = ModelConfig { hidden: 16, latent: 8, instances: 3, tracing_steps: 3, density: true };
    let mut model = Model::init(&config, 4).unwrap();
    model.metadata = Metadata { instance_names: NAMES.map(String::from).into(), side: Some(16), orbit_radius: Some(1.3) };
    let dir = tempfile::tempdir().unwrap();
    model.save(&dir.path().join("model.safetensors")).unwrap();
    dir
}

/// Runs in `dir`; `DATA/` stands for the test set.
fn sigma_pose(dir: &Path, args: &str) -> Output {
    let args = args.split_whitespace().map(|arg| arg.replace("DATA", TEST));
    Command::new(env!("CARGO_BIN_EXE_sigma-pose")).current_dir(dir).args(args).output().unwrap()
}

#[track_caller]
fn run(dir: &Path, args: &str, code: i32) -> String {
    let output = sigma_pose(dir, args);
    assert_eq!(output.status.code(), Some(code), "{args}\n{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[track_caller]
fn fail(dir: &Path, args: &str, words: &[&str]) {
    let output = sigma_pose(dir, args);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{args}\n{message}");
    assert!(words.iter().all(|word| message.contains(word)), "{args}\n{message}");
    let errors = message.lines().filter(|line| line.starts_with("error: ") && !line.contains("XDG")).count();
    assert!(output.stdout.is_empty() && errors == 1, "{args}\n{message}");
}

fn files(dir: &Path) -> Vec<String> {
    let mut names: Vec<_> = fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn matrix(value: &Value) -> DMat4 {
    let rows: [[f64; 4]; 4] = serde_json::from_value(value.clone()).unwrap();
    DMat4::from_cols_array_2d(&rows).transpose()
}

/// Both executors do a step of every phase of the search, and agree; more steps through a random network multiply the last digit.
#[test]
fn executors_agree_and_json_says_everything() {
    let home = home();
    let estimate = |executor: &str| -> Value {
        let args = format!(
            "estimate DATA/{CHICKEN} DATA/seat/rgb/000011.png --model model.safetensors --truth auto --steps 3 --json --executor \
             {executor} --accept 1e9"
        );
        serde_json::from_str(&run(home.path(), &args, 0)).unwrap()
    };
    let [cpu, gpu] = ["cpu", "gpu"].map(estimate);
    assert_eq!(cpu["executor"], "cpu");
    assert!(gpu["executor"].as_str().unwrap().len() > 3, "the adapter's name");
    for (k, instance) in ["chicken", "seat"].into_iter().enumerate() {
        let [cpu, gpu] = [&cpu, &gpu].map(|report| &report["images"][k]);
        assert_eq!((cpu["instance"].as_str(), cpu["converged"].as_bool()), (Some(instance), Some(true)));
        let [a, b] = [cpu, gpu].map(|image| matrix(&image["world_from_camera"]));
        let (rotation, translation) = pose_error(&a, &b);
        assert!(rotation < 0.1 && translation < 1e-3, "{instance}: {rotation}° {translation}");
        assert_eq!(cpu["start"], gpu["start"]);

        // The matrix, the six numbers, and the ranking tell the same.
        let numbers = |name: &str| -> [f64; 3] { serde_json::from_value(cpu[name].clone()).unwrap() };
        let ([a1, a2, a3], t) = (numbers("euler_rad"), numbers("translation"));
        let rotation = DMat4::from_rotation_x(a1) * DMat4::from_rotation_y(a2) * DMat4::from_rotation_z(a3);
        assert!((DMat4::from_translation(t.into()) * rotation).abs_diff_eq(a, 1e-9));
        let ranking = cpu["ranking"].as_array().unwrap();
        assert_eq!((ranking.len(), &ranking[0]["start"], &ranking[0]["loss"]), (84, &cpu["start"], &cpu["loss"]));
        assert_eq!(ranking[0]["error"], cpu["error"]);
        let key = |r: &Value| (std::cmp::Reverse(r["phases"].as_u64().unwrap()), r["loss"].as_f64().unwrap());
        assert!(ranking.windows(2).all(|pair| key(&pair[0]) <= key(&pair[1])));
        for field in ["image", "loss", "unexplained", "seconds"] {
            assert!(!cpu[field].is_null(), "{field}");
        }
        let pose = PathBuf::from(TEST).join(format!("{instance}/pose/{}.txt", ["000003", "000011"][k]));
        let (rotation, translation) = pose_error(&a, &srn_data::srn::read_pose(&pose).unwrap());
        let error = |name: &str| cpu["error"][name].as_f64().unwrap();
        assert!((error("rotation_deg") - rotation).abs() < 1e-6 && (error("translation") - translation).abs() < 1e-6);
    }
}

#[test]
fn starts_come_from_files_and_rough_poses() {
    let home = home();
    let dir = home.path();
    let poses: String = ["000000", "000010"]
        .map(|name| fs::read_to_string(format!("{TEST}/chicken/pose/{name}.txt")).unwrap().replace('\n', " ") + "\n")
        .concat();
    fs::write(dir.join("starts.txt"), "# two\n".to_string() + &poses).unwrap();
    let starts = |args: &str| -> Vec<Value> {
        let args = format!("estimate DATA/{CHICKEN} --model model.safetensors --executor cpu --steps 1 --json {args}");
        let report: Value = serde_json::from_str(&run(dir, &args, 1)).unwrap();
        report["images"][0]["ranking"].as_array().unwrap().clone()
    };
    assert_eq!(starts("--starts starts.txt --accept 1e-9").len(), 2);
    // Without a step to speak of, the four are where they started: 30° from the rough pose, here the true one.
    let near = starts("--rough auto --truth auto --preset paper --lr 1e-9 --stride 4 --accept 1e-9");
    assert_eq!(near.len(), 4);
    assert!(near.iter().all(|r| (r["error"]["rotation_deg"].as_f64().unwrap() - 30.0).abs() < 0.01), "{near:?}");
}

#[test]
fn presets_and_losses_are_heard() {
    let home = home();
    let phases = |args: &str| -> u64 {
        let args =
            format!("estimate DATA/{CHICKEN} --model model.safetensors --executor cpu --rough auto --json --accept 1e9 {args}");
        let report: Value = serde_json::from_str(&run(home.path(), &args, 0)).unwrap();
        report["images"][0]["ranking"].as_array().unwrap().iter().map(|r| r["phases"].as_u64().unwrap()).sum()
    };
    assert_eq!(phases("--preset paper --steps 2"), 4);
    assert_eq!(phases("--preset paper --steps 10 --cull --loss norm_l1"), 8);
    assert_eq!(phases("--preset paper --steps 2 --loss gmsd"), 4);
    let most = phases("--steps 6 --no-cull");
    assert!(most.is_multiple_of(4) && phases("--steps 6") < most);
}

/// One line per image; pictures where they were asked for; nothing overwritten.
#[test]
fn records_are_written_once() {
    let home = home();
    let dir = home.path();
    let args = format!(
        "estimate DATA/{CHICKEN} DATA/{CHICKEN} --model model.safetensors --executor cpu --steps 8 --truth auto --record pictures"
    );
    let lines = run(dir, &(args.clone() + " --accept 1e9"), 0);
    assert_eq!(lines.lines().count(), 2);
    assert!(lines.contains("chicken") && lines.contains("loss") && lines.contains("error") && !lines.contains("NOT"), "{lines}");
    let written = ["chicken-000003-again.gif", "chicken-000003-again.png", "chicken-000003.gif", "chicken-000003.png"];
    assert_eq!(files(&dir.join("pictures")), written);
    let page = image::open(dir.join("pictures/chicken-000003.png")).unwrap();
    assert!(page.width() > 1000 && page.height() > 400);
    let animation = std::io::BufReader::new(fs::File::open(dir.join("pictures/chicken-000003.gif")).unwrap());
    let frames = image::AnimationDecoder::into_frames(image::codecs::gif::GifDecoder::new(animation).unwrap());
    assert!(frames.count() > 3);

    fail(dir, &args, &["chicken-000003.png", "--force"]);
    let lines = run(dir, &(args + " --force --accept 1e-9"), 1);
    assert_eq!(lines.matches("NOT CONVERGED").count(), 2);
}

#[test]
fn a_photo_needs_to_be_explained() {
    let home = home();
    let dir = home.path();
    // A JPEG of odd size, called like a PNG.
    let photo = image::RgbImage::from_fn(90, 50, |x, y| image::Rgb([x as u8, y as u8, 99]));
    photo.save_with_format(dir.join("photo.png"), image::ImageFormat::Jpeg).unwrap();
    let args = "estimate photo.png --model model.safetensors --executor cpu --steps 2";
    fail(dir, args, &["photo.png", "--focal"]);
    fail(dir, &format!("{args} --fov 50"), &["photo.png", "--instance"]);
    run(dir, &format!("{args} --fov 50 --instance seat --accept 1e9"), 0);
    fail(dir, &format!("{args} --fov 50 --focal 30"), &["--fov", "--focal"]);
    fs::write(dir.join("intrinsics.txt"), "50 45 25 0.\n0. 0. 0.\n1.\n50 90\n").unwrap();
    run(dir, &format!("{args} --intrinsics intrinsics.txt --instance 2 --accept 1e9"), 0);
    fs::write(dir.join("intrinsics.txt"), "50 32 32 0.\n0. 0. 0.\n1.\n64 64\n").unwrap();
    fail(dir, &format!("{args} --intrinsics intrinsics.txt --instance 2"), &["photo.png", "90×50", "64×64"]);
}

/// Colours so large that no loss is finite: no pose, no panic, also not in the pictures.
#[test]
fn a_search_that_blows_up_has_not_converged() {
    let home = home();
    let dir = home.path();
    let mut model = Model::load(&dir.join("model.safetensors")).unwrap();
    model.parameters.last_mut().unwrap().values.fill(3e38);
    model.save(&dir.join("large.safetensors")).unwrap();
    let args = format!("estimate DATA/{CHICKEN} --model large.safetensors --steps 4 --truth auto --executor cpu --accept 1e9");
    let report: Value = serde_json::from_str(&run(dir, &format!("{args} --json --record pictures"), 1)).unwrap();
    let image = &report["images"][0];
    assert!(image["loss"].is_null() && image["converged"] == false, "{image}");
    assert_eq!(files(&dir.join("pictures")).len(), 2);
    assert!(run(dir, &args, 1).contains("NOT CONVERGED"));
    run(dir, "evaluate --model large.safetensors --data DATA --instances 1 --views 1 --steps 2 --executor cpu --out results", 0);
}

#[test]
fn bad_calls_end_with_2_and_one_line() {
    let home = home();
    let dir = home.path();
    fs::write(dir.join("nan.txt"), "1 0 0 0 0 1 0 0 0 0 1 nan 0 0 0 1").unwrap();
    fs::write(dir.join("short.txt"), "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0").unwrap();
    fs::write(dir.join("text.safetensors"), "not a model").unwrap();
    fs::write(dir.join("text.png"), "not a picture").unwrap();
    let whole = fs::read(dir.join("model.safetensors")).unwrap();
    fs::write(dir.join("cut.safetensors"), &whole[..whole.len() / 2]).unwrap();
    let model = "--model model.safetensors";
    let image = format!("estimate DATA/{CHICKEN}");
    for (args, words) in [
        (format!("estimate {model}"), &["IMAGE"][..]),
        (format!("{image} --instance chicken"), &["--model"]),
        (format!("{image} --model nowhere.safetensors"), &["nowhere.safetensors"]),
        (format!("{image} --model text.safetensors"), &["text.safetensors"]),
        (format!("{image} --model cut.safetensors"), &["cut.safetensors"]),
        (format!("{image} {model} --instance teapot"), &["teapot", "bucket, chicken, seat"]),
        (format!("estimate DATA/forklift/rgb/000000.png {model}"), &["forklift"]),
        (format!("estimate nowhere.png {model} --fov 40 --instance seat"), &["nowhere.png"]),
        (format!("estimate text.png {model} --fov 40 --instance seat"), &["text.png"]),
        (format!("{image} {model} --rough nan.txt"), &["nan.txt", "finite"]),
        (format!("{image} {model} --truth short.txt"), &["short.txt", "16 numbers", "15"]),
        (format!("{image} {model} --starts short.txt"), &["short.txt", "line 1"]),
        (format!("{image} {model} --starts fixed25"), &["fixed25", "around84"]),
        (format!("{image} {model} --starts neighbor4"), &["--rough"]),
        (format!("{image} {model} --truth nan.txt --truth nan.txt"), &["--truth", "2 poses for 1"]),
        (format!("{image} {model} --loss l3"), &["l3", "gmsd"]),
        (format!("{image} {model} --loss mse"), &["--loss", "--preset paper"]),
        (format!("{image} {model} --lr 0.1"), &["--lr", "--preset paper"]),
        (format!("{image} {model} --steps 0"), &["--steps"]),
        (format!("{image} {model} --lr -1"), &["-1"]),
        (format!("{image} {model} --stride 100 --executor cpu"), &["stride"]),
        (format!("{image} {model} --preset paper --loss gmsd --stride 2 --executor cpu"), &["stride 1"]),
        (format!("{image} {model} --memory 1 --executor cpu"), &["budget of 1 bytes"]),
        (format!("{image} {model} --adapter no-such-card"), &["no-such-card"]),
        (format!("evaluate {model} --data nowhere"), &["nowhere"]),
        (format!("evaluate {model} --data DATA/forklift"), &["forklift", "none of its 1 instances"]),
        (format!("evaluate {model} --data DATA --views 0"), &["--views"]),
        (format!("render {model} --instance seat --out seat.bmp"), &["seat.bmp"]),
        (format!("render {model} --instance seat --out seat.gif"), &["--orbit"]),
        (format!("render {model} --instance seat --out seat.png --orbit 3"), &["seat.png"]),
        (format!("render {model} --instance seat --out seat.png --pose nan.txt"), &["nan.txt"]),
        (format!("render {model} --instance seat --out seat.png --pose nan.txt --azimuth 3"), &["--azimuth"]),
        (format!("render {model} --instance seat --out model.safetensors/seat.png --executor cpu"), &["model.safetensors/seat"]),
    ] {
        fail(dir, &args, words);
    }
    assert_eq!(files(dir), ["cut.safetensors", "model.safetensors", "nan.txt", "short.txt", "text.png", "text.safetensors"]);
}

#[test]
fn evaluate_prints_a_table_and_keeps_the_results() {
    let home = home();
    let dir = home.path();
    let args = "evaluate --model model.safetensors --data DATA --views 2 --steps 4 --executor cpu --instances 2";
    let table = run(dir, &format!("{args} --out results"), 0);
    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split('|').map(str::trim).collect()).collect();
    assert_eq!(rows.iter().map(|row| row[1]).collect::<Vec<_>>(), ["instance", "---------:", "bucket", "chicken", "all"]);
    assert!(rows.iter().all(|row| row.len() == 14) && rows[4][2] == "4", "{table}");
    assert_eq!(files(&dir.join("results")), ["pictures.png", "results.json"]);
    assert!(image::open(dir.join("results/pictures.png")).unwrap().width() > 500);
    let results: Value = serde_json::from_slice(&fs::read(dir.join("results/results.json")).unwrap()).unwrap();
    let views = results["views"].as_array().unwrap();
    let error = |view: &Value, of: &str| view[of]["rotation_deg"].as_f64().unwrap();
    let mean = views.iter().map(|view| error(view, "error")).sum::<f64>() / 4.0;
    assert!((results["overall"]["rotation_deg"]["mean"].as_f64().unwrap() - mean).abs() < 1e-9);
    assert!(views.iter().all(|view| error(view, "oracle") <= error(view, "error")));
    assert_eq!(
        views.iter().map(|view| view["view"].as_str().unwrap()).collect::<Vec<_>>(),
        ["000000", "000010", "000000", "000010"]
    );

    fail(dir, &format!("{args} --out results"), &["results.json", "--force"]);
    let again: Value = serde_json::from_str(&run(dir, &format!("{args} --out results --force --json"), 0)).unwrap();
    assert_eq!(again["overall"]["rotation_deg"], results["overall"]["rotation_deg"], "runs repeat");
}

#[test]
fn render_makes_pictures_animations_and_folders() {
    let home = home();
    let dir = home.path();
    let render = |rest: &str| run(dir, &format!("render --model model.safetensors --instance seat --executor cpu {rest}"), 0);
    render("--out view.png --side 24 --elevation -20 --azimuth 200");
    assert_eq!(image::image_dimensions(dir.join("view.png")).unwrap(), (24, 24));
    render("--out depth.png --depth --pose DATA/seat/pose/000004.txt --fov 40");
    assert_eq!(image::image_dimensions(dir.join("depth.png")).unwrap(), (16, 16));
    render("--out orbit.gif --orbit 10 --radius 1.5");
    let animation = std::io::BufReader::new(fs::File::open(dir.join("orbit.gif")).unwrap());
    assert_eq!(image::AnimationDecoder::into_frames(image::codecs::gif::GifDecoder::new(animation).unwrap()).count(), 10);

    // A folder is an instance: its intrinsics and poses are those of the pictures.
    render("--out orbit --orbit 3 --elevation 10");
    let views = srn_data::SrnSet::open(dir.join("orbit")).unwrap().load(16).unwrap().instances.remove(0).views;
    assert_eq!(views.len(), 3);
    let rows = views[1].world_from_camera;
    assert!((rows[11] - 1.3 * 10f64.to_radians().sin()).abs() < 1e-6, "height {}", rows[11]);
    let error = "render --model model.safetensors --instance seat --executor cpu --out";
    fail(dir, &format!("{error} view.png"), &["view.png", "--force"]);
    fail(dir, &format!("{error} orbit --orbit 2"), &["orbit", "--force"]);
    render("--out orbit --orbit 2 --force");
    assert_eq!(files(&dir.join("orbit/rgb")), ["000000.png", "000001.png"]);
}

/// One object alone: the same picture, the same poses, wherever a model goes.
#[test]
fn a_baked_model_is_a_model() {
    let home = home();
    let dir = home.path();
    let line = run(dir, "bake --model model.safetensors --instance chicken --out chicken.safetensors", 0);
    assert!(line.contains("chicken.safetensors: chicken, 0.0"), "{line}");
    let models = ["model", "chicken"];
    let pictures = models.map(|model| {
        run(dir, &format!("render --model {model}.safetensors --instance chicken --executor cpu --out {model}.png"), 0);
        image::open(dir.join(model).with_extension("png")).unwrap().into_rgb8()
    });
    let apart = pictures[0].as_raw().iter().zip(pictures[1].as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(apart <= Some(1), "{apart:?}");
    let poses = models.map(|model| {
        let args = format!("estimate DATA/{CHICKEN} --model {model}.safetensors --executor cpu --steps 3 --json --accept 1e9");
        let report: Value = serde_json::from_str(&run(dir, &args, 0)).unwrap();
        matrix(&report["images"][0]["world_from_camera"])
    });
    let (rotation, translation) = pose_error(&poses[0], &poses[1]);
    assert!(rotation < 0.01 && translation < 1e-4, "{rotation}° {translation}");
    let evaluate = "evaluate --model chicken.safetensors --data DATA --views 1 --steps 2 --executor cpu";
    assert!(run(dir, evaluate, 0).contains("chicken"));

    let bake = "bake --model model.safetensors --instance";
    fail(dir, &format!("{bake} seat --out chicken.safetensors"), &["chicken.safetensors", "exists already", "--force"]);
    fail(dir, &format!("{bake} teapot --out teapot.safetensors"), &["model.safetensors", "teapot", "bucket, chicken, seat"]);
    fail(dir, "bake --model chicken.safetensors --instance 0 --out more.safetensors", &["chicken.safetensors", "is baked"]);
    run(dir, &format!("{bake} seat --out chicken.safetensors --force"), 0);
    fail(dir, &format!("estimate DATA/{CHICKEN} --model chicken.safetensors"), &["`chicken`", "1 instances: seat"]);
}
