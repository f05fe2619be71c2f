//! Everywhere but in a browser: adapters and devices of our own, errors that are known when a call returns, and waiting that blocks.

use std::sync::{Arc, mpsc};

use srn_shaders::Cooperative;

use super::{AdapterInfo, Gpu, lock, one_line, open_scopes};

impl AdapterInfo {
    /// Whether all of `words` are in what is printed of it, in any case.
    fn has_words(&self, words: &str) -> bool {
        let printed = self.to_string().to_lowercase();
        words.to_lowercase().split_whitespace().all(|word| printed.contains(word))
    }
}

/// Why no device could be opened.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum OpenError {
    /// No driver of any backend reports an adapter.
    #[error("no GPU adapter found (on Linux without a GPU, install the package mesa-vulkan-drivers)")]
    NoAdapter,
    /// Adapters exist, but none is like that.
    #[error("no adapter is called `{wanted}`; found: {}", found.join(", "))]
    NotFound {
        /// What was asked for.
        wanted: String,
        /// The adapters that exist, as [`AdapterInfo`] prints them.
        found: Vec<String>,
    },
    /// The adapter gave no device.
    #[error("adapter `{adapter}` refuses a device: {what}")]
    Refused {
        /// Name of the adapter.
        adapter: String,
        /// The driver's reason.
        what: String,
    },
    /// [`Gpu::open_cooperative`]: the adapter multiplies no matrices of `f16`.
    #[error("adapter `{adapter}` has no square cooperative matrices of f16 with sums in f32 for subgroups of one size")]
    NoCooperativeMatrices {
        /// Name of the adapter.
        adapter: String,
    },
}

/// All adapters, the one that [`Gpu::open`] prefers first: discrete, integrated, virtual, other, software.
pub fn adapters() -> Vec<AdapterInfo> {
    enumerate().iter().map(|adapter| adapter.get_info().into()).collect()
}

fn enumerate() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        // Also in debug builds no validation layers, which report false errors; the environment can turn them on.
        flags: wgpu::InstanceFlags::empty().with_env(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let mut found = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
    found.sort_by_key(|adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    found
}

/// What cooperative matrices of `f16` need.
const COOPERATIVE: wgpu::Features =
    wgpu::Features::EXPERIMENTAL_COOPERATIVE_MATRIX.union(wgpu::Features::SHADER_F16).union(wgpu::Features::SUBGROUP);

/// Bytes of workgroup memory that they take, rounded up to what all such devices offer.
const COOPERATIVE_STORAGE: u32 = 32 << 10;

/// The largest matrices that subgroups of this adapter multiply in `f16` with sums in `f32`.
fn find_cooperative(adapter: &wgpu::Adapter) -> Option<Cooperative> {
    use wgpu::wgt::CooperativeScalarType::{F16, F32};
    let info = adapter.get_info();
    let is_whole = adapter.features().contains(COOPERATIVE) && info.subgroup_min_size == info.subgroup_max_size;
    // llvmpipe (Mesa 26.1.6) with vectors of 512 bits, 16 lanes, crashes when it compiles them.
    if info.device_type == wgpu::DeviceType::Cpu && info.subgroup_min_size > 8 {
        return None;
    }
    let properties = adapter.cooperative_matrix_properties().into_iter();
    let sides = properties.filter(|p| (p.ab_type, p.cr_type) == (F16, F32) && p.m_size == p.n_size && p.n_size == p.k_size);
    let side = sides.map(|p| p.m_size).max().filter(|_| is_whole)?;
    let cooperative = Cooperative { side, lanes: info.subgroup_min_size };
    let is_supported =
        cooperative.invocations() == 128 && adapter.limits().max_compute_workgroup_storage_size >= COOPERATIVE_STORAGE;
    is_supported.then_some(cooperative)
}

impl Gpu {
    /// Opens the first of [`adapters`], or the first whose name, backend and driver contain all words of `adapter` (in any case): `intel`,
    /// say, or `geforce dx12`, since on Windows each GPU is there under Vulkan and under DX12.
    pub fn open(adapter: Option<&str>) -> Result<Gpu, OpenError> {
        Self::open_with(adapter, false)
    }

    /// The same with cooperative matrices (tensor cores), an experimental feature of wgpu: where a linear layer is fastest so, the factors
    /// of its products are sums of two numbers in `f16`, of 22 digits for the 24 of `f32`, and its sums in `f32`.
    pub fn open_cooperative(adapter: Option<&str>) -> Result<Gpu, OpenError> {
        Self::open_with(adapter, true)
    }

    fn open_with(adapter: Option<&str>, with_cooperative: bool) -> Result<Gpu, OpenError> {
        let mut found = enumerate();
        let infos: Vec<AdapterInfo> = found.iter().map(|adapter| adapter.get_info().into()).collect();
        let chosen = match adapter {
            _ if infos.is_empty() => return Err(OpenError::NoAdapter),
            None => 0,
            Some(wanted) => infos.iter().position(|info| info.has_words(wanted)).ok_or_else(|| OpenError::NotFound {
                wanted: wanted.into(),
                found: infos.iter().map(AdapterInfo::to_string).collect(),
            })?,
        };
        let adapter = found.swap_remove(chosen);
        let name = &infos[chosen].name;
        let mut features = adapter.features() & (wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::SUBGROUP);
        let mut experimental_features = wgpu::ExperimentalFeatures::disabled();
        let mut limits = wgpu::Limits::default();
        let mut cooperative = None;
        if with_cooperative {
            let found = find_cooperative(&adapter);
            cooperative = Some(found.ok_or_else(|| OpenError::NoCooperativeMatrices { adapter: name.clone() })?);
            features |= COOPERATIVE;
            limits.max_compute_workgroup_storage_size = COOPERATIVE_STORAGE;
            // SAFETY: what is experimental are WGSL's cooperative matrices. Our texts load and store them within the arrays that they
            // declare, in uniform control flow.
            experimental_features = unsafe { wgpu::ExperimentalFeatures::enabled() };
        }
        let request = adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("sigma-srn"),
            required_features: features,
            experimental_features,
            // Default limits, so that what runs here runs elsewhere, except for the size of the work.
            required_limits: wgpu::Limits {
                max_storage_buffer_binding_size: adapter.limits().max_storage_buffer_binding_size,
                max_buffer_size: adapter.limits().max_buffer_size,
                ..limits
            },
            memory_hints: wgpu::MemoryHints::MemoryUsage,
            ..Default::default()
        });
        let (device, queue) = pollster::block_on(request)
            .map_err(|error| OpenError::Refused { adapter: name.clone(), what: one_line(&error.to_string()) })?;
        let gpu = Gpu { cooperative, ..Gpu::from_device(device, queue) };
        // The device owns what it calls, and pipelines, which are shared, own the device: it would never be freed.
        let shared = Arc::downgrade(&gpu.shared);
        gpu.device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let Some(shared) = shared.upgrade() else { return };
            lock(&shared.uncaptured).get_or_insert(one_line(&error.to_string()));
        }));
        let shared = Arc::downgrade(&gpu.shared);
        gpu.device.set_device_lost_callback(move |reason, message| {
            let Some(shared) = shared.upgrade() else { return };
            lock(&shared.lost).get_or_insert(format!("the device was lost ({reason:?}): {}", one_line(&message)));
        });
        Ok(gpu)
    }

    /// Whether it can be told how long a kernel takes.
    pub(crate) fn can_time(&self) -> bool {
        true
    }

    /// Does `work`; what wgpu reports for it comes last to first.
    pub(super) fn scoped<T>(&self, work: impl FnOnce() -> T) -> (T, Vec<wgpu::Error>) {
        let scopes = open_scopes(&self.device);
        let value = work();
        (value, scopes.into_iter().rev().filter_map(|scope| pollster::block_on(scope.pop())).collect())
    }

    /// Waits for all work submitted so far, and for `buffer` to be there to be read.
    pub(super) fn map(&self, buffer: &wgpu::Buffer) -> Result<(), String> {
        let (sender, receiver) = mpsc::channel();
        buffer.slice(..).map_async(wgpu::MapMode::Read, move |result| drop(sender.send(result)));
        self.poll(wgpu::PollType::wait_indefinitely())?;
        // Another thread's `poll` may be the one that calls back, after ours has returned: wait for it.
        match receiver.recv() {
            Ok(Ok(())) => Ok(()),
            _ => Err("the device was lost, or the buffer cannot be mapped".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use srn_shaders::SUM_FORWARD;

    use super::*;

    #[test]
    fn a_device_is_freed_with_its_last_clone() {
        let gpu = Gpu::open(std::env::var("SIGMA_SRN_ADAPTER").ok().as_deref()).unwrap();
        gpu.pipeline(&SUM_FORWARD, &SUM_FORWARD.variants[0]).unwrap();
        let (clone, shared) = (gpu.clone(), Arc::downgrade(&gpu.shared));
        drop(gpu);
        assert!(shared.upgrade().is_some());
        drop(clone);
        assert!(shared.upgrade().is_none());
    }
}
