//! Gradient magnitude similarity deviation of whole images (spec 4).

use srn_shaders::{
    GMSD_BACKWARD_POOL, GMSD_BACKWARD_SIMILARITY, GMSD_DEVIATION, GMSD_MOMENTS, GMSD_POOL, GMSD_SIMILARITY, GmsdParams,
};

use super::{overwrite, read, sum};
use crate::{BufferId, Builder, PlanError};

/// Pooled pixels per partial sum.
const CHUNK: u32 = 256;

/// Sizes of the images.
#[derive(Clone, Copy, Debug)]
pub struct Images {
    /// How many.
    pub count: u32,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Images {
    /// Pixels of one image after 2×2 pooling.
    pub fn pooled(self) -> u32 {
        (self.width / 2) * (self.height / 2)
    }

    fn pooled_len(self) -> usize {
        self.count as usize * self.pooled() as usize
    }

    fn rgb_len(self) -> usize {
        3 * self.count as usize * self.width as usize * self.height as usize
    }

    fn extent(self) -> [u32; 3] {
        [self.count * self.pooled(), 1, 1]
    }

    /// Length of the partial sums of [`deviation`].
    pub fn partial_len(self) -> usize {
        2 * self.count as usize * self.pooled().div_ceil(CHUNK) as usize
    }

    fn params(self, scale: f32) -> GmsdParams {
        let Images { count, width, height } = self;
        GmsdParams { images: count, width, height, chunk: CHUNK, chunks: self.pooled().div_ceil(CHUNK), scale }
    }
}

/// Maps of the forward pass: kept for the way back.
#[derive(Clone, Copy, Debug)]
pub struct Saved {
    /// Pooled luma of the render `[images, h2·w2]`.
    pub luma: BufferId,
    /// Pooled luma of the target.
    pub target_luma: BufferId,
    /// Similarity map.
    pub quality: BufferId,
    /// `[images, 2]`: sums of `q - 1` and its square.
    pub moments: BufferId,
}

/// `rgb [images, height, width, 3]` → pooled `luma`.
pub fn pool(b: &mut Builder, images: Images, rgb: BufferId, luma: BufferId) -> Result<(), PlanError> {
    let args = [read(rgb, images.rgb_len()), overwrite(luma, images.pooled_len())];
    b.step(&GMSD_POOL, images.params(0.0), &args, images.extent(), 4, 0)
}

/// Both lumas → `quality`.
pub fn similarity(b: &mut Builder, images: Images, saved: Saved) -> Result<(), PlanError> {
    let n = images.pooled_len();
    let args = [read(saved.luma, n), read(saved.target_luma, n), overwrite(saved.quality, n)];
    b.step(&GMSD_SIMILARITY, images.params(0.0), &args, images.extent(), 18, 0)
}

/// `quality` → `moments` → `loss [images]`, by way of `partial`.
pub fn deviation(b: &mut Builder, images: Images, saved: Saved, partial: BufferId, loss: BufferId) -> Result<(), PlanError> {
    let params = images.params(0.0);
    let args = [read(saved.quality, images.pooled_len()), overwrite(partial, images.partial_len())];
    b.step(&GMSD_MOMENTS, params, &args, [images.count * params.chunks, 1, 1], CHUNK.into(), 0)?;
    sum::forward(b, sum::Groups::all(images.count), params.chunks, 2, partial, saved.moments, false)?;
    let args = [read(saved.moments, 2 * images.count as usize), overwrite(loss, images.count as usize)];
    b.step(&GMSD_DEVIATION, params, &args, [images.count, 1, 1], 0, 0)
}

/// `d_rgb [images, height, width, 3]` of `scale · Σ_images loss`, by way of `d_response [images, 2, h2·w2]`; overwrites.
pub fn backward(
    b: &mut Builder,
    images: Images,
    scale: f32,
    saved: Saved,
    loss: BufferId,
    d_response: BufferId,
    d_rgb: BufferId,
) -> Result<(), PlanError> {
    let n = images.pooled_len();
    let args = [
        read(saved.luma, n),
        read(saved.target_luma, n),
        read(saved.quality, n),
        read(saved.moments, 2 * images.count as usize),
        read(loss, images.count as usize),
        overwrite(d_response, 2 * n),
    ];
    b.step(&GMSD_BACKWARD_SIMILARITY, images.params(scale), &args, images.extent(), 18, 0)?;
    let args = [read(d_response, 2 * n), overwrite(d_rgb, images.rgb_len())];
    let pixels = images.count * images.width * images.height;
    b.step(&GMSD_BACKWARD_POOL, images.params(0.0), &args, [pixels, 1, 1], 18, 0)
}
