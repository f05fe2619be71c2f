use std::collections::HashMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};

use srn_plan::{ExecutorError, Kernel};
use srn_shaders::{Cooperative, Requirement, TABLE, Variant};

use crate::choice::{Choice, Chooser, key};
use crate::pipeline::Pipeline;

/// An adapter of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// Name that the driver gives, for example `llvmpipe (LLVM 15.0.6, 256 bits)`.
    pub name: String,
    /// `Vulkan`, `Metal` or `Dx12`.
    pub backend: String,
    /// The driver and its version.
    pub driver: String,
    /// True where the "GPU" is this machine's CPU (llvmpipe, WARP, SwiftShader).
    pub is_software: bool,
}

impl AdapterInfo {
    /// Whether all of `words` are in what is printed of it, in any case.
    fn has_words(&self, words: &str) -> bool {
        let printed = self.to_string().to_lowercase();
        words.to_lowercase().split_whitespace().all(|word| printed.contains(word))
    }
}

impl From<wgpu::AdapterInfo> for AdapterInfo {
    fn from(info: wgpu::AdapterInfo) -> Self {
        AdapterInfo {
            name: info.name,
            backend: format!("{:?}", info.backend),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            is_software: info.device_type == wgpu::DeviceType::Cpu,
        }
    }
}

impl fmt::Display for AdapterInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({}, {})", self.name, self.backend, self.driver)
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
    let is_supported = cooperative.invocations() <= wgpu::Limits::default().max_compute_invocations_per_workgroup
        && adapter.limits().max_compute_workgroup_storage_size >= COOPERATIVE_STORAGE;
    is_supported.then_some(cooperative)
}

type Sources = dyn Fn(&Kernel, &Variant) -> String + Send + Sync;

/// What all clones of a [`Gpu`] share.
#[derive(Default)]
struct Shared {
    pipelines: Mutex<HashMap<String, Arc<Pipeline>>>,
    /// What the device reported outside of any call of ours; a lost device stays lost.
    uncaptured: Mutex<Option<String>>,
    lost: Mutex<Option<String>>,
}

/// A device with its queue and compiled kernels; clones share them, and may be used from any thread.
#[derive(Clone)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    shared: Arc<Shared>,
    sources: Arc<Sources>,
    chooser: Arc<Chooser>,
    /// For kernels that multiply them.
    cooperative: Option<Cooperative>,
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
        let shared = gpu.shared.clone();
        gpu.device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            lock(&shared.uncaptured).get_or_insert(one_line(&error.to_string()));
        }));
        let shared = gpu.shared.clone();
        gpu.device.set_device_lost_callback(move |reason, message| {
            lock(&shared.lost).get_or_insert(format!("the device was lost ({reason:?}): {}", one_line(&message)));
        });
        Ok(gpu)
    }

    /// Uses the caller's device and queue, within that device's features and limits.
    ///
    /// The caller's error handlers stay as they are: errors caused by calls of this crate are caught in error scopes.
    pub fn from_device(device: wgpu::Device, queue: wgpu::Queue) -> Gpu {
        tracing::debug!(adapter = %AdapterInfo::from(device.adapter_info()), features = ?device.features(), "device");
        Gpu {
            device,
            queue,
            shared: Arc::default(),
            sources: Arc::new(Kernel::source),
            chooser: Arc::default(),
            cooperative: None,
        }
    }

    /// The same device, for products in `f32` alone.
    pub fn without_cooperative(&self) -> Gpu {
        Gpu { cooperative: None, ..self.clone() }
    }

    /// Matrices that subgroups multiply; none but with [`Gpu::open_cooperative`].
    pub fn cooperative(&self) -> Option<Cooperative> {
        self.cooperative
    }

    /// The same device, with WGSL texts from `sources` in place of [`Kernel::source`]: kernels in development, planted faults.
    pub fn with_sources(&self, sources: impl Fn(&Kernel, &Variant) -> String + Send + Sync + 'static) -> Gpu {
        Gpu { sources: Arc::new(sources), chooser: Arc::new(self.chooser.afresh()), ..self.clone() }
    }

    /// The same device, with the variants of kernels chosen in this way.
    pub fn with_choice(&self, choice: Choice) -> Gpu {
        Gpu { chooser: Arc::new(Chooser::new(choice)), ..self.clone() }
    }

    /// How variants are chosen.
    pub fn choice(&self) -> &Choice {
        self.chooser.choice()
    }

    /// What [`Gpu::remember`] was told last under this name of a device with this name, driver and kernels' texts, in this process or another;
    /// `None` where nothing is kept.
    pub fn remembered(&self, name: &str) -> Option<String> {
        self.chooser.remembered(&self.key(name))
    }

    /// Keeps a word about this device where choices of variants are kept.
    pub fn remember(&self, name: &str, word: &str) {
        self.chooser.remember(&self.key(name), word);
    }

    /// What a word about the whole device is kept under.
    fn key(&self, name: &str) -> String {
        let texts = TABLE.iter().flat_map(|kernel| kernel.variants.iter().map(|variant| self.source(kernel, variant)));
        key(&format!("{} {name} {:?}", self.adapter(), texts.collect::<Vec<_>>()))
    }

    pub(crate) fn chooser(&self) -> &Chooser {
        &self.chooser
    }

    /// Whether kernels may use subgroups, and count on eight lanes.
    pub(crate) fn has_subgroups(&self) -> bool {
        self.device.features().contains(wgpu::Features::SUBGROUP) && self.device.adapter_info().subgroup_min_size >= 8
    }

    /// The adapter behind the device.
    pub fn adapter(&self) -> AdapterInfo {
        self.device.adapter_info().into()
    }

    /// The device.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// Its queue.
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Bytes that one buffer may have: the limit for `srn_plan::Builder::new`.
    pub fn max_binding_bytes(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }

    /// Bytes that a plan may take where the user sets no budget: 4 GiB on a discrete GPU; 2 GiB on adapters that take
    /// their memory from the machine. (wgpu does not tell how much there is.)
    pub fn default_memory_budget(&self) -> u64 {
        match self.device.adapter_info().device_type {
            wgpu::DeviceType::DiscreteGpu => 4 << 30,
            _ => 2 << 30,
        }
    }

    /// The WGSL text of a kernel variant.
    pub(crate) fn source(&self, kernel: &Kernel, variant: &Variant) -> String {
        let text = (self.sources)(kernel, variant);
        match self.cooperative {
            Some(cooperative) if variant.requires.contains(&Requirement::CooperativeMatrices) => cooperative.head() + &text,
            _ => text,
        }
    }

    /// The pipeline of a kernel variant, compiled on first use.
    pub(crate) fn pipeline(&self, kernel: &Kernel, variant: &Variant) -> Result<Arc<Pipeline>, ExecutorError> {
        let text = self.source(kernel, variant);
        let mut pipelines = lock(&self.shared.pipelines);
        if let Some(pipeline) = pipelines.get(&text) {
            return Ok(pipeline.clone());
        }
        let pipeline = Arc::new(Pipeline::new(self, kernel, variant, &text)?);
        pipelines.insert(text, pipeline.clone());
        Ok(pipeline)
    }

    /// Does `work` and returns the first error that wgpu reports for it, or that the device reported since the last call.
    pub(crate) fn checked<T>(&self, what: &str, work: impl FnOnce() -> T) -> Result<T, ExecutorError> {
        use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
        let scopes = [Validation, OutOfMemory, Internal].map(|filter| self.device.push_error_scope(filter));
        let value = work();
        // Popped in reverse, all of them; natively the errors of a call are known when it returns.
        let errors: Vec<_> = scopes.into_iter().rev().filter_map(|scope| pollster::block_on(scope.pop())).collect();
        // A lost device explains every other error, and tells it when polled.
        if !errors.is_empty() {
            let _ = self.poll(wgpu::PollType::Poll);
        }
        let lost = lock(&self.shared.lost).clone();
        let error = lost.or_else(|| match errors.first() {
            Some(wgpu::Error::OutOfMemory { .. }) => Some("out of device memory; set a smaller memory budget".into()),
            Some(error) => Some(one_line(&error.to_string())),
            None => lock(&self.shared.uncaptured).take(),
        });
        error.map_or(Ok(value), |error| Err(ExecutorError::Device { what: format!("{what}: {error}") }))
    }

    /// wgpu panics in `poll`, where it holds no lock, when the driver reports a lost device.
    pub(crate) fn poll(&self, poll: wgpu::PollType) -> Result<(), String> {
        match catch_unwind(AssertUnwindSafe(|| self.device.poll(poll))) {
            Ok(status) => status.map(drop).map_err(|error| error.to_string()),
            Err(_) => Err("the device was lost".into()),
        }
    }

    /// Reads the first `bytes` of a buffer with usage `COPY_SRC`, after all work submitted before.
    pub(crate) fn download(&self, what: &str, buffer: &wgpu::Buffer, bytes: u64) -> Result<wgpu::BufferView, ExecutorError> {
        let failed = |error: String| ExecutorError::Device { what: format!("{what}: {error}") };
        let (sender, receiver) = mpsc::channel();
        let staging = self.checked(what, || {
            let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("read back"),
                size: bytes,
                usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            let mut encoder = self.device.create_command_encoder(&Default::default());
            encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, bytes);
            self.queue.submit([encoder.finish()]);
            staging.slice(..).map_async(wgpu::MapMode::Read, move |result| drop(sender.send(result)));
            self.poll(wgpu::PollType::wait_indefinitely()).map(|()| staging)
        })?;
        let staging = staging.map_err(failed)?;
        // Another thread's `poll` may be the one that calls back, after ours has returned: wait for it.
        match receiver.recv() {
            Ok(Ok(())) => staging.slice(..).get_mapped_range().map_err(|error| failed(one_line(&error.to_string()))),
            _ => Err(failed("the device was lost, or the buffer cannot be mapped".into())),
        }
    }
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Gpu").field(&self.adapter()).finish()
    }
}

/// A panic elsewhere leaves these values whole: they are replaced, never half written.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// wgpu's messages are trees over several lines.
fn one_line(message: &str) -> String {
    message.lines().map(str::trim).filter(|line| !["", "Caused by:"].contains(line)).collect::<Vec<_>>().join(": ")
}
