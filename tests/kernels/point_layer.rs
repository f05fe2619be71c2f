use srn_plan::Rows;
use srn_plan::ops::linear::{Layer, Sets};
use srn_plan::ops::point_layer;
use srn_shaders::{POINT_LAYER_BACKWARD_INPUT, POINT_LAYER_FORWARD};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &POINT_LAYER_FORWARD,
    // Worst 3.7e-7 on llvmpipe, 1.1e-6 on the CPU.
    tolerance: 6e-6,
    cases,
    faults: &[
        ("forward", "* params.weight_stride", "* 0u"),
        ("forward", "slots[params.first_group + group]", "slots[group]"),
        ("forward", "+ 1e-5", "+ 1e-2"),
        ("forward", "weights[first + 3u * j + 2u]", "weights[first + 3u * j + 1u]"),
        ("forward", "group * params.rows_per_group + row", "row"),
        ("forward_subgroup", "* params.weight_stride", "* 0u"),
        ("forward_subgroup", "slots[params.first_group + group]", "slots[group]"),
        ("forward_subgroup", "+ 1e-5", "+ 1e-2"),
        ("forward_subgroup", "vec4(p.y, q.x, q.w, r.z)", "vec4(p.y, q.x, q.w, r.y)"),
        ("forward_subgroup", "inside * weights[first + 3u * n + j]", "0.0 * weights[first + 3u * n + j]"),
        ("forward_subgroup", "mean += sums(raw1, 1u < per_row)", "mean += sums(raw1, true)"),
        ("forward_subgroup", "f32(c < params.features / 4u)", "1.0"),
        ("forward_subgroup", "octet + 5u / per_row", "octet"),
        ("forward_subgroup", "subgroupShuffleXor(mean, 4u)", "subgroupShuffleXor(mean, 2u)"),
        ("forward_subgroup", "workgroup.x) + team", "workgroup.x) + team / 2u"),
        ("forward_subgroup", "max(value, vec4(0.0))", "value"),
        ("forward_subgroup", "end, c6, gamma6 * (z6 * rstd.b.z)", "end, c6, gamma6 * (z6 * rstd.b.x)"),
        ("forward_short", "* params.weight_stride", "* 0u"),
        ("forward_short", "slots[params.first_group + group]", "slots[group]"),
        ("forward_short", "+ 1e-5", "+ 1e-2"),
        ("forward_short", "inside * weights[first + 3u * n + j]", "0.0 * weights[first + 3u * n + j]"),
        ("forward_short", "f32(c < params.features / 4u)", "1.0"),
        ("forward_short", "max(value, vec4(0.0))", "value"),
        ("forward_short", "d3 = linear(w_d, p3)", "d3 = linear(w_c, p3)"),
        ("forward_short", "2u, params.features > 64u", "1u, params.features > 64u"),
        ("forward_short", "4u * turns * (sharers", "3u * turns * (sharers"),
    ],
};

pub static BACKWARD_INPUT: KernelTest = KernelTest {
    kernel: &POINT_LAYER_BACKWARD_INPUT,
    // Worst 1.4e-6 on llvmpipe.
    tolerance: 7e-6,
    cases,
    faults: &[
        ("backward_input", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input", "- mean_e", "+ mean_e"),
        ("backward_input", "along += e * normalised", "along += e"),
        ("backward_input", "> 0.0)", "< 0.0)"),
        ("backward_input", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_subgroup", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_subgroup", "vec4(p.z, q.y, r.x, r.w)", "vec4(p.z, q.y, r.x, r.x)"),
        ("backward_input_subgroup", "w.y - m.y", "w.y"),
        ("backward_input_subgroup", "f32(c < params.features / 4u)", "1.0"),
        ("backward_input_subgroup", "> vec4(0.0)", "< vec4(0.0)"),
        ("backward_input_subgroup", "d5 = e5 - z5 * factor.b.y", "d5 = e5 - z5 * factor.a.y"),
        ("backward_input_subgroup", "dot(w6.z, d6)", "dot(w6.y, d6)"),
        ("backward_input_subgroup", "k = member * per_row", "k = member"),
        ("backward_input_subgroup", "accumulate == 1u", "accumulate == 0u"),
        ("backward_input_short", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_short", "w.y - m.y", "w.y"),
        ("backward_input_short", "f32(c < params.features / 4u)", "1.0"),
        ("backward_input_short", "> vec4(0.0)", "< vec4(0.0)"),
        ("backward_input_short", "z_d2 = e_d2 - d2 * factor.z", "z_d2 = e_d2 - d2 * factor.x"),
        ("backward_input_short", "dot(w_c.z, z_c1)", "dot(w_c.y, z_c1)"),
        ("backward_input_short", "put(at + 1u, d_1[member])", "put(at + 1u, d_1.x)"),
        ("backward_input_short", "index / 8u / teams * teams", "index / 8u"),
        ("backward_input_short", "4u * turns * (sharers", "3u * turns * (sharers"),
        ("backward_input_short", "accumulate == 1u", "accumulate == 0u"),
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

/// One, two, four and eight lanes to a row, a row too long for them, and widths that are no multiples of four. With eleven widths and five
/// kinds of rows, each meets each in the end.
const WIDTHS: [u32; 11] = [4, 3, 36, 64, 17, 100, 228, 30, 256, 260, 8];

fn cases() -> Vec<Case> {
    (0..5 * WIDTHS.len())
        .map(|k| case(WIDTHS[k % WIDTHS.len()], ROWS[k % ROWS.len()], if k % 3 == 0 { 0 } else { 4 }, k % 4 < 2))
        .collect()
}

/// `sets` of weights; 0: one that all groups share.
fn case(features: u32, rows: Rows, sets: u32, accumulate: bool) -> Case {
    let mut s = Sketch::new(format!("{features} features, {rows:?}, {sets} sets, accumulate {accumulate}"));
    let n = rows.count() as usize;
    let weights = s.random("weights", (sets.max(1) * 4 * features) as usize);
    let shared = if sets == 0 { Sets::Shared } else { Sets::Slots { count: sets } };
    let layer = Layer { weights, in_features: point_layer::COORDINATES, out_features: features, sets: shared };
    let x = s.random("x", 3 * n);
    let slots = s.indices("slots", (rows.first_group + rows.groups) as usize, sets.max(1));
    let affine = s.random("affine", 2 * features as usize);
    let d_y = s.random("d_y", n * features as usize);
    let y = s.scratch("y", n * features as usize);
    let d_x = s.output("d_x", 3 * n, accumulate);
    s.step(|b| point_layer::forward(b, rows, layer, x, slots, affine, y));
    s.step(|b| point_layer::backward_input(b, rows, layer, x, slots, affine, d_y, d_x, accumulate));
    s.finish()
}
