//! The formats as files: what goes through them unchanged, what real files look like, and what bad ones get.

use glam::{DMat4, DQuat, DVec3};
use image::{Rgb, RgbImage};
use proptest::prelude::*;
use srn_data::camera::{Axes, look_at_origin, rigid_error, uniform_sphere};
use srn_data::capture::{Bounds, Capture, Frame, FrameRecord, UpAxis};
use srn_data::formats::{self, Format, ReadOptions, WriteOptions, bop};
use srn_data::inspect::{self, Origin};
use srn_data::{Camera, SrnSet};
use std::fs;
use std::path::{Path, PathBuf};

mod spoil;
use spoil::{fuzz, spoiled};

const BOX: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/box");
/// Length of the box's diagonal in metres.
const BOX_DIAGONAL: f64 = 0.3285;

/// A small picture: each its own.
fn picture(k: usize, [w, h]: [usize; 2]) -> RgbImage {
    RgbImage::from_fn(w as u32, h as u32, |x, y| Rgb([(9 * x + k as u32) as u8, (7 * y) as u8, (k * 31) as u8]))
}

/// A capture with its pictures in a folder: cameras all around, each `lens(k)`.
fn made(dir: &Path, name: &str, views: usize, lens: impl Fn(usize) -> Camera) -> Capture {
    let mut capture = Capture { name: name.into(), ..Capture::default() };
    for (k, world_from_camera) in uniform_sphere(views, 1.3, 4).into_iter().enumerate() {
        let camera = Camera { world_from_camera, ..lens(k) };
        let image = dir.join(format!("{name}-{k}.png"));
        picture(k, camera.size).save(&image).unwrap();
        capture.frames.push(Frame { name: format!("{k:06}"), image, mask: None, camera });
    }
    capture
}

const PINHOLE: Camera = Camera {
    world_from_camera: DMat4::IDENTITY,
    intrinsics: [74.4, 74.4, 8.25, 6.1],
    size: [16, 12],
    pixel_centre: 0.0,
    distortion: [0.0; 5],
};
const LENS: Camera = Camera {
    intrinsics: [14.4, 14.4, 8.25, 6.1],
    distortion: [-0.11, 0.031, 1.25e-3, -0.7e-3, 0.0],
    pixel_centre: 0.5,
    ..PINHOLE
};

fn written(capture: &Capture, format: Format, out: &Path) -> PathBuf {
    formats::write(capture, format, out, &WriteOptions::default()).unwrap().dir
}

/// Reads the only capture.
fn read(path: &Path, format: Format) -> Capture {
    let mut captures = formats::read(path, format, &ReadOptions::default()).unwrap();
    assert_eq!((captures.len(), captures[0].skipped.len()), (1, 0), "{:?}", captures[0].skipped);
    captures.remove(0)
}

/// The largest differences of a pose's numbers, and of intrinsics and lens, relative.
fn differences(a: &Capture, b: &Capture) -> [f64; 2] {
    assert_eq!(a.frames.len(), b.frames.len());
    let mut worst = [0.0f64; 2];
    for (a, b) in a.frames.iter().zip(&b.frames) {
        assert_eq!((&a.name, a.camera.size), (&b.name, b.camera.size));
        let [m, n] = [a, b].map(|frame| frame.camera.world_from_camera.to_cols_array());
        let poses = m.iter().zip(n).map(|(m, n)| (m - n).abs());
        worst[0] = poses.fold(worst[0], f64::max);
        let [a, b] = [a, b].map(|frame| frame.camera.with_pixel_centre(0.0));
        let pairs = a.intrinsics.iter().chain(&a.distortion).zip(b.intrinsics.iter().chain(&b.distortion));
        worst[1] = pairs.map(|(a, b)| (a - b).abs() / a.abs().max(1e-9)).fold(worst[1], f64::max);
    }
    worst
}

fn round_trip(start: &Capture, dir: &Path) -> Capture {
    let mut capture = start.clone();
    let stations = [Format::Srn, Format::Transforms, Format::Bop, Format::Colmap, Format::ColmapText, Format::Srn];
    for (k, format) in stations.into_iter().enumerate() {
        let out = written(&capture, format, &dir.join(format!("{k}")));
        assert_eq!(Format::detect(&out).unwrap(), if format == Format::ColmapText { Format::Colmap } else { format });
        capture = read(&out, format);
        capture.name = start.name.clone();
    }
    capture
}

#[test]
fn a_round_trip_keeps_every_pose_and_intrinsic() {
    let dir = tempfile::tempdir().unwrap();
    // One camera for all; and each view its own, with pixels that are not square.
    let own = |k: usize| {
        let k = k as f64;
        Camera { intrinsics: [70.1 + k / 3.0, 71.7 - k / 7.0, 8.0 + 0.13 * k, 5.0 - 0.11 * k], ..PINHOLE }
    };
    let shared = made(dir.path(), "shared", 24, |_| PINHOLE);
    let varied = made(dir.path(), "varied", 24, own);
    for start in [shared, varied] {
        let end = round_trip(&start, &dir.path().join(&start.name));
        let [pose, intrinsics] = differences(&start, &end);
        // Measured: 5e-16 and 3e-16.
        assert!(pose < 1e-6 && intrinsics < 1e-9, "{}: {pose:.1e} {intrinsics:.1e}", start.name);
        assert!(pose < 1e-14 && intrinsics < 1e-14, "worse than it was: {pose:.1e} {intrinsics:.1e}");
        for (a, b) in start.frames.iter().zip(&end.frames) {
            assert_eq!(fs::read(&a.image).unwrap(), fs::read(&b.image).unwrap(), "the picture of {} changed", a.name);
        }
    }
}

#[test]
fn a_lens_goes_unchanged_through_the_formats_that_have_one() {
    let dir = tempfile::tempdir().unwrap();
    let with_k3 = Camera { distortion: [-0.1, 0.03, 1e-3, 0.0, -0.002], ..LENS };
    let simple = Camera { distortion: [0.2, 0.0, 0.0, 0.0, 0.0], ..LENS };
    let radial = Camera { distortion: [0.2, -0.05, 0.0, 0.0, 0.0], ..LENS };
    for (name, lens) in [("opencv", LENS), ("full_opencv", with_k3), ("simple_radial", simple), ("radial", radial)] {
        let start = made(dir.path(), name, 5, |_| lens);
        let mut capture = start.clone();
        for (k, format) in [Format::Transforms, Format::ColmapText, Format::Transforms, Format::Colmap].into_iter().enumerate() {
            let out = written(&capture, format, &dir.path().join(format!("{name}{k}")));
            capture = Capture { name: name.into(), ..read(&out, format) };
            if format == Format::ColmapText {
                let text = fs::read_to_string(out.join("sparse/0/cameras.txt")).unwrap();
                assert!(text.contains(&format!("\n1 {} 16 12 ", name.to_uppercase())), "{text}");
            }
        }
        for (a, b) in start.frames.iter().zip(&capture.frames) {
            assert_eq!((a.camera.intrinsics, a.camera.distortion), (b.camera.intrinsics, b.camera.distortion), "{name}");
        }
        // Formats without a lens get pinhole pictures.
        for format in [Format::Srn, Format::Bop] {
            let end = read(&written(&start, format, &dir.path().join(format!("{name}-{}", format.name()))), format);
            let straight = Camera { distortion: [0.0; 5], ..lens }.with_pixel_centre(0.0);
            assert_eq!(end.frames[0].camera.intrinsics, straight.intrinsics);
            let [before, after] = [&start, &end].map(|capture| image::open(&capture.frames[3].image).unwrap().into_rgb8());
            assert_ne!(before, after, "{name}: not resampled");
        }
    }
}

#[test]
fn each_format_counts_pixels_its_own_way() {
    let dir = tempfile::tempdir().unwrap();
    let capture = made(dir.path(), "thing", 1, |_| Camera { intrinsics: [74.4, 74.4, 8.0, 6.0], ..PINHOLE });
    let text = |format: Format, file: &str| fs::read_to_string(written(&capture, format, dir.path()).join(file)).unwrap();
    assert_eq!(text(Format::Srn, "intrinsics.txt"), "74.4 8.0 6.0 0.\n0. 0. 0.\n1.\n12 16\n");
    assert!(
        text(Format::Bop, "scene_camera.json").split_whitespace().collect::<String>().contains("[74.4,0.0,8.0,0.0,74.4,6.0,")
    );
    fs::remove_dir_all(dir.path().join("thing")).unwrap();
    assert!(text(Format::ColmapText, "sparse/0/cameras.txt").contains("1 SIMPLE_PINHOLE 16 12 74.4 8.5 6.5\n"));
    fs::remove_dir_all(dir.path().join("thing")).unwrap();
    let json = text(Format::Transforms, "transforms.json");
    assert!(json.contains("\"cx\": 8.5") && json.contains("\"cy\": 6.5"), "{json}");
}

#[test]
fn poses_are_written_the_way_each_format_names_axes() {
    let dir = tempfile::tempdir().unwrap();
    let mut capture = made(dir.path(), "thing", 1, |_| PINHOLE);
    // From +x: x of the camera is world y, y is down, z is −x.
    capture.frames[0].camera.world_from_camera = look_at_origin(2.0 * DVec3::X);
    let json = |path: PathBuf| -> serde_json::Value { serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap() };
    let numbers = |value: &serde_json::Value| value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect::<Vec<_>>();
    let near = |a: &[f64], b: &[f64]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);

    let file = json(written(&capture, Format::Transforms, dir.path()).join("transforms.json"));
    let rows = file["frames"][0]["transform_matrix"].as_array().unwrap();
    let expected = [[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    assert!(rows.iter().zip(expected).all(|(row, expected)| near(&numbers(row), &expected)), "{rows:?}");

    let gt = &json(written(&capture, Format::Bop, dir.path()).join("scene_gt.json"))["0"][0];
    assert!(near(&numbers(&gt["cam_R_m2c"]), &[0.0, 1.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0, 0.0]), "{gt}");
    assert!(near(&numbers(&gt["cam_t_m2c"]), &[0.0, 0.0, 2000.0]), "{gt}");

    fs::remove_dir_all(dir.path().join("thing")).unwrap();
    let text = fs::read_to_string(written(&capture, Format::ColmapText, dir.path()).join("sparse/0/images.txt")).unwrap();
    let words: Vec<_> = text.lines().nth(1).unwrap().split(' ').collect();
    let q: Vec<f64> = words[1..8].iter().map(|word| word.parse().unwrap()).collect();
    let rotation = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    assert!((rotation * DVec3::Z - DVec3::NEG_Y).length() < 1e-12, "world up is up, −y, in the picture");
    assert!(near(&q[4..], &[0.0, 0.0, 2.0]) && words[9] == "000000.png", "{text}");

    // Another convention where the format leaves one.
    let options = WriteOptions { axes: Some(Axes::OpenGl), replace: true, ..WriteOptions::default() };
    let out = formats::write(&capture, Format::Srn, &dir.path().join("gl"), &options).unwrap().dir;
    let again = formats::read(&out, Format::Srn, &ReadOptions { axes: Some(Axes::OpenGl), ..ReadOptions::default() }).unwrap();
    assert!(differences(&capture, &again[0])[0] < 1e-15 && differences(&capture, &read(&out, Format::Srn))[0] > 0.5);
    let refused = formats::write(&capture, Format::Bop, dir.path(), &options).unwrap_err().to_string();
    assert!(refused.contains("opencv") && refused.contains("opengl"), "{refused}");
    let exists = formats::write(&capture, Format::Srn, &dir.path().join("gl"), &WriteOptions::default()).unwrap_err();
    assert!(exists.to_string().contains("exists already"), "{exists}");
}

/// An SRN instance of three views, its files replaced by others.
fn srn(files: &[(&str, &str)]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let capture = made(dir.path(), "source", 3, |_| Camera { intrinsics: [20.0, 20.0, 8.0, 8.0], size: [16; 2], ..PINHOLE });
    let thing = written(&Capture { name: "thing".into(), ..capture }, Format::Srn, dir.path());
    for (file, text) in files {
        let path = thing.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        if text.is_empty() { fs::remove_file(path).unwrap() } else { fs::write(path, text).unwrap() }
    }
    dir
}

fn words(matrix: DMat4, rows: usize, between: &str) -> String {
    let rows = (0..rows).map(|r| matrix.row(r).to_array().map(|x| format!("{x:?}")).join(" "));
    rows.collect::<Vec<_>>().join(between)
}

#[test]
fn srn_archives_are_read_as_they_are_found() {
    let pose = uniform_sphere(3, 1.3, 4)[1];
    let one_line = words(pose, 4, " ") + " ";
    let four_lines = words(pose, 4, "\r\n") + "\r\n\r\n";
    let in_camera = words(pose.inverse(), 3, "\n");
    for text in [&one_line, &four_lines, &in_camera] {
        let dir = srn(&[("pose/000001.txt", text)]);
        let capture = read(dir.path(), Format::Srn);
        assert!(capture.frames[1].camera.world_from_camera.abs_diff_eq(pose, 1e-12), "{text}");
        assert_eq!(capture.frames[1].camera.intrinsics, [20.0, 20.0, 8.0, 8.0]);
        // Training reads the same.
        let view = &SrnSet::open(dir.path()).unwrap().load(16).unwrap().instances[0].views[1];
        assert!(DMat4::from_cols_array(&view.world_from_camera).transpose().abs_diff_eq(pose, 1e-12));
    }

    // Nine numbers; the values of 512 pixels beside pictures of 16; each view its own.
    let big = "640. 256. 256. 0.\n0. 0. 0.\n1.\n512 512\n";
    for (file, text, expected) in [
        ("intrinsics.txt", "21 0 8.5\n0 22 7.5\n0 0 1\n", [21.0, 22.0, 8.5, 7.5]),
        ("intrinsics.txt", big, [20.0, 20.0, 8.0, 8.0]),
        ("intrinsics/000001.txt", "23 0 8.25 0 24 7.75 0 0 1", [23.0, 24.0, 8.25, 7.75]),
    ] {
        let dir = srn(&[(file, text)]);
        assert_eq!(read(dir.path(), Format::Srn).frames[1].camera.intrinsics, expected, "{text}");
        let set = SrnSet::open(dir.path()).unwrap().load(16).unwrap();
        assert_eq!(set.instances[0].views[1].intrinsics.map(f64::from), expected);
    }

    let dir = srn(&[("intrinsics.txt", "21 5 8.5\n0 22 7.5\n0 0 1\n")]);
    let error = formats::read(dir.path(), Format::Srn, &ReadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("intrinsics.txt") && error.contains("skew"), "{error}");
    // No intrinsics at all: the angle of view says them.
    let dir = srn(&[("intrinsics.txt", "")]);
    let error = formats::read(dir.path(), Format::Srn, &ReadOptions::default()).unwrap_err().to_string();
    assert!(error.contains("intrinsics.txt") && error.contains("--fov"), "{error}");
    let options = ReadOptions { fov_deg: Some(90.0), ..ReadOptions::default() };
    let intrinsics = formats::read(dir.path(), Format::Srn, &options).unwrap()[0].frames[0].camera.intrinsics;
    assert!(intrinsics.iter().all(|x| (x - 8.0).abs() < 1e-12), "{intrinsics:?}");

    // DeepVoxels marks poses that are inverted.
    let text = words(pose.inverse(), 4, "\n");
    let dir = srn(&[("intrinsics.txt", "20 8 8 0.\n0 0 0\n1\n16 16\n1\n"), ("pose/000001.txt", &text)]);
    assert!(read(dir.path(), Format::Srn).frames[1].camera.world_from_camera.abs_diff_eq(pose, 1e-12));
    let error = SrnSet::open(dir.path()).unwrap().load(16).unwrap_err().to_string();
    assert!(error.contains("world2cam") && error.contains("import"), "{error}");
}

/// Writes files and pictures of 16×12 into a new folder.
fn folder(files: &[(&str, &str)], pictures: &[&str]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let path = |file: &str| {
        let path = dir.path().join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        path
    };
    files.iter().for_each(|(file, text)| fs::write(path(file), text).unwrap());
    pictures.iter().enumerate().for_each(|(k, file)| picture(k, [16, 12]).save(path(file)).unwrap());
    dir
}

const IDENTITY: &str = "[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]";

#[test]
fn transforms_are_read_in_all_their_dialects() {
    // NeRF's own: an angle of view, no endings, subfolders with equal names.
    let json = format!(
        r#"{{"camera_angle_x": 1.5707963267948966, "frames": [
            {{"file_path": "./train/r_0", "rotation": 0.01, "transform_matrix": {IDENTITY}}},
            {{"file_path": "test\\r_0.png", "transform_matrix": {IDENTITY}}}]}}"#
    );
    let dir = folder(&[("transforms.json", &json)], &["train/r_0.png", "test/r_0.png"]);
    let capture = read(dir.path(), Format::Transforms);
    let names: Vec<_> = capture.frames.iter().map(|frame| frame.name.as_str()).collect();
    assert_eq!(names, ["r_0", "r_0-2"]);
    let camera = &capture.frames[0].camera;
    assert!(camera.intrinsics.iter().zip([8.0, 8.0, 8.0, 6.0]).all(|(a, b)| (a - b).abs() < 1e-12), "{:?}", camera.intrinsics);
    // It stands at z = 2 and looks along −z, at the origin.
    assert!((camera.project(DVec3::ZERO).0 - glam::DVec2::new(7.5, 5.5)).length() < 1e-9 && camera.project(DVec3::ZERO).1 == 2.0);

    // Intrinsics of all and of one; half-size pictures; a transform that was applied before; a mask; fields of others.
    let json = format!(
        r#"{{"camera_model": "OPENCV", "fl_x": 40.0, "fl_y": 41, "cx": 16.5, "cy": 12, "w": 32, "h": 24.0, "k1": 0.1, "k2": 0,
            "p1": 0, "p2": 0.002, "k3": 0.01, "aabb_scale": 4, "ply_file_path": "a.ply",
            "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0.5]],
            "frames": [{{"file_path": "a.png", "mask_path": "m.png", "transform_matrix": {IDENTITY}, "colmap_im_id": 1}},
                       {{"file_path": "b.png", "fl_x": 50.0, "transform_matrix": {IDENTITY}}}]}}"#
    );
    let dir = folder(&[("transforms.json", &json)], &["a.png", "b.png", "m.png"]);
    let capture = read(&dir.path().join("transforms.json"), Format::Transforms);
    assert_eq!(capture.frames[0].camera.intrinsics, [20.0, 20.5, 8.25, 6.0]);
    assert_eq!(capture.frames[0].camera.distortion, [0.1, 0.0, 0.0, 0.002, 0.01]);
    assert_eq!(capture.frames[1].camera.intrinsics, [25.0, 20.5, 8.25, 6.0]);
    assert!(capture.frames[0].mask.as_ref().unwrap().ends_with("m.png") && capture.frames[1].mask.is_none());
    assert_eq!(capture.applied_transform.unwrap().row(2).to_array(), [0.0, -1.0, 0.0, 0.5]);
    let out = written(&Capture { name: "again".into(), ..capture.clone() }, Format::Transforms, dir.path());
    let again = read(&out, Format::Transforms);
    assert_eq!(again.applied_transform, capture.applied_transform);
    assert!(again.frames[0].mask.is_some() && differences(&capture, &again) == [0.0; 2]);
}

#[test]
fn bop_scenes_onboarding_and_models() {
    let k = r#""cam_K": [20, 0, 8, 0, 21, 6, 0, 0, 1]"#;
    let pose = |z: u32, id: u32| format!(r#"{{"cam_R_m2c": [1,0,0, 0,1,0, 0,0,1], "cam_t_m2c": [10, 0, {z}], "obj_id": {id}}}"#);
    let camera = format!(r#"{{"3": {{{k}, "depth_scale": 0.1}}, "20": {{{k}, "cam_R_w2c": [1,0,0,0,1,0,0,0,1]}}}}"#);
    let gt = format!(r#"{{"3": [{}, {}], "20": [{}, {}]}}"#, pose(500, 5), pose(700, 7), pose(600, 5), pose(900, 5));
    let models = r#"{"5": {"diameter": 100, "min_x": -10, "min_y": -20, "min_z": 0, "size_x": 20, "size_y": 40, "size_z": 40,
        "symmetries_discrete": [[-1,0,0,4, 0,-1,0,0, 0,0,1,0, 0,0,0,1]],
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [2, 0, 0]}]}, "7": {"diameter": 3}}"#;
    let files = [
        ("test/000048/scene_camera.json", camera.as_str()),
        ("test/000048/scene_gt.json", &gt),
        ("models/models_info.json", models),
    ];
    let pictures = ["rgb/000003.png", "rgb/000020.png", "mask_visib/000003_000000.png", "mask/000020_000001.png"];
    let dir = folder(&files, &pictures.map(|file| format!("test/000048/{file}")).each_ref().map(String::as_str));
    for path in ["test", "test/000048"] {
        let captures = formats::read(&dir.path().join(path), Format::Bop, &ReadOptions::default()).unwrap();
        assert!(captures.iter().all(|capture| capture.scene_id == Some(48)));
        let found: Vec<_> = captures.iter().map(|c| (c.name.as_str(), c.object_id, c.frames.len())).collect();
        assert_eq!(found, [("000048-obj_000005", Some(5), 3), ("000048-obj_000007", Some(7), 1)]);
        let names: Vec<_> = captures[0].frames.iter().map(|frame| frame.name.as_str()).collect();
        assert_eq!(names, ["000003", "000020_000000", "000020_000001"]);
        let masks: Vec<_> = captures[0].frames.iter().map(|frame| frame.mask.is_some()).collect();
        assert_eq!(masks, [true, false, true]);
        let first = &captures[0].frames[0].camera;
        assert_eq!((first.intrinsics, first.pixel_centre), ([20.0, 21.0, 8.0, 6.0], 0.0));
        // Millimetres became metres, the object in the camera the camera about the object.
        assert_eq!(first.world_from_camera.w_axis.to_array(), [-0.01, 0.0, -0.5, 1.0]);
        let bounds = captures[0].bounds.unwrap();
        assert!(
            bounds.centre.abs_diff_eq(DVec3::new(0.0, 0.0, 0.02), 1e-12) && (bounds.diagonal - 0.06).abs() < 1e-12,
            "{bounds:?}"
        );
        assert_eq!(captures[1].bounds, None);
    }
    let options = ReadOptions { object: Some(7), ..ReadOptions::default() };
    assert_eq!(formats::read(dir.path().join("test").as_path(), Format::Bop, &options).unwrap().len(), 1);
    let info = &bop::read_models_info(&dir.path().join("models/models_info.json")).unwrap()[&5];
    assert_eq!((info.discrete[0].w_axis.x, info.discrete[0].x_axis.x), (0.004, -1.0));
    assert_eq!(info.continuous, [[DVec3::Z, DVec3::new(0.002, 0.0, 0.0)]]);

    // Onboarding: folders of other names, one object each.
    let gt = format!(r#"{{"0": [{}]}}"#, pose(500, 1));
    let camera = format!(r#"{{"0": {{{k}}}}}"#);
    let at = |side: &str, file: &str| format!("onboarding_static/obj_000001_{side}/{file}");
    let names = ["up", "down"].map(|side| ["scene_camera.json", "scene_gt.json", "rgb/000000.jpg"].map(|file| at(side, file)));
    let files: Vec<_> = names.iter().flat_map(|n| [(n[0].as_str(), camera.as_str()), (n[1].as_str(), gt.as_str())]).collect();
    let dir = folder(&files, &[&names[0][2], &names[1][2]]);
    let captures = formats::read(&dir.path().join("onboarding_static"), Format::Bop, &ReadOptions::default()).unwrap();
    assert_eq!(captures.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["obj_000001_down", "obj_000001_up"]);
}

#[test]
fn bop_results_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("results.csv");
    let estimate = |(k, pose): (usize, DMat4)| bop::Estimate {
        scene_id: 48,
        im_id: k as u32,
        obj_id: 5,
        score: 0.9 - k as f64,
        camera_from_object: pose.inverse(),
        time: if k == 0 { -1.0 } else { 0.25 },
    };
    let estimates: Vec<_> = uniform_sphere(3, 0.8, 1).into_iter().enumerate().map(estimate).collect();
    bop::write_results(&path, &estimates, false).unwrap();
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.starts_with("scene_id,im_id,obj_id,score,R,t,time\n48,0,5,0.9,"), "{text}");
    assert!(text.lines().all(|line| line.split(',').count() == 7));
    for (a, b) in estimates.iter().zip(bop::read_results(&path).unwrap()) {
        assert!(a.camera_from_object.abs_diff_eq(b.camera_from_object, 1e-15));
        assert_eq!(bop::Estimate { camera_from_object: b.camera_from_object, ..*a }, b);
    }
    assert!(bop::write_results(&path, &estimates, false).unwrap_err().to_string().contains("exists"));
    for (line, words) in [
        ("1,2,3", "line 1: expected 7 values"),
        ("1,2,x,1,1 0 0 0 1 0 0 0 1,0 0 1,1", "obj_id"),
        ("1,2,3,1,1 0 0 0 1 0 0 0,0 0 1,1", "line 1: R: expected 9"),
        ("1,2,3,1,1 0 0 0 1 0 0 0 -1,0 0 1,1", "right-handed"),
        ("1,2,3,1,1 0 0 0 1 0 0 0 1,0 0 NaN,1", "line 1: t: expected 3 finite"),
    ] {
        fs::write(&path, line).unwrap();
        let error = bop::read_results(&path).unwrap_err().to_string();
        assert!(error.contains(words) && error.contains("results.csv"), "{error}");
    }
}

#[test]
fn colmap_text_as_colmap_writes_it() {
    let cameras = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 2\n\
        1 SIMPLE_RADIAL 32 24 25.5 16 12 -0.0218\n7 OPENCV 16 12 20 21 8 6 0.1 0.2 0.3 0.4\n";
    // The first image has no points and so an empty line; the second's name has spaces.
    let images = "# Image list with two lines of data per image:\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n\
        4 1 0 0 0 0.5 0 2 1 b.png\n\n\
        2 0.7071067811865476 0 0 0.7071067811865476 0 0 3 7 sub/a picture.png\n2362.39 248.498 58396 1784.7 268.254 -1\n";
    let dir = folder(
        &[("sparse/0/cameras.txt", cameras), ("sparse/0/images.txt", images)],
        &["images/b.png", "images/sub/a picture.png", "masks/b.png.png"],
    );
    for path in [dir.path().to_owned(), dir.path().join("sparse/0")] {
        let capture = read(&path, Format::Colmap);
        let names: Vec<_> = capture.frames.iter().map(|frame| frame.name.as_str()).collect();
        assert_eq!(names, ["a picture", "b"]);
        let [a, b] = [&capture.frames[0], &capture.frames[1]];
        assert_eq!((a.camera.intrinsics, a.camera.distortion), ([20.0, 21.0, 8.0, 6.0], [0.1, 0.2, 0.3, 0.4, 0.0]));
        // The picture is half as large as its camera says.
        assert_eq!((b.camera.intrinsics, b.camera.distortion), ([12.75, 12.75, 8.0, 6.0], [-0.0218, 0.0, 0.0, 0.0, 0.0]));
        assert_eq!(b.camera.world_from_camera.w_axis.to_array(), [-0.5, 0.0, -2.0, 1.0]);
        // A quarter turn about z takes world x to camera y.
        let turned = a.camera.world_from_camera.inverse().transform_vector3(DVec3::X);
        assert!(turned.abs_diff_eq(DVec3::Y, 1e-12), "{turned}");
        assert!(b.mask.is_some() && a.mask.is_none());
    }
}

#[test]
fn colmap_folders_of_folders() {
    let cameras = "1 PINHOLE 16 12 20 21 8 6\n";
    let images = |names: &[&str]| {
        let line = |(k, name): (usize, &&str)| format!("{} 1 0 0 0 0 0 2 1 {name}\n\n", k + 1);
        names.iter().enumerate().map(line).collect::<String>()
    };
    // Equal names in two folders: each has its own mask, or none.
    let names = ["cam0/1.png", "cam1/1.png", "cam1/2.png"];
    let pictures = ["images/cam0/1.png", "images/cam1/1.png", "images/cam1/2.png", "masks/cam0/1.png.png", "masks/cam1/2.png"];
    let (one, three) = (images(&names[..1]), images(&names));
    // Of the pieces of a reconstruction the largest; the first piece may be gone.
    let first = [("sparse/0/cameras.txt", cameras), ("sparse/0/images.txt", one.as_str())];
    let second = [("sparse/1/cameras.txt", cameras), ("sparse/1/images.txt", three.as_str())];
    for files in [[&first[..], &second].concat(), second.to_vec()] {
        let dir = folder(&files, &pictures);
        assert_eq!(Format::detect(dir.path()).unwrap(), Format::Colmap);
        for path in [dir.path().to_owned(), dir.path().join("sparse")] {
            let capture = read(&path, Format::Colmap);
            let masks = capture.frames.iter().map(|frame| Some(frame.mask.as_ref()?.strip_prefix(dir.path()).unwrap()));
            let expected = [Some(Path::new("masks/cam0/1.png.png")), None, Some(Path::new("masks/cam1/2.png"))];
            assert_eq!(masks.collect::<Vec<_>>(), expected);
        }
    }
    // Binary models say how many images they have.
    let dir = tempfile::tempdir().unwrap();
    let all = made(dir.path(), "all", 5, |_| PINHOLE);
    let few = Capture { name: "few".into(), frames: all.frames[..2].to_vec(), ..Capture::default() };
    let [few, all] = [few, all].map(|capture| written(&capture, Format::Colmap, dir.path()));
    fs::rename(all.join("sparse/0"), all.join("sparse/2")).unwrap();
    fs::rename(few.join("sparse/0"), all.join("sparse/0")).unwrap();
    assert_eq!(read(&all, Format::Colmap).frames.len(), 5);

    for (file, text, other) in [("cameras.txt", cameras, "images.txt"), ("images.txt", three.as_str(), "cameras.txt")] {
        let dir = folder(&[(&format!("sparse/0/{file}"), text)], &[]);
        let found = formats::read(dir.path(), Format::Colmap, &ReadOptions::default()).map(|_| ());
        for error in [found.unwrap_err(), Format::detect(dir.path()).unwrap_err()] {
            let error = error.to_string();
            assert!(error.contains(&format!("sparse/0/{other}: missing")) && error.contains(file), "{error}");
        }
    }
}

#[test]
fn no_picture_is_written_over_before_it_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let replace = WriteOptions { replace: true, ..WriteOptions::default() };
    for (format, path, _) in sources(dir.path()) {
        let mut capture = read(&path, format);
        let pictures = |capture: &Capture| capture.frames.iter().map(|frame| fs::read(&frame.image).unwrap()).collect::<Vec<_>>();
        let before = pictures(&capture);
        let refused = |capture: &Capture, out: &Path| {
            let error = formats::write(capture, format, out, &replace).unwrap_err().to_string();
            let dir = formats::folder(capture, format, out);
            assert!(error.contains(dir.to_str().unwrap()) && error.contains("pictures of the source"), "{error}");
            assert_eq!(pictures(capture), before, "{format:?}");
        };
        refused(&capture, path.parent().unwrap());
        // A mask is lost as well, and so is what lies behind a link.
        let out = dir.path().join("others").join(format.name());
        let other = formats::folder(&capture, format, &out);
        fs::create_dir_all(other.join("masks")).unwrap();
        image::GrayImage::new(16, 12).save(other.join("masks/0.png")).unwrap();
        capture.frames[0].mask = Some(other.join("masks/0.png"));
        refused(&capture, &out);
        capture.frames[0].mask = None;
        #[cfg(unix)]
        {
            let images = capture.frames[0].image.clone();
            let folder = if matches!(format, Format::Srn | Format::Bop) { "rgb" } else { "images" };
            std::os::unix::fs::symlink(images.parent().unwrap(), other.join(folder)).unwrap();
            refused(&capture, &out);
            fs::remove_file(other.join(folder)).unwrap();
            fs::create_dir(other.join(folder)).unwrap();
            std::os::unix::fs::symlink(&images, other.join(folder).join(images.file_name().unwrap())).unwrap();
            refused(&capture, &out);
            fs::remove_dir_all(other.join(folder)).unwrap();
        }
        assert_eq!(formats::write(&capture, format, &out, &replace).unwrap().views, 3);
    }
}

/// What an earlier export left there is read by none: a model of the other kind, masks, pictures with another ending.
#[test]
fn a_later_export_is_the_one_that_is_read() {
    let dir = tempfile::tempdir().unwrap();
    let mut earlier = made(dir.path(), "thing", 3, |_| PINHOLE);
    let mask = dir.path().join("mask.png");
    image::GrayImage::new(16, 12).save(&mask).unwrap();
    earlier.frames.iter_mut().for_each(|frame| frame.mask = Some(mask.clone()));
    let mut later = earlier.clone();
    for frame in &mut later.frames {
        frame.mask = None;
        frame.camera.world_from_camera.w_axis.x += 0.1;
        let image = frame.image.with_extension("jpg");
        image::open(&frame.image).unwrap().save(&image).unwrap();
        frame.image = image;
    }
    let replace = WriteOptions { replace: true, ..WriteOptions::default() };
    let pairs = [(Format::Colmap, Format::ColmapText), (Format::ColmapText, Format::Colmap), (Format::Bop, Format::Bop)];
    for (k, (first, second)) in pairs.into_iter().enumerate() {
        let out = dir.path().join(format!("{k}"));
        let folder = written(&earlier, first, &out);
        assert!(read(&folder, first).frames.iter().all(|frame| frame.mask.is_some()), "{first:?}");
        assert_eq!(formats::write(&later, second, &out, &replace).unwrap().dir, folder);
        let found = read(&folder, second);
        assert!(differences(&Capture { name: found.name.clone(), ..later.clone() }, &found)[0] < 1e-9, "{second:?}");
        for (frame, written) in found.frames.iter().zip(&later.frames) {
            assert_eq!(frame.mask, None, "{second:?}");
            assert_eq!(
                fs::read(&frame.image).unwrap(),
                fs::read(&written.image).unwrap(),
                "{second:?}: {}",
                frame.image.display()
            );
        }
    }
}

#[test]
fn scenes_and_objects_have_numbers_of_their_own() {
    let captures = [
        (None, None),
        (Some(48), Some(5)),
        (None, Some(5)),
        (Some(49), Some(5)),
        (Some(7), Some(1)),
        (Some(7), Some(2)),
        (None, Some(1)),
    ];
    let mut captures = captures.map(|(scene_id, object_id)| Capture { scene_id, object_id, ..Capture::default() });
    bop::number(&mut captures);
    let found = captures.map(|capture| (capture.scene_id.unwrap(), capture.object_id.unwrap()));
    assert_eq!(found, [(3, 3), (48, 5), (5, 5), (49, 5), (1, 1), (2, 2), (4, 1)]);
}

/// Reads the box's frames and puts the object into our frame.
fn placed_box(bounds: Option<Bounds>) -> (Capture, FrameRecord, Bounds) {
    let mut capture = read(Path::new(BOX), Format::Transforms);
    let (found, how) = capture.find_bounds(bounds.map(|b| b.centre), bounds.map(|b| b.diagonal), 1.3).unwrap();
    let placed = capture.placement(found, UpAxis::Axis(2, false));
    let record = FrameRecord {
        world_from_source: placed.transpose().to_cols_array_2d(),
        format: "transforms".into(),
        found_by: how,
        ..FrameRecord::default()
    };
    capture.transform(&placed);
    (capture, record, found)
}

#[test]
fn photographs_become_squares_around_the_object() {
    let dir = tempfile::tempdir().unwrap();
    // Where the object is and how large is seen in the silhouettes: here four, 39° apart at most.
    let (_, record, found) = placed_box(None);
    assert!(record.found_by.contains("silhouette"), "{}", record.found_by);
    assert!(found.centre.length() < 0.03 && (found.diagonal / BOX_DIAGONAL - 1.0).abs() < 0.1, "{found:?}");

    let (capture, record, _) = placed_box(Some(Bounds { centre: DVec3::ZERO, diagonal: BOX_DIAGONAL }));
    let options = WriteOptions { side: Some(48), margin: 0.1, ..WriteOptions::default() };
    let out = formats::write(&capture, Format::Srn, dir.path(), &options).unwrap();
    assert_eq!((out.views, out.skipped.len(), out.warnings.len()), (4, 0, 0), "{out:?}");
    record.write(&out.dir).unwrap();

    let mut squares = read(dir.path(), Format::Srn);
    for frame in &squares.frames {
        let picture = image::open(&frame.image).unwrap().into_rgb8();
        let (w, h) = picture.dimensions();
        assert_eq!((w, h), (48, 48));
        let white = |x, y| picture.get_pixel(x, y).0 == [255; 3];
        assert!((0..48).all(|i| white(i, 0) && white(0, i) && white(i, 47) && white(47, i)), "{}: the margin", frame.name);
        let dark = picture.pixels().filter(|p| p.0[2] < 128).count();
        assert!((300..1500).contains(&dark), "{}: {dark} dark pixels", frame.name);
        // The box's middle is inside of its silhouette, and its corners at the unit sphere.
        let (origin, depth) = frame.camera.project(DVec3::ZERO);
        assert!((origin - 23.5).length() < 6.0 && depth > 1.0, "{}: {origin}", frame.name);
    }
    let report = inspect::inspect(&[squares.clone()], Axes::OpenCv, false, Origin::Given);
    assert!(report.problems.is_empty(), "{:?}", report.problems);
    assert!(report.instances[0].filled.is_some_and(|f| (0.75..1.1).contains(&f)), "{:?}", report.instances[0].filled);

    // Without masks the square is around the unit sphere, and the room stays in the picture.
    let mut bare = capture.clone();
    bare.frames.iter_mut().for_each(|frame| frame.mask = None);
    let options = WriteOptions { placed: true, ..options };
    let written = formats::write(&bare, Format::Srn, &dir.path().join("bare"), &options).unwrap();
    assert!(written.warnings.len() == 1 && written.warnings[0].contains("4 of 4 pictures have no mask"), "{written:?}");
    for frame in &read(&written.dir, Format::Srn).frames {
        let (origin, depth) = frame.camera.project(DVec3::ZERO);
        let radius = frame.camera.intrinsics[0] * (0.5 / depth);
        assert!((origin - 23.5).length() < 2.0 && (18.0..22.0).contains(&radius), "{origin} {radius}");
    }

    // With the record, poses go back to what the file says.
    squares.restore();
    let source = read(Path::new(BOX), Format::Transforms);
    for (a, b) in source.frames.iter().zip(&squares.frames) {
        assert!(a.camera.world_from_camera.abs_diff_eq(b.camera.world_from_camera, 1e-12), "{}", a.name);
    }
    // Read with the wrong convention, the doctor says so.
    let mut wrong =
        formats::read(Path::new(BOX), Format::Transforms, &ReadOptions { axes: Some(Axes::OpenCv), ..Default::default() })
            .unwrap();
    inspect::place_all(&mut wrong, UpAxis::Cameras).unwrap();
    let report = inspect::inspect(&wrong, Axes::OpenCv, false, Origin::Found);
    assert!(report.problems.iter().any(|p| p.contains("--convention opengl")), "{:?}", report.problems);
}

#[test]
fn an_empty_mask_is_skipped_and_counted() {
    let dir = tempfile::tempdir().unwrap();
    let mut capture = made(dir.path(), "thing", 3, |_| PINHOLE);
    let mask = |name: &str, value: u8| {
        let path = dir.path().join(name);
        let object = move |x: u32, y: u32| if (4..9).contains(&x) && (3..8).contains(&y) { value } else { 0 };
        image::GrayImage::from_fn(16, 12, |x, y| image::Luma([object(x, y)])).save(&path).unwrap();
        Some(path)
    };
    (capture.frames[0].mask, capture.frames[1].mask) = (mask("good.png", 255), mask("empty.png", 0));
    let options = WriteOptions { side: Some(8), ..WriteOptions::default() };
    let out = formats::write(&capture, Format::Srn, &dir.path().join("set"), &options).unwrap();
    assert_eq!((out.views, out.skipped.len()), (2, 1));
    assert!(out.skipped[0].contains("thing-1.png") && out.skipped[0].contains("empty"), "{:?}", out.skipped);
    // So is a picture that cannot be read; an inverted mask is remarked on.
    fs::write(&capture.frames[2].image, &fs::read(&capture.frames[1].image).unwrap()[..70]).unwrap();
    capture.frames[0].mask = mask("inverted.png", 255).inspect(|path| {
        let mut mask = image::open(path).unwrap();
        mask.invert();
        mask.save(path).unwrap();
    });
    let worse = formats::write(&capture, Format::Srn, &dir.path().join("worse"), &options).unwrap();
    assert_eq!((worse.views, worse.skipped.len(), worse.warnings.len()), (1, 2, 1), "{worse:?}");
    assert!(worse.skipped[1].contains("not a readable image") && worse.warnings[0].contains("inverted"), "{worse:?}");
    let whole = formats::write(&capture, Format::Srn, &dir.path().join("whole"), &WriteOptions::default()).unwrap();
    assert_eq!((whole.views, whole.skipped.len()), (2, 1), "{whole:?}");
    // What remains can be trained on.
    assert_eq!(SrnSet::open(dir.path().join("set")).unwrap().load(8).unwrap().instances[0].views.len(), 2);
}

/// A valid source of each format in its own folder, and its parsed files.
fn sources(dir: &Path) -> Vec<(Format, PathBuf, Vec<PathBuf>)> {
    fs::create_dir_all(dir).unwrap();
    let start = made(dir, "thing", 3, |_| LENS);
    let files = |format: Format| match format {
        Format::Srn => vec!["intrinsics.txt", "pose/000001.txt", "rgb/000001.png", "frame.json"],
        Format::Transforms => vec!["transforms.json", "images/000001.png"],
        Format::Bop => vec!["scene_camera.json", "scene_gt.json", "rgb/000001.png"],
        Format::Colmap => vec!["sparse/0/cameras.bin", "sparse/0/images.bin"],
        Format::ColmapText => vec!["sparse/0/cameras.txt", "sparse/0/images.txt"],
    };
    let source = |format: Format| {
        let out = written(&start, format, &dir.join(format.name()));
        if format == Format::Srn {
            let identity = DMat4::IDENTITY.transpose().to_cols_array_2d();
            FrameRecord { world_from_source: identity, ..FrameRecord::default() }.write(&out).unwrap();
        }
        let files = files(format).into_iter().map(|file| out.join(file)).collect();
        (format, out, files)
    };
    Format::ALL.into_iter().map(source).collect()
}

/// Reads, looks and writes; whatever comes through has poses that are motions, and finite intrinsics.
fn survive(format: Format, path: &Path) -> Result<(), TestCaseError> {
    let Ok(mut captures) = formats::read(path, format, &ReadOptions::default()) else { return Ok(()) };
    for frame in captures.iter().flat_map(|capture| &capture.frames) {
        let camera = &frame.camera;
        prop_assert!(rigid_error(&camera.world_from_camera) <= 2e-3, "{}", camera.world_from_camera);
        prop_assert!(camera.intrinsics.iter().chain(&camera.distortion).all(|x| x.is_finite()), "{:?}", camera);
    }
    let report = inspect::inspect(&captures, format.axes(), false, Origin::Given);
    prop_assert!(report.problems.iter().all(|line| !line.contains('\n')));
    inspect::contact_sheet(&captures, 2, 1);
    inspect::place_all(&mut captures, format.up()).ok();
    let dir = tempfile::tempdir().unwrap();
    let options = WriteOptions { side: Some(8), ..WriteOptions::default() };
    captures.iter().for_each(|capture| drop(formats::write(capture, Format::Srn, dir.path(), &options)));
    Ok(())
}

/// Reads a source while any of its files, in turn, is not as it should be.
fn survive_all(target: &str, format: Format) {
    let dir = tempfile::tempdir().unwrap();
    let (_, path, files) = sources(dir.path()).into_iter().find(|(found, ..)| *found == format).unwrap();
    let good: Vec<_> = files.iter().map(|file| fs::read(file).unwrap()).collect();
    fuzz(target, 200, &(0..files.len(), spoiled()), |(which, spoiled)| {
        for (k, (file, good)) in files.iter().zip(&good).enumerate() {
            let bytes = if k == which { spoiled.of(good) } else { good.clone() };
            fs::write(file, bytes).unwrap();
        }
        survive(format, &path)
    });
    files.iter().zip(good).for_each(|(file, good)| fs::write(file, good).unwrap());
    assert!(formats::read(&path, format, &ReadOptions::default()).is_ok(), "the source is in order again");
}

#[test]
fn fuzz_srn() {
    survive_all("srn", Format::Srn);
}

#[test]
fn fuzz_transforms() {
    survive_all("transforms", Format::Transforms);
}

#[test]
fn fuzz_bop() {
    survive_all("bop", Format::Bop);
}

#[test]
fn fuzz_colmap() {
    survive_all("colmap", Format::Colmap);
}

#[test]
fn fuzz_colmap_text() {
    survive_all("colmap-text", Format::ColmapText);
}

/// The way of training and estimation: poses and intrinsics as they are, without a capture.
#[test]
fn fuzz_srn_set() {
    let dir = tempfile::tempdir().unwrap();
    let capture = made(dir.path(), "thing", 2, |_| Camera { intrinsics: [20.0, 20.0, 8.0, 8.0], size: [16; 2], ..PINHOLE });
    let set = dir.path().join("set");
    let instance = written(&capture, Format::Srn, &set);
    let files = ["pose/000001.txt", "intrinsics.txt", "rgb/000001.png"].map(|file| instance.join(file));
    let good = files.each_ref().map(|file| fs::read(file).unwrap());
    fuzz("srn-set", 400, &(0..files.len(), spoiled()), |(which, spoiled)| {
        for (k, (file, good)) in files.iter().zip(&good).enumerate() {
            let bytes = if k == which { spoiled.of(good) } else { good.clone() };
            fs::write(file, bytes).unwrap();
        }
        let read = SrnSet::open(&set).and_then(|set| set.load(16));
        for view in read.iter().flat_map(|set| &set.instances).flat_map(|instance| &instance.views) {
            let pose = DMat4::from_cols_array(&view.world_from_camera).transpose();
            prop_assert!(rigid_error(&pose) <= 2e-3 && view.intrinsics.iter().all(|x| x.is_finite()), "{pose}");
        }
        prop_assert!(read.err().is_none_or(|error| !error.to_string().contains('\n')));
        Ok(())
    });
}

#[test]
fn fuzz_bop_tables() {
    let dir = tempfile::tempdir().unwrap();
    let (results, models) = (dir.path().join("results.csv"), dir.path().join("models_info.json"));
    let estimate = bop::Estimate {
        scene_id: 1,
        im_id: 2,
        obj_id: 3,
        score: 0.5,
        camera_from_object: look_at_origin(DVec3::ONE).inverse(),
        time: -1.0,
    };
    bop::write_results(&results, &[estimate], false).unwrap();
    let table = fs::read(&results).unwrap();
    fuzz("bop-results", 400, &spoiled(), |spoiled| {
        fs::write(&results, spoiled.of(&table)).unwrap();
        for estimate in bop::read_results(&results).unwrap_or_default() {
            prop_assert!(rigid_error(&estimate.camera_from_object) <= 1e-3);
        }
        Ok(())
    });
    let info = br#"{"5": {"min_x": -10, "min_y": -20, "min_z": 0, "size_x": 20, "size_y": 40, "size_z": 40,
        "symmetries_discrete": [[-1,0,0,4, 0,-1,0,0, 0,0,1,0, 0,0,0,1]]}}"#;
    fuzz("bop-models", 400, &spoiled(), |spoiled| {
        fs::write(&models, spoiled.of(info)).unwrap();
        for info in bop::read_models_info(&models).unwrap_or_default().into_values() {
            prop_assert!(info.bounds.is_none_or(|b| b.diagonal > 0.0 && b.centre.is_finite()));
            prop_assert!(info.discrete.iter().all(|motion| rigid_error(motion) <= 1e-3));
        }
        Ok(())
    });
}

#[test]
fn bad_files_are_named_with_the_place() {
    let text = |text: &str| text.as_bytes().to_vec();
    let swap = |from: &'static str, to: &'static str| {
        move |good: &[u8]| {
            let good = String::from_utf8(good.to_vec()).unwrap();
            assert!(good.contains(from), "{from}: {good}");
            good.replacen(from, to, 1).into_bytes()
        }
    };
    type Spoil = Box<dyn Fn(&[u8]) -> Vec<u8>>;
    let cut = |n: usize| Box::new(move |good: &[u8]| good[..n].to_vec()) as Spoil;
    let to = |bytes: Vec<u8>| Box::new(move |_: &[u8]| bytes.clone()) as Spoil;
    let cases: Vec<(Format, &str, Spoil, &[&str])> = vec![
        (Format::Transforms, "transforms.json", to(vec![]), &["line 1, column 0", "EOF"]),
        (Format::Transforms, "transforms.json", cut(100), &["line ", "EOF"]),
        (Format::Transforms, "transforms.json", to(vec![b'{', 0xff, 0xfe]), &["byte 1", "UTF-8"]),
        (Format::Transforms, "transforms.json", to(text("[1, 2]")), &["line 1"]),
        (Format::Transforms, "transforms.json", to(text(r#"{"frames": []}"#)), &["at least one usable view", "none"]),
        (
            Format::Transforms,
            "transforms.json",
            Box::new(swap("\"OPENCV\"", "\"OPENCV_FISHEYE\"")),
            &["frames[0]", "camera_model", "FISHEYE"],
        ),
        (Format::Transforms, "transforms.json", Box::new(swap("\"fl_x\": 14.4", "\"fl_x\": NaN")), &["line ", "column", "NaN"]),
        (Format::Transforms, "transforms.json", Box::new(swap("\"fl_x\": 14.4", "\"fl_x\": -2")), &["above 0", "-2"]),
        (
            Format::Transforms,
            "transforms.json",
            Box::new(swap("\"fl_x\": 14.4", "\"camera_angle_x\": 40")),
            &["frames[0]", "camera_angle_x: expected radians between 0 and π, found 40"],
        ),
        (Format::Bop, "scene_camera.json", to(text("{}")), &["scene_camera.json", "image 0", "a camera"]),
        (Format::Bop, "scene_gt.json", to(text(r#"{"0": [{"obj_id": 1}]}"#)), &["cam_R_m2c", "line 1"]),
        (Format::Bop, "scene_gt.json", to(text("{}")), &["obj", "none"]),
        (Format::Colmap, "sparse/0/cameras.bin", cut(21), &["byte 16: width: expected 8 bytes, found 5"]),
        (Format::Colmap, "sparse/0/images.bin", cut(30), &["byte ", "until the end"]),
        (Format::Colmap, "sparse/0/images.bin", to(vec![0xff; 8]), &["byte 8: image_id: expected 4 bytes, found 0"]),
        (
            Format::Colmap,
            "sparse/0/cameras.bin",
            Box::new(|good| [&good[..12], &[5, 0, 0, 0], &good[16..]].concat()),
            &["OPENCV_FISHEYE"],
        ),
        (
            Format::ColmapText,
            "sparse/0/cameras.txt",
            Box::new(swap("OPENCV", "THIN_PRISM_FISHEYE")),
            &["camera 1: model", "THIN"],
        ),
        (Format::ColmapText, "sparse/0/cameras.txt", Box::new(swap(" 14.4", "")), &["parameters of OPENCV", "8", "7"]),
        (Format::ColmapText, "sparse/0/images.txt", to(text("1 1 0 0\n\n")), &["line 1: QZ", "end of the line"]),
        (Format::ColmapText, "sparse/0/images.txt", to(text("1 1 0 0 0 0 0 1 1\n\n")), &["line 1: NAME"]),
        (Format::ColmapText, "sparse/0/images.txt", to(text("1 0 0 0 0 0 0 1 1 000000.png\n\n")), &["quaternion", "000000.png"]),
        (Format::ColmapText, "sparse/0/images.txt", to(text("1 1 0 0 0 0 0 1 9 000000.png\n\n")), &["a camera 9"]),
        (Format::Srn, "frame.json", to(text("{}")), &["frame.json", "world_from_source"]),
    ];
    for (format, file, spoil, words) in cases {
        let dir = tempfile::tempdir().unwrap();
        let (_, path, _) = sources(dir.path()).into_iter().find(|(found, ..)| *found == format).unwrap();
        let good = fs::read(path.join(file)).unwrap();
        fs::write(path.join(file), spoil(&good)).unwrap();
        let error = formats::read(&path, format, &ReadOptions::default()).map(|_| ()).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{file} {words:?}: {error}");
        assert!(error.contains(path.to_str().unwrap()), "{file}: {error}");
    }
    // One bad view of three is left out, and counted.
    let dir = tempfile::tempdir().unwrap();
    let mirrored = words_of_mirror();
    for (format, path, _) in sources(dir.path()) {
        match format {
            Format::Srn => fs::write(path.join("pose/000001.txt"), &mirrored).unwrap(),
            Format::Bop => fs::remove_file(path.join("rgb/000001.png")).unwrap(),
            _ => fs::remove_file(path.join("images/000001.png")).unwrap(),
        }
        let capture = &formats::read(&path, format, &ReadOptions::default()).unwrap()[0];
        assert_eq!((capture.frames.len(), capture.skipped.len()), (2, 1), "{format:?}");
        assert!(capture.skipped[0].contains("000001"), "{:?}", capture.skipped);
    }
    // A name with a line break in it does not break the line that tells of it: found by the fuzzer.
    let (format, path, files) = sources(&dir.path().join("names")).remove(3);
    let bytes = fs::read(&files[1]).unwrap();
    let at = bytes.windows(10).position(|name| name == b"000001.png").unwrap();
    fs::write(&files[1], [&bytes[..at], b"\n", &bytes[at + 1..]].concat()).unwrap();
    let capture = &formats::read(&path, format, &ReadOptions::default()).unwrap()[0];
    assert!(capture.skipped.len() == 1 && !capture.skipped[0].contains('\n'), "{:?}", capture.skipped);
    // Far too long, sparse on disk.
    let (_, path, files) = sources(&dir.path().join("huge")).remove(1);
    fs::File::options().write(true).open(&files[0]).unwrap().set_len(3 << 30).unwrap();
    let error = formats::read(&path, Format::Transforms, &ReadOptions::default()).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("3221225472"), "{error}");
    let nothing = tempfile::tempdir().unwrap();
    let error = Format::detect(nothing.path()).unwrap_err().to_string();
    assert!(error.contains("transforms.json") && error.contains("nothing"), "{error}");
}

fn words_of_mirror() -> String {
    words(look_at_origin(DVec3::ONE) * DMat4::from_scale(DVec3::new(1.0, -1.0, 1.0)), 4, "\n")
}
