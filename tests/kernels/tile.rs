use srn_plan::ops::tile;
use srn_plan::{Rows, Tile};
use srn_shaders::{TILE_GATHER, TILE_SCATTER};
use srn_tests::{Case, Sketch};

use crate::{KernelTest, ROWS};

pub static GATHER: KernelTest = KernelTest {
    kernel: &TILE_GATHER,
    // A copy.
    tolerance: 0.0,
    cases: gather,
    faults: &[
        ("gather", "params.first_group + ", "0u + "),
        ("gather", "params.first_row + ", "0u + "),
        ("gather", "row % params.rows_per_group", "row / params.rows_per_group"),
        ("gather", "image * params.rows_per_image", "image * params.rows_per_group"),
    ],
};

pub static SCATTER: KernelTest = KernelTest {
    kernel: &TILE_SCATTER,
    // A copy.
    tolerance: 0.0,
    cases: scatter,
    faults: &[
        ("scatter", "params.first_group + ", "0u + "),
        ("scatter", "params.first_row + ", "0u + "),
        ("scatter", "image * params.rows_per_image", "image * params.rows_per_group"),
    ],
};

#[test]
fn gather_matches_reference() {
    GATHER.matches_reference();
}

#[test]
fn scatter_matches_reference() {
    SCATTER.matches_reference();
}

/// Tiles from the middle of their images.
fn tile(rows: Rows) -> Tile {
    Tile { rows, first_row: 2, rows_per_image: rows.rows_per_group + 5 }
}

/// Part and whole, in values.
fn lengths(tile: Tile, columns: u32) -> (usize, usize) {
    let images = tile.rows.first_group + tile.rows.groups;
    ((tile.rows.count() * columns) as usize, (images * tile.rows_per_image * columns) as usize)
}

fn gather() -> Vec<Case> {
    ROWS.iter().flat_map(|&rows| [1, 3].map(|columns| gather_case(tile(rows), columns))).collect()
}

fn gather_case(tile: Tile, columns: u32) -> Case {
    let mut s = Sketch::new(format!("{tile:?}, {columns} columns"));
    let (in_part, in_whole) = lengths(tile, columns);
    let whole = s.random("whole", in_whole);
    let part = s.scratch("part", in_part);
    s.step(|b| tile::gather(b, tile, columns, whole, part));
    s.finish()
}

fn scatter() -> Vec<Case> {
    ROWS.iter().flat_map(|&rows| [1, 3].map(|columns| scatter_case(tile(rows), columns))).collect()
}

fn scatter_case(tile: Tile, columns: u32) -> Case {
    let mut s = Sketch::new(format!("{tile:?}, {columns} columns"));
    let (in_part, in_whole) = lengths(tile, columns);
    let part = s.random("part", in_part);
    let whole = s.random("whole", in_whole);
    s.step(|b| tile::scatter(b, tile, columns, part, whole));
    s.finish()
}
