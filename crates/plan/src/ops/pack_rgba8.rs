//! Rendered colours to bytes that a texture takes.

use srn_shaders::{PACK_RGBA8_FORWARD, PackParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// Distance between packed rows, in pixels: texture copies want rows of a multiple of 256 bytes.
pub fn stride(width: u32) -> u32 {
    width.next_multiple_of(64)
}

/// Image number `image` of `rgb [images, height, width, 3]` → `packed [height, stride(width)]`, RGBA8.
pub fn forward(b: &mut Builder, width: u32, height: u32, image: u32, rgb: BufferId, packed: BufferId) -> Result<(), PlanError> {
    let params = PackParams { width, height, stride: stride(width), first_pixel: image * width * height };
    let args = [read(rgb, size([image + 1, width, height, 3])), overwrite(packed, size([stride(width), height]))];
    b.step(&PACK_RGBA8_FORWARD, params, &args, [width * height, 1, 1], 0, 0)
}
