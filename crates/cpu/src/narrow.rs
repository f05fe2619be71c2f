//! Products of blocks of rows with the weights of a narrow layer, on processors with AVX-512: sums stay in registers and begin with the
//! bias. Wide layers are the matrix library's, which is as fast there.

use std::cell::RefCell;

/// Values of a vector.
const LANES: usize = 16;
/// Vectors of outputs whose sums are held at once.
const VECTORS: usize = 4;
const COLUMNS: usize = VECTORS * LANES;
/// Inputs at a time: their weights for [`COLUMNS`] outputs stay in the first cache.
const DEPTH: usize = 128;

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
    /// `[ins, outs]`, or one such matrix after the other, each for the next [`COLUMNS`] outputs.
    values: &'a [f32],
    in_columns: bool,
}

/// Whether there are products with such layers here.
pub(crate) fn is_for(ins: usize, outs: usize) -> bool {
    let narrow = ins.min(outs) <= DEPTH && ins.is_multiple_of(LANES) && outs.is_multiple_of(LANES);
    narrow && avx512::is_there()
}

/// Works with a layer for which [`is_for`] holds.
pub(crate) fn with_layer(ins: usize, outs: usize, weights: Weights, work: impl FnOnce(&Layer)) {
    thread_local! {
        static TRANSPOSED: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
    }
    assert!(is_for(ins, outs));
    match weights {
        Weights::InputsByOutputs(values) => work(&Layer { ins, outs, values: &values[..ins * outs], in_columns: false }),
        Weights::OutputsByInputs(values) => TRANSPOSED.with_borrow_mut(|transposed| {
            let values = &values[..ins * outs];
            if transposed.len() < values.len() {
                transposed.resize(values.len(), 0.0);
            }
            for (values, columns) in values.chunks(COLUMNS * ins).zip(transposed.chunks_mut(COLUMNS * ins)) {
                // SAFETY: the processor has AVX-512; both have `ins` values for each of a multiple of the lanes, as `ins` is.
                unsafe { avx512::transpose(values, ins, columns) };
            }
            work(&Layer { ins, outs, values: transposed, in_columns: true });
        }),
    }
}

impl Layer<'_> {
    /// `y [rows, outs] = begin + x w`, rows of `x` being `stride` values apart.
    pub(crate) fn product(&self, x: &[f32], stride: usize, begin: Begin, y: &mut [f32]) {
        let &Layer { ins, outs, values, in_columns } = self;
        let rows = y.len() / outs;
        assert!(rows > 0 && y.len() == rows * outs && stride >= ins && x.len() >= (rows - 1) * stride + ins);
        assert!(!matches!(begin, Begin::Bias(bias) if bias.len() < outs));
        for out in (0..outs).step_by(COLUMNS) {
            let columns = COLUMNS.min(outs - out);
            let (w, w_stride) = if in_columns { (&values[out * ins..], columns) } else { (&values[out..], outs) };
            for first in (0..ins).step_by(DEPTH) {
                let depth = DEPTH.min(ins - first);
                let begin = match begin {
                    Begin::Bias(bias) if first == 0 => Begin::Bias(&bias[out..]),
                    Begin::Zero if first == 0 => Begin::Zero,
                    _ => Begin::Before,
                };
                let (x, w, y) = (&x[first..], &w[first * w_stride..], &mut y[out..]);
                let block = Block { rows, depth, x, x_stride: stride, w, w_stride, begin, y, y_stride: outs };
                // SAFETY: the processor has AVX-512. By the assertions here and in `with_layer`, there are `rows` rows of `x` and `y`, and
                // `depth` of `w`, that far apart, the last with all the values that the others have.
                unsafe {
                    match columns / LANES {
                        1 => block.run::<1>(),
                        2 => block.run::<2>(),
                        3 => block.run::<3>(),
                        _ => block.run::<VECTORS>(),
                    }
                }
            }
        }
    }
}

/// Rows of inputs, for some of the inputs and of the outputs.
#[cfg_attr(not(target_arch = "x86_64"), expect(dead_code, reason = "there is nothing there that reads it"))]
struct Block<'a> {
    rows: usize,
    depth: usize,
    x: &'a [f32],
    x_stride: usize,
    w: &'a [f32],
    w_stride: usize,
    begin: Begin<'a>,
    y: &'a mut [f32],
    y_stride: usize,
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use std::arch::x86_64::*;

    use super::{Begin, Block, LANES};

    /// Rows whose sums are held at once: with the weights of an input, they take all but a few of the 32 registers.
    const ROWS: usize = 6;

    pub fn is_there() -> bool {
        is_x86_feature_detected!("avx512f")
    }

    impl Block<'_> {
        /// # Safety
        /// The processor has AVX-512, `x` has `rows` rows of `depth` values, `w` has `depth` of `V` vectors, a bias has `V` vectors, and
        /// `y` has `rows` rows of `V`.
        #[target_feature(enable = "avx512f")]
        pub unsafe fn run<const V: usize>(mut self) {
            let mut row = 0;
            // SAFETY: no row beyond the last.
            unsafe {
                while row + ROWS <= self.rows {
                    self.sums::<ROWS, V>(row);
                    row += ROWS;
                }
                match self.rows - row {
                    0 => {}
                    1 => self.sums::<1, V>(row),
                    2 => self.sums::<2, V>(row),
                    3 => self.sums::<3, V>(row),
                    4 => self.sums::<4, V>(row),
                    _ => self.sums::<5, V>(row),
                }
            }
        }

        /// # Safety
        /// As for [`Block::run`], of `R` rows from `row` on.
        #[target_feature(enable = "avx512f")]
        #[inline]
        unsafe fn sums<const R: usize, const V: usize>(&mut self, row: usize) {
            let &mut Block { depth, x_stride, w_stride, begin, y_stride, .. } = self;
            // SAFETY: the caller's.
            unsafe {
                let (x, w) = (self.x.as_ptr().add(row * x_stride), self.w.as_ptr());
                let y = self.y.as_mut_ptr().add(row * y_stride);
                let mut sums = [[_mm512_setzero_ps(); V]; R];
                for (r, sums) in sums.iter_mut().enumerate() {
                    for (v, sum) in sums.iter_mut().enumerate() {
                        match begin {
                            Begin::Zero => {}
                            Begin::Bias(bias) => *sum = _mm512_loadu_ps(bias.as_ptr().add(LANES * v)),
                            Begin::Before => *sum = _mm512_loadu_ps(y.add(r * y_stride + LANES * v)),
                        }
                    }
                }
                for k in 0..depth {
                    let w: [__m512; V] = std::array::from_fn(|v| _mm512_loadu_ps(w.add(k * w_stride + LANES * v)));
                    for (r, sums) in sums.iter_mut().enumerate() {
                        let x = _mm512_set1_ps(*x.add(r * x_stride + k));
                        for (sum, &w) in sums.iter_mut().zip(&w) {
                            *sum = _mm512_fmadd_ps(x, w, *sum);
                        }
                    }
                }
                for (r, sums) in sums.iter().enumerate() {
                    for (v, &sum) in sums.iter().enumerate() {
                        _mm512_storeu_ps(y.add(r * y_stride + LANES * v), sum);
                    }
                }
            }
        }
    }

    /// `to [ins, outs] = from [outs, ins]ᵀ`.
    ///
    /// # Safety
    /// The processor has AVX-512; `ins` and `outs`, the length of `from` over `ins`, are multiples of the lanes, and `to` is as long.
    #[target_feature(enable = "avx512f")]
    pub unsafe fn transpose(from: &[f32], ins: usize, to: &mut [f32]) {
        let outs = from.len() / ins;
        for out in (0..outs).step_by(LANES) {
            for first in (0..ins).step_by(LANES) {
                // SAFETY: a whole square lies there, in both.
                unsafe { square(from.as_ptr().add(out * ins + first), ins, to.as_mut_ptr().add(first * outs + out), outs) }
            }
        }
    }

    /// A square of as many rows as lanes: pairs of rows, then fours, change places within quarters of the vectors, then the quarters do.
    ///
    /// # Safety
    /// The processor has AVX-512, and both sides have these rows, so far apart.
    #[target_feature(enable = "avx512f")]
    #[inline]
    unsafe fn square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
        // SAFETY: the caller's.
        let mut a: [__m512; LANES] = std::array::from_fn(|row| unsafe { _mm512_loadu_ps(from.add(row * from_stride)) });
        let mut b = a;
        for i in 0..8 {
            b[2 * i] = _mm512_unpacklo_ps(a[2 * i], a[2 * i + 1]);
            b[2 * i + 1] = _mm512_unpackhi_ps(a[2 * i], a[2 * i + 1]);
        }
        for i in [0, 4, 8, 12] {
            let [p, q, r, s] = [b[i], b[i + 1], b[i + 2], b[i + 3]].map(|four| _mm512_castps_pd(four));
            a[i] = _mm512_castpd_ps(_mm512_unpacklo_pd(p, r));
            a[i + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(p, r));
            a[i + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(q, s));
            a[i + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(q, s));
        }
        for i in 0..4 {
            for j in [i, i + 8] {
                b[j] = _mm512_shuffle_f32x4(a[j], a[j + 4], 0b10_00_10_00);
                b[j + 4] = _mm512_shuffle_f32x4(a[j], a[j + 4], 0b11_01_11_01);
            }
        }
        for i in 0..8 {
            a[i] = _mm512_shuffle_f32x4(b[i], b[i + 8], 0b10_00_10_00);
            a[i + 8] = _mm512_shuffle_f32x4(b[i], b[i + 8], 0b11_01_11_01);
        }
        for (row, &values) in a.iter().enumerate() {
            // SAFETY: the caller's.
            unsafe { _mm512_storeu_ps(to.add(row * to_stride), values) };
        }
    }
}

/// Other processors never get here.
#[cfg(not(target_arch = "x86_64"))]
mod avx512 {
    pub fn is_there() -> bool {
        false
    }

    impl super::Block<'_> {
        pub unsafe fn run<const V: usize>(self) {
            unreachable!("`is_there` is false")
        }
    }

    pub unsafe fn transpose(_from: &[f32], _ins: usize, _to: &mut [f32]) {
        unreachable!("`is_there` is false")
    }
}
