//! The reference of every kernel: same name, same parameters, plain slices.

pub mod adam;
pub mod advance;
pub mod bfgs;
pub mod density_sum;
pub mod depth;
pub mod depth_loss;
pub mod embedding;
pub mod gmsd;
pub mod hidden_layer;
pub mod image_loss;
pub mod latent_loss;
pub mod layer_norm_relu;
pub mod linear;
pub mod lstm_cell;
pub mod pack_rgba8;
pub mod point_layer;
pub mod pose;
pub mod rays;
pub mod sum;
pub mod tile;

/// Whether the kernel called `name` has a reference.
pub fn implements(name: &str) -> bool {
    crate::executor::REFERENCES.contains(&name)
}

/// Values of a block that one thread works on: small enough for the first cache, large enough to be worth a task.
const BLOCK_VALUES: usize = 16_384;

/// Of sets of `length` weights that begin every `stride` values, the one that a group of rows uses; with no stride all share one.
fn set_of<'a, T>(weights: &'a [T], length: usize, stride: u32, slots: &[u32], group: usize) -> &'a [T] {
    let start = if stride == 0 { 0 } else { slots[group] as usize * stride as usize };
    &weights[start..start + length]
}

/// Part `index` of `0..count` cut into parts of `length`.
fn chunk_of(index: usize, length: u32, count: u32) -> std::ops::Range<usize> {
    let start = index * length as usize;
    start..(start + length as usize).min(count as usize)
}
