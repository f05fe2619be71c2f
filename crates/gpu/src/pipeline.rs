use naga::{AddressSpace, StorageAccess};
use srn_plan::{ExecutorError, Kernel};
use srn_shaders::Variant;

use crate::Gpu;

/// What a WGSL binding is connected to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Slot {
    /// The step's parameters.
    Params,
    /// The step's buffer with this position in [`Kernel::bindings`].
    Buffer(usize),
}

/// A compiled kernel, and where its buffers go.
pub(crate) struct Pipeline {
    pub compute: wgpu::ComputePipeline,
    pub layout: wgpu::BindGroupLayout,
    /// `@binding` numbers of group 0.
    pub slots: Vec<(u32, Slot)>,
}

impl Pipeline {
    pub fn new(gpu: &Gpu, kernel: &Kernel, variant: &Variant, text: &str) -> Result<Self, ExecutorError> {
        let label = kernel.label(variant);
        tracing::debug!(kernel = label, "compile");
        let slots = reflect(kernel, text).map_err(|what| ExecutorError::Device { what: format!("{label}: {what}") })?;
        let entries: Vec<_> = slots
            .iter()
            .map(|&(binding, _, ty)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
                count: None,
            })
            .collect();
        gpu.checked(&label, || {
            let device = gpu.device();
            let label = Some(label.as_str());
            let module = device
                .create_shader_module(wgpu::ShaderModuleDescriptor { label, source: wgpu::ShaderSource::Wgsl(text.into()) });
            let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label, entries: &entries });
            let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label,
                bind_group_layouts: &[Some(&layout)],
                immediate_size: 0,
            });
            let compute = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label,
                layout: Some(&pipeline_layout),
                module: &module,
                entry_point: None,
                // Our kernels write what they read of it.
                compilation_options: wgpu::PipelineCompilationOptions {
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            });
            Pipeline { compute, layout, slots: slots.iter().map(|&(binding, slot, _)| (binding, slot)).collect() }
        })
    }
}

/// The bindings of a WGSL text: the uniform variable holds the parameters, storage variables are found by name.
fn reflect(kernel: &Kernel, text: &str) -> Result<Vec<(u32, Slot, wgpu::BufferBindingType)>, String> {
    let module = naga::front::wgsl::parse_str(text).map_err(|error| {
        let line = error.location(text).map_or(0, |location| location.line_number);
        format!("WGSL line {line} (common functions first): {}", error.message())
    })?;
    let mut slots = Vec::new();
    for (_, variable) in module.global_variables.iter() {
        let Some(binding) = variable.binding else { continue };
        let name = variable.name.as_deref().unwrap_or_default();
        if binding.group != 0 {
            return Err(format!("`{name}` is in group {}, expected 0", binding.group));
        }
        let (slot, ty) = match variable.space {
            AddressSpace::Uniform => (Slot::Params, wgpu::BufferBindingType::Uniform),
            AddressSpace::Storage { access } => {
                let position = kernel.bindings.iter().position(|entry| entry.name == name);
                let position = position.ok_or_else(|| format!("`{name}` is not a binding of the table"))?;
                let read_only = !access.contains(StorageAccess::STORE);
                (Slot::Buffer(position), wgpu::BufferBindingType::Storage { read_only })
            }
            _ => return Err(format!("`{name}` is neither a uniform nor a storage buffer")),
        };
        slots.push((binding.binding, slot, ty));
    }
    Ok(slots)
}
