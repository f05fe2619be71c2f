//! This crate owns the command lines: flags, progress, reports and exit codes. It does not know the network or the file formats.

pub mod common;
pub mod data;
mod meshes;
pub mod pose;
mod progress;
pub mod render;
pub mod sets;
pub mod train;
