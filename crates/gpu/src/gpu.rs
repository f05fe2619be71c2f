use std::collections::{BTreeSet, HashMap};
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use srn_plan::{ExecutorError, Kernel};
use srn_shaders::{Cooperative, HIDDEN_LAYER_FORWARD, Requirement, TABLE, Variant};

use crate::choice::{Choice, Chooser, key};
use crate::pipeline::Pipeline;

#[cfg(target_family = "wasm")]
mod browser;
#[cfg(not(target_family = "wasm"))]
mod native;

#[cfg(not(target_family = "wasm"))]
pub use native::{OpenError, adapters};

/// An adapter of this machine.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterInfo {
    /// Name that the driver gives, for example `llvmpipe (LLVM 15.0.6, 256 bits)`; browsers give none.
    pub name: String,
    /// `Vulkan`, `Metal`, `Dx12` or `BrowserWebGpu`.
    pub backend: String,
    /// The driver and its version.
    pub driver: String,
    /// True where the "GPU" is this machine's CPU (llvmpipe, WARP, SwiftShader).
    pub is_software: bool,
}

impl From<wgpu::AdapterInfo> for AdapterInfo {
    fn from(info: wgpu::AdapterInfo) -> Self {
        AdapterInfo {
            name: if info.name.is_empty() { "GPU".into() } else { info.name },
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

/// What translates kernels for the driver.
const TRANSLATOR: &str = "naga 30.0.1";

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
    /// Uses the caller's device and queue, within that device's features and limits. In a browser, where results are waited for by suspending
    /// WebAssembly, call what waits from exports with `#[wasm_bindgen(jspi)]`, one at a time. With [`Choice::Named`] nothing is measured, and nothing waits
    /// but what reads.
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

    /// What [`Gpu::remember`] was told last under this name of a device with this name, driver, features and kernels' texts, in this process or another;
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
        key(&format!("{} {name} {:?}", self.identity(), texts.collect::<Vec<_>>()))
    }

    /// Everything but a kernel's text that decides what the device computes, and how fast.
    pub(crate) fn identity(&self) -> String {
        let (info, features) = (self.device.adapter_info(), self.device.features());
        format!("{} {TRANSLATOR} {features:?} {} {}", self.adapter(), info.subgroup_min_size, info.subgroup_max_size)
    }

    /// The forms of kernels beside the plain ones that this device may run, as names for [`Choice::Named`].
    pub fn forms(&self) -> BTreeSet<&'static str> {
        let may_run = |variant: &&Variant| match variant.requires {
            requires if requires.contains(&Requirement::CooperativeMatrices) => false,
            requires => self.has_subgroups() || !requires.contains(&Requirement::Subgroups),
        };
        let others = TABLE.iter().flat_map(|kernel| kernel.variants.iter().skip(1)).filter(may_run);
        let joined = self.may_join().then_some(HIDDEN_LAYER_FORWARD.op);
        others.filter_map(|variant| variant.name.rsplit('_').next()).chain(joined).collect()
    }

    /// Whether two steps may be one where that is faster: it must be timed, and one dispatch less is nothing to the threads of a processor.
    pub(crate) fn may_join(&self) -> bool {
        self.can_time() && !self.adapter().is_software
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
        let (value, errors) = self.scoped(work);
        // A lost device explains every other error, and tells it when polled.
        if !errors.is_empty() {
            let _ = self.poll(wgpu::PollType::Poll);
        }
        let lost = lock(&self.shared.lost).clone();
        let error = lost.or_else(|| errors.first().map(told)).or_else(|| lock(&self.shared.uncaptured).take());
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
            self.map(&staging).map(|()| staging)
        })?;
        staging.map_err(failed)?.slice(..).get_mapped_range().map_err(|error| failed(one_line(&error.to_string())))
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

/// Catches errors from now on; to be popped in reverse, all of them.
fn open_scopes(device: &wgpu::Device) -> [wgpu::ErrorScopeGuard; 3] {
    use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
    [Validation, OutOfMemory, Internal].map(|filter| device.push_error_scope(filter))
}

fn told(error: &wgpu::Error) -> String {
    match error {
        wgpu::Error::OutOfMemory { .. } => "out of device memory; set a smaller memory budget".into(),
        error => one_line(&error.to_string()),
    }
}

/// wgpu's messages are trees over several lines.
fn one_line(message: &str) -> String {
    message.lines().map(str::trim).filter(|line| !["", "Caused by:"].contains(line)).collect::<Vec<_>>().join(": ")
}
