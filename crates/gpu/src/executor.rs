use std::cell::{OnceCell, RefCell};
use std::collections::HashMap;
use std::sync::Arc;

use bytemuck::Pod;
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

/// A plan on a device: its buffers (zero at first), and its steps ready to run.
pub struct GpuExecutor {
    gpu: Gpu,
    plan: Plan,
    buffers: Vec<wgpu::Buffer>,
    stages: Vec<Vec<Launch>>,
    /// After a failed run the buffers hold anything: every later call answers with this.
    failure: Option<ExecutorError>,
}

impl GpuExecutor {
    /// Makes buffers, pipelines and bind groups for `plan`, whose buffers may take `budget` bytes in all.
    ///
    /// Where a step can run several variants of its kernel, the device's [`Choice`](crate::Choice) decides.
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
        let params = Params::upload(gpu, plan.stages.iter().flat_map(|stage| &stage.steps))?;
        let mut offsets = params.offsets.iter().copied();
        let pipelines = Pipelines::default();
        let mut stages = Vec::new();
        for stage in &plan.stages {
            let mut launches = Vec::with_capacity(stage.steps.len());
            for step in &stage.steps {
                let bound: Vec<&wgpu::Buffer> = step.buffers.iter().map(|id| &buffers[id.index()]).collect();
                let params = params.binding(step, offsets.next().unwrap_or_default());
                let scratch = Scratch::default();
                let variant = gpu.chooser().choose(gpu, step, |variant, extent| {
                    launch(gpu, &pipelines, step, variant, extent, &scratch.instead_of_outputs(gpu, step, &bound)?, &params)
                })?;
                launches.push(launch(gpu, &pipelines, step, variant, step.extent, &bound, &params)?);
            }
            stages.push(launches);
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

    /// The kernel variant that a step runs, as `op/variant`.
    pub fn label(&self, stage: StageId, step: usize) -> &str {
        &self.stages[stage.index()][step].label
    }

    /// Appends all steps of a stage to the caller's encoder, as one compute pass. Its errors appear where the caller
    /// finishes and submits the encoder.
    pub fn encode(&self, stage: StageId, encoder: &mut wgpu::CommandEncoder) {
        encode(&self.stages[stage.index()], &self.plan.stage(stage).name, encoder);
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

    pub(crate) fn launches(&self, stage: StageId) -> &[Launch] {
        &self.stages[stage.index()]
    }

    fn submit(&self, launches: &[Launch], label: &str) -> Result<(), ExecutorError> {
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
            launch::submissions(&plan.steps).into_iter().try_for_each(|part| this.submit(&this.launches(stage)[part], &plan.name))
        })
    }

    fn run_step(&mut self, stage: StageId, step: usize) -> Result<(), ExecutorError> {
        self.attempt(|this| {
            let launch = &this.launches(stage)[step];
            this.submit(std::slice::from_ref(launch), &launch.label)
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
fn encode(launches: &[Launch], label: &str, encoder: &mut wgpu::CommandEncoder) {
    let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(label), timestamp_writes: None });
    launches.iter().for_each(|launch| launch.dispatch(&mut pass));
}

/// The pipelines of a plan by their labels: the device knows them by their whole texts, which are long, and a plan has a thousand steps.
type Pipelines = RefCell<HashMap<String, Arc<Pipeline>>>;

/// Makes one dispatch: `bound` has a buffer for each binding of the kernel, `extent` is the step's or a part of it.
fn launch(
    gpu: &Gpu,
    pipelines: &Pipelines,
    step: &Step,
    variant: &Variant,
    extent: [u32; 3],
    bound: &[&wgpu::Buffer],
    params: &wgpu::BufferBinding<'_>,
) -> Result<Launch, ExecutorError> {
    let label = step.kernel.label(variant);
    let most = gpu.device().limits().max_compute_workgroups_per_dimension;
    let grid = launch::grid(extent, variant.tile, most).ok_or_else(|| ExecutorError::Device {
        what: format!("{label}: extent {extent:?} in tiles of {:?} needs more than {most} workgroups", variant.tile),
    })?;
    let known = pipelines.borrow().get(&label).cloned();
    let pipeline = match known {
        Some(pipeline) => pipeline,
        None => {
            let made = gpu.pipeline(step.kernel, variant)?;
            pipelines.borrow_mut().insert(label.clone(), made.clone());
            made
        }
    };
    let entry = |&(binding, slot): &(u32, Slot)| wgpu::BindGroupEntry {
        binding,
        resource: match slot {
            Slot::Params => wgpu::BindingResource::Buffer(params.clone()),
            Slot::Buffer(position) => bound[position].as_entire_binding(),
        },
    };
    let entries: Vec<_> = pipeline.slots.iter().map(entry).collect();
    let bind_group = gpu.checked(&label, || {
        let descriptor = wgpu::BindGroupDescriptor { label: Some(&label), layout: &pipeline.layout, entries: &entries };
        gpu.device().create_bind_group(&descriptor)
    })?;
    Ok(Launch { pipeline, bind_group, grid, label })
}

/// Buffers that a step writes while its variants are measured, made when they are needed. What it reads are the plan's.
#[derive(Default)]
struct Scratch(OnceCell<Vec<Option<wgpu::Buffer>>>);

impl Scratch {
    fn instead_of_outputs<'a>(
        &'a self,
        gpu: &Gpu,
        step: &Step,
        bound: &[&'a wgpu::Buffer],
    ) -> Result<Vec<&'a wgpu::Buffer>, ExecutorError> {
        if self.0.get().is_none() {
            let made = gpu.checked("making buffers to measure with", || {
                let make = |buffer: &wgpu::Buffer| {
                    let (label, size, usage) = (Some("measurement"), buffer.size(), wgpu::BufferUsages::STORAGE);
                    gpu.device().create_buffer(&wgpu::BufferDescriptor { label, size, usage, mapped_at_creation: false })
                };
                let bindings = step.kernel.bindings.iter().zip(bound);
                bindings.map(|(binding, buffer)| binding.written.then(|| make(buffer))).collect::<Vec<_>>()
            })?;
            let _ = self.0.set(made);
        }
        let made = self.0.get().into_iter().flatten();
        Ok(made.zip(bound).map(|(scratch, &buffer)| scratch.as_ref().unwrap_or(buffer)).collect())
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
