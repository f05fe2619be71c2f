//! Skeletons of the five parts of a kernel.

/// Writes them.
pub fn run(_: &[String]) -> Result<(), String> {
    Ok(())
}
