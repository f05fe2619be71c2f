use srn_plan::Rows;
use srn_plan::ops::rays::{self, Pixels};
use srn_shaders::{RAYS_BACKWARD, RAYS_FORWARD};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &RAYS_FORWARD,
    // Worst 1.5e-7 on llvmpipe.
    tolerance: 8e-7,
    cases: forward,
    faults: &[
        ("forward", "intrinsics[k + 3u]", "intrinsics[k + 2u]"),
        ("forward", "params.first_group + ", "0u + "),
        ("forward", "ray / length(ray)", "ray"),
        ("forward", "z0[row] * ray", "z0[row] * d"),
        ("forward", ".distance * d", ".distance * ray"),
        ("forward", "eye - along * direction", "eye + along * direction"),
        ("forward", "max(radius * radius -", "max(radius -"),
        ("forward", "0.25 * radius * radius", "0.5 * radius * radius"),
        ("forward", "Beginning(-along - half", "Beginning(-along + half"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &RAYS_BACKWARD,
    // Worst 1.9e-7 on llvmpipe.
    tolerance: 1e-6,
    cases: backward,
    faults: &[
        ("backward", "d_d - direction", "d_d + direction"),
        ("backward", ") / norm;", ");"),
        ("backward", "d_t += d_o", "d_t = d_o"),
        ("backward", " + d_s * begins.d_eye", ""),
        ("backward", "+ begins.distance * d_o ", ""),
        ("backward", "+ d_s * begins.d_direction", ""),
        ("backward", "change * nearest - direction", "change * nearest"),
        ("backward", "change * nearest - direction", "-direction"),
        ("backward", "half > 0.5 * radius", "true"),
        ("backward", "(1.0 + change * along)", "(1.0 - change * along)"),
        ("backward", "12u * (params.first_group + group)", "12u * group"),
        ("backward", "first + params.chunk_rows", "params.chunk_rows"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

#[test]
fn backward_matches_reference() {
    BACKWARD.matches_reference();
}

/// Cameras (their matrices need not be rigid here) and pixels of 64 × 64 images.
fn pixels(s: &mut Sketch, rows: Rows, sphere: f32) -> Pixels {
    let images = (rows.first_group + rows.groups) as usize;
    let n = rows.count() as usize;
    let world_from_camera = s.random("world_from_camera", 12 * images);
    let intrinsics = s.numbers(4 * images).chunks(4).flat_map(|k| [80.0 + k[0], 90.0 + k[1], 32.0 + k[2], 30.0 + k[3]]).collect();
    let intrinsics = s.input("intrinsics", intrinsics);
    let uv = s.numbers(2 * n).into_iter().map(|value| 32.0 + 32.0 * value).collect();
    let uv = s.input("uv", uv);
    let z0 = s.random("z0", n);
    Pixels { world_from_camera, intrinsics, uv, z0, sphere }
}

/// Rays that begin at the camera, and on a sphere: cameras are inside and outside of it, and rays meet it or pass it.
fn all(case: fn(Rows, f32) -> Case) -> Vec<Case> {
    [0.0, 0.9].into_iter().flat_map(|sphere| ROWS.map(|rows| case(rows, sphere))).collect()
}

fn forward() -> Vec<Case> {
    all(forward_case)
}

fn forward_case(rows: Rows, sphere: f32) -> Case {
    let mut s = Sketch::new(format!("{rows:?}, sphere {sphere}"));
    let pixels = pixels(&mut s, rows, sphere);
    let [origin, direction] = ["origin", "direction"].map(|name| s.scratch(name, 3 * rows.count() as usize));
    s.step(|b| rays::forward(b, rows, pixels, origin, direction));
    s.finish()
}

fn backward() -> Vec<Case> {
    all(backward_case)
}

/// Images before the first of the tile keep their gradient.
fn backward_case(rows: Rows, sphere: f32) -> Case {
    let mut s = Sketch::new(format!("{rows:?}, sphere {sphere}"));
    let pixels = pixels(&mut s, rows, sphere);
    let [d_origin, d_direction] = ["d_origin", "d_direction"].map(|name| s.random(name, 3 * rows.count() as usize));
    let partial = s.scratch("partial", rays::partial_len(rows));
    let accumulate = rows.first_group > 0;
    let d_pose = s.output("d_world_from_camera", 12 * (rows.first_group + rows.groups) as usize, accumulate);
    s.step(|b| rays::backward(b, rows, pixels, d_origin, d_direction, partial, d_pose, accumulate));
    s.finish()
}
