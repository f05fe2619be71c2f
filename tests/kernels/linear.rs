use srn_plan::ops::linear::{self, Layer, Sets};
use srn_plan::{Parts, Rows};
use srn_shaders::{LINEAR_BACKWARD_INPUT, LINEAR_BACKWARD_WEIGHT, LINEAR_FORWARD};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &LINEAR_FORWARD,
    // Worst 2.5e-7 on llvmpipe.
    tolerance: 2e-6,
    cases: forward,
    faults: &[
        ("forward", "* params.weight_stride", "* 0u"),
        ("forward", "slots[params.first_group + group]", "slots[group]"),
        ("forward", "var y2 = bias", "var y2 = vec4(0.0)"),
        ("forward", "row + 7u, out, y7", "row + 7u, out, y6"),
        ("forward", "accumulate == 1u", "accumulate == 0u"),
        ("forward", "min(params.out_features - out, 4u)", "min(params.out_features - out, 3u)"),
        ("forward_vec4", "slots[params.first_group + group]", "slots[group]"),
        ("forward_vec4", "columns[r] + b", "columns[r]"),
        ("forward_vec4", "y_ab += wb * xa", "y_ab += wa * xa"),
        ("forward_vec4", "row + 4u, out + 4u, y_bb", "row + 4u, out + 4u, y_ba"),
        ("forward_vec4", "accumulate == 1u", "accumulate == 0u"),
        ("forward_workgroup", "slots[params.first_group + group]", "slots[group]"),
        ("forward_workgroup", "w_tile[k + 3u][to] = ws[3]", "w_tile[k + 3u][to] = ws[2]"),
        ("forward_workgroup", "(index >> 3u) & 6u", "(index >> 3u) & 2u"),
        ("forward_workgroup", "number % workgroups.y", "number % workgroups.x"),
        ("forward_workgroup", "first + feature < n", "first + feature <= n"),
        ("forward_workgroup", "tile[2] + bias", "tile[2]"),
        ("forward_workgroup", "row + 32u, out, sums.ba", "row + 32u, out, sums.aa"),
        ("forward_workgroup", "multiply_add(&sums, local, 13u)", "multiply_add(&sums, local, 12u)"),
        ("forward_workgroup", "accumulate == 1u", "accumulate == 0u"),
        ("forward_subgroup", "slots[params.first_group + group]", "slots[group]"),
        ("forward_subgroup", "subgroupShuffle(mine, first + 3u)", "subgroupShuffle(mine, first + 2u)"),
        ("forward_subgroup", "multiply_add(&y_2b, wb, x2", "multiply_add(&y_2b, wb, x1"),
        ("forward_subgroup", "row + 24u, out_b", "row + 16u, out_b"),
        ("forward_subgroup", "row >= params.rows_per_group || out", "row > params.rows_per_group || out"),
        ("forward_subgroup", "sum.r5 + bias", "sum.r5"),
        ("forward_subgroup", "accumulate == 1u", "accumulate == 0u"),
        ("forward_cooperative", "slots[params.first_group + group]", "slots[group]"),
        ("forward_cooperative", "268u - ", "254u + 0u * "),
        ("forward_cooperative", "first + feature < n", "first + feature <= n"),
        ("forward_cooperative", "y_12 = coopMultiplyAdd(x1", "y_12 = coopMultiplyAdd(x0"),
        ("forward_cooperative", "values - high(values)", "0.0 * values"),
        ("forward_cooperative", "w_low[W_STRIDE * (out + SIDE)", "w_low[W_STRIDE * out"),
        ("forward_cooperative", "4u * SIDE * (subgroup % (32u / SIDE))", "0u * (subgroup % (32u / SIDE))"),
        ("forward_cooperative", "min(first_out + r, last_out)", "min(first_out + r, last_out - 1u)"),
        ("forward_cooperative", "sum + weights[bias]", "sum"),
        ("forward_cooperative", "row >= params.rows_per_group || out", "row > params.rows_per_group || out"),
        ("forward_cooperative", "accumulate == 1u", "accumulate == 0u"),
    ],
};

pub static BACKWARD_INPUT: KernelTest = KernelTest {
    kernel: &LINEAR_BACKWARD_INPUT,
    // Worst 1.9e-6 on llvmpipe.
    tolerance: 1e-5,
    cases: backward_input,
    faults: &[
        ("backward_input", "o = begin", "o = 0u"),
        ("backward_input", "min(begin + params.chunk_outs, params.out_features)", "params.out_features"),
        ("backward_input", "x5 += w * d_y[y_b.y", "x5 += w * d_y[y_b.x"),
        ("backward_input", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_vec4", "o = begin / 4u", "o = 0u"),
        ("backward_input_vec4", "store(part, row, in_ + 4u, x_ab)", "store(group, row, in_ + 4u, x_ab)"),
        ("backward_input_vec4", "x_ba += wa * yb", "x_ba += wb * yb"),
        ("backward_input_vec4", "weights[at + 3u * stride]", "weights[at + 2u * stride]"),
        ("backward_input_vec4", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_workgroup", "first = begin / 4u", "first = 0u"),
        ("backward_input_workgroup", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_workgroup", "4u * (index / 16u)", "4u * (index / 32u)"),
        ("backward_input_workgroup", "(index >> 1u) & 6u", "(index >> 1u) & 2u"),
        ("backward_input_workgroup", "number / workgroups.y", "number / workgroups.x"),
        ("backward_input_workgroup", "first + index % 4u <= last", "first + index % 4u <= last + 1u"),
        ("backward_input_workgroup", "multiply_add(&sums, local, 13u)", "multiply_add(&sums, local, 12u)"),
        ("backward_input_workgroup", "ab[0] += wb * ya[0]", "ab[0] += wa * ya[0]"),
        ("backward_input_workgroup", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_subgroup", "o = begin / 4u", "o = 0u"),
        ("backward_input_subgroup", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_subgroup", "subgroupShuffle(mine, first + 7u)", "subgroupShuffle(mine, first + 6u)"),
        ("backward_input_subgroup", "weights[at + 3u * stride]", "weights[at + 2u * stride]"),
        ("backward_input_subgroup", "row + member + vec4(0u, 8u,", "row + member + vec4(0u, 9u,"),
        (
            "backward_input_subgroup",
            "team = (subgroup * subgroup_size + lane) / 8u",
            "team = 0u * (subgroup * subgroup_size + lane)",
        ),
        ("backward_input_subgroup", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_cooperative", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_cooperative", "268u - ", "254u + 0u * "),
        ("backward_input_cooperative", "first + feature < n", "first + feature <= n"),
        ("backward_input_cooperative", "W_STRIDE * k + (in_ + SIDE) / 4u", "W_STRIDE * k + in_ / 4u"),
        ("backward_input_cooperative", "values - high(values)", "0.0 * values"),
        ("backward_input_cooperative", "y_low[Y_STRIDE * (row + SIDE)", "y_low[Y_STRIDE * row"),
        ("backward_input_cooperative", "4u * first + w_row", "4u * first"),
        ("backward_input_cooperative", "(254u - exponent(r)) << 23u", "127u << 23u"),
        ("backward_input_cooperative", "accumulate == 1u", "accumulate == 0u"),
    ],
};

pub static BACKWARD_WEIGHT: KernelTest = KernelTest {
    kernel: &LINEAR_BACKWARD_WEIGHT,
    // Worst 3.9e-7 on llvmpipe.
    tolerance: 2e-6,
    cases: backward_weight,
    faults: &[
        ("backward_weight", "r + lane < vec4(end)", "r + lane <= vec4(end)"),
        ("backward_weight", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_weight", "workgroup.z / params.chunks", "0u / params.chunks"),
        ("backward_weight", "bias += ", "bias = "),
        ("backward_weight", "accumulate == 1u", "accumulate == 0u"),
        ("backward_weight_rows", "r + lane < vec4(end)", "r + lane <= vec4(end)"),
        ("backward_weight_rows", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_weight_rows", "r += 32u", "r += 36u"),
        ("backward_weight_rows", "bias += biases[other]", "bias += biases[own]"),
        ("backward_weight_rows", "accumulate == 1u", "accumulate == 0u"),
        ("backward_weight_vec4", "r + lane < vec4(end)", "r + lane <= vec4(end)"),
        ("backward_weight_vec4", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_weight_vec4", "w_ba += xa * transpose(yb)", "w_ba += xa * transpose(ya)"),
        ("backward_weight_vec4", "bias_b += yb", "bias_b += ya"),
        ("backward_weight_vec4", "accumulate == 1u", "accumulate == 0u"),
        ("backward_weight_workgroup", "row < vec4(end)", "row <= vec4(end)"),
        ("backward_weight_workgroup", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_weight_workgroup", "x_tile[to + 16u] = x[x_at.y]", "x_tile[to + 16u] = x[x_at.x]"),
        ("backward_weight_workgroup", "multiply_add(&sums, local, 13u)", "multiply_add(&sums, local, 12u)"),
        ("backward_weight_workgroup", ".b += yb", ".b += ya"),
        ("backward_weight_workgroup", "accumulate == 1u", "accumulate == 0u"),
        ("backward_weight_subgroup", "r + four < vec4(end)", "r + four <= vec4(end)"),
        ("backward_weight_subgroup", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_weight_subgroup", "subgroupShuffle(mine, first + 4u)", "subgroupShuffle(mine, first + 5u)"),
        ("backward_weight_subgroup", "32u * (team % 4u)", "32u * (team % 2u)"),
        ("backward_weight_subgroup", "bias += vec4(1.0)", "bias += vec4(0.5)"),
        ("backward_weight_subgroup", "out + 3u, in_b, w_3b", "out + 3u, in_b, w_3a"),
        ("backward_weight_subgroup", "accumulate == 1u", "accumulate == 0u"),
    ],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

#[test]
fn backward_input_matches_reference() {
    BACKWARD_INPUT.matches_reference();
}

#[test]
fn backward_weight_matches_reference() {
    BACKWARD_WEIGHT.matches_reference();
}

/// Sizes of a step.
#[derive(Clone, Copy, Debug)]
struct Size {
    rows: Rows,
    in_features: u32,
    out_features: u32,
    /// Sets of weights; 0: one that all groups share.
    sets: u32,
    accumulate: bool,
}

/// Widths that are multiples of four, for the vectorised variants, and widths that are not; wide and narrow.
const WIDTHS: [(u32, u32); 8] = [(1, 1), (3, 17), (30, 64), (17, 3), (4, 4), (64, 12), (8, 64), (68, 132)];

/// All rows and widths at least once, not all their combinations; both kinds of weights, both kinds of output.
fn sizes() -> impl Iterator<Item = Size> {
    (0..2 * WIDTHS.len()).map(|k| {
        let (in_features, out_features) = WIDTHS[k % WIDTHS.len()];
        // Rows, sets and accumulation repeat after 5, 3 and 2: coprime, so they meet in all ways.
        let rows = ROWS[k % ROWS.len()];
        Size { rows, in_features, out_features, sets: if k % 3 == 0 { 0 } else { 4 }, accumulate: k % 2 == 1 }
    })
}

fn layer(s: &mut Sketch, size: Size) -> Layer {
    let Size { in_features, out_features, .. } = size;
    let sets = if size.sets == 0 { Sets::Shared } else { Sets::Slots { count: size.sets } };
    let weights = s.random("weights", (size.sets.max(1) * (in_features + 1) * out_features) as usize);
    Layer { weights, in_features, out_features, sets }
}

fn forward() -> Vec<Case> {
    sizes().map(forward_case).collect()
}

fn forward_case(size: Size) -> Case {
    let mut s = Sketch::new(format!("{size:?}"));
    let Size { rows, accumulate, .. } = size;
    let layer = layer(&mut s, size);
    let x = s.random("x", (rows.count() * size.in_features) as usize);
    let slots = s.indices("slots", (rows.first_group + rows.groups) as usize, size.sets.max(1));
    let y = s.output("y", (rows.count() * size.out_features) as usize, accumulate);
    s.step(|b| linear::forward(b, rows, layer, x, slots, y, accumulate));
    s.finish()
}

/// The last ones sum so many outputs that they go in parts.
fn backward_input() -> Vec<Case> {
    let rows = |rows_per_group| Rows { groups: 1, rows_per_group, first_group: 0 };
    let wide = |rows, in_features, out_features, sets| Size { rows, in_features, out_features, sets, accumulate: sets > 1 };
    let two = Rows { groups: 2, rows_per_group: 7, first_group: 1 };
    let wide = [
        wide(rows(3), 3, 2050, 1),
        wide(rows(33), 4, 2052, 1),
        wide(rows(1030), 4, 16_392, 1),
        wide(two, 8, 1028, 3),
        wide(two, 5, 1030, 3),
    ];
    sizes().chain(wide).map(backward_input_case).collect()
}

/// A plan with many tiles needs no more memory for its long sums than one with a single tile.
#[test]
fn long_sums_share_a_buffer() {
    let mut s = Sketch::new("two tiles");
    let size = Size {
        rows: Rows { groups: 1, rows_per_group: 3, first_group: 0 },
        in_features: 3,
        out_features: 2050,
        sets: 1,
        accumulate: false,
    };
    let layer = layer(&mut s, size);
    let slots = s.indices("slots", 1, 1);
    for _ in 0..2 {
        let d_y = s.random("d_y", 3 * 2050);
        let d_x = s.output("d_x", 3 * 3, false);
        s.step(|b| linear::backward_input(b, size.rows, layer, d_y, slots, d_x, false));
    }
    let buffers = s.finish().plan.buffers.len();
    // Weights, slots, twice d_y and d_x.
    assert_eq!(buffers, 2 + 2 * 2 + 1);
}

fn backward_input_case(size: Size) -> Case {
    let mut s = Sketch::new(format!("{size:?}"));
    let Size { rows, accumulate, .. } = size;
    let layer = layer(&mut s, size);
    let d_y = s.random("d_y", (rows.count() * size.out_features) as usize);
    let slots = s.indices("slots", (rows.first_group + rows.groups) as usize, size.sets.max(1));
    let d_x = s.output("d_x", (rows.count() * size.in_features) as usize, accumulate);
    s.step(|b| linear::backward_input(b, rows, layer, d_y, slots, d_x, accumulate));
    s.finish()
}

/// The last ones have so many rows that they are summed in parts.
fn backward_weight() -> Vec<Case> {
    let rows = Rows { groups: 2, rows_per_group: 1030, first_group: 1 };
    let long = |in_features, out_features, sets| Size { rows, in_features, out_features, sets, accumulate: true };
    let long = [long(5, 3, 4), long(4, 8, 4), long(3, 7, 0), long(12, 4, 0)];
    sizes().chain(long).map(backward_weight_case).collect()
}

/// Weights of later images than the first are sums: those of earlier images stay.
fn backward_weight_case(size: Size) -> Case {
    let mut s = Sketch::new(format!("{size:?}"));
    let Size { rows, in_features, out_features, accumulate, .. } = size;
    let sets = if size.sets == 0 { Sets::Shared } else { Sets::Slots { count: rows.first_group + rows.groups } };
    let x = s.random("x", (rows.count() * in_features) as usize);
    let d_y = s.random("d_y", (rows.count() * out_features) as usize);
    // The weights themselves take no part.
    let layer = Layer { weights: x, in_features, out_features, sets };
    let parts = Parts::of(rows, 500);
    let sums = s.output("sums", linear::sums_len(parts, layer), accumulate);
    s.step(|b| linear::backward_weight(b, parts, layer, x, d_y, sums, accumulate));
    let (written, kept) = if size.sets == 0 { (1, 0) } else { (rows.groups, rows.first_group) };
    let accumulate = accumulate || kept > 0;
    let d_weights = s.output("d_weights", ((kept + written) * layer.parameters()) as usize, accumulate);
    s.step(|b| linear::sum_of_parts(b, parts, layer, sums, d_weights, accumulate));
    s.finish()
}
