//! Lockstep names the first kernel that differs, and judges each on the reference's inputs.

use srn_cpu::Precision;
use srn_gpu::GpuExecutor;
use srn_plan::Executor;
use srn_tests::{Case, gpu, lockstep};

use crate::layer_norm_relu;

fn case() -> Case {
    (layer_norm_relu::BACKWARD_INPUT.cases)().swap_remove(2)
}

fn reference(case: &Case) -> Box<dyn Executor> {
    let mut reference = srn_cpu::executor(Precision::F64, case.plan.clone(), u64::MAX).unwrap();
    case.fill(reference.as_mut()).unwrap();
    reference
}

#[test]
fn passes_and_reports_every_kernel() {
    let case = case();
    let mut subject = GpuExecutor::new(gpu(), case.plan.clone(), u64::MAX).unwrap();
    case.fill(&mut subject).unwrap();
    let worst = lockstep(&mut subject, reference(&case).as_mut(), case.stage, |_| Some(1e-5)).unwrap();
    let kernels: Vec<_> = worst.keys().copied().collect();
    let expected = ["backward_affine", "backward_input", "forward"].map(|direction| format!("layer_norm_relu/{direction}"));
    assert_eq!(kernels, [&expected[0], &expected[1], &expected[2], "sum/forward"]);
}

#[test]
fn names_the_first_kernel_that_differs() {
    let case = case();
    let tests = [&layer_norm_relu::FORWARD, &layer_norm_relu::BACKWARD_INPUT, &layer_norm_relu::BACKWARD_AFFINE];
    for (step, test) in tests.into_iter().enumerate() {
        let mut subject = GpuExecutor::new(&test.faulty_gpu(gpu(), &test.faults[0]), case.plan.clone(), u64::MAX).unwrap();
        case.fill(&mut subject).unwrap();
        let divergence = lockstep(&mut subject, reference(&case).as_mut(), case.stage, |_| Some(1e-5)).unwrap_err();
        assert_eq!((divergence.step, divergence.kernel), (step, test.kernel.name), "{divergence}");
    }
}
