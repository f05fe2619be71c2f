use srn_plan::{BufferId, Element, Executor, ExecutorError, Plan, StageId, Step};

use crate::{Real, ops};

/// The values of one buffer.
#[derive(Clone, Debug)]
enum Storage<T> {
    F(Vec<T>),
    U(Vec<u32>),
}

impl<T> Default for Storage<T> {
    fn default() -> Self {
        Storage::U(Vec::new())
    }
}

impl<T> Storage<T> {
    fn f(&self) -> &[T] {
        match self {
            Storage::F(values) => values,
            Storage::U(_) => unreachable!("the builder checks element types"),
        }
    }

    fn u(&self) -> &[u32] {
        match self {
            Storage::U(values) => values,
            Storage::F(_) => unreachable!("the builder checks element types"),
        }
    }

    fn f_mut(&mut self) -> &mut [T] {
        match self {
            Storage::F(values) => values,
            Storage::U(_) => unreachable!("the builder checks element types"),
        }
    }

    fn u_mut(&mut self) -> &mut [u32] {
        match self {
            Storage::U(values) => values,
            Storage::F(_) => unreachable!("the builder checks element types"),
        }
    }
}

/// Runs a plan on the CPU in `T`, with all threads of the current rayon pool.
#[derive(Debug)]
pub struct CpuExecutor<T> {
    plan: Plan,
    buffers: Vec<Storage<T>>,
}

impl<T: Real> CpuExecutor<T> {
    /// Allocates the plan's buffers as zeros; fails where they exceed `budget` bytes or a kernel has no reference.
    pub fn new(plan: Plan, budget: u64) -> Result<Self, ExecutorError> {
        let needed = plan.bytes() / 4 * size_of::<T>() as u64;
        if needed > budget {
            return Err(ExecutorError::Memory { needed, budget });
        }
        for step in plan.stages.iter().flat_map(|stage| &stage.steps) {
            if !ops::implements(step.kernel.name) {
                return Err(ExecutorError::MissingKernel { executor: "cpu", kernel: step.kernel.name });
            }
        }
        let buffers = plan
            .buffers
            .iter()
            .map(|buffer| match buffer.element {
                Element::F32 => Storage::F(vec![T::zero(); buffer.len]),
                Element::U32 => Storage::U(vec![0; buffer.len]),
            })
            .collect();
        Ok(CpuExecutor { plan, buffers })
    }

    fn check(&self, id: BufferId, element: Element, got: usize) -> Result<(), ExecutorError> {
        let buffer = self.plan.buffer(id);
        if buffer.element != element {
            return Err(ExecutorError::ElementType { buffer: buffer.name.clone() });
        }
        if buffer.len != got {
            return Err(ExecutorError::Length { buffer: buffer.name.clone(), expected: buffer.len, got });
        }
        Ok(())
    }

    /// Takes the written buffers out for the time of the step, so that inputs and outputs can be borrowed together.
    fn execute(buffers: &mut [Storage<T>], step: &Step) {
        let is_written = |binding: usize| step.kernel.bindings[binding].written;
        let (written, read): (Vec<usize>, Vec<usize>) = (0..step.buffers.len()).partition(|&binding| is_written(binding));
        let mut outputs: Vec<Storage<T>> =
            written.iter().map(|&binding| std::mem::take(&mut buffers[step.buffers[binding].index()])).collect();
        let inputs: Vec<&Storage<T>> = read.iter().map(|&binding| &buffers[step.buffers[binding].index()]).collect();
        dispatch(step, &inputs, &mut outputs);
        for (&binding, output) in written.iter().zip(outputs) {
            buffers[step.buffers[binding].index()] = output;
        }
    }
}

impl<T: Real> Executor for CpuExecutor<T> {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn write(&mut self, buffer: BufferId, values: &[f32]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::F32, values.len())?;
        for (to, &from) in self.buffers[buffer.index()].f_mut().iter_mut().zip(values) {
            *to = T::of_f32(from);
        }
        Ok(())
    }

    fn write_f64(&mut self, buffer: BufferId, values: &[f64]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::F32, values.len())?;
        for (to, &from) in self.buffers[buffer.index()].f_mut().iter_mut().zip(values) {
            *to = T::of(from);
        }
        Ok(())
    }

    fn write_u32(&mut self, buffer: BufferId, values: &[u32]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::U32, values.len())?;
        self.buffers[buffer.index()].u_mut().copy_from_slice(values);
        Ok(())
    }

    fn run(&mut self, stage: StageId) -> Result<(), ExecutorError> {
        for step in &self.plan.stages[stage.index()].steps {
            Self::execute(&mut self.buffers, step);
        }
        Ok(())
    }

    fn run_step(&mut self, stage: StageId, step: usize) -> Result<(), ExecutorError> {
        Self::execute(&mut self.buffers, &self.plan.stages[stage.index()].steps[step]);
        Ok(())
    }

    fn read(&mut self, buffer: BufferId) -> Result<Vec<f32>, ExecutorError> {
        self.check(buffer, Element::F32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].f().iter().map(|value| value.as_f32()).collect())
    }

    fn read_f64(&mut self, buffer: BufferId) -> Result<Vec<f64>, ExecutorError> {
        self.check(buffer, Element::F32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].f().iter().map(|value| value.wide()).collect())
    }

    fn read_u32(&mut self, buffer: BufferId) -> Result<Vec<u32>, ExecutorError> {
        self.check(buffer, Element::U32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].u().to_vec())
    }

    fn describe(&self) -> String {
        format!("cpu {}, {} threads", T::NAME, rayon::current_num_threads())
    }
}

/// Lists the references once: `op/direction` with the element types of inputs and outputs, in the order of the bindings.
macro_rules! references {
    ($($name:literal => $op:ident::$direction:ident($($input:ident)*) -> ($($output:ident)*);)*) => {
        fn dispatch<T: Real>(step: &Step, inputs: &[&Storage<T>], outputs: &mut [Storage<T>]) {
            let mut inputs = inputs.iter();
            let mut outputs = outputs.iter_mut();
            match step.kernel.name {
                $($name => ops::$op::$direction(
                    step.params(),
                    $(inputs.next().expect("the builder checks the number of buffers").$input(),)*
                    $(outputs.next().expect("the builder checks the number of buffers").$output(),)*
                ),)*
                other => unreachable!("`new` checks that {other} has a reference"),
            }
        }

        /// The kernels that have a reference here.
        pub(crate) const REFERENCES: &[&str] = &[$($name),*];
    };
}

references! {
    "pose/forward" => pose::forward(f) -> (f_mut);
    "pose/backward" => pose::backward(f f) -> (f_mut);
    "rays/forward" => rays::forward(f f f f) -> (f_mut f_mut);
    "rays/backward" => rays::backward(f f f f f f) -> (f_mut);
    "tile/gather" => tile::gather(f) -> (f_mut);
    "tile/scatter" => tile::scatter(f) -> (f_mut);
    "embedding/forward" => embedding::forward(f u) -> (f_mut);
    "embedding/backward" => embedding::backward(u f) -> (f_mut);
    "linear/forward" => linear::forward(f f u) -> (f_mut);
    "linear/backward_input" => linear::backward_input(f f u) -> (f_mut);
    "linear/backward_weight" => linear::backward_weight(f f) -> (f_mut);
    "layer_norm_relu/forward" => layer_norm_relu::forward(f f) -> (f_mut f_mut);
    "layer_norm_relu/backward_input" => layer_norm_relu::backward_input(f f f f) -> (f_mut);
    "layer_norm_relu/backward_affine" => layer_norm_relu::backward_affine(f f f f) -> (f_mut);
    "lstm_cell/forward" => lstm_cell::forward(f f) -> (f_mut f_mut);
    "lstm_cell/backward" => lstm_cell::backward(f f f f f) -> (f_mut f_mut);
    "advance/forward" => advance::forward(f f f) -> (f_mut);
    "advance/backward" => advance::backward(f f f) -> (f_mut f_mut);
    "density_sum/forward" => density_sum::forward(f f) -> (f_mut);
    "density_sum/backward" => density_sum::backward(f f f) -> (f_mut f_mut);
    "depth/forward" => depth::forward(f f) -> (f_mut);
    "depth/backward" => depth::backward(f f) -> (f_mut);
    "depth_loss/forward" => depth_loss::forward(f) -> (f_mut);
    "latent_loss/forward" => latent_loss::forward(f) -> (f_mut);
    "latent_loss/backward" => latent_loss::backward(f) -> (f_mut);
    "image_loss/count" => image_loss::count(f) -> (f_mut);
    "image_loss/forward" => image_loss::forward(f f f) -> (f_mut);
    "image_loss/backward" => image_loss::backward(f f f) -> (f_mut);
    "gmsd/pool" => gmsd::pool(f) -> (f_mut);
    "gmsd/similarity" => gmsd::similarity(f f) -> (f_mut);
    "gmsd/moments" => gmsd::moments(f) -> (f_mut);
    "gmsd/deviation" => gmsd::deviation(f) -> (f_mut);
    "gmsd/backward_similarity" => gmsd::backward_similarity(f f f f f) -> (f_mut);
    "gmsd/backward_pool" => gmsd::backward_pool(f) -> (f_mut);
    "adam/step" => adam::step(f f) -> (f_mut f_mut f_mut);
    "sum/forward" => sum::forward(f) -> (f_mut);
    "bfgs/equations" => bfgs::equations(f f f f f f f) -> (f_mut);
    "bfgs/begin" => bfgs::begin(f f f) -> (f_mut);
    "bfgs/gradient" => bfgs::gradient(f f) -> (f_mut);
    "bfgs/update" => bfgs::update(f f f) -> (f_mut);
    "bfgs/solve" => bfgs::solve() -> (f_mut f_mut);
    "pack_rgba8/forward" => pack_rgba8::forward(f) -> (u_mut);
}
