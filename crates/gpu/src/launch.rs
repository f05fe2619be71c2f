//! How a step becomes a dispatch: how many workgroups, in which submission.

use std::ops::Range;

use srn_plan::Step;

/// Most matrix work of one submission, so that no driver's watchdog takes it for a hang (20 GFLOP: a second on a slow device).
pub(crate) const MOST_FLOPS: u64 = 20_000_000_000;
/// Most steps of one submission. Two timestamps each fit a query set.
pub(crate) const MOST_STEPS: usize = 2000;

/// Workgroups that cover `extent`, or none where a dimension exceeds `most`. One-dimensional grids are folded into y: the
/// kernels number their workgroups with `flat_index`.
pub(crate) fn grid(extent: [u32; 3], tile: [u32; 3], most: u32) -> Option<[u32; 3]> {
    let mut grid = [0, 1, 2].map(|axis| extent[axis].div_ceil(tile[axis]));
    if grid[0] > most && extent[1..] == [1, 1] && tile[1..] == [1, 1] {
        let folds = grid[0].div_ceil(most);
        grid = [grid[0].div_ceil(folds), folds, 1];
    }
    grid.iter().all(|&count| count <= most).then_some(grid)
}

/// Cuts a stage into submissions.
pub(crate) fn submissions(steps: &[Step]) -> Vec<Range<usize>> {
    let mut parts = Vec::new();
    let (mut start, mut flops) = (0, 0);
    for (index, step) in steps.iter().enumerate() {
        if index > start && (index - start == MOST_STEPS || flops + step.flops > MOST_FLOPS) {
            parts.push(start..index);
            (start, flops) = (index, 0);
        }
        flops += step.flops;
    }
    if start < steps.len() {
        parts.push(start..steps.len());
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_cover_the_extent() {
        assert_eq!(grid([1, 1, 1], [64, 1, 1], 65_535), Some([1, 1, 1]));
        assert_eq!(grid([65, 17, 3], [64, 8, 1], 65_535), Some([2, 3, 3]));
        let folded = grid([64 * 65_535 + 1, 1, 1], [64, 1, 1], 65_535).unwrap();
        assert_eq!(folded, [32_768, 2, 1]);
        assert_eq!(grid([1, 65_536, 1], [64, 1, 1], 65_535), None);
        assert_eq!(grid([64 * 65_536, 2, 1], [64, 1, 1], 65_535), None);
    }

    #[test]
    fn submissions_are_bounded_and_complete() {
        let step = |flops| Step { kernel: &srn_shaders::SUM_FORWARD, buffers: vec![], params: vec![], extent: [1; 3], flops };
        assert!(submissions(&[]).is_empty());
        assert_eq!(submissions(&[step(3 * MOST_FLOPS), step(1), step(MOST_FLOPS)]), [0..1, 1..2, 2..3]);
        assert_eq!(submissions(&vec![step(0); MOST_STEPS + 1]), [0..MOST_STEPS, MOST_STEPS..MOST_STEPS + 1]);
    }
}
