//! Linear layers: blocks of rows through `layer.rs`, where it can, all else through a matrix library.

use std::ops::Range;

use gemm::{Parallelism, gemm};
use srn_shaders::LinearParams;

use super::set_of;
use crate::Real;
use crate::chain::is_alone;
use crate::layer::{self, Begin, Weights};
use crate::simd::vectorised;

/// A matrix as the library wants it: values and the distances between rows and between columns.
struct Matrix<'a, T>(&'a [T], [usize; 2]);

/// `c [m,n] = (c if accumulate) + a [m,k] · b [k,n]`, `c` row-major.
fn product<T: Real>([m, n, k]: [usize; 3], c: &mut [T], a: Matrix<T>, b: Matrix<T>, accumulate: bool, threads: Parallelism) {
    let last = |[row, column]: [usize; 2], rows: usize, columns: usize| (rows - 1) * row + (columns - 1) * column;
    assert!(c.len() >= m * n && a.0.len() > last(a.1, m, k) && b.0.len() > last(b.1, k, n), "matrix product out of range");
    let [a_row, a_column] = a.1.map(|stride| stride as isize);
    let [b_row, b_column] = b.1.map(|stride| stride as isize);
    // SAFETY: the three ranges were checked above, and `c` is borrowed mutably.
    unsafe {
        gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
            1,
            n as isize,
            accumulate,
            a.0.as_ptr(),
            a_column,
            a_row,
            b.0.as_ptr(),
            b_column,
            b_row,
            T::one(),
            T::one(),
            false,
            false,
            false,
            threads,
        );
    }
}

/// The weights of group `group`.
fn weights_of<'a, T>(p: LinearParams, weights: &'a [T], slots: &[u32], group: usize) -> &'a [T] {
    let length = (p.out_features * p.in_features + p.out_features) as usize;
    set_of(weights, length, p.weight_stride, slots, p.first_group as usize + group)
}

/// Within one of many blocks of rows, the thread that works on it; else the library may split the product.
fn threads() -> Parallelism {
    if is_alone() { Parallelism::None } else { Parallelism::Rayon(0) }
}

/// A product for rows that a layer is ready for: inputs and outputs, or gradients of both the other way, and what will be wanted after it.
pub(crate) type Rows<'a, T> = &'a dyn Fn(&[T], &mut [T], &[T]);

/// Rows that are best taken at a time where something else is to be done with them, too: as many as stay in the first cache with their
/// weights, or all where putting the weights in order costs as much again each time.
const FEW_ROWS: usize = 48;
const ALL_ROWS: usize = usize::MAX;

/// Whether `layer.rs` makes the product. The matrix library also works on all threads.
fn is_ours<T: Real>(ins: usize, outs: usize) -> bool {
    is_alone() && T::singles(&[]).is_some() && layer::is_for(ins, outs)
}

fn singles<T: Real>(values: &[T]) -> &[f32] {
    T::singles(values).expect("`is_ours` saw that they are")
}

fn singles_mut<T: Real>(values: &mut [T]) -> &mut [f32] {
    T::singles_mut(values).expect("`is_ours` saw that they are")
}

/// `work` with `y (+)= x Wᵀ + b` for rows of group `group`, and with how many to take at a time.
pub(crate) fn with_forward<T: Real>(
    p: LinearParams,
    weights: &[T],
    slots: &[u32],
    group: usize,
    work: impl FnOnce(usize, Rows<T>),
) {
    let [ins, outs] = [p.in_features, p.out_features].map(|size| size as usize);
    let (weight, bias) = weights_of(p, weights, slots, group).split_at(outs * ins);
    let accumulate = p.accumulate == 1;
    let add_bias = |y: &mut [T]| {
        for y in y.chunks_exact_mut(outs) {
            y.iter_mut().zip(bias).for_each(|(y, &b)| *y += b);
        }
    };
    if is_ours::<T>(ins, outs) {
        return layer::with_layer(ins, outs, Weights::OutputsByInputs(singles(weight)), |layer| {
            work(FEW_ROWS, &|x, y, soon| {
                if accumulate {
                    add_bias(y);
                }
                let begin = if accumulate { Begin::Before } else { Begin::Bias(singles(bias)) };
                layer.product(singles(x), ins, begin, singles_mut(y), singles(soon));
            });
        });
    }
    work(ALL_ROWS, &|x, y, _| {
        match accumulate {
            true => add_bias(y),
            false => y.chunks_exact_mut(outs).for_each(|y| y.copy_from_slice(bias)),
        }
        product([y.len() / outs, outs, ins], y, Matrix(x, [ins, 1]), Matrix(weight, [1, ins]), true, threads());
    });
}

/// `work` with `d_x (+)= d_y W` for rows of group `group`, over some outputs, and with how many to take at a time.
pub(crate) fn with_backward_input<T: Real>(
    p: LinearParams,
    weights: &[T],
    slots: &[u32],
    group: usize,
    over: Range<usize>,
    work: impl FnOnce(usize, Rows<T>),
) {
    let [ins, outs] = [p.in_features, p.out_features].map(|size| size as usize);
    let (first, count) = (over.start, over.len());
    let weight = &weights_of(p, weights, slots, group)[first * ins..over.end * ins];
    let accumulate = p.accumulate == 1;
    if is_ours::<T>(count, ins) {
        let begin = if accumulate { Begin::Before } else { Begin::Zero };
        return layer::with_layer(count, ins, Weights::InputsByOutputs(singles(weight)), |layer| {
            work(FEW_ROWS, &|d_y, d_x, soon| {
                layer.product(&singles(d_y)[first..], outs, begin, singles_mut(d_x), singles(soon));
            });
        });
    }
    work(ALL_ROWS, &|d_y, d_x, _| {
        let size = [d_x.len() / ins, ins, count];
        product(size, d_x, Matrix(&d_y[first..], [outs, 1]), Matrix(weight, [ins, 1]), accumulate, threads());
    });
}

/// `y (+)= x Wᵀ + b`.
pub fn forward<T: Real>(p: LinearParams, x: &[T], weights: &[T], slots: &[u32], y: &mut [T]) {
    let [rows, ins, outs] = [p.rows_per_group, p.in_features, p.out_features].map(|size| size as usize);
    let groups = y.chunks_exact_mut(rows * outs).zip(x.chunks_exact(rows * ins));
    for (group, (y, x)) in groups.enumerate().take(p.groups as usize) {
        with_forward(p, weights, slots, group, |_, rows| rows(x, y, &[]));
    }
}

/// `d_x (+)= d_y W`, per group and chunk of outputs.
pub fn backward_input<T: Real>(p: LinearParams, d_y: &[T], weights: &[T], slots: &[u32], d_x: &mut [T]) {
    let [rows, ins, outs] = [p.rows_per_group, p.in_features, p.out_features].map(|size| size as usize);
    let [chunk_outs, chunks] = [p.chunk_outs, p.chunks].map(|size| size as usize);
    let groups = d_x.chunks_exact_mut(chunks * rows * ins).zip(d_y.chunks_exact(rows * outs));
    for (group, (d_x, d_y)) in groups.enumerate().take(p.groups as usize) {
        for (chunk, d_x) in d_x.chunks_exact_mut(rows * ins).enumerate() {
            let over = chunk * chunk_outs..outs.min((chunk + 1) * chunk_outs);
            with_backward_input(p, weights, slots, group, over, |_, rows| rows(d_y, d_x, &[]));
        }
    }
}

/// Per group and chunk of rows: `d_yᵀ x`, then the column sums of `d_y`.
pub fn backward_weight<T: Real>(p: LinearParams, x: &[T], d_y: &[T], partial: &mut [T]) {
    let [ins, outs, rows, chunk] = [p.in_features, p.out_features, p.rows_per_group, p.chunk_rows].map(|size| size as usize);
    let accumulate = p.accumulate == 1;
    let mut partial = partial.chunks_exact_mut(outs * ins + outs);
    let groups = x.chunks_exact(rows * ins).zip(d_y.chunks_exact(rows * outs));
    for (x, d_y) in groups.take(p.groups as usize) {
        for ((x, d_y), partial) in x.chunks(chunk * ins).zip(d_y.chunks(chunk * outs)).zip(&mut partial) {
            let (d_weight, d_bias) = partial.split_at_mut(outs * ins);
            let size = [outs, ins, x.len() / ins];
            product(size, d_weight, Matrix(d_y, [1, outs]), Matrix(x, [ins, 1]), accumulate, threads());
            let mut sums = vec![0.0; outs];
            add_rows(d_y, &mut sums);
            for (d_bias, sum) in d_bias.iter_mut().zip(sums) {
                *d_bias = T::of(sum + if accumulate { d_bias.wide() } else { 0.0 });
            }
        }
    }
}

vectorised! {
    /// Adds each row to `sums`, four at a time.
    fn add_rows<T: Real>(rows: &[T], sums: &mut [f64]) {
        let width = sums.len();
        let fours = rows.chunks_exact(4 * width);
        for row in fours.remainder().chunks_exact(width) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += value.wide();
            }
        }
        for four in fours {
            let (first, last) = four.split_at(2 * width);
            let (rows, more) = (first.split_at(width), last.split_at(width));
            let pairs = rows.0.iter().zip(rows.1).zip(more.0.iter().zip(more.1));
            for (sum, ((&a, &b), (&c, &d))) in sums.iter_mut().zip(pairs) {
                *sum += ((a + b) + (c + d)).wide();
            }
        }
    }
}
