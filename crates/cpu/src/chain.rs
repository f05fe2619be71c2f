//! Steps whose rows do not know each other run in chains: a thread takes a block of rows through all steps of a chain before it takes the
//! next, so that what one step leaves is in the cache when the next one wants it.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::ops::Range;
use std::thread::LocalKey;

use srn_plan::{BufferId, Step};
use srn_shaders::{
    AdvanceParams, DensitySumParams, DepthParams, ImageLossParams, LayerNormParams, LinearParams, LstmParams, PointLayerParams,
    RaysParams, TileParams,
};

/// Rows of a block: what it reads and writes in a step should stay in a core's cache.
const BLOCK_ROWS: usize = 256;
/// The same for rows with more values than [`NARROW`], whose weights are large: packing them for a product must be worth it.
const WIDE_BLOCK_ROWS: usize = 512;
const NARROW: usize = 128;
/// With as many blocks for each thread it does not matter that one thread has one more.
const FEW_BLOCKS: usize = 8;
/// A block of fewer is not worth another thread.
const FEWEST_ROWS: usize = 32;

/// Rows of a block where a row has up to `values` values.
fn block_rows(values: usize) -> usize {
    if values > NARROW { WIDE_BLOCK_ROWS } else { BLOCK_ROWS }
}

/// Rows of a network with layers of `features` that are a block for each thread.
pub fn rows_for_all_threads(features: usize) -> usize {
    block_rows(features) * rayon::current_num_threads()
}

/// Rows for one sum over a part of the rows of a tile, at most, in a network with layers of `features`: those of a block, as the chain of such
/// sums has a block for each part.
pub fn part_rows(tile_rows: usize, features: usize) -> usize {
    (tile_rows / rayon::current_num_threads()).max(FEWEST_ROWS).min(block_rows(features))
}

thread_local! {
    /// How many blocks this thread has begun, and whether it works on the last of them.
    static BLOCK: Cell<(u64, bool)> = const { Cell::new((0, false)) };
}

/// Works on one of many blocks, while other threads work on others.
pub(crate) fn alone(work: impl FnOnce()) {
    let (number, _) = BLOCK.get();
    BLOCK.set((number + 1, true));
    work();
    BLOCK.set((number + 1, false));
}

/// Whether this thread works on one of many blocks.
pub(crate) fn is_alone() -> bool {
    let (_, is_alone) = BLOCK.get();
    is_alone
}

/// What a thread has made of weights, by their address and number. They stay as they are while it works on a block: a step that wrote them would have ended the chain.
pub(crate) struct Kept<V> {
    block: u64,
    /// What was used longest ago first: every tile of a block wants them in the same order.
    made: Vec<((usize, usize), V)>,
    spare: Vec<V>,
}

/// Those of one object's layers, and some; a block may meet the weights of many objects, and at the paper's width these are a quarter of a megabyte each.
const MOST_KEPT: usize = 32;

impl<V> Default for Kept<V> {
    fn default() -> Self {
        Kept { block: 0, made: vec![], spare: vec![] }
    }
}

/// Works with what was made of `weights` in this block, or is made now; `make` may use what is no longer wanted.
pub(crate) fn with_kept<V>(
    kept: &'static LocalKey<RefCell<Kept<V>>>,
    weights: &[f32],
    make: impl FnOnce(Option<V>) -> V,
    work: impl FnOnce(&V),
) {
    let name = (weights.as_ptr() as usize, weights.len());
    let made = kept.with_borrow_mut(|Kept { block, made, spare }| {
        let (number, is_alone) = BLOCK.get();
        if !is_alone || *block != number || made.len() == MOST_KEPT {
            *block = number;
            spare.extend(made.drain(..).map(|(_, value)| value));
        }
        match made.iter().position(|(known, _)| *known == name) {
            Some(place) => made.remove(place).1,
            None => make(spare.pop()),
        }
    });
    work(&made);
    kept.with_borrow_mut(|kept| kept.made.push((name, made)));
}

/// Parameters of kernels that make each row of their outputs from the same row of their inputs, or sums over parts of the rows.
pub(crate) trait RowWise {
    /// Rows of the step.
    fn rows(&self) -> usize;

    /// Rows that belong together, where it matters.
    fn rows_per_group(&self) -> Option<usize> {
        None
    }

    /// Rows of each part of a group, the last one aside, where sums over them are made.
    fn chunk_rows(&self) -> Option<usize> {
        None
    }

    /// Parameters for a block of the rows, of one group; where sums are made, for one part.
    fn block(self, rows: Range<usize>) -> Self;
}

macro_rules! plain_rows {
    ($($params:ident)*) => {
        $(impl RowWise for $params {
            fn rows(&self) -> usize {
                self.rows as usize
            }

            fn block(self, rows: Range<usize>) -> Self {
                Self { rows: rows.len() as u32, ..self }
            }
        })*
    };
}

plain_rows!(AdvanceParams DensitySumParams LstmParams);

macro_rules! rows_of_groups {
    ($($params:ident: $group_matters:expr;)*) => {
        $(impl RowWise for $params {
            fn rows(&self) -> usize {
                (self.groups * self.rows_per_group) as usize
            }

            fn rows_per_group(&self) -> Option<usize> {
                let group_matters: fn(&Self) -> bool = $group_matters;
                group_matters(self).then_some(self.rows_per_group as usize)
            }

            fn block(self, rows: Range<usize>) -> Self {
                let first_group = self.first_group + rows.start as u32 / self.rows_per_group;
                Self { groups: 1, rows_per_group: rows.len() as u32, first_group, ..self }
            }
        })*
    };
}

// Which group a row belongs to is all the same to a layer with one set of weights: its step has them all as one.
rows_of_groups! {
    ImageLossParams: |_| true;
    PointLayerParams: |p| p.weight_stride > 0;
    RaysParams: |_| true;
    DepthParams: |_| true;
}

impl RowWise for TileParams {
    fn rows(&self) -> usize {
        (self.groups * self.rows_per_group) as usize
    }

    fn block(self, rows: Range<usize>) -> Self {
        let rows = rows.len() as u32;
        Self { groups: 1, rows_per_group: rows, first_group: 0, first_row: 0, rows_per_image: rows, ..self }
    }
}

impl RowWise for LinearParams {
    fn rows(&self) -> usize {
        (self.groups * self.rows_per_group) as usize
    }

    fn rows_per_group(&self) -> Option<usize> {
        (self.weight_stride > 0 || self.chunk_rows > 0).then_some(self.rows_per_group as usize)
    }

    fn chunk_rows(&self) -> Option<usize> {
        (self.chunk_rows > 0).then_some(self.chunk_rows as usize)
    }

    fn block(self, rows: Range<usize>) -> Self {
        let first_group = self.first_group + rows.start as u32 / self.rows_per_group;
        let rows = rows.len() as u32;
        Self { groups: 1, rows_per_group: rows, first_group, chunk_rows: rows, chunks: self.chunks.min(1), ..self }
    }
}

impl RowWise for LayerNormParams {
    fn rows(&self) -> usize {
        self.rows as usize
    }

    fn rows_per_group(&self) -> Option<usize> {
        (self.chunks > 0).then_some(self.rows_per_group as usize)
    }

    fn chunk_rows(&self) -> Option<usize> {
        (self.chunks > 0).then_some(self.chunk_rows as usize)
    }

    fn block(self, rows: Range<usize>) -> Self {
        let rows = rows.len() as u32;
        Self { rows, rows_per_group: rows, chunk_rows: rows, chunks: self.chunks.min(1), ..self }
    }
}

/// What a block of rows has of a buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Share {
    /// All of it, as every block has.
    Whole,
    /// So many values for each of its rows, of which the step's first is so far into the buffer.
    Row { values: usize, first: usize },
    /// So many values.
    Block(usize),
}

impl Share {
    /// Whether these are other rows of a buffer than those, where there are so many of either.
    fn is_apart_from(self, other: Share, rows: usize) -> bool {
        match (self, other) {
            (Share::Row { values, first }, Share::Row { values: others, first: others_first }) => {
                values == others && first.abs_diff(others_first) >= rows
            }
            _ => false,
        }
    }

    /// The values of the buffer that `rows` rows of a step have; none where that does not depend on rows.
    pub fn values(self, rows: usize) -> Range<usize> {
        if let Share::Row { values, first } = self { values * first..values * (first + rows) } else { 0..0 }
    }
}

/// How a step falls apart into rows.
#[derive(Debug)]
pub(crate) struct Split {
    /// Number of rows.
    pub rows: usize,
    /// See [`RowWise::rows_per_group`].
    pub rows_per_group: Option<usize>,
    /// See [`RowWise::chunk_rows`].
    pub chunk_rows: Option<usize>,
    /// Of each binding.
    pub shares: Vec<Share>,
}

impl Split {
    /// Of a step with these parameters.
    pub fn of(params: &impl RowWise, shares: Vec<Share>) -> Self {
        Split { rows: params.rows(), rows_per_group: params.rows_per_group(), chunk_rows: params.chunk_rows(), shares }
    }
}

/// What a chain has of a buffer.
#[derive(Debug)]
pub(crate) struct Place {
    pub share: Share,
    written: bool,
}

/// A buffer of a chain with the numbers of its places there.
#[derive(Debug)]
pub(crate) struct Buffer {
    pub id: BufferId,
    /// Whether a step writes to any of them.
    pub is_written: bool,
    /// Those that begin earlier in the buffer first.
    pub places: Vec<usize>,
}

/// A step of a chain; numbers are those of [`Chain::places`].
#[derive(Debug)]
pub(crate) struct Link {
    pub inputs: Vec<usize>,
    pub outputs: Vec<usize>,
}

/// Steps that run block by block; one step that does not fall apart is a chain with one block.
#[derive(Debug)]
pub(crate) struct Chain {
    /// Numbers of the steps in their stage.
    pub steps: Range<usize>,
    pub links: Vec<Link>,
    pub places: Vec<Place>,
    pub buffers: Vec<Buffer>,
    /// Numbers of the buffers.
    numbers: HashMap<BufferId, usize>,
    /// Rows of each block, in order; none where the step is done as a whole.
    pub blocks: Vec<Range<usize>>,
    pub rows: usize,
    rows_per_group: Option<usize>,
    chunk_rows: Option<usize>,
}

impl Chain {
    /// Chains of all steps, in their order.
    pub fn of(steps: &[Step], split: impl Fn(&Step) -> Option<Split>) -> Vec<Chain> {
        let mut chains: Vec<Chain> = Vec::new();
        for (number, step) in steps.iter().enumerate() {
            let split = split(step);
            let longer = split.as_ref().is_some_and(|split| chains.last_mut().is_some_and(|chain| chain.add(step, split)));
            if !longer {
                chains.push(Chain::begin(number, step, split));
            }
        }
        let threads = rayon::current_num_threads();
        for chain in &mut chains {
            let values = |place: &Place| if let Share::Row { values, .. } = place.share { values } else { 0 };
            let widest = chain.places.iter().map(values).max().unwrap_or(0);
            let group = chain.rows_per_group.unwrap_or(chain.rows).max(1);
            chain.blocks = match chain.chunk_rows {
                Some(chunk) => parts(chain.rows, group, chunk),
                None => blocks(chain.rows, group, widest, threads),
            };
            for buffer in &mut chain.buffers {
                buffer.places.sort_by_key(|&place| chain.places[place].share.values(0).start);
            }
        }
        chains
    }

    fn begin(number: usize, step: &Step, split: Option<Split>) -> Chain {
        let whole = Split { rows: 0, rows_per_group: None, chunk_rows: None, shares: vec![Share::Whole; step.buffers.len()] };
        let split = split.unwrap_or(whole);
        let mut chain = Chain {
            steps: number..number,
            links: vec![],
            places: vec![],
            buffers: vec![],
            numbers: HashMap::new(),
            blocks: vec![],
            rows: split.rows,
            rows_per_group: None,
            chunk_rows: None,
        };
        assert!(chain.add(step, &split), "the builder checks that outputs are no inputs");
        chain
    }

    /// Takes the step in, unless its blocks would meddle with those of the others.
    fn add(&mut self, step: &Step, split: &Split) -> bool {
        let agree = |ours: Option<usize>, theirs: Option<usize>| ours.zip(theirs).is_none_or(|(ours, theirs)| ours == theirs);
        let parts_agree = agree(self.rows_per_group, split.rows_per_group) && agree(self.chunk_rows, split.chunk_rows);
        let bindings = || step.buffers.iter().zip(&split.shares).zip(step.kernel.bindings);
        let fits = |((&buffer, &share), binding): ((&BufferId, &Share), &srn_shaders::Binding)| {
            let places = self.numbers.get(&buffer).map_or(&[][..], |&number| &self.buffers[number].places);
            let mut known = places.iter().map(|&place| &self.places[place]);
            known.all(|known| {
                let is_only_read = !known.written && !binding.written;
                is_only_read || known.share == share || known.share.is_apart_from(share, self.rows)
            })
        };
        if split.rows != self.rows || !parts_agree || !bindings().all(fits) {
            return false;
        }
        let mut link = Link { inputs: vec![], outputs: vec![] };
        for ((&buffer, &share), binding) in bindings() {
            let number = *self.numbers.entry(buffer).or_insert_with(|| {
                self.buffers.push(Buffer { id: buffer, is_written: false, places: vec![] });
                self.buffers.len() - 1
            });
            let known = &mut self.buffers[number];
            let place = known.places.iter().copied().find(|&place| self.places[place].share == share).unwrap_or_else(|| {
                self.places.push(Place { share, written: false });
                known.places.push(self.places.len() - 1);
                self.places.len() - 1
            });
            self.places[place].written |= binding.written;
            known.is_written |= binding.written;
            if binding.written { &mut link.outputs } else { &mut link.inputs }.push(place);
        }
        self.links.push(link);
        self.steps.end += 1;
        self.rows_per_group = self.rows_per_group.or(split.rows_per_group);
        self.chunk_rows = self.chunk_rows.or(split.chunk_rows);
        true
    }
}

/// The parts of groups of `group` rows.
fn parts(rows: usize, group: usize, chunk_rows: usize) -> Vec<Range<usize>> {
    let of_group =
        |first: usize| (first..first + group).step_by(chunk_rows).map(move |row| row..(first + group).min(row + chunk_rows));
    (0..rows).step_by(group).flat_map(of_group).collect()
}

/// Blocks of `rows` rows with up to `values` values, each of rows of one group; where there are few, as many for each thread.
fn blocks(rows: usize, group: usize, values: usize, threads: usize) -> Vec<Range<usize>> {
    let (groups, whole) = (rows.div_ceil(group), group.div_ceil(block_rows(values)));
    let even = (whole..whole + threads).find(|count| (groups * count).is_multiple_of(threads)).unwrap_or(whole);
    let few = groups * whole < FEW_BLOCKS * threads;
    let count = if few { even.min(group / FEWEST_ROWS).max(whole) } else { whole };
    parts(rows, group, group.div_ceil(count))
}

#[cfg(test)]
mod tests {
    use srn_plan::ops::linear::{self, Layer, Sets};
    use srn_plan::ops::tile;
    use srn_plan::{Builder, Parts, Rows, Tile};

    use super::*;
    use crate::executor::split;

    /// Rows of the blocks on two threads.
    fn lengths(rows: usize, rows_per_group: Option<usize>, values: usize) -> Vec<usize> {
        let blocks = blocks(rows, rows_per_group.unwrap_or(rows).max(1), values, 2);
        assert!(blocks.windows(2).all(|pair| pair[0].end == pair[1].start), "in order, no row twice");
        assert_eq!(blocks.iter().map(ExactSizeIterator::len).sum::<usize>(), rows, "all rows");
        blocks.iter().map(ExactSizeIterator::len).collect()
    }

    #[test]
    fn layers_and_sums_for_their_weights_belong_to_a_chain_of_groups() {
        let mut b = Builder::new(u64::MAX);
        let rows = Rows { groups: 3, rows_per_group: 256, first_group: 0 };
        let sizes = [("x", 768 * 4), ("y", 768 * 4), ("z", 768 * 4), ("weights", 60), ("shared", 20), ("sums", 9 * 20)];
        let [x, y, z, weights, shared, sums] = sizes.map(|(name, len)| b.input(name, len).unwrap());
        let slots = b.input_u32("slots", 3).unwrap();
        let layer = |weights, sets| Layer { in_features: 4, out_features: 4, weights, sets };
        let of_groups = layer(weights, Sets::Slots { count: 3 });
        let of_all = layer(shared, Sets::Shared);
        let parts = Parts::of(rows, 100);
        b.stage("layers");
        linear::forward(&mut b, rows, of_groups, x, slots, y, false).unwrap();
        linear::forward(&mut b, rows, of_all, y, slots, z, false).unwrap();
        b.stage("layers and sums");
        linear::forward(&mut b, rows, of_groups, x, slots, y, false).unwrap();
        linear::backward_weight(&mut b, parts, of_all, x, y, sums, false).unwrap();
        linear::backward_weight(&mut b, parts, of_groups, x, y, sums, true).unwrap();
        let plan = b.finish().unwrap();
        let chains = plan.stages.iter().map(|stage| Chain::of(&stage.steps, split)).collect::<Vec<_>>();
        assert_eq!(chains.iter().map(Vec::len).collect::<Vec<_>>(), [1, 1]);
        for block in chains.iter().flat_map(|chains| &chains[0].blocks) {
            assert_eq!(block.start / 256, (block.end - 1) / 256, "{block:?}");
        }
        let lengths = chains[1][0].blocks.iter().map(ExactSizeIterator::len).collect::<Vec<_>>();
        assert_eq!(lengths, [86, 86, 84, 86, 86, 84, 86, 86, 84], "the parts");
    }

    #[test]
    fn what_is_made_of_weights_is_kept_as_long_as_they_stay() {
        thread_local! {
            static NUMBERS: RefCell<Kept<usize>> = RefCell::default();
        }
        let weights = [0.0; 2 * MOST_KEPT];
        let made = Cell::new(0);
        let used = |weights: &[f32]| {
            let mut used = 0;
            let make = |_| made.replace(made.get() + 1);
            with_kept(&NUMBERS, weights, make, |&number| used = number);
            used
        };
        let both = || [used(&weights[..2]), used(&weights[2..4]), used(&weights[..2]), used(&weights[..3])];
        alone(|| assert_eq!(both(), [0, 1, 0, 2]));
        alone(|| assert_eq!(both(), [3, 4, 3, 5], "other weights may be there now"));
        assert_eq!(both(), [6, 7, 8, 9], "outside of a block nobody knows how long they stay");
        alone(|| {
            (0..2 * MOST_KEPT).for_each(|k| assert_eq!(used(&weights[k..]), 10 + k));
            NUMBERS.with_borrow(|Kept { made, spare, .. }| assert!(made.len() + spare.len() <= MOST_KEPT + 1));
        });
    }

    /// Tiles use the same buffers one after the other, and other rows of what is whole.
    #[test]
    fn tiles_belong_to_a_chain_where_they_are_apart() {
        let lengths_of = |first_rows: [u32; 3]| {
            let mut b = Builder::new(u64::MAX);
            let [whole, weights, made] =
                [("whole", 1536 * 4), ("weights", 20), ("made", 1536 * 4)].map(|(name, len)| b.input(name, len).unwrap());
            let slots = b.input_u32("slots", 1).unwrap();
            let [x, y] = ["x", "y"].map(|name| b.scratch(name, 512 * 4).unwrap());
            b.stage("tiles");
            for first_row in first_rows {
                let rows = Rows { groups: 1, rows_per_group: 512, first_group: 0 };
                let cut = Tile { rows, first_row, rows_per_image: 1536 };
                let layer = Layer { in_features: 4, out_features: 4, weights, sets: Sets::Shared };
                tile::gather(&mut b, cut, 4, whole, x).unwrap();
                linear::forward(&mut b, rows, layer, x, slots, y, false).unwrap();
                tile::scatter(&mut b, cut, 4, y, made).unwrap();
            }
            let plan = b.finish().unwrap();
            Chain::of(&plan.stages[0].steps, split).iter().map(|chain| chain.steps.len()).collect::<Vec<_>>()
        };
        assert_eq!(lengths_of([0, 512, 1024]), [9]);
        assert_eq!(lengths_of([1024, 0, 512]), [9]);
        // The third tile's rows are in part the first's, for another thread.
        assert_eq!(lengths_of([0, 512, 256]), [8, 1]);
        assert_eq!(lengths_of([0, 512, 0]), [9]);
    }

    #[test]
    fn few_rows_are_shared_evenly() {
        assert_eq!(lengths(512, None, 64), [256, 256]);
        assert_eq!(lengths(256, Some(256), 64), [128, 128], "one image of 16 x 16 pixels");
        assert_eq!(lengths(768, Some(256), 64), [128; 6], "three of them");
        assert_eq!(lengths(600, None, 64), [150; 4]);
        assert_eq!(lengths(601, None, 64), [151, 151, 151, 148]);
        assert_eq!(lengths(1024, None, 256), [512, 512]);
        assert_eq!(lengths(40, None, 64), [40], "not worth two threads");
        assert_eq!(lengths(33 * 256, None, 64), [256; 33], "many blocks stay large");
        assert_eq!(lengths(0, None, 64), [0usize; 0]);
    }
}
