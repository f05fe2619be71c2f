//! One function per kernel: checks the shapes by name, fills the parameters, appends the step.
//!
//! Arguments come in the order of the kernel's bindings, inputs before outputs; `accumulate` says whether an output is
//! overwritten or added to. Formulas and shapes stand at the kernel's entry in `srn_shaders::TABLE`.

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

use crate::{Access, Arg, BufferId};

fn read(buffer: BufferId, len: usize) -> Arg {
    Arg(buffer, len, Access::Read)
}

fn overwrite(buffer: BufferId, len: usize) -> Arg {
    Arg(buffer, len, Access::Overwrite)
}

fn update(buffer: BufferId, len: usize) -> Arg {
    Arg(buffer, len, Access::Update)
}

fn output(buffer: BufferId, len: usize, accumulate: bool) -> Arg {
    Arg(buffer, len, if accumulate { Access::Update } else { Access::Overwrite })
}

/// Product of sizes, as a length.
fn size<const N: usize>(factors: [u32; N]) -> usize {
    factors.iter().map(|&factor| factor as usize).product()
}
