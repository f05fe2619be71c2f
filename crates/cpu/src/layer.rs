//! Products of blocks of rows with the weights of a layer: sums stay in the processor's registers and begin with the bias.

use std::cell::RefCell;

use pulp::{Arch, Simd, WithSimd};

use crate::aligned::Aligned;
use crate::chain::{Kept, with_kept};

/// Inputs at a time: their weights for as many outputs as have their sums in registers stay in the first cache.
const DEPTH: usize = 128;
/// Rows whose sums are held at once.
const ROWS: usize = 6;
/// Inputs and outputs, at most. Wider layers are the matrix library's: putting their weights in order for some rows would cost too much.
const WIDEST: usize = 512;
/// Inputs in a turn of the loop; vectors are as long or longer.
const AT_A_TIME: usize = 4;

/// Vectors of outputs whose sums are held at once: with the weights of an input, [`ROWS`] times as many take all but a few of the registers,
/// 32 of sixteen values or 16 of eight. None for other processors: what is best there could not be measured.
const fn vectors(lanes: usize) -> usize {
    match lanes {
        16 => 4,
        8 => 2,
        _ => 0,
    }
}

/// What the sums begin with.
#[derive(Clone, Copy)]
pub(crate) enum Begin<'a> {
    Zero,
    /// One value for each output.
    Bias(&'a [f32]),
    /// What is there.
    Before,
}

/// Weights, with their order.
#[derive(Clone, Copy)]
pub(crate) enum Weights<'a> {
    OutputsByInputs(&'a [f32]),
    InputsByOutputs(&'a [f32]),
}

/// A layer that is ready for products.
pub(crate) struct Layer<'a> {
    ins: usize,
    outs: usize,
    /// Weights to the first [`columns`] outputs `[ins, columns]`, then those to the next.
    values: &'a [f32],
}

/// Values of a vector of this processor.
fn lanes() -> usize {
    struct Lanes;

    impl WithSimd for Lanes {
        type Output = usize;

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> usize {
            S::F32_LANES
        }
    }

    Arch::new().dispatch(Lanes)
}

/// Outputs whose sums are held at once.
fn columns() -> usize {
    lanes() * vectors(lanes())
}

/// Whether there are products with such layers here.
pub(crate) fn is_for(ins: usize, outs: usize) -> bool {
    let lanes = lanes();
    vectors(lanes) > 0 && ins.max(outs) <= WIDEST && ins.is_multiple_of(lanes) && outs.is_multiple_of(lanes)
}

/// Works with a layer for which [`is_for`] holds.
pub(crate) fn with_layer(ins: usize, outs: usize, weights: Weights, work: impl FnOnce(&Layer)) {
    // The two directions differ.
    thread_local! {
        static FORWARD: RefCell<Kept<Aligned<f32>>> = RefCell::default();
        static BACK: RefCell<Kept<Aligned<f32>>> = RefCell::default();
    }
    assert!(is_for(ins, outs));
    let (length, columns) = (ins * outs, columns());
    if let Weights::InputsByOutputs(values) = weights
        && outs <= columns
    {
        return work(&Layer { ins, outs, values: &values[..length] });
    }
    let (kept, values) = match weights {
        Weights::OutputsByInputs(values) => (&FORWARD, &values[..length]),
        Weights::InputsByOutputs(values) => (&BACK, &values[..length]),
    };
    let in_order = |spare: Option<Aligned<f32>>| {
        let mut in_order = spare.filter(|spare| spare.values().len() >= length).unwrap_or_else(|| Aligned::zeros(length));
        let parts = in_order.values_mut()[..length].chunks_mut(columns * ins);
        for (first, to) in (0..outs).step_by(columns).zip(parts) {
            let columns = to.len() / ins;
            match weights {
                Weights::OutputsByInputs(_) => transpose(&values[first * ins..][..columns * ins], ins, to),
                Weights::InputsByOutputs(_) => {
                    for (from, to) in values.chunks_exact(outs).zip(to.chunks_exact_mut(columns)) {
                        to.copy_from_slice(&from[first..first + columns]);
                    }
                }
            }
        }
        in_order
    };
    with_kept(kept, values, in_order, |in_order| work(&Layer { ins, outs, values: &in_order.values()[..length] }));
}

impl Layer<'_> {
    /// `y [rows, outs] = begin + x w`, rows of `x` being `stride` values apart. What lies in `soon` is asked for meanwhile.
    pub(crate) fn product(&self, x: &[f32], stride: usize, begin: Begin, y: &mut [f32], soon: &[f32]) {
        let &Layer { ins, outs, values } = self;
        let rows = y.len() / outs;
        assert!(rows > 0 && y.len() == rows * outs && stride >= ins && x.len() >= (rows - 1) * stride + ins);
        assert!(!matches!(begin, Begin::Bias(bias) if bias.len() < outs));
        let most = columns();
        for out in (0..outs).step_by(most) {
            let columns = most.min(outs - out);
            let w = &values[out * ins..];
            for first in (0..ins).step_by(DEPTH) {
                let depth = DEPTH.min(ins - first);
                let begin = match begin {
                    Begin::Bias(bias) if first == 0 => Begin::Bias(&bias[out..]),
                    Begin::Zero if first == 0 => Begin::Zero,
                    _ => Begin::Before,
                };
                let soon = if out == 0 && first == 0 { soon } else { &[] };
                let (x, w, y) = (&x[first..], &w[first * columns..], &mut y[out..]);
                // By the assertions here and in `with_layer` there are `rows` rows of `x` and `y`, and `depth` of `w`, that far apart, the
                // last with all the values that the others have; a bias has `columns` values.
                Arch::new().dispatch(Block { rows, columns, depth, x, x_stride: stride, w, begin, y, y_stride: outs, soon });
            }
        }
    }
}

/// Rows of inputs, for some of the inputs and of the outputs.
struct Block<'a> {
    rows: usize,
    columns: usize,
    depth: usize,
    x: &'a [f32],
    x_stride: usize,
    w: &'a [f32],
    begin: Begin<'a>,
    y: &'a mut [f32],
    y_stride: usize,
    soon: &'a [f32],
}

impl WithSimd for Block<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match (vectors(S::F32_LANES), self.columns / S::F32_LANES) {
            (2.., 1) => self.run::<S, 1>(simd),
            (2.., 2) => self.run::<S, 2>(simd),
            (4.., 3) => self.run::<S, 3>(simd),
            (4.., 4) => self.run::<S, 4>(simd),
            _ => unreachable!("`is_for` is false, or more columns than are held"),
        }
    }
}

impl Block<'_> {
    /// All rows, of `V` vectors of outputs.
    #[inline(always)]
    fn run<S: Simd, const V: usize>(mut self, simd: S) {
        let whole = self.rows - self.rows % ROWS;
        let mut soon = self.soon.chunks((self.soon.len() * ROWS).div_ceil(self.rows).max(1));
        for row in (0..whole).step_by(ROWS) {
            soon.next().into_iter().for_each(ask_for);
            self.sums::<S, ROWS, V>(simd, row);
        }
        match self.rows - whole {
            0 => {}
            1 => self.sums::<S, 1, V>(simd, whole),
            2 => self.sums::<S, 2, V>(simd, whole),
            3 => self.sums::<S, 3, V>(simd, whole),
            4 => self.sums::<S, 4, V>(simd, whole),
            _ => self.sums::<S, 5, V>(simd, whole),
        }
    }

    /// `R` rows from `row` on.
    #[inline(always)]
    fn sums<S: Simd, const R: usize, const V: usize>(&mut self, simd: S, row: usize) {
        let &mut Block { columns, depth, x_stride, begin, y_stride, .. } = self;
        assert!(row + R <= self.rows);
        // SAFETY: see `Layer::product`, and `is_for` for the last turn of the loop.
        unsafe {
            let (x, w) = (self.x.as_ptr().add(row * x_stride), self.w.as_ptr());
            let y = self.y.as_mut_ptr().add(row * y_stride);
            let vector = |from: *const f32, v: usize| from.cast::<S::f32s>().add(v);
            let mut sums = [[simd.splat_f32s(0.0); V]; R];
            for r in 0..R {
                for v in 0..V {
                    match begin {
                        Begin::Zero => {}
                        Begin::Bias(bias) => sums[r][v] = vector(bias.as_ptr(), v).read_unaligned(),
                        Begin::Before => sums[r][v] = vector(y.add(r * y_stride), v).read_unaligned(),
                    }
                }
            }
            for first in (0..depth).step_by(AT_A_TIME) {
                for k in first..first + AT_A_TIME {
                    let mut weights = [simd.splat_f32s(0.0); V];
                    for v in 0..V {
                        weights[v] = vector(w.add(k * columns), v).read_unaligned();
                    }
                    for r in 0..R {
                        let x = simd.splat_f32s(*x.add(r * x_stride + k));
                        for v in 0..V {
                            sums[r][v] = simd.mul_add_e_f32s(x, weights[v], sums[r][v]);
                        }
                    }
                }
            }
            for r in 0..R {
                for v in 0..V {
                    y.add(r * y_stride).cast::<S::f32s>().add(v).write_unaligned(sums[r][v]);
                }
            }
        }
    }
}

/// Has values brought to the second cache: the first is full of weights and rows. Every processor of this kind has SSE.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn ask_for(values: &[f32]) {
    use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
    for line in values.chunks(crate::aligned::LINE / size_of::<f32>()) {
        // SAFETY: nothing is read.
        unsafe { _mm_prefetch::<_MM_HINT_T1>(line.as_ptr().cast()) }
    }
}

/// Others have no stable way to ask.
#[cfg(not(target_arch = "x86_64"))]
fn ask_for(_: &[f32]) {}

/// `to [ins, outs] = from [outs, ins]ᵀ`, both sizes multiples of four.
fn transpose(from: &[f32], ins: usize, to: &mut [f32]) {
    let outs = from.len() / ins;
    assert!(ins.is_multiple_of(4) && outs.is_multiple_of(4) && from.len() == outs * ins && to.len() >= from.len());
    for out in (0..outs).step_by(4) {
        for first in (0..ins).step_by(4) {
            // SAFETY: four times four values lie there, in both.
            unsafe { square(from.as_ptr().add(out * ins + first), ins, to.as_mut_ptr().add(first * outs + out), outs) }
        }
    }
}

/// Four times four values change places. Every processor of this kind has SSE.
///
/// # Safety
/// Both sides have four rows of four values, so far apart.
#[cfg(target_arch = "x86_64")]
unsafe fn square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
    use std::arch::x86_64::*;
    // SAFETY: the caller's.
    unsafe {
        let [mut a, mut b, mut c, mut d] = std::array::from_fn(|row| _mm_loadu_ps(from.add(row * from_stride)));
        _MM_TRANSPOSE4_PS(&mut a, &mut b, &mut c, &mut d);
        for (row, values) in [a, b, c, d].into_iter().enumerate() {
            _mm_storeu_ps(to.add(row * to_stride), values);
        }
    }
}

/// The same for others.
///
/// # Safety
/// Both sides have four rows of four values, so far apart.
#[cfg(not(target_arch = "x86_64"))]
unsafe fn square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
    for (row, column) in (0..16).map(|k| (k / 4, k % 4)) {
        // SAFETY: the caller's.
        unsafe { *to.add(column * to_stride + row) = *from.add(row * from_stride + column) }
    }
}
