use crate::{BufferId, ExecutorError, Plan, StageId};

/// Runs a plan: holds its buffers and computes its stages.
pub trait Executor: Send {
    /// The plan that this executor holds.
    fn plan(&self) -> &Plan;

    /// Overwrites a whole `f32` buffer.
    fn write(&mut self, buffer: BufferId, values: &[f32]) -> Result<(), ExecutorError>;

    /// Overwrites a whole `f32` buffer from `f64` values; an executor that computes in `f64` keeps their digits.
    fn write_f64(&mut self, buffer: BufferId, values: &[f64]) -> Result<(), ExecutorError> {
        self.write(buffer, &values.iter().map(|&value| value as f32).collect::<Vec<_>>())
    }

    /// Overwrites a whole `u32` buffer.
    fn write_u32(&mut self, buffer: BufferId, values: &[u32]) -> Result<(), ExecutorError>;

    /// Runs all steps of a stage. A failure on the device may only show at the next read.
    fn run(&mut self, stage: StageId) -> Result<(), ExecutorError>;

    /// Runs one step of a stage (lockstep comparison, profiles).
    fn run_step(&mut self, stage: StageId, step: usize) -> Result<(), ExecutorError>;

    /// Reads a whole `f32` buffer; waits for the work before it and surfaces its errors.
    fn read(&mut self, buffer: BufferId) -> Result<Vec<f32>, ExecutorError>;

    /// Reads a whole `f32` buffer as `f64`; an executor that computes in `f64` gives all its digits.
    fn read_f64(&mut self, buffer: BufferId) -> Result<Vec<f64>, ExecutorError> {
        Ok(self.read(buffer)?.into_iter().map(f64::from).collect())
    }

    /// Reads a whole `u32` buffer.
    fn read_u32(&mut self, buffer: BufferId) -> Result<Vec<u32>, ExecutorError>;

    /// What computes, in words: "cpu f32, 2 threads", "llvmpipe (Vulkan)".
    fn describe(&self) -> String;
}
