//! This crate owns the scheduler: adapters, devices, pipelines, buffers, dispatches, read-back and timing of plans on wgpu.
//! It does not know the model, nor what the kernels compute.
//!
//! [`Gpu`] is a device, opened here or borrowed from an application; [`GpuExecutor`] runs one plan on it. Everything that
//! does not change between runs is made once, when the executor is: buffers, pipelines, parameters, bind groups, grids.
//!
//! Errors of wgpu never panic: what a call causes comes back from that call, what the device reports later (a lost device)
//! from the next one (in a browser, all), and an executor with a failed run answers every read with that failure.

mod choice;
mod executor;
mod gpu;
mod launch;
mod pipeline;
mod profile;
pub mod raster;

pub use choice::{Choice, cache_folder};
pub use executor::GpuExecutor;
pub use gpu::{AdapterInfo, Gpu};
#[cfg(not(target_family = "wasm"))]
pub use gpu::{OpenError, adapters};
pub use profile::KernelTime;
/// The version of wgpu whose devices, encoders and buffers this crate takes and gives.
pub use wgpu;
