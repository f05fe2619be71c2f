//! Rows of a tile out of the whole batch, and back into it.

use srn_shaders::{Kernel, TILE_GATHER, TILE_SCATTER, TileParams};

use super::{output, read, size};
use crate::{BufferId, Builder, PlanError, Tile};

/// `whole [images · rows_per_image, columns]` → `part [rows, columns]`.
pub fn gather(b: &mut Builder, tile: Tile, columns: u32, whole: BufferId, part: BufferId) -> Result<(), PlanError> {
    push(b, &TILE_GATHER, tile, columns, |in_part, in_whole| [read(whole, in_whole), output(part, in_part, false)])
}

/// `part [rows, columns]` → its place in `whole`; all other rows stay as they are.
pub fn scatter(b: &mut Builder, tile: Tile, columns: u32, part: BufferId, whole: BufferId) -> Result<(), PlanError> {
    push(b, &TILE_SCATTER, tile, columns, |in_part, in_whole| [read(part, in_part), output(whole, in_whole, false)])
}

fn push(
    b: &mut Builder,
    kernel: &'static Kernel,
    tile: Tile,
    columns: u32,
    args: impl Fn(usize, usize) -> [crate::Arg; 2],
) -> Result<(), PlanError> {
    let Tile { rows, first_row, rows_per_image } = tile;
    let part = size([rows.count(), columns]);
    let whole = size([rows.first_group + rows.groups, rows_per_image, columns]);
    let params = TileParams {
        groups: rows.groups,
        rows_per_group: rows.rows_per_group,
        first_group: rows.first_group,
        first_row,
        rows_per_image,
        columns,
    };
    b.step(kernel, params, &args(part, whole), [part as u32, 1, 1], 0, 0)
}
