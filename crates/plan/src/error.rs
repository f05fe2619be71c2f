/// What is wrong with a plan; found when it is built.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A buffer is too short for the step that binds it.
    #[error("{op}: `{binding}` is bound to buffer `{buffer}` of {len} elements, but needs {needed}")]
    TooShort {
        /// Kernel name.
        op: &'static str,
        /// Binding name.
        binding: &'static str,
        /// Buffer name.
        buffer: String,
        /// Elements in the buffer.
        len: usize,
        /// Elements that the step touches.
        needed: usize,
    },
    /// A buffer of the other element type.
    #[error("{op}: `{binding}` is bound to buffer `{buffer}`, whose elements have the wrong type")]
    ElementType {
        /// Kernel name.
        op: &'static str,
        /// Binding name.
        binding: &'static str,
        /// Buffer name.
        buffer: String,
    },
    /// A buffer bound twice in one step, at least once for writing.
    #[error("{op}: buffer `{buffer}` is written and bound a second time")]
    Aliased {
        /// Kernel name.
        op: &'static str,
        /// Buffer name.
        buffer: String,
    },
    /// A step reads what no earlier step and no input wrote.
    #[error("{op} in stage `{stage}` reads buffer `{buffer}` before anything wrote it")]
    ReadBeforeWrite {
        /// Kernel name.
        op: &'static str,
        /// Stage name.
        stage: String,
        /// Buffer name.
        buffer: String,
    },
    /// A buffer that no step binds.
    #[error("buffer `{buffer}` is never used")]
    Unused {
        /// Buffer name.
        buffer: String,
    },
    /// One invocation would loop longer than some drivers allow (they stop silently after 65,535 iterations).
    #[error("{op}: an invocation would run {loops} loop iterations, the limit is {limit}")]
    TooManyLoops {
        /// Kernel name.
        op: &'static str,
        /// Iterations of one invocation.
        loops: u64,
        /// Most that are allowed.
        limit: u64,
    },
    /// A buffer larger than one binding may be.
    #[error("buffer `{buffer}` needs {bytes} bytes, but this device binds at most {limit}")]
    TooLarge {
        /// Buffer name.
        buffer: String,
        /// Its size.
        bytes: u64,
        /// The device's limit.
        limit: u64,
    },
    /// A step with nothing to do, or with sizes that do not fit together.
    #[error("{op}: {what}")]
    Shape {
        /// Kernel name.
        op: &'static str,
        /// What does not fit.
        what: String,
    },
}

/// What can go wrong when a plan runs.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ExecutorError {
    /// A slice whose length is not the buffer's.
    #[error("buffer `{buffer}` has {expected} elements, got {got}")]
    Length {
        /// Buffer name.
        buffer: String,
        /// Its length.
        expected: usize,
        /// The slice's length.
        got: usize,
    },
    /// A buffer accessed with the other element type.
    #[error("buffer `{buffer}` holds the other element type")]
    ElementType {
        /// Buffer name.
        buffer: String,
    },
    /// A kernel that this executor has no code for.
    #[error("{executor} executor: no implementation of kernel `{kernel}`")]
    MissingKernel {
        /// Which executor.
        executor: &'static str,
        /// Kernel name.
        kernel: &'static str,
    },
    /// The device cannot hold the plan.
    #[error("the plan needs {needed} bytes, the memory budget is {budget}")]
    Memory {
        /// Size of the plan.
        needed: u64,
        /// What is allowed.
        budget: u64,
    },
    /// The device, its driver or a kernel failed.
    #[error("{what}")]
    Device {
        /// What happened, with the kernel or buffer it happened to.
        what: String,
    },
}
