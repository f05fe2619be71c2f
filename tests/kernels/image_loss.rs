use srn_plan::Rows;
use srn_plan::ops::image_loss::{self, Kind};
use srn_shaders::{IMAGE_LOSS_BACKWARD, IMAGE_LOSS_COUNT, IMAGE_LOSS_FORWARD};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static COUNT: KernelTest = KernelTest {
    kernel: &IMAGE_LOSS_COUNT,
    // Sums of quarters.
    tolerance: 0.0,
    cases: whole_images,
    faults: &[
        ("count", "!= 1.0", "== 1.0"),
        ("count", "% params.chunks)", "/ params.chunks)"),
        ("count", "4u * row + 3u", "4u * row"),
    ],
};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &IMAGE_LOSS_FORWARD,
    // Worst 8.2e-7 on llvmpipe.
    tolerance: 5e-6,
    cases: whole_images,
    faults: &[
        ("forward", "1.0 + count[image]", "count[image]"),
        ("forward", "params.kind == MSE", "params.kind == MAE"),
        ("forward", "|| params.kind == NORM_L2) {", "|| params.kind == MAE) {"),
        ("forward", "group * params.rows_per_group;", "params.rows_per_group;"),
        ("forward", "wanted[4u * row + 3u] *", ""),
        ("forward", "+ params.soft)", ")"),
        ("forward", "params.kind == CHARBONNIER", "false"),
        ("forward", "first + params.chunk_rows", "params.chunk_rows"),
    ],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &IMAGE_LOSS_BACKWARD,
    // Worst 1.1e-7 on llvmpipe.
    tolerance: 6e-7,
    cases: tiles,
    faults: &[
        ("backward", "params.first_group + i", "0u + i"),
        ("backward", "sign(e)", "select(-1.0, 1.0, e >= 0.0)"),
        ("backward", "2.0 * e", "e"),
        ("backward", "wanted[4u * row + 3u] *", ""),
        ("backward", "wanted[i + row]", "wanted[i]"),
        ("backward", "e / sqrt", "e * sqrt"),
        ("backward", "f32(params.values_per_image)", "f32(params.rows_per_group)"),
    ],
};

#[test]
fn count_matches_reference() {
    COUNT.matches_reference();
}

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

#[test]
fn backward_matches_reference() {
    BACKWARD.matches_reference();
}

const KINDS: [Kind; 5] = [Kind::Mae, Kind::Mse, Kind::NormL1, Kind::NormL2, Kind::Charbonnier { soft: 0.2 }];

/// Render `[rows,3]`, and what is wanted `[rows,4]`: every fifth value is white, every seventh is met exactly; some rows count less,
/// some not at all.
fn pictures(s: &mut Sketch, rows: usize) -> [Vec<f32>; 2] {
    let [mut rgb, mut target] = [(); 2].map(|()| s.numbers(3 * rows));
    target.iter_mut().step_by(5).for_each(|target| *target = 1.0);
    rgb.iter_mut().zip(&target).skip(1).step_by(7).for_each(|(rgb, target)| *rgb = *target);
    let weights = [1.0, 0.25, 0.0, 1.0, 1.75].iter().cycle();
    let wanted = target.chunks(3).zip(weights).flat_map(|(rgb, &weight)| [rgb[0], rgb[1], rgb[2], weight]).collect();
    [rgb, wanted]
}

fn whole_images() -> Vec<Case> {
    let sizes = [(1, 1), (3, 7), (2, 300), (1, 1000)];
    sizes.iter().flat_map(|&(images, pixels)| KINDS.map(|kind| whole_images_case(kind, images, pixels))).collect()
}

fn whole_images_case(kind: Kind, images: u32, pixels: u32) -> Case {
    let mut s = Sketch::new(format!("{kind:?}, {images} images of {pixels} pixels"));
    let [rgb, wanted] = pictures(&mut s, (images * pixels) as usize);
    let rgb = s.input("rgb", rgb);
    let wanted = s.input("wanted", wanted);
    let partial = s.scratch("partial", image_loss::partial_len(images, pixels));
    let [count, loss] = ["count", "loss"].map(|name| s.scratch(name, images as usize));
    s.step(|b| image_loss::count(b, images, pixels, wanted, partial, count));
    s.step(|b| image_loss::forward(b, kind, images, pixels, rgb, wanted, count, partial, loss));
    s.finish()
}

fn tiles() -> Vec<Case> {
    ROWS.iter().flat_map(|&rows| KINDS.map(|kind| tile_case(kind, rows))).collect()
}

/// A tile holds some of the pixels of its images.
fn tile_case(kind: Kind, rows: Rows) -> Case {
    let mut s = Sketch::new(format!("{kind:?}, {rows:?}"));
    let n = 3 * rows.count() as usize;
    let [rgb, wanted] = pictures(&mut s, rows.count() as usize);
    let rgb = s.input("rgb", rgb);
    let wanted = s.input("wanted", wanted);
    let count = s.input("count", (0..rows.first_group + rows.groups).map(|image| 10.0 + image as f32).collect());
    let d_rgb = s.scratch("d_rgb", n);
    s.step(|b| image_loss::backward(b, kind, rows, 2 * rows.rows_per_group, 0.3, rgb, wanted, count, d_rgb));
    s.finish()
}
