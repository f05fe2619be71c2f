//! This crate owns what tests share: the comparison of results, the device, plans with random inputs, and lockstep.
//! It does not know single kernels, nor the model.

pub mod between;
mod case;
mod close;
mod device;
pub mod golden;
mod lockstep;
pub mod peer;
pub mod table;

pub use case::{Case, Sketch};
pub use close::{assert_close, difference};
pub use device::{cooperative_gpu, gpu};
pub use lockstep::{Divergence, lockstep};
