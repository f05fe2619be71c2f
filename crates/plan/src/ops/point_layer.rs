//! The first layer of a network of points, whose weights take no gradient: [`super::linear`] and [`super::layer_norm_relu`] in one. Nothing is
//! kept for the way back but the points.

use srn_shaders::{POINT_LAYER_BACKWARD_INPUT, POINT_LAYER_FORWARD, PointLayerParams};

use super::linear::Layer;
use super::{output, overwrite, read, size};
use crate::{BufferId, Builder, PlanError, Rows};

/// Coordinates of a point: `in_features` of the layer.
pub const COORDINATES: u32 = 3;

/// `x [rows, 3]` → `y [rows, out]`; `affine [2, out]` = (gamma, beta).
pub fn forward(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    x: BufferId,
    slots: BufferId,
    affine: BufferId,
    y: BufferId,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let features = layer.out_features;
    let args = [
        read(x, size([rows.count(), COORDINATES])),
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        read(affine, size([2, features])),
        overwrite(y, size([rows.count(), features])),
    ];
    let extent = [rows.rows_per_group, 1, rows.groups];
    b.step(&POINT_LAYER_FORWARD, params(rows, layer, false), &args, extent, 3 * u64::from(features), layer.flops(rows))
}

/// `d_x [rows, 3] (+)=` the gradient of [`forward`] from `d_y [rows, out]`.
pub fn backward_input(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    x: BufferId,
    slots: BufferId,
    affine: BufferId,
    d_y: BufferId,
    d_x: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let features = layer.out_features;
    let points = size([rows.count(), COORDINATES]);
    let args = [
        read(x, points),
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        read(affine, size([2, features])),
        read(d_y, size([rows.count(), features])),
        output(d_x, points, accumulate),
    ];
    let extent = [rows.rows_per_group, 1, rows.groups];
    let loops = 4 * u64::from(features) + 3;
    b.step(&POINT_LAYER_BACKWARD_INPUT, params(rows, layer, accumulate), &args, extent, loops, layer.flops(rows))
}

fn params(rows: Rows, layer: Layer, accumulate: bool) -> PointLayerParams {
    PointLayerParams {
        groups: rows.groups,
        rows_per_group: rows.rows_per_group,
        first_group: rows.first_group,
        features: layer.out_features,
        weight_stride: layer.stride(),
        accumulate: accumulate.into(),
    }
}
