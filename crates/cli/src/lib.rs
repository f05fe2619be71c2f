//! This crate owns the command lines: flags, progress, reports and exit codes. It does not know the network or the file formats.

pub mod common;
pub mod data;
pub mod pose;
pub mod render;
pub mod sets;
pub mod train;
