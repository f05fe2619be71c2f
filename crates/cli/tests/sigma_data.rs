//! `sigma-data` as a user runs it: exit codes, what is written, what is never overwritten.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

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
        assert_eq!((&a.name, a.world_from_camera, a.intrinsics), (&b.name, b.world_from_camera, b.intrinsics));
        let difference = a.rgb.iter().zip(&b.rgb).map(|(x, y)| (x - y).abs()).sum::<f32>() / a.rgb.len() as f32;
        // Bit-equal on the driver that made it; half a grey level of 255 is room for other drivers' edges.
        assert!(difference < 0.004, "view {}: mean difference {difference}", a.name);
    }
}
