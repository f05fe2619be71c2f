//! The reference of every kernel: same name, same parameters, plain slices.

pub mod adam;
pub mod advance;
pub mod bfgs;
pub mod density_sum;
pub mod depth;
pub mod depth_loss;
pub mod embedding;
pub mod gmsd;
pub mod image_loss;
pub mod latent_loss;
pub mod layer_norm_relu;
pub mod linear;
pub mod lstm_cell;
pub mod pack_rgba8;
pub mod pose;
pub mod rays;
pub mod sum;
pub mod tile;

use rayon::prelude::*;

/// Whether the kernel called `name` has a reference.
pub fn implements(name: &str) -> bool {
    crate::executor::REFERENCES.contains(&name)
}

/// Values of a block that one thread works on: small enough for the first cache, large enough to be worth a task.
const BLOCK_VALUES: usize = 16_384;

/// Rows per block for rows of `width` values.
fn block_rows(width: usize) -> usize {
    (BLOCK_VALUES / width.max(1)).max(1)
}

/// Calls `work(first_row, block)` for blocks of whole rows, in parallel.
fn for_rows<T: Send>(out: &mut [T], width: usize, work: impl Fn(usize, &mut [T]) + Sync) {
    let rows = block_rows(width);
    out.par_chunks_mut(rows * width).enumerate().for_each(|(block, out)| work(block * rows, out));
}

/// The same for two outputs with rows of different widths.
fn for_rows2<T: Send>(
    (a, a_width): (&mut [T], usize),
    (b, b_width): (&mut [T], usize),
    work: impl Fn(usize, &mut [T], &mut [T]) + Sync,
) {
    let rows = block_rows(a_width.max(b_width));
    a.par_chunks_mut(rows * a_width)
        .zip(b.par_chunks_mut(rows * b_width))
        .enumerate()
        .for_each(|(block, (a, b))| work(block * rows, a, b));
}

/// Part `index` of `0..count` cut into parts of `length`.
fn chunk_of(index: usize, length: u32, count: u32) -> std::ops::Range<usize> {
    let start = index * length as usize;
    start..(start + length as usize).min(count as usize)
}
