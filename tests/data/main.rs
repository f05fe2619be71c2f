//! The rasteriser against the camera of `srn-data`: both must mean the same by a pose, a pixel and a colour.

use glam::{DMat4, DVec2, DVec3, Vec3};
use srn_data::{Camera, camera};
use srn_gpu::Gpu;
use srn_gpu::raster::{Model, Part, RasterError, Rasterizer, Texture, Vertex, View};

const SIDE: u32 = 64;
const INTRINSICS: [f64; 4] = [70.0, 80.0, 32.0, 30.5];

fn rasterizer() -> Rasterizer {
    let gpu = Gpu::open(None).expect("an adapter");
    println!("adapter: {}", gpu.adapter());
    Rasterizer::new(&gpu).unwrap()
}

fn view(pose: &DMat4) -> View {
    View { world_from_camera: pose.transpose().to_cols_array(), intrinsics: INTRINSICS, side: SIDE }
}

/// Six squares, each of its own colour, given by its outward normal.
fn cube(centre: Vec3, side: f32, colour: impl Fn(Vec3) -> Vec3) -> Vec<Vertex> {
    let normals = [Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y, Vec3::Z, -Vec3::Z];
    let faces = normals.into_iter().flat_map(|normal| {
        let [a, b] = [Vec3::new(normal.y, normal.z, normal.x), Vec3::new(normal.z, normal.x, normal.y)];
        let corners = [(-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1)];
        corners.map(|(i, j)| Vertex {
            position: (centre + 0.5 * side * (normal + a * i as f32 + b * j as f32)).to_array(),
            normal: normal.to_array(),
            colour: colour(normal).to_array(),
            uv: [(i + 1) as f32 / 2.0, (j + 1) as f32 / 2.0],
        })
    });
    faces.collect()
}

fn model(rasterizer: &Rasterizer, vertices: &[Vertex]) -> Model {
    rasterizer.upload(vertices, &[(0..vertices.len() as u32, None)], &[]).unwrap()
}

/// The colour without its brightness: shading scales all channels alike.
fn hue(pixel: &[u8]) -> Vec3 {
    Vec3::from_array([0, 1, 2].map(|c| f32::from(pixel[c]))).normalize()
}

fn pixel(picture: &[u8], x: u32, y: u32) -> &[u8] {
    &picture[3 * (y * SIDE + x) as usize..][..3]
}

#[test]
fn each_side_of_a_cube_is_seen_from_its_own_side() {
    let rasterizer = rasterizer();
    // Opposite faces differ: a mirrored or inverted pose shows another colour.
    let colour = |n: Vec3| if n.min_element() < 0.0 { 0.3 + 0.6 * (1.0 + n) * 0.5 - 0.3 * n * n } else { 0.1 + 0.8 * n };
    let cube = model(&rasterizer, &cube(Vec3::ZERO, 0.5, colour));
    let mut brightness = vec![];
    for axis in [Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y, Vec3::Z, -Vec3::Z] {
        let picture = rasterizer.render(&cube, &view(&camera::look_at_origin(1.5 * axis.as_dvec3()))).unwrap();
        let centre = pixel(&picture, 32, 30);
        assert!((hue(centre) - colour(axis).normalize()).length() < 0.03, "from {axis}: {centre:?}, not {}", colour(axis));
        brightness.push(f32::from(*centre.iter().max().unwrap()) / 255.0 / colour(axis).max_element());
        for (x, y) in [(0, 0), (63, 0), (0, 63), (63, 63), (32, 1), (2, 30)] {
            assert_eq!(pixel(&picture, x, y), [255; 3], "background at {x}, {y}");
        }
    }
    // Faces are told apart by their shading, and none is black or burnt out.
    brightness.sort_by(f32::total_cmp);
    assert!(brightness.windows(2).all(|pair| pair[1] - pair[0] > 0.05), "{brightness:?}");
    assert!(brightness[0] > 0.3 && brightness[5] <= 1.0, "{brightness:?}");
}

#[test]
fn the_inside_is_shaded_as_the_viewer_sees_it() {
    let rasterizer = rasterizer();
    let square = |flip: f32| {
        let mut square = cube(Vec3::ZERO, 0.5, |_| Vec3::ONE);
        square.truncate(6);
        square.iter_mut().for_each(|v| v.normal = [flip, 0.0, 0.0]);
        rasterizer.render(&model(&rasterizer, &square), &view(&camera::look_at_origin(DVec3::X * 1.5))).unwrap()
    };
    assert_eq!(square(1.0), square(-1.0), "the sign of a normal is of no meaning");
}

#[test]
fn points_appear_where_the_camera_projects_them() {
    let rasterizer = rasterizer();
    let points = [(Vec3::new(0.3, 0.0, 0.0), Vec3::X), (Vec3::new(0.0, 0.3, 0.0), Vec3::Y), (Vec3::new(0.0, 0.0, 0.3), Vec3::Z)];
    let blobs: Vec<_> = points.iter().flat_map(|&(centre, colour)| cube(centre, 0.06, |_| colour)).collect();
    let blobs = model(&rasterizer, &blobs);
    for pose in camera::uniform_sphere(20, 1.3, 3) {
        let picture = rasterizer.render(&blobs, &view(&pose)).unwrap();
        let camera = Camera {
            world_from_camera: pose,
            intrinsics: INTRINSICS,
            size: [SIDE as usize; 2],
            pixel_centre: 0.0,
            distortion: [0.0; 5],
        };
        for (channel, (point, _)) in points.iter().enumerate() {
            // The share of a pixel that the blob covers: its colour lacks the other two channels, however it is lit.
            let dark = |p: &[u8], c: usize| 255.0 - f64::from(p[c]);
            let own = |p: &[u8]| {
                let others = dark(p, (channel + 1) % 3).min(dark(p, (channel + 2) % 3));
                if others > dark(p, channel) { others } else { 0.0 }
            };
            let [mut sum, mut weight] = [DVec2::ZERO, DVec2::ZERO];
            for (i, p) in picture.chunks(3).enumerate() {
                sum += own(p) * DVec2::new((i as u32 % SIDE).into(), (i as u32 / SIDE).into());
                weight += own(p);
            }
            // Another blob in front of it moves what is left of it.
            let projected = |k: usize| camera.project(points[k].0.as_dvec3()).0;
            let alone = (0..3).all(|k| k == channel || (projected(k) - projected(channel)).length() > 9.0);
            if alone {
                // Worst of these views: 0.081 px (lavapipe); the middle of a silhouette is not quite the projected middle.
                let (expected, _) = camera.project(point.as_dvec3());
                assert!(weight.x > 255.0 && (sum / weight - expected).length() < 0.2, "{channel}: {} {expected}", sum / weight);
            }
        }
    }
    // World up is up in the picture, and from +x world +y is on the right.
    let picture = rasterizer.render(&blobs, &view(&camera::look_at_origin(1.3 * DVec3::X))).unwrap();
    let nearest = |colour: Vec3| {
        let distance = |i: &usize| (255.0 * (hue(&picture[3 * i..][..3]) - colour)).length() as u32;
        (0..(SIDE * SIDE) as usize).min_by_key(distance).map(|i| [i as u32 % SIDE, i as u32 / SIDE]).unwrap()
    };
    assert!(nearest(Vec3::Z)[1] < 20 && nearest(Vec3::Y)[0] > 44, "{:?} {:?}", nearest(Vec3::Z), nearest(Vec3::Y));
}

#[test]
fn nearer_surfaces_hide_farther_ones() {
    let rasterizer = rasterizer();
    let [red, blue] = [(0.3, Vec3::X), (-0.3, Vec3::Z)].map(|(x, colour)| cube(Vec3::new(x, 0.0, 0.0), 0.2, |_| colour));
    for order in [[&red, &blue], [&blue, &red]] {
        let both = model(&rasterizer, &order.map(Vec::as_slice).concat());
        for (x, colour) in [(1.5, Vec3::X), (-1.5, Vec3::Z)] {
            let picture = rasterizer.render(&both, &view(&camera::look_at_origin(DVec3::X * x))).unwrap();
            assert!((hue(pixel(&picture, 32, 30)) - colour).length() < 0.01);
        }
    }
}

#[test]
fn edges_are_smooth_and_pictures_repeat() {
    let rasterizer = rasterizer();
    let black = cube(Vec3::ZERO, 0.5, |_| Vec3::ZERO);
    let cube = model(&rasterizer, &black);
    let pose = camera::look_at_origin(DVec3::new(0.9, 0.7, 0.5));
    let picture = rasterizer.render(&cube, &view(&pose)).unwrap();
    let mut greys: Vec<_> = picture.chunks(3).map(|p| p[0]).filter(|&p| p != 0 && p != 255).collect();
    greys.sort();
    greys.dedup();
    assert!(greys.len() > 20, "the edges of a black cube have only the greys {greys:?}");
    assert_eq!(picture, rasterizer.render(&cube, &view(&pose)).unwrap());
    // Also on a device opened anew.
    let again = self::rasterizer();
    assert_eq!(picture, again.render(&model(&again, &black), &view(&pose)).unwrap());
}

#[test]
fn textures_lie_the_right_way_round() {
    let rasterizer = rasterizer();
    // Top left red, top right green, bottom left blue, bottom right black; v points down.
    let rgba = [[200, 0, 0, 255], [0, 200, 0, 255], [0, 0, 200, 255], [0, 0, 0, 255]].concat();
    let corner = |y: f32, z: f32, uv: [f32; 2]| Vertex { position: [0.0, y, z], normal: [1.0, 0.0, 0.0], colour: [1.0; 3], uv };
    let [a, b, c, d] = [(-1., 1., [0., 0.]), (1., 1., [1., 0.]), (-1., -1., [0., 1.]), (1., -1., [1., 1.])]
        .map(|(y, z, uv): (f32, f32, _)| corner(0.3 * y, 0.3 * z, uv));
    let texture = Texture { width: 2, height: 2, rgba: &rgba };
    let square = rasterizer.upload(&[a, b, c, b, c, d], &[(0..6, Some(0))], &[texture]).unwrap();
    let picture = rasterizer.render(&square, &view(&camera::look_at_origin(1.2 * DVec3::X))).unwrap();
    for (x, y, expected) in [(23, 20, Vec3::X), (41, 20, Vec3::Y), (23, 41, Vec3::Z)] {
        assert!((hue(pixel(&picture, x, y)) - expected).length() < 0.25, "{x}, {y}: {:?}", pixel(&picture, x, y));
    }
    assert!(pixel(&picture, 41, 41).iter().all(|&c| c < 40));
}

#[test]
fn bad_input_is_refused_with_both_numbers() {
    let rasterizer = rasterizer();
    let vertices = cube(Vec3::ZERO, 0.5, |_| Vec3::ONE);
    let short = Texture { width: 2, height: 2, rgba: &[0; 12] };
    let empty = Texture { width: 0, height: 2, rgba: &[] };
    let cases: [(Part, &[Texture], [u64; 2]); 4] = [
        ((0..37, None), &[], [36, 37]),
        ((0..36, Some(1)), &[Texture { width: 1, height: 1, rgba: &[0; 4] }], [1, 2]),
        ((0..36, None), &[short], [16, 12]),
        ((0..36, None), &[empty], [1, 0]),
    ];
    for (part, textures, numbers) in cases {
        match rasterizer.upload(&vertices, &[part], textures).map(|_| ()) {
            Err(RasterError::Input { expected, found, .. }) => assert_eq!([expected, found], numbers),
            other => panic!("{numbers:?}: {other:?}"),
        }
    }
    let cube = model(&rasterizer, &vertices);
    for side in [0, 100_000] {
        let result = rasterizer.render(&cube, &View { side, ..view(&DMat4::IDENTITY) });
        assert!(matches!(result, Err(RasterError::Input { found, .. }) if found == u64::from(side)), "{side}");
    }
    // Nothing to draw is a white picture.
    let nothing = rasterizer.upload(&[], &[], &[]).unwrap();
    assert!(rasterizer.render(&nothing, &view(&DMat4::IDENTITY)).unwrap().iter().all(|&byte| byte == 255));
}

#[test]
fn a_lost_device_is_an_error() {
    let gpu = Gpu::open(None).unwrap();
    let rasterizer = Rasterizer::new(&gpu).unwrap();
    let cube = model(&rasterizer, &cube(Vec3::ZERO, 0.5, |_| Vec3::ONE));
    gpu.device().destroy();
    assert!(matches!(rasterizer.render(&cube, &view(&DMat4::IDENTITY)), Err(RasterError::Device(_))));
}
