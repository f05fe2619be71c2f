/// The rows that a step works on: `groups · rows_per_group`, group `g` belonging to image `first_group + g`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rows {
    /// Number of images.
    pub groups: u32,
    /// Rows of each.
    pub rows_per_group: u32,
    /// Number of the first image.
    pub first_group: u32,
}

impl Rows {
    /// Rows that belong to no image in particular.
    pub fn plain(rows: u32) -> Self {
        Rows { groups: 1, rows_per_group: rows, first_group: 0 }
    }

    /// Number of rows.
    pub fn count(self) -> u32 {
        self.groups * self.rows_per_group
    }
}

/// The rows of each group cut into parts, as even as possible: a sum over rows goes over each part first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parts {
    /// The rows.
    pub rows: Rows,
    /// Rows of a part; the last one of each group may have fewer.
    pub chunk_rows: u32,
    /// Parts of each group.
    pub chunks: u32,
}

impl Parts {
    /// Parts of at most `most` rows.
    pub fn of(rows: Rows, most: u32) -> Self {
        let fewest = rows.rows_per_group.div_ceil(most.max(1)).max(1);
        let chunk_rows = rows.rows_per_group.div_ceil(fewest).max(1);
        Parts { rows, chunk_rows, chunks: rows.rows_per_group.div_ceil(chunk_rows).max(1) }
    }

    /// One part for each group.
    pub fn whole(rows: Rows) -> Self {
        Parts::of(rows, rows.rows_per_group)
    }

    /// Number of parts.
    pub fn count(self) -> u32 {
        self.rows.groups * self.chunks
    }
}

/// A part of a batch of images that is computed at once: some whole images, or a part of one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile {
    /// Its rows, and the images they belong to.
    pub rows: Rows,
    /// Number of its first row within each of its images.
    pub first_row: u32,
    /// Rows of each image in the whole batch.
    pub rows_per_image: u32,
}

/// Cuts `images · rows_per_image` rows into tiles of at most `most` rows, as even as possible.
pub fn tiles(images: u32, rows_per_image: u32, most: u32) -> Vec<Tile> {
    let most = most.max(1);
    let tile = |first_group, groups, first_row, rows_per_group| Tile {
        rows: Rows { groups, rows_per_group, first_group },
        first_row,
        rows_per_image,
    };
    if rows_per_image <= most {
        even_parts(images, most / rows_per_image).map(|(first, count)| tile(first, count, 0, rows_per_image)).collect()
    } else {
        (0..images)
            .flat_map(|image| even_parts(rows_per_image, most).map(move |(first, count)| tile(image, 1, first, count)))
            .collect()
    }
}

/// `(start, length)` of the fewest parts of at most `most` that cover `0..count`, their lengths differing by at most one.
fn even_parts(count: u32, most: u32) -> impl Iterator<Item = (u32, u32)> {
    let parts = count.div_ceil(most);
    (0..parts).map(move |part| {
        let edge = |k: u32| (u64::from(count) * u64::from(k) / u64::from(parts)) as u32;
        (edge(part), edge(part + 1) - edge(part))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_even_and_no_longer_than_asked_for() {
        for (rows_per_group, most, expected) in [
            (256, 256, [256, 1]),
            (300, 256, [150, 2]),
            (4096, 1024, [1024, 4]),
            (5, 4, [3, 2]),
            (9, 4, [3, 3]),
            (7, 100, [7, 1]),
        ] {
            let parts = Parts::of(Rows { groups: 3, rows_per_group, first_group: 2 }, most);
            assert_eq!([parts.chunk_rows, parts.chunks], expected);
            assert_eq!(parts.count(), 3 * expected[1]);
            assert!((parts.chunks - 1) * parts.chunk_rows < rows_per_group && rows_per_group <= parts.chunks * parts.chunk_rows);
        }
        assert_eq!(Parts::whole(Rows::plain(70_000)).count(), 1);
    }

    #[test]
    fn tiles_cover_every_row_once() {
        for (images, rows, most) in [(1, 1, 1), (3, 256, 8192), (24, 4096, 8192), (5, 4096, 1000), (7, 4096, 4096), (2, 100, 33)]
        {
            let mut seen = vec![0u32; (images * rows) as usize];
            for tile in tiles(images, rows, most) {
                assert!(tile.rows.count() <= most && tile.rows.count() > 0);
                for group in 0..tile.rows.groups {
                    for row in 0..tile.rows.rows_per_group {
                        seen[((tile.rows.first_group + group) * rows + tile.first_row + row) as usize] += 1;
                    }
                }
            }
            assert!(seen.iter().all(|&count| count == 1), "{images} images of {rows} rows in tiles of {most}");
        }
    }
}
