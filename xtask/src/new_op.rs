//! Skeletons of a kernel's five parts: WGSL, reference, step, test; and the lines that make them known.

use std::io::Write;
use std::path::Path;

use crate::shell::root;

/// Writes the skeletons of `OP DIRECTION`; nothing that exists is changed, only added to.
pub fn run(arguments: &[String]) -> Result<(), String> {
    let [op, direction] = arguments else { return Err("usage: cargo xtask new-op OP DIRECTION".into()) };
    for name in [op, direction] {
        let fits = name.starts_with(|c: char| c.is_ascii_lowercase())
            && name.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
        if !fits {
            return Err(format!("`{name}`: names are of lower-case letters, digits and _"));
        }
    }
    let kernel = format!("shaders/{op}/{direction}.wgsl");
    if root().join(&kernel).exists() {
        return Err(format!("{kernel} exists"));
    }
    let constant = format!("{op}_{direction}").to_uppercase();
    let shouted = direction.to_uppercase();
    let camel: String = op.split('_').map(|part| part[..1].to_uppercase() + &part[1..]).collect();
    let fill = |text: &str| {
        text.replace("{op}", op)
            .replace("{direction}", direction)
            .replace("{CONSTANT}", &constant)
            .replace("{DIRECTION}", &shouted)
            .replace("{Op}", &camel)
    };

    append(&kernel, "", &fill(KERNEL))?;
    append(&format!("crates/cpu/src/ops/{op}.rs"), &fill(REFERENCE_FILE), &fill(REFERENCE))?;
    append(&format!("crates/plan/src/ops/{op}.rs"), &fill(STEP_FILE), &fill(STEP))?;
    append(&format!("tests/kernels/{op}.rs"), &fill(TEST_FILE), &fill(TEST))?;
    println!("{}", fill(HINTS));
    Ok(())
}

fn append(path: &str, opening: &str, text: &str) -> Result<(), String> {
    let full = root().join(path);
    let failed = |error: std::io::Error| format!("{path}: {error}");
    let text = if full.exists() { format!("\n{text}") } else { format!("{opening}{text}") };
    std::fs::create_dir_all(full.parent().unwrap_or(Path::new("."))).map_err(failed)?;
    let mut file = std::fs::OpenOptions::new().create(true).append(true).open(&full).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    println!("{path}");
    Ok(())
}

const KERNEL: &str = "\
// y = formula of x.
// One invocation computes one value.
// x [count] → y [count].
// OVERWRITES y.

struct Params {
    count: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> x: array<f32>;
@group(0) @binding(2) var<storage, read_write> y: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) workgroup: vec3<u32>,
    @builtin(num_workgroups) workgroups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
) {
    let i = flat_index(workgroup, workgroups, local);
    if (i >= params.count) {
        return;
    }
    y[i] = x[i];
}
";

const REFERENCE_FILE: &str = "//! What {op} is.\n\nuse srn_shaders::{Op}Params;\n\nuse crate::Real;\n\n";

const REFERENCE: &str = "\
/// `y = formula of x`.
pub fn {direction}<T: Real>(p: {Op}Params, x: &[T], y: &mut [T]) {
    let count = p.count as usize;
    y[..count].copy_from_slice(&x[..count]);
}
";

const STEP_FILE: &str = "\
//! What {op} is.

use srn_shaders::{{CONSTANT}, {Op}Params};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

";

const STEP: &str = "\
/// `x [count]` → `y [count]`; overwrites.
pub fn {direction}(b: &mut Builder, count: u32, x: BufferId, y: BufferId) -> Result<(), PlanError> {
    let args = [read(x, size([count])), overwrite(y, size([count]))];
    b.step(&{CONSTANT}, {Op}Params { count }, &args, [count, 1, 1], 0, 0)
}
";

const TEST_FILE: &str = "\
use srn_plan::ops::{op};
use srn_shaders::{CONSTANT};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

";

const TEST: &str = r#"pub static {DIRECTION}: KernelTest = KernelTest {
    kernel: &{CONSTANT},
    // Worst … on llvmpipe.
    tolerance: 1e-6,
    cases: {direction},
    faults: &[("{direction}", "y[i] = x[i]", "y[i] = x[i] + 1.0")],
};

#[test]
fn {direction}_matches_reference() {
    {DIRECTION}.matches_reference();
}

fn {direction}() -> Vec<Case> {
    [1, 63, 130].map({direction}_case).into()
}

fn {direction}_case(count: u32) -> Case {
    let mut s = Sketch::new(format!("{count}"));
    let x = s.random("x", count as usize);
    let y = s.scratch("y", count as usize);
    s.step(|b| {op}::{direction}(b, count, x, y));
    s.finish()
}
"#;

const HINTS: &str = r#"
Now make them known:
  shaders/src/params.rs        params! { {Op}Params { count: u32 } } as for the others there
  shaders/src/table.rs         {CONSTANT} = "{op}"/"{direction}", {Op}Params, tile FLAT, (x: f32) -> (y: f32);
  crates/cpu/src/ops/mod.rs    pub mod {op};
  crates/cpu/src/executor.rs   "{op}/{direction}" => {op}::{direction}(f) -> (f_mut);
  crates/plan/src/ops/mod.rs   pub mod {op};
  tests/kernels/main.rs        mod {op};   and   &{op}::{DIRECTION}, in the order of the table
then: cargo xtask table, cargo xtask test"#;
