//! [`super::linear`] and [`super::layer_norm_relu`], one after the other.

use srn_shaders::{HiddenLayerParams, LayerNormParams, LinearParams};

use super::{layer_norm_relu, linear};
use crate::Real;

/// `z = W x + b`, then `y = relu(gamma ẑ + beta)`, with `ẑ = (z - mean) rstd`.
pub fn forward<T: Real>(
    p: HiddenLayerParams,
    x: &[T],
    weights: &[T],
    slots: &[u32],
    affine: &[T],
    z: &mut [T],
    y: &mut [T],
    stats: &mut [T],
) {
    linear::forward(map(p), x, weights, slots, z);
    layer_norm_relu::forward(norm(p, p.out_features), z, affine, y, stats);
}

/// `d_y = Wᵀ d_z`, then in the place of `d_z` the gradient to `x`, from which the layer before made what this one read.
pub fn backward_input<T: Real>(
    p: HiddenLayerParams,
    weights: &[T],
    slots: &[u32],
    x: &[T],
    stats: &[T],
    affine: &[T],
    d_y: &mut [T],
    d_z: &mut [T],
) {
    linear::backward_input(map(p), d_z, weights, slots, d_y);
    layer_norm_relu::backward_input(norm(p, p.in_features), x, stats, affine, d_y, d_z);
}

/// The linear map alone.
fn map(p: HiddenLayerParams) -> LinearParams {
    LinearParams {
        groups: p.groups,
        rows_per_group: p.rows_per_group,
        first_group: p.first_group,
        in_features: p.in_features,
        out_features: p.out_features,
        weight_stride: p.weight_stride,
        chunk_outs: p.out_features,
        chunks: 1,
        ..Default::default()
    }
}

/// The norm alone.
fn norm(p: HiddenLayerParams, features: u32) -> LayerNormParams {
    LayerNormParams { rows: p.groups * p.rows_per_group, features, centred: p.centred, ..Default::default() }
}
