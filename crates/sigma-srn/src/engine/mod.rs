//! Where plans run: a GPU through wgpu, or the CPU.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use srn_cpu::Precision;
use srn_gpu::{AdapterInfo, Gpu, GpuExecutor};
use srn_plan::{Builder, Executor, ExecutorError, Plan, PlanError};

use crate::Error;
use proof::{Proofs, difference};

#[cfg(not(target_family = "wasm"))]
mod automatic;
pub(crate) mod proof;

/// Memory that a plan may take on the CPU where the user sets no budget, in bytes.
const CPU_BUDGET: u64 = 2 << 30;
/// Rows of a tile on a GPU: enough to fill a large one.
const GPU_TILE_ROWS: u32 = 32_768;
/// The same for a software adapter.
const SOFTWARE_TILE_ROWS: u32 = 4096;

/// Most tiles of a plan, which has some hundred steps for each: they take memory that no budget counts.
const MOST_TILES: u32 = 1024;

/// Rows of a sum, which are a loop of one invocation.
const GPU_PART_ROWS: u32 = 512;

/// Most difference that cooperative matrices may make to a pose gradient, relative to the largest.
const COOPERATIVE_LIMIT: f64 = 0.01;

/// What computes.
#[derive(Clone, Debug)]
enum Kind {
    Cpu(Precision),
    Gpu(Gpu),
}

/// A place to run plans, with a memory budget. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Engine {
    kind: Kind,
    budget: u64,
    /// The user's choice; by kind and width of the network where there is none.
    tile_rows: Option<u32>,
    /// Where cooperative matrices are wanted: the difference that they were found to make, see [`Engine::cooperative_difference`].
    cooperative: Option<Arc<OnceLock<f64>>>,
    /// Whether the CPU computes where the GPU is refused.
    or_cpu: bool,
    proofs: Arc<Mutex<Proofs>>,
}

impl Engine {
    /// The CPU in `f32`, with all threads of the current rayon pool.
    pub fn cpu() -> Self {
        let kind = Kind::Cpu(Precision::F32);
        Engine { kind, budget: CPU_BUDGET, tile_rows: None, cooperative: None, or_cpu: false, proofs: Arc::default() }
    }

    /// The CPU in `f64`: the oracle of the tests.
    pub fn cpu_f64() -> Self {
        Engine { kind: Kind::Cpu(Precision::F64), ..Self::cpu() }
    }

    /// A GPU, or a software adapter: opened by [`Gpu::open`], or made from the caller's device by [`Gpu::from_device`].
    ///
    /// With one that was opened by [`Gpu::open_cooperative`], poses are looked for with cooperative matrices; see
    /// [`Engine::cooperative_difference`].
    pub fn gpu(gpu: Gpu) -> Self {
        let budget = gpu.default_memory_budget();
        let cooperative = gpu.cooperative().map(|_| Arc::default());
        Engine { kind: Kind::Gpu(gpu), budget, tile_rows: None, cooperative, or_cpu: false, proofs: Arc::default() }
    }

    /// The same, but a GPU that computes wrong results is not an error ([`Error::Adapter`]): the CPU goes on in its place, with a warning.
    pub fn or_cpu(self) -> Self {
        Engine { or_cpu: true, ..self }
    }

    /// What computes, by what is known of it now.
    fn kind(&self) -> Kind {
        let proofs = self.proofs.lock().unwrap_or_else(PoisonError::into_inner);
        proofs.instead.as_ref().unwrap_or(&self.kind).clone()
    }

    /// The same with another memory budget, in bytes.
    pub fn with_budget(self, budget: u64) -> Self {
        Engine { budget, ..self }
    }

    /// The same with at most `rows` rays in flight, but for work that would take more than a thousand turns so.
    pub fn with_tile_rows(self, rows: u32) -> Self {
        Engine { tile_rows: Some(rows.max(1)), ..self }
    }

    /// What cooperative matrices change in the pose gradients of the first few hypotheses, relative to the largest of their numbers; above
    /// 0.01 the engine goes on without. Known once [`estimate`](crate::estimate) has begun on an engine that has them; clones share it.
    pub fn cooperative_difference(&self) -> Option<f64> {
        self.cooperative.as_ref()?.get().copied()
    }

    /// Whether poses are looked for with cooperative matrices.
    pub fn is_cooperative(&self) -> bool {
        self.cooperative_difference().is_some_and(|difference| difference <= COOPERATIVE_LIMIT)
    }

    /// Finds [`Engine::cooperative_difference`] if it is wanted and not known yet; `gradients` are evaluated once without and once with them.
    pub(crate) fn check_cooperative(&self, gradients: impl Fn(&Engine) -> Result<Vec<[f64; 6]>, Error>) -> Result<(), Error> {
        let Some(known) = self.cooperative.as_ref().filter(|known| known.get().is_none()) else { return Ok(()) };
        let found = |difference: f64| Engine { cooperative: Some(Arc::new(difference.into())), ..self.clone() };
        let (without, with) = (gradients(&found(f64::INFINITY))?.concat(), gradients(&found(0.0))?.concat());
        // Another thread may have been first, with the same outcome.
        known.get_or_init(|| difference(&[with], &[without]));
        Ok(())
    }

    /// The memory budget in bytes.
    pub fn budget(&self) -> u64 {
        self.budget
    }

    /// The GPU, if it is one.
    pub fn as_gpu(&self) -> Option<Gpu> {
        match self.kind() {
            Kind::Gpu(gpu) => Some(gpu),
            Kind::Cpu(_) => None,
        }
    }

    /// Most bytes of one buffer, four to a value.
    pub(crate) fn max_binding_bytes(&self) -> u64 {
        match self.kind() {
            Kind::Gpu(gpu) => gpu.max_binding_bytes(),
            Kind::Cpu(_) => u64::MAX,
        }
    }

    /// Bytes that a value of a plan takes.
    pub(crate) fn value_bytes(&self) -> u64 {
        if matches!(self.kind(), Kind::Cpu(Precision::F64)) { 8 } else { 4 }
    }

    /// A builder with this engine's limits.
    fn builder(&self) -> Builder {
        Builder::new(self.max_binding_bytes())
    }

    /// The product, or an error where that is too large to count rows with.
    pub(crate) fn rows<const N: usize>(factors: [u32; N]) -> Result<u32, Error> {
        let product = factors.into_iter().try_fold(1u32, u32::checked_mul);
        product.ok_or_else(|| Error::Setting { field: "rays", what: format!("{factors:?} are more than {} at once", u32::MAX) })
    }

    /// Builds a plan with the largest tiles that fit the budget and the device's limits, for a network of `features`
    /// wide layers; `build` gets the rows of a tile. Where nothing fits, the error says what the smallest tiles need that are still few enough.
    pub(crate) fn fit<T>(
        &self,
        rows: u32,
        features: u32,
        build: impl Fn(&mut Builder, u32) -> Result<T, PlanError>,
    ) -> Result<(Plan, T), Error> {
        let preferred = self.tile_rows.unwrap_or(match self.kind() {
            Kind::Gpu(gpu) if gpu.adapter().is_software => SOFTWARE_TILE_ROWS,
            Kind::Gpu(_) => GPU_TILE_ROWS,
            // What is kept for the way back stays in the caches.
            Kind::Cpu(_) => srn_cpu::rows_for_all_threads(features as usize) as u32,
        });
        let least = rows.div_ceil(MOST_TILES).max(1);
        // A plan with tiles of so many rows, or what it needs where that is too much: anything where the device can bind no such buffer.
        let attempt = |tile_rows: u32| {
            let mut builder = self.builder();
            match build(&mut builder, tile_rows).and_then(|rest| Ok((builder.finish()?, rest))) {
                Ok((plan, rest)) if self.bytes(&plan) <= self.budget => Ok(Ok((plan, rest))),
                Ok((plan, _)) => Ok(Err(self.bytes(&plan))),
                Err(PlanError::TooLarge { .. }) if tile_rows > least => Ok(Err(u64::MAX)),
                Err(error) => Err(Error::from(error)),
            }
        };
        let smaller = |tile_rows: u32| (tile_rows * 3 / 4).max(least);
        let mut tile_rows = rows.min(preferred).max(least);
        let needed = loop {
            match attempt(tile_rows)? {
                Ok(built) => return Ok(built),
                Err(u64::MAX) => tile_rows = smaller(tile_rows),
                Err(needed) => break needed,
            }
        };
        // The smallest tiles say at once whether any fit, and how much a row takes.
        let smallest = match attempt(least)? {
            Ok(built) => built,
            Err(needed) => return Err(Error::Budget { budget: self.budget, needed }),
        };
        let (left, taken) = (self.budget - self.bytes(&smallest.0), needed - self.bytes(&smallest.0));
        tile_rows = least + (f64::from(tile_rows - least) * left as f64 / taken as f64) as u32;
        while tile_rows > least {
            if let Ok(built) = attempt(tile_rows)? {
                return Ok(built);
            }
            tile_rows = smaller(tile_rows);
        }
        Ok(smallest)
    }

    /// Rows of a tile of `tile_rows` over which one sum for the gradients of weights goes, at most, for a network of `features` wide layers.
    pub(crate) fn part_rows(&self, tile_rows: u32, features: u32) -> u32 {
        match self.kind() {
            Kind::Gpu(_) => GPU_PART_ROWS,
            Kind::Cpu(_) => srn_cpu::part_rows(tile_rows as usize, features as usize) as u32,
        }
    }

    fn bytes(&self, plan: &Plan) -> u64 {
        plan.bytes() / 4 * self.value_bytes()
    }

    /// Makes a plan ready to run.
    pub(crate) fn prepare(&self, plan: Plan) -> Result<Runner, ExecutorError> {
        Ok(match self.kind() {
            Kind::Cpu(precision) => Runner::Cpu(srn_cpu::executor(precision, plan, self.budget)?),
            Kind::Gpu(gpu) => Runner::Gpu(GpuExecutor::new(&gpu.without_cooperative(), plan, self.budget)?),
        })
    }

    /// The same for one that looks for poses.
    pub(crate) fn prepare_descent(&self, plan: Plan) -> Result<Runner, ExecutorError> {
        match self.kind() {
            Kind::Gpu(gpu) if self.is_cooperative() => Ok(Runner::Gpu(GpuExecutor::new(&gpu, plan, self.budget)?)),
            _ => self.prepare(plan),
        }
    }
}

impl std::fmt::Display for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.kind() {
            Kind::Cpu(Precision::F32) => write!(f, "cpu"),
            Kind::Cpu(Precision::F64) => write!(f, "cpu64"),
            Kind::Gpu(gpu) => {
                let AdapterInfo { name, backend, .. } = gpu.adapter();
                write!(f, "{backend} {name}{}", if self.is_cooperative() { ", cooperative matrices" } else { "" })
            }
        }
    }
}

/// A plan on its executor.
pub(crate) enum Runner {
    Cpu(Box<dyn Executor>),
    Gpu(GpuExecutor),
}

impl Runner {
    /// The GPU executor, if it is one.
    pub fn as_gpu(&self) -> Option<&GpuExecutor> {
        match self {
            Runner::Gpu(executor) => Some(executor),
            Runner::Cpu(_) => None,
        }
    }
}

impl std::ops::Deref for Runner {
    type Target = dyn Executor;

    fn deref(&self) -> &Self::Target {
        match self {
            Runner::Cpu(executor) => executor.as_ref(),
            Runner::Gpu(executor) => executor,
        }
    }
}

impl std::ops::DerefMut for Runner {
    fn deref_mut(&mut self) -> &mut Self::Target {
        match self {
            Runner::Cpu(executor) => executor.as_mut(),
            Runner::Gpu(executor) => executor,
        }
    }
}

#[cfg(test)]
mod tests {
    use srn_plan::ops::latent_loss;

    use super::*;

    /// A plan of so many bytes a row, for a device that binds no more than `most` rows.
    fn built(engine: &Engine, rows: u32, most: u32) -> Result<u32, Error> {
        let build = |b: &mut Builder, tile_rows: u32| {
            if tile_rows > most {
                return Err(PlanError::TooLarge { buffer: "rows".into(), bytes: tile_rows.into(), limit: most.into() });
            }
            let [z, d_z] = [b.input("z", tile_rows as usize)?, b.input("d z", tile_rows as usize)?];
            b.stage("all");
            latent_loss::backward(b, tile_rows, 1.0, z, d_z)?;
            Ok(tile_rows)
        };
        engine.fit(rows, 64, build).map(|(_, tile_rows)| tile_rows)
    }

    #[test]
    fn tiles_are_as_large_as_the_budget_and_the_device_allow() {
        let rows = 1 << 20;
        let engine = Engine::cpu().with_tile_rows(100_000);
        assert_eq!(built(&engine, rows, u32::MAX).unwrap(), 100_000);
        assert_eq!(built(&engine, 70, u32::MAX).unwrap(), 70);
        assert_eq!(built(&engine, rows, 75_000).unwrap(), 75_000);
        // Eight bytes a row.
        let budget = |bytes: u64| built(&engine.clone().with_budget(bytes), rows, 80_000);
        assert_eq!([budget(600_000).unwrap(), budget(400_000).unwrap(), budget(8 * 1024).unwrap()], [75_000, 50_000, 1024]);
        // More than a thousand tiles would fill the memory with steps.
        assert!(matches!(budget(8 * 1024 - 1), Err(Error::Budget { needed: 8192, .. })));
        assert_eq!(built(&engine.with_tile_rows(10), rows, u32::MAX).unwrap(), 1024);
    }
}
