//! Steps whose rows do not know each other run in chains: a thread takes a block of rows through all steps of a chain before it takes the
//! next, so that what one step leaves is in the cache when the next one wants it.

use std::cell::Cell;
use std::ops::Range;

use srn_plan::{BufferId, Step};
use srn_shaders::{
    AdvanceParams, DensitySumParams, ImageLossParams, LayerNormParams, LinearParams, LstmParams, PointLayerParams, RowsParams,
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

thread_local! {
    static ALONE: Cell<bool> = const { Cell::new(false) };
}

/// Works on one of many blocks, while other threads work on others.
pub(crate) fn alone(work: impl FnOnce()) {
    ALONE.set(true);
    work();
    ALONE.set(false);
}

/// Whether this thread works on one of many blocks.
pub(crate) fn is_alone() -> bool {
    ALONE.get()
}

/// Parameters of kernels that make each row of their outputs from the same row of their inputs.
pub(crate) trait RowWise {
    /// Rows of the step.
    fn rows(&self) -> usize;

    /// Rows that belong together, where it matters.
    fn rows_per_group(&self) -> Option<usize> {
        None
    }

    /// Parameters for a part of the rows, of one group.
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

plain_rows!(AdvanceParams DensitySumParams LayerNormParams LstmParams);

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
    LinearParams: |p| p.weight_stride > 0;
    PointLayerParams: |p| p.weight_stride > 0;
    RowsParams: |_| true;
}

/// How a step falls apart into rows.
#[derive(Debug)]
pub(crate) struct Split {
    /// Number of rows.
    pub rows: usize,
    /// See [`RowWise::rows_per_group`].
    pub rows_per_group: Option<usize>,
    /// Values of a row in each binding; 0 where all rows read the same.
    pub widths: Vec<usize>,
}

/// A buffer of a chain.
#[derive(Debug)]
pub(crate) struct Place {
    pub buffer: BufferId,
    /// Values of a row; 0 if every block gets the whole buffer.
    pub width: usize,
    pub written: bool,
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
    /// Rows of each block, in order; none where the step is done as a whole.
    pub blocks: Vec<Range<usize>>,
    rows: usize,
    rows_per_group: Option<usize>,
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
            let values = chain.places.iter().map(|place| place.width).max().unwrap_or(0);
            chain.blocks = blocks(chain.rows, chain.rows_per_group, values, threads);
        }
        chains
    }

    fn begin(number: usize, step: &Step, split: Option<Split>) -> Chain {
        let mut chain =
            Chain { steps: number..number, links: vec![], places: vec![], blocks: vec![], rows: 0, rows_per_group: None };
        let whole = Split { rows: 0, rows_per_group: None, widths: vec![0; step.buffers.len()] };
        let split = split.unwrap_or(whole);
        chain.rows = split.rows;
        assert!(chain.add(step, &split), "the builder checks that outputs are no inputs");
        chain
    }

    /// Takes the step in, unless its blocks would meddle with those of the others.
    fn add(&mut self, step: &Step, split: &Split) -> bool {
        let groups_agree = match (self.rows_per_group, split.rows_per_group) {
            (Some(ours), Some(theirs)) => ours == theirs,
            _ => true,
        };
        let bindings = || step.buffers.iter().zip(&split.widths).zip(step.kernel.bindings);
        let fits = |((&buffer, &width), binding): ((&BufferId, &usize), &srn_shaders::Binding)| {
            let mut known = self.places.iter().filter(|place| place.buffer == buffer);
            known.all(|known| known.width == width || !known.written && !binding.written)
        };
        if split.rows != self.rows || !groups_agree || !bindings().all(fits) {
            return false;
        }
        let mut link = Link { inputs: vec![], outputs: vec![] };
        for ((&buffer, &width), binding) in bindings() {
            let is_it = |place: &Place| place.buffer == buffer && place.width == width;
            let place = self.places.iter().position(is_it).unwrap_or_else(|| {
                self.places.push(Place { buffer, width, written: false });
                self.places.len() - 1
            });
            self.places[place].written |= binding.written;
            if binding.written { &mut link.outputs } else { &mut link.inputs }.push(place);
        }
        self.links.push(link);
        self.steps.end += 1;
        self.rows_per_group = self.rows_per_group.or(split.rows_per_group);
        true
    }
}

/// Blocks of `rows` rows with up to `values` values, each of rows of one group; where there are few, as many for each thread.
fn blocks(rows: usize, rows_per_group: Option<usize>, values: usize, threads: usize) -> Vec<Range<usize>> {
    let group = rows_per_group.unwrap_or(rows).max(1);
    let (groups, whole) = (rows.div_ceil(group), group.div_ceil(block_rows(values)));
    let even = (whole..whole + threads).find(|count| (groups * count).is_multiple_of(threads)).unwrap_or(whole);
    let few = groups * whole < FEW_BLOCKS * threads;
    let count = if few { even.min(group / FEWEST_ROWS).max(whole) } else { whole };
    let of_group = |first: usize| {
        let step = group.div_ceil(count);
        (first..first + group).step_by(step).map(move |row| row..(first + group).min(row + step))
    };
    (0..rows).step_by(group).flat_map(of_group).collect()
}

#[cfg(test)]
mod tests {
    use srn_plan::ops::linear::{self, Layer, Sets};
    use srn_plan::{Builder, Rows};

    use super::*;

    /// Rows of the blocks on two threads.
    fn lengths(rows: usize, rows_per_group: Option<usize>, values: usize) -> Vec<usize> {
        let blocks = blocks(rows, rows_per_group, values, 2);
        assert!(blocks.windows(2).all(|pair| pair[0].end == pair[1].start), "in order, no row twice");
        assert_eq!(blocks.iter().map(ExactSizeIterator::len).sum::<usize>(), rows, "all rows");
        blocks.iter().map(ExactSizeIterator::len).collect()
    }

    #[test]
    fn layers_with_one_set_of_weights_belong_to_a_chain_of_groups() {
        let mut b = Builder::new(u64::MAX);
        let rows = Rows { groups: 3, rows_per_group: 256, first_group: 0 };
        let sizes = [("x", 768 * 4), ("y", 768 * 4), ("z", 768 * 4), ("weights", 60), ("shared", 20)];
        let [x, y, z, weights, shared] = sizes.map(|(name, len)| b.input(name, len).unwrap());
        let slots = b.input_u32("slots", 3).unwrap();
        let layer = |weights, sets| Layer { in_features: 4, out_features: 4, weights, sets };
        b.stage("layers");
        linear::forward(&mut b, rows, layer(weights, Sets::Slots { count: 3 }), x, slots, y, false).unwrap();
        linear::forward(&mut b, rows, layer(shared, Sets::Shared), y, slots, z, false).unwrap();
        let plan = b.finish().unwrap();
        let split = |step: &Step| {
            let p: LinearParams = step.params();
            Some(Split { rows: p.rows(), rows_per_group: p.rows_per_group(), widths: vec![4, 0, 0, 4] })
        };
        let chains = Chain::of(&plan.stages[0].steps, split);
        assert_eq!(chains.len(), 1);
        assert!(chains[0].blocks.iter().all(|block| block.start / 256 == (block.end - 1) / 256), "{:?}", chains[0].blocks);
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
