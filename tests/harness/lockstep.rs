use std::collections::BTreeMap;
use std::fmt;

use srn_plan::{BufferId, Element, Executor, ExecutorError, Kernel, StageId};

use crate::difference;

/// The first step after which two executors hold different values.
#[derive(Debug, Clone, PartialEq)]
pub struct Divergence {
    /// Number of the step in its stage.
    pub step: usize,
    /// Name of its kernel.
    pub kernel: &'static str,
    /// What differs, and by how much; or what failed.
    pub what: String,
}

impl fmt::Display for Divergence {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "step {}, {}: {}", self.step, self.kernel, self.what)
    }
}

/// Runs a stage step by step on two executors of one plan whose buffers hold the same values, and compares what each step
/// wrote. Returns the worst [`difference`] of every kernel, or the first step that exceeds its tolerance.
///
/// After each step the subject gets the reference's values, so that every kernel is judged on the same inputs and errors
/// do not add up. A kernel with no tolerance is not run on the subject at all. Integers are compared as packed bytes.
pub fn lockstep(
    subject: &mut dyn Executor,
    reference: &mut dyn Executor,
    stage: StageId,
    tolerance: impl Fn(&Kernel) -> Option<f64>,
) -> Result<BTreeMap<&'static str, f64>, Divergence> {
    let steps = reference.plan().stage(stage).steps.clone();
    let mut worst = BTreeMap::new();
    for (index, step) in steps.iter().enumerate() {
        let diverged = |what: String| Divergence { step: index, kernel: step.kernel.name, what };
        let failed = |error: ExecutorError| diverged(error.to_string());
        let tolerance = tolerance(step.kernel);
        reference.run_step(stage, index).map_err(failed)?;
        if tolerance.is_some() {
            subject.run_step(stage, index).map_err(failed)?;
        }
        for (binding, &id) in step.kernel.bindings.iter().zip(&step.buffers).filter(|(binding, _)| binding.written) {
            if let Some(tolerance) = tolerance {
                let name = format!("`{}` (buffer `{}`)", binding.name, reference.plan().buffer(id).name);
                let got = comparable(subject, id, binding.element).map_err(failed)?;
                let want = comparable(reference, id, binding.element).map_err(failed)?;
                let error = difference(&got, &want).map_err(|what| diverged(format!("{name} {what}")))?;
                let kernel = worst.entry(step.kernel.name).or_insert(0.0);
                *kernel = error.max(*kernel);
                if error > tolerance {
                    return Err(diverged(format!("{name} differs by {error:.2e} of its largest value, allowed {tolerance:.0e}")));
                }
            }
            share(subject, reference, id, binding.element).map_err(failed)?;
        }
    }
    Ok(worst)
}

fn comparable(executor: &mut dyn Executor, id: BufferId, element: Element) -> Result<Vec<f32>, ExecutorError> {
    match element {
        Element::F32 => executor.read(id),
        Element::U32 => Ok(executor.read_u32(id)?.iter().flat_map(|word| word.to_le_bytes()).map(f32::from).collect()),
    }
}

/// The reference's values, rounded to what the subject can hold, for both.
fn share(subject: &mut dyn Executor, reference: &mut dyn Executor, id: BufferId, element: Element) -> Result<(), ExecutorError> {
    match element {
        Element::F32 => {
            let values = reference.read(id)?;
            reference.write(id, &values)?;
            subject.write(id, &values)
        }
        Element::U32 => subject.write_u32(id, &reference.read_u32(id)?),
    }
}
