//! Every WGSL kernel against its CPU reference in `f64`, and every kernel with a fault planted into it.
//!
//! `<op>.rs` holds a [`KernelTest`] and a test for each direction of an op. Sizes are odd, groups several, outputs poisoned.

use std::collections::BTreeSet;

use srn_cpu::Precision;
use srn_gpu::{Choice, Gpu, GpuExecutor, wgpu};
use srn_plan::{Executor, ExecutorError, Kernel, Rows, Step};
use srn_shaders::{Requirement, TABLE, Variant};
use srn_tests::{Case, Divergence, cooperative_gpu, gpu, lockstep};

mod adam;
mod advance;
mod bfgs;
mod density_sum;
mod depth;
mod depth_loss;
mod embedding;
mod executor;
mod gmsd;
mod hidden_layer;
mod image_loss;
mod latent_loss;
mod layer_norm_relu;
mod linear;
mod lockstep;
mod lstm_cell;
mod pack_rgba8;
mod point_layer;
mod pose;
mod rays;
mod sum;
mod tile;

/// What a kernel is tried on, how close it must come, and what must make it fail.
struct KernelTest {
    kernel: &'static Kernel,
    /// Most difference, relative to the largest value of the output: the worst that was measured, which stands beside it,
    /// times five.
    tolerance: f64,
    cases: fn() -> Vec<Case>,
    /// Each of them some case must catch.
    faults: &'static [Fault],
}

/// `(variant, from, to)`: a change to the WGSL text.
type Fault = (&'static str, &'static str, &'static str);

/// One of each kernel, in the order of the table.
static ALL: &[&KernelTest] = &[
    &pose::FORWARD,
    &pose::BACKWARD,
    &rays::FORWARD,
    &rays::BACKWARD,
    &tile::GATHER,
    &tile::SCATTER,
    &embedding::FORWARD,
    &embedding::BACKWARD,
    &linear::FORWARD,
    &linear::BACKWARD_INPUT,
    &linear::BACKWARD_WEIGHT,
    &layer_norm_relu::FORWARD,
    &layer_norm_relu::BACKWARD_INPUT,
    &layer_norm_relu::BACKWARD_AFFINE,
    &hidden_layer::FORWARD,
    &hidden_layer::BACKWARD_INPUT,
    &point_layer::FORWARD,
    &point_layer::BACKWARD_INPUT,
    &lstm_cell::FORWARD,
    &lstm_cell::BACKWARD,
    &advance::FORWARD,
    &advance::BACKWARD,
    &density_sum::FORWARD,
    &density_sum::BACKWARD,
    &depth::FORWARD,
    &depth::BACKWARD,
    &depth_loss::FORWARD,
    &latent_loss::FORWARD,
    &latent_loss::BACKWARD,
    &image_loss::COUNT,
    &image_loss::FORWARD,
    &image_loss::BACKWARD,
    &gmsd::POOL,
    &gmsd::SIMILARITY,
    &gmsd::MOMENTS,
    &gmsd::DEVIATION,
    &gmsd::BACKWARD_SIMILARITY,
    &gmsd::BACKWARD_POOL,
    &adam::STEP,
    &sum::FORWARD,
    &bfgs::EQUATIONS,
    &bfgs::BEGIN,
    &bfgs::GRADIENT,
    &bfgs::UPDATE,
    &bfgs::SOLVE,
    &pack_rgba8::FORWARD,
];

/// Rows of one image and of several, below and above a workgroup, starting at image 0 and later.
const ROWS: [Rows; 5] = [
    Rows { groups: 1, rows_per_group: 1, first_group: 0 },
    Rows { groups: 1, rows_per_group: 7, first_group: 1 },
    Rows { groups: 3, rows_per_group: 33, first_group: 2 },
    Rows { groups: 1, rows_per_group: 129, first_group: 0 },
    Rows { groups: 2, rows_per_group: 300, first_group: 0 },
];

impl KernelTest {
    /// Runs every case on every variant, and on the CPU in `f32`; only the steps of this kernel run there, on inputs that the reference
    /// computed.
    fn matches_reference(&self) {
        for case in (self.cases)() {
            let mut executor =
                srn_cpu::executor(Precision::F32, case.plan.clone(), u64::MAX).expect("every kernel has a reference");
            self.worst(&case, executor.as_mut()).unwrap_or_else(|what| panic!("{} on the CPU: {what}", case.name));
        }
        for variant in self.kernel.variants {
            // What the device cannot run has no turn.
            let Some(gpu) = device(variant) else { continue };
            let gpu = gpu.with_choice(Choice::Named(variant.name.into()));
            let (mut ran, mut worst) = (false, 0.0f64);
            for case in (self.cases)() {
                let mut executor =
                    GpuExecutor::new(&gpu, case.plan.clone(), u64::MAX).unwrap_or_else(|error| panic!("{}: {error}", case.name));
                // Other cases run the plain form, which has its own turn.
                if self.runs(&case, &executor, variant) {
                    ran = true;
                    let found = self.worst(&case, &mut executor);
                    worst = worst.max(found.unwrap_or_else(|what| panic!("{}: {what}", case.name)));
                }
            }
            assert!(ran, "no case runs {}", variant.name);
            println!("worst {worst:.1e}: {}", self.kernel.label(variant));
        }
    }

    /// Whether some step of this kernel runs this variant.
    fn runs(&self, case: &Case, executor: &GpuExecutor, variant: &Variant) -> bool {
        let label = self.kernel.label(variant);
        let steps = case.plan.stage(case.stage).steps.iter().enumerate();
        steps
            .filter(|(_, step)| step.kernel.name == self.kernel.name)
            .any(|(index, _)| executor.label(case.stage, index) == label)
    }

    fn worst(&self, case: &Case, executor: &mut dyn Executor) -> Result<f64, Divergence> {
        let mut reference = srn_cpu::executor(Precision::F64, case.plan.clone(), u64::MAX).expect("every kernel has a reference");
        case.fill(reference.as_mut()).expect("filling the reference");
        case.fill(executor).expect("filling the device");
        let tolerance = |kernel: &Kernel| (kernel.name == self.kernel.name).then_some(self.tolerance);
        let worst = lockstep(executor, reference.as_mut(), case.stage, tolerance)?;
        Ok(worst[self.kernel.name])
    }

    /// The device, with a fault planted into this kernel.
    fn faulty_gpu(&self, gpu: &Gpu, &(name, from, to): &Fault) -> Gpu {
        let op = self.kernel.op;
        let faulty = gpu.with_sources(move |kernel, variant| {
            let text = kernel.source(variant);
            if (kernel.op, variant.name) == (op, name) { plant(&text, from, to) } else { text }
        });
        faulty.with_choice(Choice::Named(name.into()))
    }

    /// Whether some case fails with the fault planted.
    fn catches(&self, gpu: &Gpu, fault: &Fault) -> Result<bool, ExecutorError> {
        let gpu = self.faulty_gpu(gpu, fault);
        for case in (self.cases)() {
            if self.worst(&case, &mut GpuExecutor::new(&gpu, case.plan.clone(), u64::MAX)?).is_err() {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

/// The device that runs the variant, on sizes that suit it; `None` where this machine has none.
fn device(variant: &Variant) -> Option<&'static Gpu> {
    let requires = |requirement| variant.requires.contains(&requirement);
    if requires(Requirement::CooperativeMatrices) {
        return cooperative_gpu();
    }
    let has_subgroups = gpu().device().features().contains(wgpu::Features::SUBGROUP);
    (has_subgroups || !requires(Requirement::Subgroups)).then(gpu)
}

/// Changes the first line of code that contains `from`.
fn plant(text: &str, from: &str, to: &str) -> String {
    let mut planted = false;
    let lines = text.lines().map(|line| {
        if planted || line.trim_start().starts_with("//") || !line.contains(from) {
            return line.to_owned();
        }
        planted = true;
        line.replacen(from, to, 1)
    });
    lines.collect::<Vec<_>>().join("\n")
}

#[test]
fn every_kernel_has_a_test_and_every_variant_a_planted_fault() {
    let tested: Vec<_> = ALL.iter().map(|test| test.kernel.name).collect();
    let table: Vec<_> = TABLE.iter().map(|kernel| kernel.name).collect();
    assert_eq!(tested, table);
    for test in ALL {
        for variant in test.kernel.variants {
            let source = test.kernel.source(variant);
            let faults: Vec<_> = test.faults.iter().filter(|fault| fault.0 == variant.name).collect();
            assert!(!faults.is_empty(), "{}/{} has no fault", test.kernel.op, variant.name);
            for (_, from, to) in faults {
                assert_ne!(plant(&source, from, to), source.trim_end(), "{}/{}: no `{from}`", test.kernel.op, variant.name);
            }
        }
    }
}

/// The same adapter, for grids of at most so many workgroups in one dimension.
fn gpu_with_grids_of(most: u32) -> Gpu {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let is_wanted = |adapter: &wgpu::Adapter| {
        let (info, wanted) = (adapter.get_info(), gpu().adapter());
        info.name == wanted.name && format!("{:?}", info.backend) == wanted.backend
    };
    let mut found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all())).into_iter().filter(is_wanted);
    let adapter = found.next().expect("the test's adapter is there");
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        required_features: adapter.features() & wgpu::Features::SUBGROUP,
        required_limits: wgpu::Limits { max_compute_workgroups_per_dimension: most, ..Default::default() },
        ..Default::default()
    }))
    .expect("a device with small limits");
    Gpu::from_device(device, queue)
}

/// What has more workgroups than one dimension of a grid holds, millions of rows, has them in two.
#[test]
fn long_grids_are_folded() {
    const MOST: u32 = 2;
    let gpu = gpu_with_grids_of(MOST);
    let mut folded = BTreeSet::new();
    for test in ALL {
        let is_flat = |variant: &&Variant| variant.tile[1..] == [1, 1] && device(variant).is_some();
        let is_cooperative = |variant: &&Variant| variant.requires.contains(&Requirement::CooperativeMatrices);
        for variant in test.kernel.variants.iter().filter(is_flat).filter(|variant| !is_cooperative(variant)) {
            let gpu = gpu.with_choice(Choice::Named(variant.name.into()));
            let is_long = |step: &Step| {
                let [x, y, z] = step.extent;
                step.kernel.name == test.kernel.name && [y, z] == [1, 1] && x > MOST * variant.tile[0]
            };
            for case in (test.cases)().into_iter().filter(|case| case.plan.stage(case.stage).steps.iter().any(is_long)) {
                // Other steps of a case may have grids that cannot be folded.
                let Ok(mut executor) = GpuExecutor::new(&gpu, case.plan.clone(), u64::MAX) else { continue };
                if test.runs(&case, &executor, variant) {
                    test.worst(&case, &mut executor).unwrap_or_else(|what| panic!("{}: {what}", case.name));
                    folded.insert(test.kernel.label(variant));
                }
            }
        }
    }
    println!("folded: {folded:?}");
    for label in ["point_layer/forward", "point_layer/backward_input", "layer_norm_relu/forward", "lstm_cell/backward_vec4"] {
        assert!(folded.contains(label), "{label}: {folded:?}");
    }
}

/// llvmpipe's subgroups have 8 lanes, unless this variable makes them 16 where the processor can; then kernels that work in
/// teams of eight have several to a subgroup, as on a real GPU. Read when the driver is loaded: in a process of its own.
#[test]
fn subgroups_of_several_teams() {
    let mut tests = std::process::Command::new(std::env::current_exe().expect("this program has a path"));
    tests.args(["linear::", "layer_norm_relu::", "point_layer::", "--quiet"]).env("LP_NATIVE_VECTOR_WIDTH", "512");
    let output = tests.output().expect("this program runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
}

#[test]
fn planted_fault() {
    let runs =
        |test: &KernelTest, fault: &Fault| test.kernel.variants.iter().find(|variant| variant.name == fault.0).and_then(device);
    let faults = ALL.iter().flat_map(|test| test.faults.iter().map(move |fault| (*test, fault)));
    let faults: Vec<_> = faults.filter_map(|(test, fault)| Some((test, runs(test, fault)?, fault))).collect();
    let missed = |&(test, gpu, fault): &(&KernelTest, &Gpu, &Fault)| {
        let (variant, from, to) = fault;
        let what = match test.catches(gpu, fault) {
            Ok(true) => return None,
            Ok(false) => "is not caught".to_owned(),
            Err(error) => error.to_string(),
        };
        Some(format!("{}/{variant}: `{from}` → `{to}` {what}", test.kernel.op))
    };
    // Compiling a kernel, most of the work here, does not use all cores.
    let missed: Vec<String> = std::thread::scope(|scope| {
        let parts = faults.chunks(faults.len().div_ceil(4));
        let workers: Vec<_> = parts.map(|part| scope.spawn(move || part.iter().filter_map(missed).collect::<Vec<_>>())).collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("a worker panicked")).collect()
    });
    assert!(missed.is_empty(), "{}", missed.join("\n"));
}
