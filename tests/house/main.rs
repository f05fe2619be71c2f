//! What the project promises about itself, checked without a GPU.

mod shaders;
