use std::ops::Range;

use rayon::prelude::*;
use srn_plan::{BufferId, Element, Executor, ExecutorError, Plan, StageId, Step};
use srn_shaders::{
    AdvanceParams, DensitySumParams, DepthParams, ImageLossParams, LayerNormParams, LinearParams, LstmParams, PointLayerParams,
    RaysParams, TileParams,
};

use crate::aligned::Aligned;
use crate::chain::{Chain, Link, RowWise, Share, Split};
use crate::ops::tile;
use crate::{Real, chain, hidden_layer, ops};

/// The values of one buffer.
#[derive(Debug)]
enum Storage<T> {
    F(Aligned<T>),
    U(Vec<u32>),
}

impl<T> Default for Storage<T> {
    fn default() -> Self {
        Storage::U(Vec::new())
    }
}

impl<T: Real> Storage<T> {
    fn f(&self) -> &[T] {
        match self {
            Storage::F(values) => values.values(),
            Storage::U(_) => unreachable!("the builder checks element types"),
        }
    }

    fn u(&self) -> &[u32] {
        match self {
            Storage::U(values) => values,
            Storage::F(_) => unreachable!("the builder checks element types"),
        }
    }

    fn f_mut(&mut self) -> &mut [T] {
        match self {
            Storage::F(values) => values.values_mut(),
            Storage::U(_) => unreachable!("the builder checks element types"),
        }
    }

    fn u_mut(&mut self) -> &mut [u32] {
        match self {
            Storage::U(values) => values,
            Storage::F(_) => unreachable!("the builder checks element types"),
        }
    }

    /// All values, to read.
    fn whole(&self) -> Part<'_, T> {
        match self {
            Storage::F(values) => Part::F(values.values()),
            Storage::U(values) => Part::U(values),
        }
    }

    /// All values, to write.
    fn whole_mut(&mut self) -> Part<'_, T> {
        match self {
            Storage::F(values) => Part::FMut(values.values_mut()),
            Storage::U(values) => Part::UMut(values),
        }
    }
}

/// What a block of rows has of a buffer.
#[derive(Debug)]
enum Part<'a, T> {
    F(&'a [T]),
    FMut(&'a mut [T]),
    U(&'a [u32]),
    UMut(&'a mut [u32]),
}

impl<T> Default for Part<'_, T> {
    fn default() -> Self {
        Part::U(&[])
    }
}

impl<'a, T> Part<'a, T> {
    fn f(&self) -> &[T] {
        match self {
            Part::F(values) => values,
            Part::FMut(values) => values,
            Part::U(_) | Part::UMut(_) => unreachable!("the builder checks element types"),
        }
    }

    fn u(&self) -> &[u32] {
        match self {
            Part::U(values) => values,
            Part::UMut(values) => values,
            Part::F(_) | Part::FMut(_) => unreachable!("the builder checks element types"),
        }
    }

    fn f_mut(&mut self) -> &mut [T] {
        match self {
            Part::FMut(values) => values,
            _ => unreachable!("what is written was taken out to be written"),
        }
    }

    fn u_mut(&mut self) -> &mut [u32] {
        match self {
            Part::UMut(values) => values,
            _ => unreachable!("what is written was taken out to be written"),
        }
    }

    /// Takes the first values off.
    fn split_off(&mut self, count: usize) -> Part<'a, T> {
        let (first, rest) = match std::mem::take(self) {
            Part::F(values) => {
                let (first, rest) = values.split_at(count);
                (Part::F(first), Part::F(rest))
            }
            Part::FMut(values) => {
                let (first, rest) = values.split_at_mut(count);
                (Part::FMut(first), Part::FMut(rest))
            }
            Part::U(values) => {
                let (first, rest) = values.split_at(count);
                (Part::U(first), Part::U(rest))
            }
            Part::UMut(values) => {
                let (first, rest) = values.split_at_mut(count);
                (Part::UMut(first), Part::UMut(rest))
            }
        };
        *self = rest;
        first
    }

    /// The same values once more, of what is only read.
    fn again(&self) -> Part<'a, T> {
        match self {
            Part::F(values) => Part::F(values),
            Part::U(values) => Part::U(values),
            Part::FMut(_) | Part::UMut(_) => unreachable!("only one step that is done as a whole writes whole buffers"),
        }
    }
}

/// What the CPU computes in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// The fallback for a machine without a GPU.
    F32,
    /// The oracle of the tests.
    F64,
}

/// An executor that runs a plan on the CPU, with all threads of the current rayon pool. Its buffers are zeros; fails where they exceed `budget`
/// bytes or a kernel has no reference.
// No type that is generic goes out: each crate that uses one compiles all references anew, half a minute of each build.
pub fn executor(precision: Precision, plan: Plan, budget: u64) -> Result<Box<dyn Executor>, ExecutorError> {
    Ok(match precision {
        Precision::F32 => Box::new(CpuExecutor::<f32>::new(plan, budget)?),
        Precision::F64 => Box::new(CpuExecutor::<f64>::new(plan, budget)?),
    })
}

/// Runs a plan in `T`.
#[derive(Debug)]
struct CpuExecutor<T> {
    plan: Plan,
    /// Of each stage.
    chains: Vec<Vec<Chain>>,
    buffers: Vec<Storage<T>>,
}

impl<T: Real> CpuExecutor<T> {
    fn new(plan: Plan, budget: u64) -> Result<Self, ExecutorError> {
        let needed = plan.bytes() / 4 * size_of::<T>() as u64;
        if needed > budget {
            return Err(ExecutorError::Memory { needed, budget });
        }
        for step in plan.stages.iter().flat_map(|stage| &stage.steps) {
            if !ops::implements(step.kernel.name) {
                return Err(ExecutorError::MissingKernel { executor: "cpu", kernel: step.kernel.name });
            }
        }
        let buffers = plan
            .buffers
            .iter()
            .map(|buffer| match buffer.element {
                Element::F32 => Storage::F(Aligned::zeros(buffer.len)),
                Element::U32 => Storage::U(vec![0; buffer.len]),
            })
            .collect();
        let chains = plan.stages.iter().map(|stage| Chain::of(&stage.steps, split)).collect();
        Ok(CpuExecutor { plan, chains, buffers })
    }

    fn check(&self, id: BufferId, element: Element, got: usize) -> Result<(), ExecutorError> {
        let buffer = self.plan.buffer(id);
        if buffer.element != element {
            return Err(ExecutorError::ElementType { buffer: buffer.name.clone() });
        }
        if buffer.len != got {
            return Err(ExecutorError::Length { buffer: buffer.name.clone(), expected: buffer.len, got });
        }
        Ok(())
    }

    /// Runs the steps of a chain. What they write is taken out for that time, so that blocks of it can be borrowed beside what they read.
    fn execute(buffers: &mut [Storage<T>], steps: &[Step], chain: &Chain) {
        let take = |buffer: &chain::Buffer| std::mem::take(&mut buffers[buffer.id.index()]);
        let mut taken: Vec<Storage<T>> = chain.buffers.iter().filter(|buffer| buffer.is_written).map(take).collect();
        let of_block = || std::iter::repeat_with(Part::default).take(chain.places.len()).collect();
        let mut blocks: Vec<Vec<Part<T>>> = std::iter::repeat_with(of_block).take(chain.blocks.len().max(1)).collect();
        let mut written = taken.iter_mut();
        for buffer in &chain.buffers {
            // Places of what is written are apart from each other, those of what is only read may not be.
            let mut rest = buffer.is_written.then(|| written.next().expect("one is taken for each").whole_mut());
            let mut begins_at = 0;
            for &place in &buffer.places {
                let share = chain.places[place].share;
                match &mut rest {
                    Some(rest) => {
                        let values = share.values(chain.rows);
                        rest.split_off(values.start - begins_at);
                        begins_at = values.end;
                        deal(rest, place, share, chain, &mut blocks);
                    }
                    None => {
                        let mut whole = buffers[buffer.id.index()].whole();
                        whole.split_off(share.values(chain.rows).start);
                        deal(&mut whole, place, share, chain, &mut blocks);
                    }
                }
            }
        }
        let run = |(number, mut parts): (usize, Vec<Part<T>>)| {
            let rows = chain.blocks.get(number);
            let mut number = 0;
            while number < steps.len() {
                let (steps, links) = (&steps[number..], &chain.links[number..]);
                number += match rows {
                    Some(rows) if both_of_a_layer(steps, rows, &mut parts, links) => 2,
                    _ => {
                        dispatch(&steps[0], rows, &mut parts, &links[0]);
                        1
                    }
                };
            }
        };
        // In a single block, a product may be split by the matrix library.
        if blocks.len() == 1 {
            run((0, blocks.swap_remove(0)));
        } else {
            blocks.into_par_iter().enumerate().for_each(|block| chain::alone(|| run(block)));
        }
        for (buffer, storage) in chain.buffers.iter().filter(|buffer| buffer.is_written).zip(taken) {
            buffers[buffer.id.index()] = storage;
        }
    }
}

impl<T: Real> Executor for CpuExecutor<T> {
    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn write(&mut self, buffer: BufferId, values: &[f32]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::F32, values.len())?;
        for (to, &from) in self.buffers[buffer.index()].f_mut().iter_mut().zip(values) {
            *to = T::of_f32(from);
        }
        Ok(())
    }

    fn write_f64(&mut self, buffer: BufferId, values: &[f64]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::F32, values.len())?;
        for (to, &from) in self.buffers[buffer.index()].f_mut().iter_mut().zip(values) {
            *to = T::of(from);
        }
        Ok(())
    }

    fn write_u32(&mut self, buffer: BufferId, values: &[u32]) -> Result<(), ExecutorError> {
        self.check(buffer, Element::U32, values.len())?;
        self.buffers[buffer.index()].u_mut().copy_from_slice(values);
        Ok(())
    }

    fn run(&mut self, stage: StageId) -> Result<(), ExecutorError> {
        let (chains, steps, buffers) = (&self.chains[stage.index()], &self.plan.stages[stage.index()].steps, &mut self.buffers);
        let mut all = || chains.iter().for_each(|chain| Self::execute(buffers, &steps[chain.steps.clone()], chain));
        // In a thread of the pool: one outside would fall asleep and be woken for each chain, and so would the pool. For a few numbers that is not worth it.
        if chains.iter().any(|chain| chain.blocks.len() > 1) {
            rayon::scope(|_| all());
        } else {
            all();
        }
        Ok(())
    }

    fn run_step(&mut self, stage: StageId, step: usize) -> Result<(), ExecutorError> {
        let (chains, steps) = (&self.chains[stage.index()], &self.plan.stages[stage.index()].steps[step..=step]);
        let mut alone = Chain::of(steps, split).swap_remove(0);
        // In the blocks of its chain: the matrix library adds in another order where there are other numbers of rows.
        let chain = chains.iter().find(|chain| chain.steps.contains(&step)).expect("every step is in one");
        alone.blocks.clone_from(&chain.blocks);
        Self::execute(&mut self.buffers, steps, &alone);
        Ok(())
    }

    fn read(&mut self, buffer: BufferId) -> Result<Vec<f32>, ExecutorError> {
        self.check(buffer, Element::F32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].f().iter().map(|value| value.as_f32()).collect())
    }

    fn read_f64(&mut self, buffer: BufferId) -> Result<Vec<f64>, ExecutorError> {
        self.check(buffer, Element::F32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].f().iter().map(|value| value.wide()).collect())
    }

    fn read_u32(&mut self, buffer: BufferId) -> Result<Vec<u32>, ExecutorError> {
        self.check(buffer, Element::U32, self.plan.buffer(buffer).len)?;
        Ok(self.buffers[buffer.index()].u().to_vec())
    }

    fn describe(&self) -> String {
        format!("cpu {}, {} threads", T::NAME, rayon::current_num_threads())
    }
}

/// Gives each block of a chain its share of a place.
fn deal<'a, T>(rest: &mut Part<'a, T>, place: usize, share: Share, chain: &Chain, blocks: &mut [Vec<Part<'a, T>>]) {
    match share {
        Share::Whole => {
            let (last, others) = blocks.split_last_mut().expect("there is at least one");
            others.iter_mut().for_each(|block| block[place] = rest.again());
            last[place] = std::mem::take(rest);
        }
        Share::Row { values, .. } => {
            let rows = chain.blocks.iter().map(ExactSizeIterator::len);
            blocks.iter_mut().zip(rows).for_each(|(block, rows)| block[place] = rest.split_off(values * rows));
        }
        Share::Block(values) => blocks.iter_mut().for_each(|block| block[place] = rest.split_off(values)),
    }
}

/// Runs the first two steps on a block of rows, if they are a linear layer and its norm, forward or back, that go together.
fn both_of_a_layer<T: Real>(steps: &[Step], rows: &Range<usize>, parts: &mut [Part<T>], links: &[Link]) -> bool {
    let ([first, second, ..], [one, two, ..]) = (steps, links) else { return false };
    // What is read where it is also written.
    let unless_written = |place: usize, written: usize| (place != written).then_some(place);
    match (first.kernel.name, second.kernel.name) {
        ("linear/forward", "layer_norm_relu/forward") => {
            let (linear, norm): (LinearParams, LayerNormParams) = (first.params(), second.params());
            let (&[x, weights, slots], &[z]) = (&one.inputs[..], &one.outputs[..]) else { return false };
            let (&[normed, affine], &[y, stats]) = (&two.inputs[..], &two.outputs[..]) else { return false };
            if normed != z {
                return false;
            }
            let [mut to_z, mut to_y, mut to_stats] = [z, y, stats].map(|place| std::mem::take(&mut parts[place]));
            hidden_layer::forward(
                linear.block(rows.clone()),
                norm,
                unless_written(x, y).map(|x| parts[x].f()),
                parts[weights].f(),
                parts[slots].u(),
                parts[affine].f(),
                to_z.f_mut(),
                to_y.f_mut(),
                to_stats.f_mut(),
            );
            [(z, to_z), (y, to_y), (stats, to_stats)].into_iter().for_each(|(place, part)| parts[place] = part);
        }
        ("linear/backward_input", "layer_norm_relu/backward_input") => {
            let (linear, norm): (LinearParams, LayerNormParams) = (first.params(), second.params());
            let (&[after, weights, slots], &[d_y]) = (&one.inputs[..], &one.outputs[..]) else { return false };
            let (&[z, stats, affine, normed], &[d_z]) = (&two.inputs[..], &two.outputs[..]) else { return false };
            if normed != d_y {
                return false;
            }
            let [mut to_d_y, mut to_d_z] = [d_y, d_z].map(|place| std::mem::take(&mut parts[place]));
            hidden_layer::backward(
                linear.block(rows.clone()),
                norm,
                unless_written(after, d_z).map(|after| parts[after].f()),
                parts[weights].f(),
                parts[slots].u(),
                parts[z].f(),
                parts[stats].f(),
                parts[affine].f(),
                to_d_y.f_mut(),
                to_d_z.f_mut(),
            );
            [(d_y, to_d_y), (d_z, to_d_z)].into_iter().for_each(|(place, part)| parts[place] = part);
        }
        _ => return false,
    }
    true
}

/// Outputs of a kernel, at most.
const OUTPUTS: usize = 3;

/// Lists the references once: `op/direction` with the element types of inputs and outputs, in the order of the bindings. Those of `rows`
/// make each row from the same row of what they read, or sums over each part of the rows; with the values of a row in each binding, 0 where
/// all rows read the same, and those of a sum; of rows
/// of the whole batch, with the number of the first in each binding, unless they are not side by side there.
macro_rules! references {
    (
        rows { $($row:literal => $row_op:ident::$row_direction:ident($($row_input:ident)*) -> ($($row_output:ident)*),
            |$p:ident: $params:ty| $widths:expr $(, from [$($first:expr),*] unless $scattered:expr)? $(, sum of $sum:expr)?;)* }
        whole { $($name:literal => $op:ident::$direction:ident($($input:ident)*) -> ($($output:ident)*);)* }
    ) => {
        /// Runs a step on a block of rows, or as a whole.
        fn dispatch<T: Real>(step: &Step, rows: Option<&Range<usize>>, parts: &mut [Part<T>], link: &Link) {
            let mut outputs: [Part<T>; OUTPUTS] = Default::default();
            for (output, &place) in outputs.iter_mut().zip(&link.outputs) {
                *output = std::mem::take(&mut parts[place]);
            }
            let mut inputs = link.inputs.iter().map(|&place| &parts[place]);
            let mut written = outputs.iter_mut();
            match step.kernel.name {
                $($row => ops::$row_op::$row_direction(
                    rows.map_or(step.params(), |rows| step.params::<$params>().block(rows.clone())),
                    $(inputs.next().expect("the builder checks the number of buffers").$row_input(),)*
                    $(written.next().expect("the builder checks the number of buffers").$row_output(),)*
                ),)*
                $($name => ops::$op::$direction(
                    step.params(),
                    $(inputs.next().expect("the builder checks the number of buffers").$input(),)*
                    $(written.next().expect("the builder checks the number of buffers").$output(),)*
                ),)*
                other => unreachable!("`new` checks that {other} has a reference"),
            }
            for (output, &place) in outputs.into_iter().zip(&link.outputs) {
                parts[place] = output;
            }
        }

        /// How a step falls apart, if it does.
        pub(crate) fn split(step: &Step) -> Option<Split> {
            match step.kernel.name {
                $($row => {
                    let $p: $params = step.params();
                    $(if $scattered {
                        return None;
                    })?
                    let widths: &[u32] = &$widths;
                    let firsts = [$($($first),*)?].into_iter().chain(std::iter::repeat(0usize));
                    let share = |(&width, first): (&u32, usize)| match width as usize {
                        0 => Share::Whole,
                        values => Share::Row { values, first },
                    };
                    let shares = widths.iter().zip(firsts).map(share)$(.chain([Share::Block($sum as usize)]))?.collect();
                    Some(Split::of(&$p, shares))
                })*
                _ => None,
            }
        }

        /// The kernels that have a reference here.
        pub(crate) const REFERENCES: &[&str] = &[$($row,)* $($name),*];
    };
}

references! {
    rows {
        "rays/forward" => rays::forward(f f f f) -> (f_mut f_mut), |_p: RaysParams| [0, 0, 2, 1, 3, 3];
        "tile/gather" => tile::gather(f) -> (f_mut), |p: TileParams| [p.columns, p.columns],
            from [tile::first(p), 0] unless tile::has_gaps(p);
        "tile/scatter" => tile::scatter(f) -> (f_mut), |p: TileParams| [p.columns, p.columns],
            from [0, tile::first(p)] unless tile::has_gaps(p);
        "linear/forward" => linear::forward(f f u) -> (f_mut), |p: LinearParams| [p.in_features, 0, 0, p.out_features];
        "linear/backward_input" => linear::backward_input(f f u) -> (f_mut), |p: LinearParams| [p.out_features, 0, 0, p.in_features],
            from [0, 0, 0, 0] unless p.chunks > 1;
        "linear/backward_weight" => linear::backward_weight(f f) -> (f_mut), |p: LinearParams| [p.in_features, p.out_features],
            sum of p.out_features * (p.in_features + 1);
        "layer_norm_relu/forward" => layer_norm_relu::forward(f f) -> (f_mut f_mut),
            |p: LayerNormParams| [p.features, 0, p.features, 2];
        "layer_norm_relu/backward_input" => layer_norm_relu::backward_input(f f f f) -> (f_mut),
            |p: LayerNormParams| [p.features, 2, 0, p.features, p.features];
        "layer_norm_relu/backward_affine" => layer_norm_relu::backward_affine(f f f f) -> (f_mut),
            |p: LayerNormParams| [p.features, 2, 0, p.features], sum of 2 * p.features;
        "point_layer/forward" => point_layer::forward(f f u f) -> (f_mut), |p: PointLayerParams| [3, 0, 0, 0, p.features];
        "point_layer/backward_input" => point_layer::backward_input(f f u f f) -> (f_mut),
            |p: PointLayerParams| [3, 0, 0, 0, p.features, 3];
        "lstm_cell/forward" => lstm_cell::forward(f f) -> (f_mut f_mut), |p: LstmParams| [4 * p.hidden, p.hidden, p.hidden, p.hidden];
        "lstm_cell/backward" => lstm_cell::backward(f f f f f) -> (f_mut f_mut),
            |p: LstmParams| [4 * p.hidden, p.hidden, p.hidden, p.hidden, p.hidden, 4 * p.hidden, p.hidden];
        "advance/forward" => advance::forward(f f f f) -> (f_mut f_mut), |p: AdvanceParams| [3, 3, p.hidden, 0, 1, 3];
        "advance/backward" => advance::backward(f f f f) -> (f_mut f_mut f_mut), |p: AdvanceParams| [3, 1, 3, 0, 1, 3, p.hidden];
        "density_sum/forward" => density_sum::forward(f f f) -> (f_mut f_mut),
            |p: DensitySumParams| [p.in_features, 0, p.features, 1, p.features];
        "density_sum/backward" => density_sum::backward(f f f f) -> (f_mut f_mut f_mut),
            |p: DensitySumParams| [1, p.features, p.features, 0, 1, p.features, p.in_features];
        "depth/forward" => depth::forward(f f) -> (f_mut), |_p: DepthParams| [0, 3, 1];
        "depth/backward" => depth::backward(f f) -> (f_mut), |_p: DepthParams| [0, 1, 3];
        "image_loss/backward" => image_loss::backward(f f f) -> (f_mut), |_p: ImageLossParams| [3, 4, 0, 3];
    }
    whole {
        "pose/forward" => pose::forward(f) -> (f_mut);
        "pose/backward" => pose::backward(f f) -> (f_mut);
        "rays/backward" => rays::backward(f f f f f f) -> (f_mut);
        "embedding/forward" => embedding::forward(f u) -> (f_mut);
        "embedding/backward" => embedding::backward(u f) -> (f_mut);
        "hidden_layer/forward" => hidden_layer::forward(f f u f) -> (f_mut f_mut f_mut);
        "hidden_layer/backward_input" => hidden_layer::backward_input(f u f f f) -> (f_mut f_mut);
        "depth_loss/forward" => depth_loss::forward(f) -> (f_mut);
        "latent_loss/forward" => latent_loss::forward(f) -> (f_mut);
        "latent_loss/backward" => latent_loss::backward(f) -> (f_mut);
        "image_loss/count" => image_loss::count(f) -> (f_mut);
        "image_loss/forward" => image_loss::forward(f f f) -> (f_mut);
        "gmsd/pool" => gmsd::pool(f) -> (f_mut);
        "gmsd/similarity" => gmsd::similarity(f f) -> (f_mut);
        "gmsd/moments" => gmsd::moments(f) -> (f_mut);
        "gmsd/deviation" => gmsd::deviation(f) -> (f_mut);
        "gmsd/backward_similarity" => gmsd::backward_similarity(f f f f f) -> (f_mut);
        "gmsd/backward_pool" => gmsd::backward_pool(f) -> (f_mut);
        "adam/step" => adam::step(f f) -> (f_mut f_mut f_mut);
        "sum/forward" => sum::forward(f) -> (f_mut);
        "bfgs/equations" => bfgs::equations(f f f f f f f) -> (f_mut);
        "bfgs/begin" => bfgs::begin(f f f) -> (f_mut);
        "bfgs/gradient" => bfgs::gradient(f f) -> (f_mut);
        "bfgs/update" => bfgs::update(f f f) -> (f_mut);
        "bfgs/solve" => bfgs::solve() -> (f_mut f_mut);
        "pack_rgba8/forward" => pack_rgba8::forward(f) -> (u_mut);
    }
}
