use srn_plan::ops::pack_rgba8;
use srn_shaders::PACK_RGBA8_FORWARD;
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &PACK_RGBA8_FORWARD,
    // Worst 0 on llvmpipe; drivers may round a byte the other way.
    tolerance: 1.0 / 255.0,
    cases,
    faults: &[
        ("forward", "* 0.5 + 0.5", "* 0.5 + 0.4"),
        ("forward", "params.first_pixel + pixel", "pixel"),
        ("forward", "* params.stride", "* params.width"),
        ("forward", "rgb[at], rgb[at + 1u]", "rgb[at + 1u], rgb[at]"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

fn cases() -> Vec<Case> {
    [(1, 1, 0), (5, 7, 2), (64, 2, 1), (70, 3, 0)].map(|(width, height, image)| case(width, height, image)).into()
}

/// Some colours lie outside of [-1, 1].
fn case(width: u32, height: u32, image: u32) -> Case {
    let mut s = Sketch::new(format!("image {image} of {width} × {height}"));
    let rgb = s.numbers(3 * ((image + 1) * width * height) as usize);
    let rgb = s.input("rgb", rgb.into_iter().map(|value| 1.2 * value).collect());
    let packed = s.builder().scratch_u32("packed", (pack_rgba8::stride(width) * height) as usize).expect("a small buffer");
    s.step(|b| pack_rgba8::forward(b, width, height, image, rgb, packed));
    s.finish()
}
