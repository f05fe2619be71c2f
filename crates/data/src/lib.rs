//! This crate owns images, SRN data sets, meshes, and the cameras that look at them.
//! It does not know the network, the GPU or the command line, and it never prints.
//!
//! Conventions, everywhere: camera axes x right, y down, z forward; `world_from_camera` maps camera to world; the world is
//! z-up; objects have a unit bounding-box diagonal centred at the origin; pixel `(u, v)` is the *centre* of a pixel, row-major
//! `v·W + u`; images are RGB in [-1, 1].

pub mod ac3d;
pub mod camera;
pub mod capture;
mod error;
pub mod formats;
pub mod gltf;
pub mod inspect;
pub mod ldraw;
pub mod masks;
pub mod mesh;
pub mod obj;
mod picture;
pub mod pixels;
pub mod ply;
pub mod sheet;
pub mod srn;
pub mod stl;
pub mod target;
pub mod vrml;

pub use camera::Camera;
pub use capture::Capture;
pub use error::{Error, Result};
pub use mesh::Mesh;
pub use srn::{Dataset, Instance, LoadedView, SrnSet};
