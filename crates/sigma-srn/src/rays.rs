use glam::DMat4;
use srn_plan::{Executor, ExecutorError};

use crate::camera::{Intrinsics, to_rows};
use crate::network::Network;
use crate::random::{Random, initial_depths};

/// Rays of a batch of images, the same number for each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rays {
    /// 3×4 row-major per image; empty where poses are estimated.
    pub world_from_camera: Vec<[f64; 12]>,
    /// fx, fy, cx, cy per image.
    pub intrinsics: Vec<[f32; 4]>,
    /// Pixel coordinates `[images, rays, 2]`, with the pixel-centre offset.
    pub uv: Vec<f32>,
    /// Initial depths `[images, rays]` (spec 2).
    pub z0: Vec<f32>,
}

impl Rays {
    /// Appends an image: the rays through `pixels` of a camera, initial depths drawn from `random`.
    pub fn push(
        &mut self,
        world_from_camera: &DMat4,
        intrinsics: &Intrinsics,
        pixels: impl IntoIterator<Item = (u32, u32)>,
        random: &mut Random,
    ) {
        self.world_from_camera.push(to_rows(world_from_camera));
        self.intrinsics.push(intrinsics.to_array());
        let before = self.uv.len() / 2;
        for (u, v) in pixels {
            self.uv.extend([u, v].map(|value| (f64::from(value) + intrinsics.pixel_center) as f32));
        }
        self.z0.extend(initial_depths(random, self.uv.len() / 2 - before));
    }

    /// Writes everything but the poses.
    pub(crate) fn write(&self, executor: &mut dyn Executor, network: &Network) -> Result<(), ExecutorError> {
        executor.write(network.intrinsics, self.intrinsics.as_flattened())?;
        executor.write(network.uv, &self.uv)?;
        executor.write(network.z0, &self.z0)
    }
}

/// What the losses compare with: the colour of each ray and how much it counts, `[rays, 4]`; without `weights`, 1 for all.
pub(crate) fn wanted(rgb: &[f32], weights: Option<&[f32]>) -> Vec<f32> {
    let weights = weights.unwrap_or_default().iter().copied().chain(std::iter::repeat(1.0));
    let mut wanted = Vec::with_capacity(rgb.len() / 3 * 4);
    for (rgb, weight) in rgb.chunks(3).zip(weights) {
        wanted.extend(rgb);
        wanted.push(weight);
    }
    wanted
}

/// All pixels of an image in row-major order, or every `stride`-th of every `stride`-th row.
pub fn pixel_grid(width: u32, height: u32, stride: u32) -> impl Iterator<Item = (u32, u32)> {
    let stride = stride.max(1);
    let first = stride / 2;
    (first..height).step_by(stride as usize).flat_map(move |v| (first..width).step_by(stride as usize).map(move |u| (u, v)))
}
