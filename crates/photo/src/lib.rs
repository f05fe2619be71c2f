//! This crate owns photographs in memory: what of one is the object, and the square around it that a model's views are compared with.
//! It does not know files, the network or the GPU, and it never prints.
//!
//! Conventions: pixel `(u, v)` is the *centre* of a pixel, row-major `v·W + u`; images are RGB in [-1, 1], their background white.

mod colours;
mod photo;
mod pixels;
mod segment;
pub mod silhouettes;

pub use photo::{MARGIN, Photo, Square};
pub use pixels::Pixels;
pub use segment::{BoundingBox, Guess, Known, Place};
