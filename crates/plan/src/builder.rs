use srn_shaders::{Element, Kernel, Params};

use crate::{Buffer, BufferId, Plan, PlanError, Role, Stage, StageId, Step};

/// Loop iterations after which some drivers (Mesa 22 llvmpipe) stop an invocation without an error.
const MOST_LOOPS: u64 = 65_535;

/// How a step uses a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Reads it.
    Read,
    /// Writes it without reading it.
    Overwrite,
    /// Reads and writes it (`accumulate`, Adam's moments).
    Update,
}

/// A buffer as an argument of a step: which, how many elements are touched, how.
#[derive(Clone, Copy, Debug)]
pub struct Arg(pub BufferId, pub usize, pub Access);

/// Collects buffers and steps, and checks each step as it comes.
#[derive(Debug)]
pub struct Builder {
    plan: Plan,
    accesses: Vec<Vec<Vec<Access>>>,
    max_binding_bytes: u64,
}

impl Builder {
    /// A builder for devices that bind at most `max_binding_bytes` per buffer (`u64::MAX` for the CPU).
    pub fn new(max_binding_bytes: u64) -> Self {
        Builder { plan: Plan { buffers: Vec::new(), stages: Vec::new() }, accesses: Vec::new(), max_binding_bytes }
    }

    /// Adds a buffer of `f32` that the caller fills.
    pub fn input(&mut self, name: impl Into<String>, len: usize) -> Result<BufferId, PlanError> {
        self.buffer(name.into(), len, Element::F32, Role::Input)
    }

    /// Adds a buffer of `u32` that the caller fills.
    pub fn input_u32(&mut self, name: impl Into<String>, len: usize) -> Result<BufferId, PlanError> {
        self.buffer(name.into(), len, Element::U32, Role::Input)
    }

    /// Adds a buffer of `f32` that a step fills.
    pub fn scratch(&mut self, name: impl Into<String>, len: usize) -> Result<BufferId, PlanError> {
        self.buffer(name.into(), len, Element::F32, Role::Scratch)
    }

    /// A buffer of `f32` for what one step hands to the next: all that ask for this name and length share it, for nobody needs it any longer than that.
    pub fn passing(&mut self, name: &str, len: usize) -> Result<BufferId, PlanError> {
        match self.plan.buffers.iter().position(|buffer| buffer.name == name && buffer.len == len) {
            Some(index) => Ok(BufferId(index as u32)),
            None => self.scratch(name, len),
        }
    }

    /// Adds a buffer of `u32` that a step fills.
    pub fn scratch_u32(&mut self, name: impl Into<String>, len: usize) -> Result<BufferId, PlanError> {
        self.buffer(name.into(), len, Element::U32, Role::Scratch)
    }

    fn buffer(&mut self, name: String, len: usize, element: Element, role: Role) -> Result<BufferId, PlanError> {
        let bytes = 4 * len as u64;
        if bytes > self.max_binding_bytes {
            return Err(PlanError::TooLarge { buffer: name, bytes, limit: self.max_binding_bytes });
        }
        // A binding of no bytes is an error on every device; an empty buffer still gets one element.
        self.plan.buffers.push(Buffer { name, len: len.max(1), element, role });
        Ok(BufferId(self.plan.buffers.len() as u32 - 1))
    }

    /// Starts a stage: the steps that follow belong to it. Stages are checked in the order in which they are begun.
    pub fn stage(&mut self, name: impl Into<String>) -> StageId {
        self.plan.stages.push(Stage { name: name.into(), steps: Vec::new() });
        self.accesses.push(Vec::new());
        StageId(self.plan.stages.len() as u32 - 1)
    }

    /// Appends a step to the current stage.
    ///
    /// `args` are in the order of the kernel's bindings; `loops` bounds the loop iterations of one invocation; `flops` counts
    /// matrix products only.
    pub fn step<P: Params>(
        &mut self,
        kernel: &'static Kernel,
        params: P,
        args: &[Arg],
        extent: [u32; 3],
        loops: u64,
        flops: u64,
    ) -> Result<(), PlanError> {
        let op = kernel.name;
        let shape = |what: String| PlanError::Shape { op, what };
        if P::LAYOUT.name != kernel.params.name {
            return Err(shape(format!("takes {}, got {}", kernel.params.name, P::LAYOUT.name)));
        }
        if args.len() != kernel.bindings.len() {
            return Err(shape(format!("takes {} buffers, got {}", kernel.bindings.len(), args.len())));
        }
        if extent.contains(&0) {
            return Err(shape(format!("nothing to do: extent {extent:?}")));
        }
        if loops > MOST_LOOPS {
            return Err(PlanError::TooManyLoops { op, loops, limit: MOST_LOOPS });
        }
        for (binding, &Arg(id, needed, access)) in kernel.bindings.iter().zip(args) {
            let buffer = self.plan.buffer(id);
            if buffer.len < needed {
                let (buffer, len) = (buffer.name.clone(), buffer.len);
                return Err(PlanError::TooShort { op, binding: binding.name, buffer, len, needed });
            }
            if buffer.element != binding.element {
                return Err(PlanError::ElementType { op, binding: binding.name, buffer: buffer.name.clone() });
            }
            if binding.written == (access == Access::Read) {
                return Err(shape(format!("`{}` is bound with the wrong access", binding.name)));
            }
            if binding.written && args.iter().filter(|other| other.0 == id).count() > 1 {
                return Err(PlanError::Aliased { op, buffer: buffer.name.clone() });
            }
        }
        let stage = self.plan.stages.last_mut().ok_or_else(|| shape("no stage was begun".into()))?;
        stage.steps.push(Step {
            kernel,
            buffers: args.iter().map(|arg| arg.0).collect(),
            params: bytemuck::bytes_of(&params).to_vec(),
            extent,
            flops,
        });
        self.accesses.last_mut().expect("one list per stage").push(args.iter().map(|arg| arg.2).collect());
        Ok(())
    }

    /// Checks the whole and returns the plan.
    pub fn finish(self) -> Result<Plan, PlanError> {
        let mut written: Vec<bool> = self.plan.buffers.iter().map(|buffer| buffer.role == Role::Input).collect();
        let mut used = vec![false; written.len()];
        for (stage, accesses) in self.plan.stages.iter().zip(&self.accesses) {
            for (step, accesses) in stage.steps.iter().zip(accesses) {
                for (&id, &access) in step.buffers.iter().zip(accesses) {
                    used[id.index()] = true;
                    if access != Access::Overwrite && !written[id.index()] {
                        return Err(PlanError::ReadBeforeWrite {
                            op: step.kernel.name,
                            stage: stage.name.clone(),
                            buffer: self.plan.buffer(id).name.clone(),
                        });
                    }
                }
                for (&id, &access) in step.buffers.iter().zip(accesses) {
                    written[id.index()] |= access != Access::Read;
                }
            }
        }
        if let Some(index) = used.iter().position(|used| !used) {
            return Err(PlanError::Unused { buffer: self.plan.buffers[index].name.clone() });
        }
        Ok(self.plan)
    }
}
