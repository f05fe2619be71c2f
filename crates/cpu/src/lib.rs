//! This crate owns the reference of every op, in `f32` and `f64`, and the executor that runs a plan on the CPU.
//! It does not know the model, the GPU or files.
//!
//! In `f64` it is the oracle that the WGSL kernels are tested against; in `f32`, threaded, it is the fallback for a machine
//! without a GPU. The functions in [`ops`] take the parameter struct of the kernel and plain slices, inputs before outputs.

mod aligned;
mod chain;
mod executor;
mod hidden_layer;
mod layer;
pub mod ops;
mod real;
mod simd;

pub use chain::{part_rows, rows_for_all_threads};
pub use executor::{Precision, executor};
pub use real::Real;
