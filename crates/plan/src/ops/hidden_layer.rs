//! A linear layer and a norm with its ReLU in one: [`super::linear`] and [`super::layer_norm_relu`]. Plans have two steps; [`joined`] makes one of
//! them for a device that is faster so.

use srn_shaders::{HIDDEN_LAYER_BACKWARD_INPUT, HIDDEN_LAYER_FORWARD, HiddenLayerParams, LayerNormParams, LinearParams};

use super::layer_norm_relu::Saved;
use super::linear::{Layer, loops};
use super::{overwrite, read, size, update};
use crate::{BufferId, Builder, PlanError, Rows, Step};

/// `x [rows, in]` → `norm.x` (what the norm reads) and `y`, both `[rows, out]`; overwrites them and `norm.stats`.
pub fn forward(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    x: BufferId,
    slots: BufferId,
    norm: Saved,
    y: BufferId,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let values = size([rows.count(), layer.out_features]);
    let args = [
        read(x, size([rows.count(), layer.in_features])),
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        read(norm.affine, size([2, layer.out_features])),
        overwrite(norm.x, values),
        overwrite(y, values),
        overwrite(norm.stats, size([rows.count(), 2])),
    ];
    let params = params(layer.params(rows, false), norm.centred.into());
    b.step(&HIDDEN_LAYER_FORWARD, params, &args, extent(params), loops(layer.in_features), layer.flops(rows))
}

/// `d_z [rows, out]` of this layer → `d_y`, and in its own place `d_z`, of the one before, both `[rows, in]`, `in = out`; `norm` is that of the one before.
pub fn backward_input(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    slots: BufferId,
    norm: Saved,
    d_y: BufferId,
    d_z: BufferId,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let values = size([rows.count(), layer.in_features]);
    let args = [
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        read(norm.x, values),
        read(norm.stats, size([rows.count(), 2])),
        read(norm.affine, size([2, layer.in_features])),
        overwrite(d_y, values),
        update(d_z, values),
    ];
    let params = params(layer.params(rows, false), norm.centred.into());
    b.step(&HIDDEN_LAYER_BACKWARD_INPUT, params, &args, extent(params), loops(layer.out_features), layer.flops(rows))
}

/// What does the work of two steps, if they are a linear layer and the norm of what it makes, forward or back, with nothing in between.
pub fn joined(first: &Step, second: &Step) -> Option<Step> {
    let (kernel, buffers) = match (first.kernel.name, second.kernel.name) {
        ("linear/forward", "layer_norm_relu/forward") => {
            let (&[x, weights, slots, z], &[normed, affine, y, stats]) = (&first.buffers[..], &second.buffers[..]) else {
                return None;
            };
            (normed == z).then_some((&HIDDEN_LAYER_FORWARD, vec![x, weights, slots, affine, z, y, stats]))?
        }
        ("linear/backward_input", "layer_norm_relu/backward_input") => {
            let (&[after, weights, slots, d_y], &[x, stats, affine, of_y, d_z]) = (&first.buffers[..], &second.buffers[..])
            else {
                return None;
            };
            (of_y == d_y && after == d_z)
                .then_some((&HIDDEN_LAYER_BACKWARD_INPUT, vec![weights, slots, x, stats, affine, d_y, d_z]))?
        }
        _ => return None,
    };
    let (map, norm): (LinearParams, LayerNormParams) = (first.params(), second.params());
    let is_forward = kernel.name == HIDDEN_LAYER_FORWARD.name;
    // Forward there are no parts of sums; back one has the place of the other.
    let fits = map.accumulate == 0 && (is_forward || (map.chunks == 1 && map.in_features == map.out_features));
    // What is written is bound once.
    let written = || kernel.bindings.iter().zip(&buffers).filter(|(binding, _)| binding.written);
    let is_distinct = written().all(|(_, id)| buffers.iter().filter(|other| *other == id).count() == 1);
    let params = params(map, norm.centred);
    (fits && is_distinct).then(|| Step {
        kernel,
        buffers,
        params: bytemuck::bytes_of(&params).to_vec(),
        extent: extent(params),
        flops: first.flops + second.flops,
    })
}

fn params(map: LinearParams, centred: u32) -> HiddenLayerParams {
    HiddenLayerParams {
        groups: map.groups,
        rows_per_group: map.rows_per_group,
        first_group: map.first_group,
        in_features: map.in_features,
        out_features: map.out_features,
        weight_stride: map.weight_stride,
        centred,
    }
}

fn extent(params: HiddenLayerParams) -> [u32; 3] {
    [params.rows_per_group, 1, params.groups]
}
