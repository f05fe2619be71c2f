use srn_plan::ops::layer_norm_relu::{self, Saved};
use srn_plan::{Parts, Rows};
use srn_shaders::{LAYER_NORM_RELU_BACKWARD_AFFINE, LAYER_NORM_RELU_BACKWARD_INPUT, LAYER_NORM_RELU_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &LAYER_NORM_RELU_FORWARD,
    // Worst 1.9e-7 on llvmpipe.
    tolerance: 1e-6,
    cases,
    faults: &[
        ("forward", "+ 1e-5", "+ 1e-2"),
        ("forward", "affine[n + j]", "affine[j]"),
        ("forward", "1.0 / sqrt", "sqrt"),
        ("forward", "params.centred == 0u", "true"),
        ("forward_vec4", "+ 1e-5", "+ 1e-2"),
        ("forward_vec4", "params.features / 4u;", "params.features / 8u;"),
        ("forward_vec4", "f32(params.features);", "f32(n);"),
        ("forward_vec4", "params.centred == 0u", "params.centred == 1u"),
        ("forward_subgroup", "+ 1e-5", "+ 1e-2"),
        ("forward_subgroup", "params.centred == 0u", "true"),
        ("forward_subgroup", "max(value, vec4(0.0))", "value"),
        ("forward_subgroup", "dot(value, vec4(1.0)), column", "dot(value, vec4(1.0)), 0u * column"),
        ("forward_subgroup", "4u, n > 16u", "2u, n > 16u"),
        ("forward_subgroup", "b + b.zwxy, per_row > 2u", "b + b.zwxy, per_row > 4u"),
        ("forward_subgroup", "subgroupShuffleXor(a, 4u)", "subgroupShuffleXor(a, 2u)"),
        ("forward_subgroup", "pick(rstd, lane % 8u * per_row)", "pick(rstd, lane % 8u)"),
        ("forward_short", "+ 1e-5", "+ 1e-2"),
        ("forward_short", "params.centred == 0u", "true"),
        ("forward_short", "max(value, vec4(0.0))", "value"),
        ("forward_short", "column < params.features / 4u);", "true);"),
        ("forward_short", "4u, params.features > 128u", "2u, params.features > 128u"),
        ("forward_short", "subgroupShuffleXor(sum, 4u)", "subgroupShuffleXor(sum, 2u)"),
        ("forward_short", "index / 8u / teams * teams", "index / 8u"),
        ("forward_short", "n * min(row + 2u, last)", "n * min(row + 1u, last)"),
        ("forward_short", "rstd[member]", "rstd.x"),
        ("forward_short", "4u * turns * (sharers", "3u * turns * (sharers"),
    ],
};

pub static BACKWARD_INPUT: KernelTest = KernelTest {
    kernel: &LAYER_NORM_RELU_BACKWARD_INPUT,
    // Worst 1.4e-7 on llvmpipe, 1.7e-6 on an H100, whose quotients are rounded twice: of three features whose gradients nearly cancel.
    tolerance: 4e-6,
    cases,
    faults: &[
        ("backward_input", "- mean_e", "+ mean_e"),
        ("backward_input", "along += e * normalised", "along += e"),
        ("backward_input", "> 0.0)", "< 0.0)"),
        ("backward_input", "params.centred == 0u", "true"),
        ("backward_input_vec4", "- mean_e", "+ mean_e"),
        ("backward_input_vec4", "dot(along, vec4(1.0))", "dot(along, vec4(1.0, 1.0, 1.0, 0.0))"),
        ("backward_input_vec4", "params.centred == 0u", "false"),
        ("backward_input_vec4", "params.features / 4u + j", "params.features / 2u + j"),
        ("backward_input_subgroup", "params.centred == 0u", "true"),
        ("backward_input_subgroup", "mean.a.y - x1", "mean.a.x - x1"),
        ("backward_input_subgroup", "passes & vec4(column < params.features / 4u)", "passes"),
        ("backward_input_subgroup", "turn = 8u / per_row", "turn = 8u"),
        ("backward_input_subgroup", "octet + 5u / per_row", "octet"),
        ("backward_input_subgroup", "subgroupShuffleXor(b, 1u)", "subgroupShuffleXor(b, 4u)"),
        ("backward_input_subgroup", "dot(e6, x6)", "dot(e6, e6)"),
        ("backward_input_short", "params.centred == 0u", "true"),
        ("backward_input_short", "mean.y - c1", "mean.x - c1"),
        ("backward_input_short", "passes & vec4(column < params.features / 4u)", "passes"),
        ("backward_input_short", "4u, params.features > 128u", "2u, params.features > 128u"),
        ("backward_input_short", "of_teams[first + 2u] +", "of_teams[first] +"),
        ("backward_input_short", "dot(e_d3, d3)", "dot(e_d3, e_d3)"),
        ("backward_input_short", "subgroupShuffleXor(sum, 1u)", "subgroupShuffleXor(sum, 4u)"),
        ("backward_input_short", "4u * turns * (sharers", "3u * turns * (sharers"),
    ],
};

pub static BACKWARD_AFFINE: KernelTest = KernelTest {
    kernel: &LAYER_NORM_RELU_BACKWARD_AFFINE,
    // Worst 2.8e-7 on llvmpipe.
    tolerance: 2e-6,
    cases,
    faults: &[
        ("backward_affine", "d_gamma += e * normalised", "d_gamma += e"),
        ("backward_affine", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_affine", "group * params.rows_per_group", "0u * params.rows_per_group"),
        ("backward_affine", "accumulate == 1u", "accumulate == 0u"),
        ("backward_affine", "> 0.0)", "> 1.0)"),
        ("backward_affine_vec4", "d_gamma += e * normalised", "d_gamma += e"),
        ("backward_affine_vec4", "chunk * params.chunk_rows", "0u * params.chunk_rows"),
        ("backward_affine_vec4", "id.y / params.chunks", "0u / params.chunks"),
        ("backward_affine_vec4", "accumulate == 1u", "accumulate == 0u"),
        ("backward_affine_workgroup", "> vec4(0.0)", "< vec4(0.0)"),
        ("backward_affine_workgroup", "passes & vec4(row + k < end)", "passes"),
        ("backward_affine_workgroup", "d_gammas[other]", "d_gammas[own]"),
        ("backward_affine_workgroup", "accumulate == 1u", "accumulate == 0u"),
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
fn backward_affine_matches_reference() {
    BACKWARD_AFFINE.matches_reference();
}

fn cases() -> Vec<Case> {
    let odd = [(1, 3, false), (7, 17, true), (129, 30, false), (300, 5, true)];
    // One, two, four and eight lanes to a row, and a row too long for them.
    let even = [
        (1, 4, true),
        (300, 8, false),
        (129, 36, true),
        (65, 64, true),
        (258, 100, false),
        (33, 228, true),
        (9, 256, false),
        (5, 260, true),
    ];
    let sizes = odd.into_iter().chain(even);
    sizes.enumerate().map(|(k, (rows, features, accumulate))| case(rows, features, accumulate, k % 3 == 1)).collect()
}

/// Forward and both ways back: these need the statistics.
fn case(rows: u32, features: u32, accumulate: bool, centred: bool) -> Case {
    let kind = if centred { ", centred" } else { "" };
    let mut s = Sketch::new(format!("{rows} rows of {features}, accumulate {accumulate}{kind}"));
    let (n, width) = ((rows * features) as usize, features as usize);
    let [x, d_y] = ["x", "d_y"].map(|name| s.random(name, n));
    let affine = s.random("affine", 2 * width);
    let stats = s.scratch("stats", 2 * rows as usize);
    let [y, d_x] = ["y", "d_x"].map(|name| s.scratch(name, n));
    // Two groups where there are as many rows in both.
    let groups = if rows.is_multiple_of(2) { 2 } else { 1 };
    let parts = Parts::of(Rows { groups, rows_per_group: rows / groups, first_group: 0 }, 100);
    let sums = s.output("sums", layer_norm_relu::sums_len(parts, features), accumulate);
    let d_affine = s.output("d_affine", 2 * width, accumulate);
    let saved = Saved { x, stats, affine, centred };
    s.step(|b| layer_norm_relu::forward(b, rows, features, saved, y));
    s.step(|b| layer_norm_relu::backward_input(b, rows, features, saved, d_y, d_x));
    s.step(|b| layer_norm_relu::backward_affine(b, parts, features, saved, d_y, sums, accumulate));
    s.step(|b| layer_norm_relu::sum_of_parts(b, parts, features, sums, d_affine, accumulate));
    s.finish()
}
