//! The GPU executor: that its results are a device's, and that what goes wrong there reaches the caller as an error.

use srn_gpu::{AdapterInfo, Choice, Gpu, GpuExecutor, OpenError, wgpu};
use srn_plan::ops::{latent_loss, linear, sum};
use srn_plan::{BufferId, Builder, Executor, ExecutorError, Plan, Rows, StageId};
use srn_tests::gpu;

/// `y = Σ x` over six values, `steps` times in a row, added to what `y` holds.
fn sums(steps: usize) -> (Plan, StageId, BufferId, BufferId) {
    let mut b = Builder::new(1 << 20);
    let x = b.input("x", 6).unwrap();
    let y = b.input("y", 1).unwrap();
    let stage = b.stage("sums");
    for _ in 0..steps {
        sum::forward(&mut b, sum::Groups::ONE, 6, 1, x, y, true).unwrap();
    }
    (b.finish().unwrap(), stage, x, y)
}

const X: [f32; 6] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];

/// A device whose failures do not reach other tests.
fn own_gpu() -> Gpu {
    Gpu::open(Some(&gpu().adapter().name)).unwrap()
}

fn message<T>(result: Result<T, ExecutorError>) -> String {
    match result {
        Ok(_) => panic!("expected an error"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn buffers_start_at_zero_and_steps_run_in_order_over_several_submissions() {
    let (plan, stage, x, y) = sums(4500);
    let mut executor = GpuExecutor::new(gpu(), plan, u64::MAX).unwrap();
    executor.run(stage).unwrap();
    assert_eq!(executor.read(y).unwrap(), [0.0]);
    executor.write(x, &X).unwrap();
    executor.run(stage).unwrap();
    executor.run_step(stage, 7).unwrap();
    assert_eq!(executor.read(y).unwrap(), [4501.0 * 21.0]);
}

#[test]
fn encodes_into_the_callers_encoder_on_the_callers_device() {
    let own = own_gpu();
    let (device, queue) = (own.device().clone(), own.queue().clone());
    let (plan, stage, x, y) = sums(2);
    let mut executor = GpuExecutor::new(&Gpu::from_device(device.clone(), queue.clone()), plan, u64::MAX).unwrap();
    executor.write(x, &X).unwrap();
    let copy = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("copy"),
        size: executor.buffer(y).size(),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&Default::default());
    executor.encode(stage, &mut encoder);
    encoder.copy_buffer_to_buffer(executor.buffer(y), 0, &copy, 0, 4);
    queue.submit([encoder.finish()]);
    copy.slice(..).map_async(wgpu::MapMode::Read, |result| result.unwrap());
    device.poll(wgpu::PollType::wait_indefinitely()).unwrap();
    assert_eq!(&copy.slice(..).get_mapped_range().unwrap()[..], 42f32.to_ne_bytes());
    assert_eq!(executor.read(y).unwrap(), [42.0]);
}

#[test]
fn bindings_are_found_by_name() {
    let swapped = gpu().with_sources(|kernel, variant| {
        let text = kernel.source(variant);
        text.replace("@binding(1)", "@binding(9)").replace("@binding(2)", "@binding(1)").replace("@binding(9)", "@binding(2)")
    });
    let (plan, stage, x, y) = sums(1);
    let mut executor = GpuExecutor::new(&swapped, plan, u64::MAX).unwrap();
    executor.write(x, &X).unwrap();
    executor.run(stage).unwrap();
    assert_eq!(executor.read(y).unwrap(), [21.0]);
}

#[test]
fn a_profile_times_every_kernel() {
    let mut b = Builder::new(1 << 20);
    let z = b.input("z", 1000).unwrap();
    let partial = b.scratch("partial", latent_loss::partial_len(1000)).unwrap();
    let loss = b.scratch("loss", 1).unwrap();
    let stage = b.stage("loss");
    for _ in 0..3 {
        latent_loss::forward(&mut b, 1000, 1.0, z, partial, loss).unwrap();
    }
    let mut executor = GpuExecutor::new(gpu(), b.finish().unwrap(), u64::MAX).unwrap();
    executor.write(z, &[1.0; 1000]).unwrap();
    let times = executor.profile(&[stage]).unwrap();
    assert_eq!(executor.read(loss).unwrap(), [1000.0]);
    let mut labels: Vec<_> = times.iter().map(|time| (time.label.as_str(), time.steps)).collect();
    labels.sort();
    assert_eq!(labels, [("latent_loss/forward", 3), ("sum/forward", 3)]);
    assert!(times.iter().all(|time| time.seconds > 0.0 && time.seconds < 10.0), "{times:?}");
    assert!(times[0].seconds >= times[1].seconds);
}

/// A layer that several variants can compute.
fn product() -> (Plan, StageId, BufferId) {
    let mut b = Builder::new(1 << 20);
    let [x, weights] = [("x", 64 * 8), ("weights", 8 * 9)].map(|(name, len)| b.input(name, len).unwrap());
    let slots = b.input_u32("slots", 1).unwrap();
    let y = b.scratch("y", 64 * 8).unwrap();
    let stage = b.stage("product");
    let layer = linear::Layer { weights, in_features: 8, out_features: 8, sets: linear::Sets::Shared };
    linear::forward(&mut b, Rows::plain(64), layer, x, slots, y, false).unwrap();
    (b.finish().unwrap(), stage, y)
}

/// What a device chooses for the [`product`].
fn chosen(gpu: &Gpu) -> String {
    let (plan, stage, y) = product();
    let mut executor = GpuExecutor::new(gpu, plan, u64::MAX).unwrap();
    assert!(executor.read(y).unwrap().iter().all(|&value| value == 0.0), "measuring wrote into the plan's buffer");
    executor.label(stage, 0).to_owned()
}

#[test]
fn a_measured_choice_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("new/folder");
    let measured = || gpu().with_choice(Choice::Measured { cache: Some(folder.clone()) });
    let first = chosen(&measured());
    assert!(first.starts_with("linear/forward"), "{first}");
    let file = folder.join("variants.txt");
    let kept = std::fs::read_to_string(&file).unwrap();
    assert!(kept.lines().count() == 1 && kept.ends_with(&format!(" {first}\n")), "{kept}");
    // Another process with another choice: its word holds, also against a measurement.
    for other in ["linear/forward", "linear/forward_vec4"] {
        std::fs::write(&file, kept.replace(&first, other)).unwrap();
        assert_eq!(chosen(&measured()), other);
    }
    // What is not a choice is measured again; nothing but the file and its lock is left.
    for broken in [kept.replace(&first, "linear/no_such_variant").into_bytes(), b"\xff\xfe {]".to_vec(), vec![]] {
        std::fs::write(&file, broken).unwrap();
        assert!(chosen(&measured()).starts_with("linear/forward"));
        let again = std::fs::read_to_string(&file).unwrap();
        assert!(again.lines().any(|line| line.starts_with(&kept[..16]) && !line.contains("no_such")), "{again}");
    }
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 2);
}

#[test]
fn other_texts_are_measured_anew() {
    let dir = tempfile::tempdir().unwrap();
    let measured = || gpu().with_choice(Choice::Measured { cache: Some(dir.path().into()) });
    chosen(&measured());
    chosen(&measured().with_sources(|kernel, variant| format!("{}\n// changed", kernel.source(variant))));
    let kept = std::fs::read_to_string(dir.path().join("variants.txt")).unwrap();
    assert_eq!(kept.lines().count(), 2, "{kept}");
}

#[test]
fn a_choice_needs_no_cache() {
    let dir = tempfile::tempdir().unwrap();
    let occupied = dir.path().join("a file");
    std::fs::write(&occupied, "in the way").unwrap();
    for cache in [None, Some(occupied)] {
        assert!(chosen(&gpu().with_choice(Choice::Measured { cache })).starts_with("linear/forward"));
    }
    assert_eq!(chosen(&gpu().with_choice(Choice::Named("forward_vec4".into()))), "linear/forward_vec4");
    assert_eq!(chosen(&gpu().with_choice(Choice::Named("of another kernel".into()))), "linear/forward");
}

#[test]
fn an_unknown_adapter_is_an_error_that_lists_the_known() {
    let Err(OpenError::NotFound { wanted, found }) = Gpu::open(Some("no such adapter")) else { panic!("expected an error") };
    assert_eq!(wanted, "no such adapter");
    assert!(found.contains(&gpu().adapter().to_string()));
}

#[test]
fn an_adapter_is_found_by_words_of_its_name_and_its_backend() {
    let AdapterInfo { name, backend, .. } = gpu().adapter();
    let of_the_name = name.split_whitespace().next().unwrap();
    for wanted in [&name, &backend, &format!("{backend} {name}"), &format!("{of_the_name} {backend}").to_uppercase()] {
        let opened = Gpu::open(Some(wanted)).unwrap().adapter();
        assert_eq!((&opened.name, &opened.backend), (&name, &backend), "{wanted}");
    }
    assert!(Gpu::open(Some(&format!("{name} on another backend"))).is_err());
}

#[test]
fn a_plan_beyond_the_budget_is_refused() {
    let (plan, ..) = sums(1);
    let result = GpuExecutor::new(gpu(), plan, 27);
    assert_eq!(result.err(), Some(ExecutorError::Memory { needed: 28, budget: 27 }));
}

#[test]
fn wrong_lengths_and_types_are_refused_and_harm_nothing() {
    let (plan, stage, x, y) = sums(1);
    let mut executor = GpuExecutor::new(gpu(), plan, u64::MAX).unwrap();
    let length = ExecutorError::Length { buffer: "x".into(), expected: 6, got: 5 };
    assert_eq!(executor.write(x, &X[..5]), Err(length));
    assert_eq!(executor.read_u32(x), Err(ExecutorError::ElementType { buffer: "x".into() }));
    executor.write(x, &X).unwrap();
    executor.run(stage).unwrap();
    assert_eq!(executor.read(y).unwrap(), [21.0]);
}

#[test]
fn an_invalid_shader_is_an_error() {
    let new = |from: &'static str, to: &'static str| {
        let faulty = gpu().with_sources(move |kernel, variant| kernel.source(variant).replace(from, to));
        message(GpuExecutor::new(&faulty, sums(1).0, u64::MAX))
    };
    // Found by the parser, by the validator, by the limits of the device, by the reflection.
    assert!(new("var total = 0.0;", "var total = ;").starts_with("sum/forward: WGSL line"));
    assert!(new("var total = 0.0;", "var total = 0u;").starts_with("sum/forward: "));
    assert!(new("workgroup_size(64)", "workgroup_size(64000)").contains("Workgroup size"));
    assert!(new("x: array", "z: array").contains("no definition in scope"));
}

#[test]
fn too_many_workgroups_are_an_error() {
    let rows = Rows { groups: 65_536, rows_per_group: 1, first_group: 0 };
    let mut b = Builder::new(1 << 20);
    let x = b.input("x", 65_536).unwrap();
    let weights = b.input("weights", 2).unwrap();
    let slots = b.input_u32("slots", 65_536).unwrap();
    let y = b.scratch("y", 65_536).unwrap();
    b.stage("test");
    let sets = linear::Sets::Slots { count: 1 };
    linear::forward(&mut b, rows, linear::Layer { weights, in_features: 1, out_features: 1, sets }, x, slots, y, false).unwrap();
    let what = message(GpuExecutor::new(gpu(), b.finish().unwrap(), u64::MAX));
    assert!(what.starts_with("linear/forward: ") && what.contains("65535 workgroups"), "{what}");
}

#[test]
fn a_failed_run_reaches_the_reader() {
    let (plan, stage, x, y) = sums(1);
    let mut executor = GpuExecutor::new(gpu(), plan, u64::MAX).unwrap();
    executor.buffer(x).destroy();
    let what = message(executor.run(stage));
    assert!(what.contains("destroyed"), "{what}");
    // Not the zero that `y` still holds.
    assert_eq!(message(executor.read(y)), what);
}

#[test]
fn a_lost_device_reaches_the_reader() {
    let own = own_gpu();
    let (plan, stage, _, y) = sums(1);
    let mut executor = GpuExecutor::new(&own, plan.clone(), u64::MAX).unwrap();
    own.device().destroy();
    // Whether the run already knows depends on the driver.
    let _ = executor.run(stage);
    assert!(message(executor.read(y)).contains("lost"));
    assert!(message(GpuExecutor::new(&own, plan, u64::MAX)).contains("lost"));
}

#[test]
fn an_error_outside_of_any_call_reaches_the_reader() {
    let own = own_gpu();
    let (plan, _, _, y) = sums(1);
    let mut executor = GpuExecutor::new(&own, plan, u64::MAX).unwrap();
    let _ = own.device().create_buffer(&wgpu::BufferDescriptor {
        label: Some("far too large"),
        size: 1 << 60,
        usage: wgpu::BufferUsages::STORAGE,
        mapped_at_creation: false,
    });
    assert!(message(executor.read(y)).contains("far too large"));
}
