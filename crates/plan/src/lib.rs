//! This crate owns plans: named buffers, the steps that compute on them, and the checks made when a plan is built.
//! It does not know devices, executors or the model.
//!
//! A [`Plan`] is built once with a [`Builder`] and run many times by an [`Executor`]. The steps are grouped into stages
//! ("hypernetwork", "iterate", …) that the caller runs by name; within a stage the steps run in order. The functions in
//! [`ops`] append steps: one function per kernel of the table in `srn_shaders`, with the same name.

mod builder;
mod error;
mod executor;
pub mod ops;
mod rows;

pub use builder::{Access, Arg, Builder};
pub use error::{ExecutorError, PlanError};
pub use executor::Executor;
pub use rows::{Parts, Rows, Tile, tiles};
pub use srn_shaders::{Element, Kernel};

/// Names a buffer of one plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct BufferId(pub(crate) u32);

impl BufferId {
    /// Position in [`Plan::buffers`].
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Names a stage of one plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct StageId(pub(crate) u32);

impl StageId {
    /// Position in [`Plan::stages`].
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

/// Who gives a buffer its first value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The caller, before the first run that reads it. Starts as zeros.
    Input,
    /// A step; reading it before is an error found when the plan is built.
    Scratch,
}

/// A named array of one scalar type.
#[derive(Clone, Debug)]
pub struct Buffer {
    /// Name in errors, profiles and lockstep reports.
    pub name: String,
    /// Number of elements.
    pub len: usize,
    /// Type of an element.
    pub element: Element,
    /// Who writes it first.
    pub role: Role,
}

/// One dispatch of one kernel.
#[derive(Clone, Debug)]
pub struct Step {
    /// The kernel, with its name and its binding names.
    pub kernel: &'static Kernel,
    /// One buffer per binding of the kernel, in the order of its table entry.
    pub buffers: Vec<BufferId>,
    /// The bytes of the kernel's parameter struct.
    pub params: Vec<u8>,
    /// Size of the work; the scheduler divides it by the tile of the kernel variant that it picks.
    pub extent: [u32; 3],
    /// Floating-point operations of the matrix products in this step (0 for elementwise kernels).
    pub flops: u64,
}

impl Step {
    /// The parameter struct of this step.
    pub fn params<P: srn_shaders::Params>(&self) -> P {
        bytemuck::pod_read_unaligned(&self.params)
    }
}

/// Steps that run together.
#[derive(Clone, Debug)]
pub struct Stage {
    /// Name in profiles.
    pub name: String,
    /// The steps, in order.
    pub steps: Vec<Step>,
}

/// Buffers and stages, checked.
#[derive(Clone, Debug)]
pub struct Plan {
    /// All buffers.
    pub buffers: Vec<Buffer>,
    /// All stages.
    pub stages: Vec<Stage>,
}

impl Plan {
    /// The buffer behind an id of this plan.
    pub fn buffer(&self, id: BufferId) -> &Buffer {
        &self.buffers[id.index()]
    }

    /// The stage behind an id of this plan.
    pub fn stage(&self, id: StageId) -> &Stage {
        &self.stages[id.index()]
    }

    /// The id of stage number `index`.
    pub fn stage_id(&self, index: usize) -> StageId {
        StageId(index as u32)
    }

    /// The buffer called `name`: for tests and reports.
    pub fn find(&self, name: &str) -> Option<BufferId> {
        self.buffers.iter().position(|buffer| buffer.name == name).map(|index| BufferId(index as u32))
    }

    /// Memory of all buffers, in bytes (four per element on a device).
    pub fn bytes(&self) -> u64 {
        self.buffers.iter().map(|buffer| 4 * buffer.len as u64).sum()
    }

    /// Floating-point operations of one run of a stage, matrix products only.
    pub fn flops(&self, id: StageId) -> u64 {
        self.stage(id).steps.iter().map(|step| step.flops).sum()
    }
}
