//! Which executor, where the user does not say.

use std::time::Instant;

use srn_gpu::Gpu;
use srn_plan::Rows;
use srn_plan::ops::linear::{self, Layer, Sets};

use super::Engine;
use crate::Error;

impl Engine {
    /// The GPU where there is an adapter that is not a software one, else whichever executor is faster on a small matrix
    /// product on this machine. Also says which it took and why. Where a GPU is refused later, the CPU goes on ([`Engine::or_cpu`]).
    pub fn automatic() -> (Self, String) {
        let gpu = match Gpu::open(None) {
            Ok(gpu) => gpu,
            Err(error) => return (Self::cpu(), format!("CPU executor: {error}")),
        };
        let name = gpu.adapter().name;
        if !gpu.adapter().is_software {
            return (Self::gpu(gpu).or_cpu(), format!("GPU executor on {name}"));
        }
        let (cpu, software) = (Self::cpu(), Self::gpu(gpu).or_cpu());
        match (cpu.matrix_product_seconds(), software.matrix_product_seconds()) {
            (Ok(cpu_time), Ok(software_time)) if software_time < cpu_time => {
                (software, format!("GPU executor on {name}: {:.1} times the CPU executor's speed here", cpu_time / software_time))
            }
            (Ok(cpu_time), Ok(software_time)) => {
                (cpu, format!("CPU executor: {:.1} times the speed of {name} here", software_time / cpu_time))
            }
            (_, Err(error)) => (cpu, format!("CPU executor: {name} failed ({error})")),
            (Err(_), _) => (software, format!("GPU executor on {name}")),
        }
    }

    /// Seconds of the best of three products of 4096 rows with 128 × 128 weights, after a first one that compiles.
    fn matrix_product_seconds(&self) -> Result<f64, Error> {
        const ROWS: u32 = 4096;
        const WIDTH: u32 = 128;
        let mut b = self.builder();
        let weights = b.input("weights", (WIDTH * WIDTH + WIDTH) as usize)?;
        let (x, y) = (b.input("x", (ROWS * WIDTH) as usize)?, b.scratch("y", (ROWS * WIDTH) as usize)?);
        let slots = b.input_u32("slots", 1)?;
        let layer = Layer { weights, in_features: WIDTH, out_features: WIDTH, sets: Sets::Shared };
        let stage = b.stage("product");
        linear::forward(&mut b, Rows::plain(ROWS), layer, x, slots, y, false)?;
        let mut runner = self.prepare(b.finish()?)?;
        let mut best = f64::INFINITY;
        for round in 0..4 {
            let start = Instant::now();
            runner.run(stage)?;
            runner.read(y)?;
            if round > 0 {
                best = best.min(start.elapsed().as_secs_f64());
            }
        }
        Ok(best)
    }
}
