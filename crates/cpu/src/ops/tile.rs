//! Rows of a tile out of the whole batch, and back.

use srn_shaders::TileParams;

/// Number of the tile's first row in the whole.
pub(crate) fn first(p: TileParams) -> usize {
    (p.first_group * p.rows_per_image + p.first_row) as usize
}

/// Whether its rows are not side by side there: those of one image are, and those of whole images.
pub(crate) fn has_gaps(p: TileParams) -> bool {
    p.groups > 1 && p.rows_per_group < p.rows_per_image
}

/// `(place in the part, place in the whole)` of each group's rows, with their common length.
fn spans(p: TileParams) -> impl Iterator<Item = (usize, usize, usize)> {
    let length = (p.rows_per_group * p.columns) as usize;
    (0..p.groups).map(move |group| {
        let whole = ((p.first_group + group) as usize * p.rows_per_image as usize + p.first_row as usize) * p.columns as usize;
        (group as usize * length, whole, length)
    })
}

/// Whole to part.
pub fn gather<T: Copy>(p: TileParams, whole: &[T], part: &mut [T]) {
    for (in_part, in_whole, length) in spans(p) {
        part[in_part..in_part + length].copy_from_slice(&whole[in_whole..in_whole + length]);
    }
}

/// Part to whole.
pub fn scatter<T: Copy>(p: TileParams, part: &[T], whole: &mut [T]) {
    for (in_part, in_whole, length) in spans(p) {
        whole[in_whole..in_whole + length].copy_from_slice(&part[in_part..in_part + length]);
    }
}
