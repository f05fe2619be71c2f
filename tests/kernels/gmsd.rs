use srn_plan::ops::gmsd::{self, Images, Saved};
use srn_shaders::{GMSD_BACKWARD_POOL, GMSD_BACKWARD_SIMILARITY, GMSD_DEVIATION, GMSD_MOMENTS, GMSD_POOL, GMSD_SIMILARITY};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static POOL: KernelTest = KernelTest {
    kernel: &GMSD_POOL,
    // Worst 6.0e-8 on llvmpipe.
    tolerance: 3e-7,
    cases,
    faults: &[("pool", "* 0.5 + 0.5", "* 0.5 + 0.4"), ("pool", "row2 % height2", "row2 % width2"), ("pool", "+ dx)", ")")],
};

pub static SIMILARITY: KernelTest = KernelTest {
    kernel: &GMSD_SIMILARITY,
    // Worst 7.7e-7 on llvmpipe.
    tolerance: 4e-6,
    cases,
    faults: &[
        ("similarity", "reference[i][j] = target_luma", "reference[j][i] = luma"),
        ("similarity", "x <= size.x", "x < size.x"),
        ("similarity", "170.0 /", "160.0 /"),
        ("similarity", "down.z - down.x", "down.z + down.x"),
    ],
};

pub static MOMENTS: KernelTest = KernelTest {
    kernel: &GMSD_MOMENTS,
    // Worst 1.3e-7 on llvmpipe.
    tolerance: 7e-7,
    cases,
    faults: &[("moments", "q * q", "q"), ("moments", "* params.chunk;", "* params.chunks;")],
};

pub static DEVIATION: KernelTest = KernelTest {
    kernel: &GMSD_DEVIATION,
    // Worst 9.4e-8 on llvmpipe.
    tolerance: 5e-7,
    cases,
    faults: &[("deviation", "mean * mean", "mean"), ("deviation", "params.height / 2u", "params.height / 1u")],
};

pub static BACKWARD_SIMILARITY: KernelTest = KernelTest {
    kernel: &GMSD_BACKWARD_SIMILARITY,
    // Worst 5.4e-6 on llvmpipe.
    tolerance: 3e-5,
    cases,
    faults: &[
        ("backward_similarity", "b - a * q", "b + a * q"),
        ("backward_similarity", "moments[2u * image]", "moments[image]"),
        ("backward_similarity", "response / a;", "response;"),
        ("backward_similarity", "a > 0.0 &&", "a >= 0.0 &&"),
    ],
};

pub static BACKWARD_POOL: KernelTest = KernelTest {
    kernel: &GMSD_BACKWARD_POOL,
    // Worst 6.3e-8 on llvmpipe.
    tolerance: 4e-7,
    cases,
    faults: &[
        ("backward_pool", "- prewitt(down)", "+ prewitt(down)"),
        ("backward_pool", "d_luma / 4.0", "d_luma / 2.0"),
        ("backward_pool", "x < size.x &&", "x <= size.x &&"),
        ("backward_pool", "plane_x + pixels", "plane_x"),
    ],
};

#[test]
fn pool_matches_reference() {
    POOL.matches_reference();
}

#[test]
fn similarity_matches_reference() {
    SIMILARITY.matches_reference();
}

#[test]
fn moments_matches_reference() {
    MOMENTS.matches_reference();
}

#[test]
fn deviation_matches_reference() {
    DEVIATION.matches_reference();
}

#[test]
fn backward_similarity_matches_reference() {
    BACKWARD_SIMILARITY.matches_reference();
}

#[test]
fn backward_pool_matches_reference() {
    BACKWARD_POOL.matches_reference();
}

/// All kernels in their order, as each needs what the ones before it computed.
fn cases() -> Vec<Case> {
    [(1, 2, 2), (1, 9, 7), (3, 16, 12), (2, 41, 36)].map(|(count, width, height)| case(Images { count, width, height })).into()
}

/// The upper half is white in render and target: magnitudes of exactly zero.
fn case(images: Images) -> Case {
    let mut s = Sketch::new(format!("{images:?}"));
    let image = (3 * images.width * images.height) as usize;
    let [rgb, target_rgb] = ["rgb", "target_rgb"].map(|name| {
        let mut values = s.numbers(images.count as usize * image);
        if images.height > 2 {
            values.chunks_mut(image).for_each(|values| values[..image / 2].fill(1.0));
        }
        s.input(name, values)
    });
    let pooled = (images.count * images.pooled()) as usize;
    let [luma, target_luma, quality] = ["luma", "target_luma", "quality"].map(|name| s.scratch(name, pooled));
    let moments = s.scratch("moments", 2 * images.count as usize);
    let saved = Saved { luma, target_luma, quality, moments };
    let partial = s.scratch("partial", images.partial_len());
    let loss = s.scratch("loss", images.count as usize);
    let d_response = s.scratch("d_response", 2 * pooled);
    let d_rgb = s.scratch("d_rgb", images.count as usize * image);
    s.step(|b| gmsd::pool(b, images, rgb, luma));
    s.step(|b| gmsd::pool(b, images, target_rgb, target_luma));
    s.step(|b| gmsd::similarity(b, images, saved));
    s.step(|b| gmsd::deviation(b, images, saved, partial, loss));
    s.step(|b| gmsd::backward(b, images, 0.3, saved, loss, d_response, d_rgb));
    s.finish()
}
