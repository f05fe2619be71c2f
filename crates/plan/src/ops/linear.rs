//! Linear layers, with one set of weights or one per instance. The work of the renderer is almost all here.

use srn_shaders::{LINEAR_BACKWARD_INPUT, LINEAR_BACKWARD_WEIGHT, LINEAR_FORWARD, LinearParams};

use super::{output, read, size, sum};
use crate::{BufferId, Builder, Parts, PlanError, Rows};

/// Output features that one sum of [`backward_input`] goes over at most: bounds the loop of one invocation. Longer sums go in parts.
const MOST_OUT: u32 = 16_384;
/// The same of so few rows that they would leave most of a GPU idle: parts run side by side.
const MOST_OUT_OF_FEW: u32 = 1024;
const FEW_ROWS: u32 = 1024;

/// A linear layer: its sizes and where its weights are.
#[derive(Clone, Copy, Debug)]
pub struct Layer {
    /// `[sets, out·in + out]`: weight row-major, then bias.
    pub weights: BufferId,
    /// Values per input row.
    pub in_features: u32,
    /// Values per output row.
    pub out_features: u32,
    /// Number of sets of weights; with more than one, `slots` chooses.
    pub sets: Sets,
}

/// Which weights a group of rows uses.
#[derive(Clone, Copy, Debug)]
pub enum Sets {
    /// All groups share one set.
    Shared,
    /// Group `g` uses set `slots[first_group + g]` of `count`.
    Slots {
        /// Number of sets.
        count: u32,
    },
}

impl Layer {
    /// Weight and bias together.
    pub fn parameters(&self) -> u32 {
        self.out_features * self.in_features + self.out_features
    }

    pub(super) fn stride(&self) -> u32 {
        match self.sets {
            Sets::Shared => 0,
            Sets::Slots { .. } => self.parameters(),
        }
    }

    pub(super) fn weights_len(&self) -> usize {
        match self.sets {
            Sets::Shared => size([self.parameters()]),
            Sets::Slots { count } => size([count, self.parameters()]),
        }
    }

    /// Groups do not matter to shared weights: one group of all rows makes the widest dispatch.
    pub(super) fn rows(&self, rows: Rows) -> Rows {
        match self.sets {
            Sets::Shared => Rows::plain(rows.count()),
            Sets::Slots { .. } => rows,
        }
    }

    pub(super) fn params(&self, rows: Rows, accumulate: bool) -> LinearParams {
        LinearParams {
            groups: rows.groups,
            rows_per_group: rows.rows_per_group,
            first_group: rows.first_group,
            in_features: self.in_features,
            out_features: self.out_features,
            weight_stride: self.stride(),
            accumulate: accumulate.into(),
            ..Default::default()
        }
    }

    pub(super) fn flops(&self, rows: Rows) -> u64 {
        2 * u64::from(rows.count()) * u64::from(self.in_features) * u64::from(self.out_features)
    }
}

/// Most loop iterations of an invocation that sums over `terms`: one for each and for each sixteen, and some to store.
pub(super) fn loops(terms: u32) -> u64 {
    u64::from(terms) + u64::from(terms) / 16 + 64
}

/// `y [rows, out] (+)= x [rows, in] Wᵀ + b`.
pub fn forward(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    x: BufferId,
    slots: BufferId,
    y: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let args = [
        read(x, size([rows.count(), layer.in_features])),
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        output(y, size([rows.count(), layer.out_features]), accumulate),
    ];
    let extent = [rows.rows_per_group, layer.out_features, rows.groups];
    let loops = loops(layer.in_features);
    b.step(&LINEAR_FORWARD, layer.params(rows, accumulate), &args, extent, loops, layer.flops(rows))
}

/// `d_x [rows, in] (+)= d_y [rows, out] W`; long sums by way of their parts.
pub fn backward_input(
    b: &mut Builder,
    rows: Rows,
    layer: Layer,
    d_y: BufferId,
    slots: BufferId,
    d_x: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let rows = layer.rows(rows);
    let most = if rows.count() <= FEW_ROWS { MOST_OUT_OF_FEW } else { MOST_OUT };
    let (chunk_outs, chunks) = (layer.out_features.min(most), layer.out_features.div_ceil(most).max(1));
    let values = size([rows.count(), layer.in_features]);
    let in_parts = chunks > 1;
    let to = if in_parts { b.passing("parts of long sums", chunks as usize * values)? } else { d_x };
    let args = [
        read(d_y, size([rows.count(), layer.out_features])),
        read(layer.weights, layer.weights_len()),
        read(slots, size([rows.first_group + rows.groups])),
        output(to, chunks as usize * values, accumulate && !in_parts),
    ];
    let params = LinearParams { chunk_outs, chunks, ..layer.params(rows, accumulate && !in_parts) };
    let extent = [rows.rows_per_group, layer.in_features, rows.groups * chunks];
    b.step(&LINEAR_BACKWARD_INPUT, params, &args, extent, loops(chunk_outs), layer.flops(rows))?;
    if in_parts {
        let groups = sum::Groups { count: rows.groups, first: 0 };
        sum::forward(b, groups, chunks, rows.rows_per_group * layer.in_features, to, d_x, accumulate)?;
    }
    Ok(())
}

/// Length of the sums of [`backward_weight`].
pub fn sums_len(parts: Parts, layer: Layer) -> usize {
    size([parts.count(), layer.parameters()])
}

/// Gradient of the weights over each part of the rows, `sums [groups · chunks, out·in + out]`; where all rows are one part, that is the gradient.
pub fn backward_weight(
    b: &mut Builder,
    parts: Parts,
    layer: Layer,
    x: BufferId,
    d_y: BufferId,
    sums: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let Parts { rows, chunk_rows, chunks } = parts;
    let args = [
        read(x, size([rows.count(), layer.in_features])),
        read(d_y, size([rows.count(), layer.out_features])),
        output(sums, sums_len(parts, layer), accumulate),
    ];
    let params = LinearParams { chunk_rows, chunks, ..layer.params(rows, accumulate) };
    let extent = [layer.out_features, layer.in_features, parts.count()];
    b.step(&LINEAR_BACKWARD_WEIGHT, params, &args, extent, loops(chunk_rows), layer.flops(rows))
}

/// From the sums of [`backward_weight`] to the gradient, `d_weights [sets, out·in + out]`; with per-instance weights group `g`
/// has set `first_group + g`, so every image has a set of its own.
pub fn sum_of_parts(
    b: &mut Builder,
    parts: Parts,
    layer: Layer,
    sums: BufferId,
    d_weights: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let (groups, terms) = match layer.sets {
        Sets::Shared => (sum::Groups::ONE, parts.count()),
        Sets::Slots { .. } => (sum::Groups { count: parts.rows.groups, first: parts.rows.first_group }, parts.chunks),
    };
    sum::forward(b, groups, terms, layer.parameters(), sums, d_weights, accumulate)
}
