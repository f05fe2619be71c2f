use std::path::PathBuf;

use srn_plan::{ExecutorError, PlanError};

/// What can go wrong in this library.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file that cannot be read or written.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A model file that is of no known format, or broken, or does not fit.
    #[error("{}: {what}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// A tensor that a model needs is not there.
    #[error("tensor `{name}` is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor of the wrong shape or type.
    #[error("tensor `{name}`: expected {expected}, got {got}")]
    Tensor {
        /// Its name.
        name: String,
        /// Shape and type that fit.
        expected: String,
        /// Shape and type that are there.
        got: String,
    },
    /// A setting that makes no sense.
    #[error("{field}: {what}")]
    Setting {
        /// The setting.
        field: &'static str,
        /// Why.
        what: String,
    },
    /// Input of the wrong size, or with values that are not finite.
    #[error("{input}: {what}")]
    Input {
        /// Which input.
        input: String,
        /// What is wrong, with both numbers.
        what: String,
    },
    /// An image whose pose is looked for, or what is known of it, that makes no sense.
    #[error("image {number}: {what}")]
    Query {
        /// Its number among the queries, from 0.
        number: usize,
        /// What is wrong.
        what: String,
    },
    /// The memory budget is too small for even the smallest portions of the work.
    #[error("the memory budget of {budget} bytes is too small: this work needs {needed}")]
    Budget {
        /// The budget.
        budget: u64,
        /// The least that works.
        needed: u64,
    },
    /// Training met a loss that is not a number.
    #[error("step {step}: the loss is not finite; lower the learning rate")]
    Diverged {
        /// The training step.
        step: u64,
    },
    /// A GPU whose results are wrong.
    #[error(
        "adapter `{adapter}` computes wrong results: {work} differ by {difference:.1e} of the largest from those of the CPU \
         executor, also with the plain form of every kernel; try another driver, another adapter, or the CPU executor"
    )]
    Adapter {
        /// The adapter, with backend and driver.
        adapter: String,
        /// What was tried.
        work: &'static str,
        /// Relative to the largest; infinite where something was not finite.
        difference: f64,
    },
    /// A mistake in a plan: a bug here, or a model with shapes that do not fit.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The executor failed.
    #[error(transparent)]
    Executor(#[from] ExecutorError),
}
