use std::collections::BTreeMap;
use std::time::Instant;

use srn_plan::{Executor, ExecutorError, StageId};

use crate::executor::Launch;
use crate::{Gpu, GpuExecutor, launch};

/// Time on the device of all steps that ran one kernel variant.
#[derive(Clone, Debug, PartialEq)]
pub struct KernelTime {
    /// `op/variant`.
    pub label: String,
    /// Number of dispatches.
    pub steps: usize,
    /// Their time in all.
    pub seconds: f64,
    /// Their floating-point operations in all, matrix products only.
    pub flops: u64,
}

impl GpuExecutor {
    /// Runs stages with a timestamp before and after each step; the slowest kernel comes first.
    ///
    /// Needs a device with `TIMESTAMP_QUERY` ([`Gpu::open`](crate::Gpu::open) asks for it). Steps cannot overlap in this
    /// run, so the sum may exceed the time of a plain run.
    pub fn profile(&mut self, stages: &[StageId]) -> Result<Vec<KernelTime>, ExecutorError> {
        if !self.gpu().device().features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return Err(ExecutorError::Device { what: format!("{} has no timestamps", self.describe()) });
        }
        self.attempt(|this| {
            let mut times: BTreeMap<&str, KernelTime> = BTreeMap::new();
            let parts = stages.iter().flat_map(|&stage| {
                launch::submissions(&this.plan().stage(stage).steps).into_iter().map(move |part| (stage, part))
            });
            for (stage, part) in parts {
                let (steps, launches): (Vec<_>, Vec<&Launch>) = this.launches(stage, part).unzip();
                let seconds = this.gpu().time(&launches)?;
                for ((steps, launch), seconds) in steps.into_iter().zip(launches).zip(seconds) {
                    let label = launch.label.as_str();
                    let new = || KernelTime { label: label.into(), steps: 0, seconds: 0.0, flops: 0 };
                    let time = times.entry(label).or_insert_with(new);
                    time.steps += 1;
                    time.seconds += seconds;
                    time.flops += this.plan().stage(stage).steps[steps].iter().map(|step| step.flops).sum::<u64>();
                }
            }
            let mut times: Vec<_> = times.into_values().collect();
            times.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
            Ok(times)
        })
    }
}

impl Gpu {
    /// Seconds that each of these takes in one submission; by the caller's clock, and a submission each, on a device without
    /// timestamps.
    pub(crate) fn time(&self, launches: &[&Launch]) -> Result<Vec<f64>, ExecutorError> {
        if !self.device().features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            return launches.iter().map(|launch| self.time_from_outside(launch)).collect();
        }
        let (device, queue) = (self.device(), self.queue());
        let count = 2 * launches.len() as u32;
        let ticks = self.checked("timing", || {
            let ty = wgpu::QueryType::Timestamp;
            let query_set = device.create_query_set(&wgpu::QuerySetDescriptor { label: Some("steps"), ty, count });
            let ticks = device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("ticks"),
                size: 8 * u64::from(count),
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            let mut encoder = device.create_command_encoder(&Default::default());
            for (index, launch) in launches.iter().enumerate() {
                let timestamp_writes = Some(wgpu::ComputePassTimestampWrites {
                    query_set: &query_set,
                    beginning_of_pass_write_index: Some(2 * index as u32),
                    end_of_pass_write_index: Some(2 * index as u32 + 1),
                });
                let label = Some(launch.label.as_str());
                launch.dispatch(&mut encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label, timestamp_writes }));
            }
            encoder.resolve_query_set(&query_set, 0..count, &ticks, 0);
            queue.submit([encoder.finish()]);
            ticks
        })?;
        let view = self.download("timing", &ticks, 8 * u64::from(count))?;
        let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view[..]);
        let period = f64::from(queue.get_timestamp_period()) * 1e-9;
        Ok(ticks.chunks_exact(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64 * period).collect())
    }

    fn time_from_outside(&self, launch: &Launch) -> Result<f64, ExecutorError> {
        let begin = Instant::now();
        let waited = self.checked("timing", || {
            let mut encoder = self.device().create_command_encoder(&Default::default());
            launch.dispatch(&mut encoder.begin_compute_pass(&Default::default()));
            self.queue().submit([encoder.finish()]);
            self.poll(wgpu::PollType::wait_indefinitely())
        })?;
        waited.map_err(|what| ExecutorError::Device { what: format!("timing: {what}") })?;
        Ok(begin.elapsed().as_secs_f64())
    }
}
