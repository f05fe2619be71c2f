//! `sigma-pose`: poses of pictures, the paper's protocol on a data set, novel views.

pub mod bake;
pub mod calibrate;
mod draw;
pub mod estimate;
pub mod evaluate;
mod files;
mod given;
mod heldout;
mod mask;
mod notation;
mod outline;
mod record;
pub mod render;
mod saved;
mod search;
mod summary;
mod symmetry;
mod tables;
pub mod track;
mod views;

/// A finite number above zero.
fn positive(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(x) if x > 0.0 && f64::is_finite(x) => Ok(x),
        _ => Err("expected a number above 0".into()),
    }
}
