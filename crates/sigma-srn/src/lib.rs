//! This crate owns the σSRN model: its weights, the renderer, training and pose estimation, written once as plans for the
//! executors. It does not know files other than models, nor command lines.
//!
//! The equations of the paper (arXiv 2305.17252) stand in its order in `network/forward.rs`: hypernetwork, rays, scene MLP f,
//! LSTM ray marcher, density net g, density-weighted sum, pixel generator h; `network/backward.rs` mirrors it.
//! Conventions: OpenCV camera axes (x right, y down, z forward), `world_from_camera`, world z up, lengths in object units
//! (the object's bounding-box diagonal is 1), colours in [-1, 1].

pub mod camera;
mod cholesky;
pub mod confidence;
mod descent;
mod engine;
mod error;
mod estimator;
mod light;
mod mask;
mod model;
mod network;
pub mod photo;
mod random;
mod rays;
mod region;
mod renderer;
mod search;
mod torch;
mod tracker;
mod trainer;
mod unseen;

pub use camera::{Intrinsics, Pose6};
pub use confidence::{Calibration, Confidence, Doubt, Seen, unexplained};
pub use descent::{Descent, Loss, Method, Shape};
pub use engine::Engine;
pub use error::Error;
pub use estimator::{Effort, Estimate, Options, Phase, Progress, Query, Ranked, estimate};
pub use light::Light;
pub use mask::Outline;
pub use model::{Block, Hypernetwork, Kind, Layout, Metadata, Model, ModelConfig, Parameter, Source, write_atomically};
pub use random::{Random, stream};
pub use rays::{Rays, pixel_grid};
pub use renderer::{Renderer, Rendering, View, render_views};
pub use search::{Found, Search};
#[cfg(not(target_family = "wasm"))]
pub use srn_gpu::adapters;
pub use srn_gpu::{AdapterInfo, Choice, Gpu, wgpu};
pub use tracker::{Tracked, Tracker};
pub use trainer::{Losses, Train, Trainer, TrainingBatch};
pub use unseen::{Unseen, estimate_unseen};

/// The README's code, compiled and run as a documentation test.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
pub struct Readme;
