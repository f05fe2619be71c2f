use srn_cpu::Precision;
use srn_gpu::{Choice, GpuExecutor};
use srn_plan::ops::layer_norm_relu::Saved;
use srn_plan::ops::linear::{Layer, Sets};
use srn_plan::ops::{hidden_layer, layer_norm_relu, linear};
use srn_plan::{Executor, Rows};
use srn_shaders::{HIDDEN_LAYER_BACKWARD_INPUT, HIDDEN_LAYER_FORWARD};
use srn_tests::{Case, Sketch, difference, gpu};

use crate::{KernelTest, ROWS};

pub static FORWARD: KernelTest = KernelTest {
    kernel: &HIDDEN_LAYER_FORWARD,
    // Worst 4.4e-7 on llvmpipe.
    tolerance: 2.2e-6,
    cases,
    faults: &[
        ("forward", "slots[params.first_group + group]", "slots[group]"),
        ("forward", "* params.weight_stride", "* 0u"),
        ("forward", "in_features * o + i", "in_features * o"),
        ("forward", "params.centred == 0u", "params.centred == 1u"),
        ("forward", "stats[2u * at] = mean", "stats[2u * at] = 0.0"),
        ("forward", "+ 1e-5", "+ 1e-2"),
        ("forward", "affine[n + o], 0.0)", "affine[n + o], -1.0)"),
        ("forward_workgroup", "slots[params.first_group + group]", "slots[group]"),
        ("forward_workgroup", "first + feature < n", "first + feature <= n"),
        ("forward_workgroup", "32u * (workgroup.y * workgroups.x + workgroup.x)", "32u * workgroup.y"),
        ("forward_workgroup", "(index >> 3u) & 6u", "(index >> 3u) & 2u"),
        ("forward_workgroup", "w_tile[k + 3u][w_to] = ws[3]", "w_tile[k + 3u][w_to] = ws[2]"),
        ("forward_workgroup", "(four % 8u) ^ (2u * feature)", "four % 8u"),
        ("forward_workgroup", "b[3] += wb * xs[3]", "b[3] += wa * xs[3]"),
        ("forward_workgroup", "multiply_add(&rows, local, 13u)", "multiply_add(&rows, local, 12u)"),
        ("forward_workgroup", "local.x + 8u <= last", "local.x <= last"),
        ("forward_workgroup", "params.centred == 0u", "params.centred == 1u"),
        ("forward_workgroup", "row[6] + row[7]", "row[6]"),
        ("forward_workgroup", "vec4(mean.z), vec4(mean.w)) * in_b", "vec4(mean.z), vec4(mean.z)) * in_b"),
        ("forward_workgroup", "+ 1e-5", "+ 1e-2"),
        ("forward_workgroup", "from_mean + mean", "from_mean"),
        ("forward_workgroup", "stats[2u * at + 1u] = rstd[local.x]", "stats[2u * at + 1u] = rstd.x"),
    ],
};

pub static BACKWARD_INPUT: KernelTest = KernelTest {
    kernel: &HIDDEN_LAYER_BACKWARD_INPUT,
    // Worst 3.9e-7 on llvmpipe.
    tolerance: 2e-6,
    cases,
    faults: &[
        ("backward_input", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input", "first + n * o + i", "first + n * i + o"),
        ("backward_input", "params.centred == 0u", "params.centred == 1u"),
        ("backward_input", "> 0.0)", "< 0.0)"),
        ("backward_input", "along += e * normalised", "along += e"),
        ("backward_input", "= rstd * (d_normalised", "= (d_normalised"),
        ("backward_input_workgroup", "slots[params.first_group + group]", "slots[group]"),
        ("backward_input_workgroup", "4u * (index / 16u)", "4u * (index / 32u)"),
        ("backward_input_workgroup", "first + index % 4u < n", "first + index % 4u <= n"),
        ("backward_input_workgroup", "(index >> 1u) & 6u", "(index >> 1u) & 2u"),
        ("backward_input_workgroup", "z_tile[z_k + 2u][z_to] = zs[2]", "z_tile[z_k + 2u][z_to] = zs[1]"),
        ("backward_input_workgroup", "b[1] += wb * zs[1]", "b[1] += wb * zs[0]"),
        ("backward_input_workgroup", "multiply_add(&rows, local, 13u)", "multiply_add(&rows, local, 12u)"),
        ("backward_input_workgroup", "> vec4(0.0)", "< vec4(0.0)"),
        ("backward_input_workgroup", "passes & vec4(column < n)", "passes"),
        ("backward_input_workgroup", "params.centred == 0u", "params.centred == 1u"),
        ("backward_input_workgroup", "(row[2] + row[3])", "row[2]"),
        ("backward_input_workgroup", "e_d2 - mean[2] - d2 * along[2]", "e_d2 - mean[2] - d2 * along[1]"),
        ("backward_input_workgroup", "d_y[at] = of_y", "d_y[at] = of_normalised"),
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

/// Input and output features; back they are as many, of the latter.
const WIDTHS: [[u32; 2]; 9] = [[64, 64], [4, 4], [3, 5], [36, 60], [20, 28], [64, 12], [7, 64], [68, 64], [64, 33]];

/// With nine widths and five kinds of rows, each meets each in the end.
fn cases() -> Vec<Case> {
    let case =
        |k: usize| case(WIDTHS[k % WIDTHS.len()], ROWS[k % ROWS.len()], if k.is_multiple_of(2) { 0 } else { 4 }, k % 4 < 2);
    (0..5 * WIDTHS.len()).map(case).collect()
}

/// `sets` of weights; 0: one that all groups share.
fn case([in_features, out_features]: [u32; 2], rows: Rows, sets: u32, centred: bool) -> Case {
    let kind = if centred { ", centred" } else { "" };
    let mut s = Sketch::new(format!("{in_features} → {out_features} features, {rows:?}, {sets} sets{kind}"));
    let (n, width) = (rows.count() as usize, out_features as usize);
    let shared = if sets == 0 { Sets::Shared } else { Sets::Slots { count: sets } };
    let slots = s.indices("slots", (rows.first_group + rows.groups) as usize, sets.max(1));
    let affine = s.random("affine", 2 * width);
    let x = s.random("x", n * in_features as usize);
    let [z, y, d_y] = ["z", "y", "d_y"].map(|name| s.scratch(name, n * width));
    let d_z = s.random("d_z", n * width);
    let stats = s.scratch("stats", 2 * n);
    let norm = Saved { x: z, stats, affine, centred };
    let mut layer = |name: &str, in_features: u32| {
        let weights = s.random(name, sets.max(1) as usize * width * (in_features + 1) as usize);
        Layer { weights, in_features, out_features, sets: shared }
    };
    let (this, next) = (layer("weights", in_features), layer("weights of the next", out_features));
    s.step(|b| hidden_layer::forward(b, rows, this, x, slots, norm, y));
    s.step(|b| hidden_layer::backward_input(b, rows, next, slots, norm, d_y, d_z));
    s.finish()
}

/// What ran of a plan in which a layer and its norm follow each other, forward and back, on a device that joins what it can; the results are those of
/// the reference.
fn ran([in_features, out_features]: [u32; 2], accumulate: bool, other_place: bool) -> Vec<String> {
    let mut s =
        Sketch::new(format!("{in_features} → {out_features} features, accumulate {accumulate}, other place {other_place}"));
    let rows = Rows { groups: 2, rows_per_group: 40, first_group: 0 };
    let n = rows.count();
    let slots = s.indices("slots", 2, 2);
    let weights = s.random("weights", 2 * (out_features * (in_features + 1)) as usize);
    let layer = Layer { weights, in_features, out_features, sets: Sets::Slots { count: 2 } };
    let width = in_features.max(out_features);
    let affine = s.random("affine", 2 * width as usize);
    let x = s.random("x", (n * in_features) as usize);
    let z = s.output("z", (n * out_features) as usize, accumulate);
    let y = s.scratch("y", (n * out_features) as usize);
    let [stats, seen] = ["stats", "stats of x"].map(|name| s.scratch(name, 2 * n as usize));
    let above = s.scratch("y of x", (n * in_features) as usize);
    let d_y = s.output("d_y", (n * in_features) as usize, accumulate);
    let d_z = s.random("d_z", (n * width) as usize);
    let to = if other_place { s.scratch("other place", (n * in_features) as usize) } else { d_z };
    let (norm, before) = (Saved { x: z, stats, affine, centred: false }, Saved { x, stats: seen, affine, centred: true });
    s.step(|b| layer_norm_relu::forward(b, n, in_features, before, above));
    s.step(|b| linear::forward(b, rows, layer, x, slots, z, accumulate));
    s.step(|b| layer_norm_relu::forward(b, n, out_features, norm, y));
    s.step(|b| linear::backward_input(b, rows, layer, d_z, slots, d_y, accumulate));
    s.step(|b| layer_norm_relu::backward_input(b, n, in_features, before, d_y, to));
    let case = s.finish();

    let gpu = gpu().with_choice(Choice::Named("hidden_layer".into()));
    let mut executor = GpuExecutor::new(&gpu, case.plan.clone(), u64::MAX).unwrap();
    let mut reference = srn_cpu::executor(Precision::F64, case.plan.clone(), u64::MAX).unwrap();
    case.fill(&mut executor).unwrap();
    case.fill(reference.as_mut()).unwrap();
    executor.run(case.stage).unwrap();
    reference.run(case.stage).unwrap();
    for id in [z, y, stats, d_y, to] {
        let [found, expected] = [executor.read(id).unwrap(), reference.read(id).unwrap()];
        let off = difference(&found, &expected).unwrap();
        assert!(off < 1e-5, "{}: `{}` is off by {off:.1e}", case.name, case.plan.buffer(id).name);
    }
    let mut labels: Vec<String> = executor.profile(&[case.stage]).unwrap().into_iter().map(|time| time.label).collect();
    labels.sort();
    labels
}

#[test]
fn a_device_joins_a_layer_and_its_norm() {
    let both = ["hidden_layer/backward_input_workgroup", "hidden_layer/forward_workgroup", "layer_norm_relu/forward"];
    assert_eq!(ran([32, 32], false, false), both);
    // What is written may not be what is read, and rows that come in the place of others have their length.
    let forward_alone =
        ["hidden_layer/forward_workgroup", "layer_norm_relu/backward_input", "layer_norm_relu/forward", "linear/backward_input"];
    assert_eq!(ran([32, 32], false, true), forward_alone);
    assert_eq!(ran([16, 32], false, false), forward_alone);
    let apart = ["layer_norm_relu/backward_input", "layer_norm_relu/forward", "linear/backward_input", "linear/forward"];
    assert_eq!(ran([32, 32], true, false), apart);
}
