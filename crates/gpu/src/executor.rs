use std::cell::RefCell;
use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::iter;
use std::ops::Range;
use std::sync::Arc;

use bytemuck::Pod;
use srn_plan::ops::hidden_layer;
use srn_plan::{BufferId, Element, Executor, ExecutorError, Plan, StageId, Step};
use srn_shaders::Variant;

use crate::pipeline::{Pipeline, Slot};
use crate::{Gpu, launch};

/// A step, ready to be dispatched.
pub(crate) struct Launch {
    pipeline: Arc<Pipeline>,
    bind_group: wgpu::BindGroup,
    grid: [u32; 3],
    /// `op/variant`, also of the pipeline and the bind group.
    pub label: String,
}

impl Launch {
    pub fn dispatch(&self, pass: &mut wgpu::ComputePass<'_>) {
        pass.set_pipeline(&self.pipeline.compute);
        pass.set_bind_group(0, &self.bind_group, &[]);
        let [x, y, z] = self.grid;
        pass.dispatch_workgroups(x, y, z);
    }
}

/// The steps of a stage, ready to be dispatched.
struct Stage {
    /// Each by itself.
    alone: Vec<Launch>,
    /// Two in one, where that is faster; by the number of the first of them.
    joined: BTreeMap<usize, Launch>,
}

impl Stage {
    /// What runs a part of the steps, each with the numbers of those that it does.
    fn launches(&self, part: Range<usize>) -> impl Iterator<Item = (Range<usize>, &Launch)> {
        let mut next = part.start;
        iter::from_fn(move || {
            let first = next;
            let alone = self.alone.get(first).filter(|_| first < part.end)?;
            let both = self.joined.get(&first).filter(|_| first + 1 < part.end);
            next = first + if both.is_some() { 2 } else { 1 };
            Some((first..next, both.unwrap_or(alone)))
        })
    }
}

/// A plan on a device: its buffers (zero at first), and its steps ready to run.
pub struct GpuExecutor {
    gpu: Gpu,
    plan: Plan,
    buffers: Vec<wgpu::Buffer>,
    stages: Vec<Stage>,
    /// After a failed run the buffers hold anything: every later call answers with this.
    failure: Option<ExecutorError>,
}

impl GpuExecutor {
    /// Makes buffers, pipelines and bind groups for `plan`, whose buffers may take `budget` bytes in all.
    ///
    /// Where a step can run several variants of its kernel, or two steps can be one, the device's [`Choice`](crate::Choice) decides.
    ///
    /// Fails where the plan exceeds the budget or a limit of the device, where a kernel does not compile, or a step needs
    /// more workgroups than the device allows.
    pub fn new(gpu: &Gpu, plan: Plan, budget: u64) -> Result<Self, ExecutorError> {
        if plan.bytes() > budget {
            return Err(ExecutorError::Memory { needed: plan.bytes(), budget });
        }
        let limit = gpu.max_binding_bytes();
        if let Some(buffer) = plan.buffers.iter().find(|buffer| 4 * buffer.len as u64 > limit) {
            let what = format!("buffer `{}` has {} elements, this device binds at most {limit} bytes", buffer.name, buffer.len);
            return Err(ExecutorError::Device { what });
        }
        let buffers = gpu.checked("making the buffers", || {
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_SRC | wgpu::BufferUsages::COPY_DST;
            let make = |buffer: &srn_plan::Buffer| {
                gpu.device().create_buffer(&wgpu::BufferDescriptor {
                    label: Some(&buffer.name),
                    size: 4 * buffer.len as u64,
                    usage,
                    mapped_at_creation: false,
                })
            };
            plan.buffers.iter().map(make).collect::<Vec<_>>()
        })?;
        let joined = plan.stages.iter().map(|stage| {
            let pairs = stage.steps.windows(2).enumerate();
            pairs.filter_map(|(number, pair)| Some((number, hidden_layer::joined(&pair[0], &pair[1])?))).collect::<Vec<_>>()
        });
        let joined: Vec<_> = joined.collect();
        let of_stages = plan.stages.iter().zip(&joined);
        let params = Params::upload(
            gpu,
            of_stages.clone().flat_map(|(stage, joined)| stage.steps.iter().chain(joined.iter().map(|(_, step)| step))),
        )?;
        let mut offsets = params.offsets.iter().copied();
        let pipelines = Pipelines::default();
        let mut bind =
            |step| Bound::new(gpu, &pipelines, step, &buffers, params.binding(step, offsets.next().unwrap_or_default()));
        let mut stages = Vec::new();
        for (stage, joined) in of_stages {
            let steps: Vec<Bound<'_>> = stage.steps.iter().map(&mut bind).collect();
            let variants = steps.iter().map(|step| gpu.chooser().choose(step)).collect::<Result<Vec<_>, _>>()?;
            let alone = steps.iter().zip(&variants).map(|(step, variant)| step.launch(variant)).collect::<Result<_, _>>()?;
            let mut made = BTreeMap::new();
            for (number, step) in joined {
                let (step, apart) = (bind(step), [0, 1].map(|k| (&steps[number + k], variants[number + k])));
                if let Some(variant) = gpu.chooser().choose_joined(&step, apart)? {
                    made.insert(*number, step.launch(variant)?);
                }
            }
            stages.push(Stage { alone, joined: made });
        }
        Ok(GpuExecutor { gpu: gpu.clone(), plan, buffers, stages, failure: None })
    }

    /// The device that this plan lives on.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// The device buffer behind an id of the plan: usages `STORAGE`, `COPY_SRC`, `COPY_DST`.
    pub fn buffer(&self, id: BufferId) -> &wgpu::Buffer {
        &self.buffers[id.index()]
    }

    /// The kernel variant that a step runs by itself, as `op/variant`.
    pub fn label(&self, stage: StageId, step: usize) -> &str {
        &self.stages[stage.index()].alone[step].label
    }

    /// Appends all steps of a stage to the caller's encoder, as one compute pass. Its errors appear where the caller
    /// finishes and submits the encoder.
    pub fn encode(&self, stage: StageId, encoder: &mut wgpu::CommandEncoder) {
        let steps = 0..self.plan.stage(stage).steps.len();
        encode(self.launches(stage, steps).map(|(_, launch)| launch), &self.plan.stage(stage).name, encoder);
    }

    /// Fails where an earlier run did; else does `work`, and remembers its failure.
    pub(crate) fn attempt<T>(&mut self, work: impl FnOnce(&Self) -> Result<T, ExecutorError>) -> Result<T, ExecutorError> {
        if let Some(failure) = &self.failure {
            return Err(failure.clone());
        }
        let result = work(self);
        self.failure = result.as_ref().err().cloned();
        result
    }

    /// What runs a part of a stage's steps, each with the numbers of those that it does.
    pub(crate) fn launches(&self, stage: StageId, part: Range<usize>) -> impl Iterator<Item = (Range<usize>, &Launch)> {
        self.stages[stage.index()].launches(part)
    }

    fn submit<'a>(&self, launches: impl Iterator<Item = &'a Launch>, label: &str) -> Result<(), ExecutorError> {
        self.gpu.checked(label, || {
            let mut encoder = self.gpu.device().create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some(label) });
            encode(launches, label, &mut encoder);
            self.gpu.queue().submit([encoder.finish()]);
        })
    }

    fn check(&self, id: BufferId, element: Element) -> Result<&srn_plan::Buffer, ExecutorError> {
        let buffer = self.plan.buffer(id);
        if buffer.element == element { Ok(buffer) } else { Err(ExecutorError::ElementType { buffer: buffer.name.clone() }) }
    }

    fn upload<T: Pod>(&mut self, id: BufferId, element: Element, values: &[T]) -> Result<(), ExecutorError> {
        let buffer = self.check(id, element)?;
        if values.len() != buffer.len {
            return Err(ExecutorError::Length { buffer: buffer.name.clone(), expected: buffer.len, got: values.len() });
        }
        self.attempt(|this| {
            let what = format!("writing buffer `{}`", this.plan.buffer(id).name);
            this.gpu.checked(&what, || this.gpu.queue().write_buffer(this.buffer(id), 0, bytemuck::cast_slice(values)))
        })
    }

    fn download<T: Pod>(&mut self, id: BufferId, element: Element) -> Result<Vec<T>, ExecutorError> {
        self.check(id, element)?;
        self.attempt(|this| {
            let buffer = this.plan.buffer(id);
            let view = this.gpu.download(&format!("reading buffer `{}`", buffer.name), this.buffer(id), 4 * buffer.len as u64)?;
            Ok(bytemuck::pod_collect_to_vec(&view[..]))
        })
    }
}

impl Executor for GpuExecutor {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn write(&mut self, buffer: BufferId, values: &[f32]) -> Result<(), ExecutorError> {
        self.upload(buffer, Element::F32, values)
    }

    fn write_u32(&mut self, buffer: BufferId, values: &[u32]) -> Result<(), ExecutorError> {
        self.upload(buffer, Element::U32, values)
    }

    fn run(&mut self, stage: StageId) -> Result<(), ExecutorError> {
        self.attempt(|this| {
            let plan = this.plan.stage(stage);
            let mut parts = launch::submissions(&plan.steps).into_iter();
            parts.try_for_each(|part| this.submit(this.launches(stage, part).map(|(_, launch)| launch), &plan.name))
        })
    }

    fn run_step(&mut self, stage: StageId, step: usize) -> Result<(), ExecutorError> {
        self.attempt(|this| {
            let launch = &this.stages[stage.index()].alone[step];
            this.submit(iter::once(launch), &launch.label)
        })
    }

    fn read(&mut self, buffer: BufferId) -> Result<Vec<f32>, ExecutorError> {
        self.download(buffer, Element::F32)
    }

    fn read_u32(&mut self, buffer: BufferId) -> Result<Vec<u32>, ExecutorError> {
        self.download(buffer, Element::U32)
    }

    fn describe(&self) -> String {
        self.gpu.adapter().to_string()
    }
}

/// One pass for all: wgpu puts a barrier between two dispatches where the second reads what the first wrote.
fn encode<'a>(launches: impl Iterator<Item = &'a Launch>, label: &str, encoder: &mut wgpu::CommandEncoder) {
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(label), timestamp_writes: None });
    launches.for_each(|launch| launch.dispatch(&mut pass));
}

/// The pipelines of a plan by their labels: the device knows them by their whole texts, which are long, and a plan has a thousand steps.
type Pipelines = RefCell<HashMap<String, Arc<Pipeline>>>;

/// A step with its buffers and parameters.
pub(crate) struct Bound<'a> {
    pub gpu: &'a Gpu,
    pub step: &'a Step,
    pipelines: &'a Pipelines,
    /// One for each binding of the kernel.
    buffers: Vec<&'a wgpu::Buffer>,
    params: wgpu::BufferBinding<'a>,
}

impl<'a> Bound<'a> {
    fn new(
        gpu: &'a Gpu,
        pipelines: &'a Pipelines,
        step: &'a Step,
        buffers: &'a [wgpu::Buffer],
        params: wgpu::BufferBinding<'a>,
    ) -> Self {
        let buffers = step.buffers.iter().map(|id| &buffers[id.index()]).collect();
        Bound { gpu, step, pipelines, buffers, params }
    }

    /// Its dispatch.
    pub fn launch(&self, variant: &Variant) -> Result<Launch, ExecutorError> {
        self.dispatch(variant, self.step.extent, &self.buffers)
    }

    /// A dispatch of a part of its extent, to be timed, with buffers of `scratch` for the plan's.
    pub fn trial(&self, variant: &Variant, extent: [u32; 3], scratch: &Scratch) -> Result<Launch, ExecutorError> {
        let buffers = self.step.buffers.iter().zip(&self.buffers);
        let buffers: Vec<_> = buffers.map(|(id, &buffer)| scratch.0.get(&id.index()).unwrap_or(buffer)).collect();
        self.dispatch(variant, extent, &buffers)
    }

    fn dispatch(&self, variant: &Variant, extent: [u32; 3], buffers: &[&wgpu::Buffer]) -> Result<Launch, ExecutorError> {
        let (gpu, kernel) = (self.gpu, self.step.kernel);
        let label = kernel.label(variant);
        let most = gpu.device().limits().max_compute_workgroups_per_dimension;
        let grid = launch::grid(extent, variant.tile, most).ok_or_else(|| ExecutorError::Device {
            what: format!("{label}: extent {extent:?} in tiles of {:?} needs more than {most} workgroups", variant.tile),
        })?;
        let known = self.pipelines.borrow().get(&label).cloned();
        let pipeline = match known {
            Some(pipeline) => pipeline,
            None => {
                let made = gpu.pipeline(kernel, variant)?;
                self.pipelines.borrow_mut().insert(label.clone(), made.clone());
                made
            }
        };
        let entry = |&(binding, slot): &(u32, Slot)| wgpu::BindGroupEntry {
            binding,
            resource: match slot {
                Slot::Params => wgpu::BindingResource::Buffer(self.params.clone()),
                Slot::Buffer(position) => buffers[position].as_entire_binding(),
            },
        };
        let entries: Vec<_> = pipeline.slots.iter().map(entry).collect();
        let bind_group = gpu.checked(&label, || {
            let descriptor = wgpu::BindGroupDescriptor { label: Some(&label), layout: &pipeline.layout, entries: &entries };
            gpu.device().create_bind_group(&descriptor)
        })?;
        Ok(Launch { pipeline, bind_group, grid, label })
    }
}

/// Buffers for all that some steps write, by their numbers in the plan: to be measured they must spoil nothing, and read what one of them wrote.
pub(crate) struct Scratch(BTreeMap<usize, wgpu::Buffer>);

impl Scratch {
    pub fn of(steps: &[&Bound<'_>]) -> Result<Self, ExecutorError> {
        let mut made = BTreeMap::new();
        for bound in steps {
            let bindings = bound.step.kernel.bindings.iter().zip(&bound.step.buffers).zip(&bound.buffers);
            for ((_, id), buffer) in bindings.filter(|((binding, _), _)| binding.written) {
                let (label, size, usage) = (Some("measurement"), buffer.size(), wgpu::BufferUsages::STORAGE);
                let make = || {
                    let descriptor = wgpu::BufferDescriptor { label, size, usage, mapped_at_creation: false };
                    bound.gpu.device().create_buffer(&descriptor)
                };
                if let Entry::Vacant(place) = made.entry(id.index()) {
                    place.insert(bound.gpu.checked("making buffers to measure with", make)?);
                }
            }
        }
        Ok(Scratch(made))
    }
}

/// The parameters of all steps in one uniform buffer.
struct Params {
    buffer: wgpu::Buffer,
    /// Byte offset of each step.
    offsets: Vec<u64>,
}

impl Params {
    fn binding(&self, step: &Step, offset: u64) -> wgpu::BufferBinding<'_> {
        wgpu::BufferBinding { buffer: &self.buffer, offset, size: wgpu::BufferSize::new(step.params.len() as u64) }
    }

    fn upload<'a>(gpu: &Gpu, steps: impl Iterator<Item = &'a Step>) -> Result<Params, ExecutorError> {
        let alignment = gpu.device().limits().min_uniform_buffer_offset_alignment as usize;
        let (mut bytes, mut offsets) = (Vec::new(), Vec::new());
        for step in steps {
            offsets.push(bytes.len() as u64);
            bytes.extend_from_slice(&step.params);
            bytes.resize(bytes.len().next_multiple_of(alignment), 0u8);
        }
        let buffer = gpu.checked("uploading the parameters", || {
            let buffer = gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("parameters"),
                size: bytes.len().max(alignment) as u64,
                usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            gpu.queue().write_buffer(&buffer, 0, &bytes);
            buffer
        })?;
        Ok(Params { buffer, offsets })
    }
}

#[cfg(test)]
mod tests {
    use srn_plan::ops::layer_norm_relu::{self, Saved};
    use srn_plan::ops::linear::{self, Layer, Sets};
    use srn_plan::{Builder, Rows};

    use super::*;
    use crate::choice::is_faster;

    /// A software adapter never asks; here it is timed all the same.
    #[test]
    fn two_steps_are_timed_against_one_and_nothing_is_spoilt() {
        let gpu = Gpu::open(std::env::var("SIGMA_SRN_ADAPTER").ok().as_deref()).unwrap();
        let (n, width) = (100, 32);
        let mut b = Builder::new(u64::MAX);
        let mut buffer = |name: &str, len: u32| b.input(name, len as usize).unwrap();
        let [x, z, y] = ["x", "z", "y"].map(|name| buffer(name, n * width));
        let (weights, affine, stats) =
            (buffer("weights", (width + 1) * width), buffer("affine", 2 * width), buffer("stats", 2 * n));
        let slots = b.input_u32("slots", 1).unwrap();
        let layer = Layer { weights, in_features: width, out_features: width, sets: Sets::Shared };
        let stage = b.stage("layer");
        linear::forward(&mut b, Rows::plain(n), layer, x, slots, z, false).unwrap();
        layer_norm_relu::forward(&mut b, n, width, Saved { x: z, stats, affine, centred: false }, y).unwrap();
        let plan = b.finish().unwrap();

        let mut executor = GpuExecutor::new(&gpu, plan.clone(), u64::MAX).unwrap();
        let values: Vec<f32> = (0..n * width).map(|k| k as f32).collect();
        executor.write(z, &values).unwrap();
        let steps = &plan.stage(stage).steps;
        let both = hidden_layer::joined(&steps[0], &steps[1]).unwrap();
        let params = Params::upload(&gpu, steps.iter().chain([&both])).unwrap();
        let pipelines = Pipelines::default();
        let bind = |step, number: usize| {
            Bound::new(&gpu, &pipelines, step, &executor.buffers, params.binding(step, params.offsets[number]))
        };
        let [first, second, both] = [(&steps[0], 0), (&steps[1], 1), (&both, 2)].map(|(step, number)| bind(step, number));
        let plain = |bound: &Bound<'_>| &bound.step.kernel.variants[0];
        is_faster(&both, &both.step.kernel.variants[1], [(&first, plain(&first)), (&second, plain(&second))]).unwrap();
        assert_eq!(executor.read(z).unwrap(), values);
    }
}
