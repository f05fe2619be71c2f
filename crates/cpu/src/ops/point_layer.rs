//! `z = W x + b`, then [`super::layer_norm_relu`]: the first layer of a network of points. It keeps nothing: to make `z` again from three
//! numbers is cheaper than to read it.

use std::cell::RefCell;

use pulp::{Arch, Simd, WithSimd};
use srn_shaders::{LayerNormParams, LinearParams, PointLayerParams};

use super::layer_norm_relu::EPSILON;
use super::{layer_norm_relu, linear, set_of};
use crate::Real;
use crate::chain::{Kept, with_kept};
use crate::simd::{load, store, sum, vectorised};

/// Rows that take turns, so that none waits for its own sums.
const ROWS: usize = 4;
/// Columns of `W` and the bias.
const COLUMNS: usize = 4;

/// `y = relu(gamma x̂ + beta)`, `x̂ = (z - mean) rstd`.
pub fn forward<T: Real>(p: PointLayerParams, x: &[T], weights: &[T], slots: &[u32], affine: &[T], y: &mut [T]) {
    let (rows, width) = (p.rows_per_group as usize, p.features as usize);
    if let [Some(x), Some(weights), Some(affine)] = [x, weights, affine].map(T::singles)
        && let Some(y) = T::singles_mut(&mut *y)
    {
        let groups = x.chunks_exact(3 * rows).zip(y.chunks_exact_mut(rows * width)).take(p.groups as usize);
        for (group, (x, y)) in groups.enumerate() {
            with_centred(p, weights, slots, group, |layer| Arch::new().dispatch(Forward { layer, affine, x, y }));
        }
        return;
    }
    steps(p, x, weights, slots, affine, y);
}

/// `d_x (+)= Wᵀ d_z`, with `e = gamma · d_y` where `y > 0`: `d_z = rstd (e - mean(e) - x̂ mean(e x̂))`.
pub fn backward_input<T: Real>(
    p: PointLayerParams,
    x: &[T],
    weights: &[T],
    slots: &[u32],
    affine: &[T],
    d_y: &[T],
    d_x: &mut [T],
) {
    let (rows, width, accumulate) = (p.rows_per_group as usize, p.features as usize, p.accumulate == 1);
    if let [Some(x), Some(weights), Some(affine), Some(d_y)] = [x, weights, affine, d_y].map(T::singles)
        && let Some(d_x) = T::singles_mut(&mut *d_x)
    {
        let groups = x.chunks_exact(3 * rows).zip(d_y.chunks_exact(rows * width)).zip(d_x.chunks_exact_mut(3 * rows));
        for (group, ((x, d_y), d_x)) in groups.enumerate().take(p.groups as usize) {
            with_centred(p, weights, slots, group, |layer| {
                Arch::new().dispatch(Backward { layer, affine, x, d_y, d_x, accumulate });
            });
        }
        return;
    }
    let [mut y, mut d_z] = [(); 2].map(|()| vec![T::zero(); d_y.len()]);
    let (z, stats) = steps(p, x, weights, slots, affine, &mut y);
    layer_norm_relu::backward_input(norm(p), &z, &stats, affine, d_y, &mut d_z);
    linear::backward_input(LinearParams { accumulate: p.accumulate, ..map(p) }, &d_z, weights, slots, d_x);
}

/// The linear map alone.
fn map(p: PointLayerParams) -> LinearParams {
    LinearParams {
        groups: p.groups,
        rows_per_group: p.rows_per_group,
        first_group: p.first_group,
        in_features: 3,
        out_features: p.features,
        chunk_outs: p.features,
        chunks: 1,
        weight_stride: p.weight_stride,
        ..Default::default()
    }
}

/// The norm alone.
fn norm(p: PointLayerParams) -> LayerNormParams {
    LayerNormParams { rows: p.groups * p.rows_per_group, features: p.features, ..Default::default() }
}

/// One step after the other, which is what this layer is; returns what they leave for the way back.
fn steps<T: Real>(p: PointLayerParams, x: &[T], weights: &[T], slots: &[u32], affine: &[T], y: &mut [T]) -> (Vec<T>, Vec<T>) {
    let (mut z, mut stats) = (vec![T::zero(); y.len()], vec![T::zero(); 2 * y.len() / p.features as usize]);
    linear::forward(map(p), x, weights, slots, &mut z);
    layer_norm_relu::forward(norm(p), &z, affine, y, &mut stats);
    (z, stats)
}

vectorised! {
    /// Takes the means off the columns and returns what [`Centred::products`] says.
    fn centre<T: Real>(columns: &mut [T]) -> [[T; COLUMNS]; COLUMNS] {
        let width = columns.len() / COLUMNS;
        let count = T::of(width as f64);
        for column in columns.chunks_exact_mut(width) {
            let mean = sum(column, column, |value, _| value) / count;
            column.iter_mut().for_each(|value| *value = *value - mean);
        }
        let mut products = [[T::zero(); COLUMNS]; COLUMNS];
        for i in 0..COLUMNS {
            for j in 0..=i {
                let product = sum(&columns[i * width..(i + 1) * width], &columns[j * width..(j + 1) * width], |a, b| a * b) / count;
                products[i][j] = product;
                products[j][i] = product;
            }
        }
        products
    }
}

/// A layer whose output has no mean before the norm, so that none has to be taken off: its weights have none. The variance then is a square
/// form of the point, which in `f64` is at least as exact as the sum over the features, and takes none.
struct Centred {
    width: usize,
    /// The columns of `W`, then the bias, each less its mean over the features.
    columns: Vec<f32>,
    /// Means over the features of the product of each two columns.
    products: [[f64; COLUMNS]; COLUMNS],
}

/// Works with the layer of a group.
fn with_centred(p: PointLayerParams, weights: &[f32], slots: &[u32], group: usize, work: impl FnOnce(&Centred)) {
    thread_local! {
        static CENTRED: RefCell<Kept<Centred>> = RefCell::default();
    }
    let width = p.features as usize;
    let weights = set_of(weights, COLUMNS * width, p.weight_stride, slots, p.first_group as usize + group);
    with_kept(&CENTRED, weights, |_| Centred::of(width, weights), work);
}

impl Centred {
    fn of(width: usize, weights: &[f32]) -> Self {
        let (weight, bias) = weights.split_at(3 * width);
        let rows = (0..3).flat_map(|i| weight.iter().skip(i).step_by(3));
        let mut columns: Vec<f64> = rows.chain(bias).map(|&value| value.into()).collect();
        let products = centre(&mut columns);
        Centred { width, columns: columns.iter().map(|&value| value as f32).collect(), products }
    }

    /// For the point `p`: rstd, and the mean over the features of `z` times each column.
    #[inline(always)]
    fn moments(&self, p: &[f32]) -> (f32, [f32; 3]) {
        let p = [f64::from(p[0]), f64::from(p[1]), f64::from(p[2]), 1.0];
        let mut with = [0.0; COLUMNS];
        for (with, row) in with.iter_mut().zip(&self.products) {
            *with = row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3];
        }
        let variance = with[0] * p[0] + with[1] * p[1] + with[2] * p[2] + with[3];
        (1.0 / (variance + EPSILON).sqrt() as f32, [with[0] as f32, with[1] as f32, with[2] as f32])
    }
}

// Vectors are not handled in closures below: the compiler leaves those outside of the code for the processor's vectors.

/// What the features at one place need of a [`Centred`] layer.
struct Features<V> {
    columns: [V; COLUMNS],
    gamma: V,
    beta: V,
}

impl<V: Copy> Features<V> {
    #[inline(always)]
    fn load<S: Simd<f32s = V>>(simd: S, layer: &Centred, affine: &[f32], start: usize) -> Self {
        let mut columns = [simd.splat_f32s(0.0); COLUMNS];
        for (vector, column) in columns.iter_mut().zip(layer.columns.chunks_exact(layer.width)) {
            *vector = load(simd, column, start);
        }
        let (gamma, beta) = affine.split_at(layer.width);
        Features { columns, gamma: load(simd, gamma, start), beta: load(simd, &beta[..layer.width], start) }
    }

    /// `z` of a point, and `gamma x̂ + beta`.
    #[inline(always)]
    fn of<S: Simd<f32s = V>>(&self, simd: S, point: &[f32], rstd: V) -> (V, V) {
        let mut z = self.columns[3];
        for (&column, &x) in self.columns.iter().zip(point) {
            z = simd.mul_add_e_f32s(column, simd.splat_f32s(x), z);
        }
        (z, simd.mul_add_e_f32s(simd.mul_f32s(z, rstd), self.gamma, self.beta))
    }
}

/// [`forward`] of one group with the processor's vectors.
struct Forward<'a> {
    layer: &'a Centred,
    affine: &'a [f32],
    x: &'a [f32],
    y: &'a mut [f32],
}

impl Forward<'_> {
    #[inline(always)]
    fn rows<S: Simd, const N: usize>(simd: S, layer: &Centred, affine: &[f32], x: &[[f32; 3]; N], y: &mut [f32]) {
        let zero = simd.splat_f32s(0.0);
        let mut rstds = [zero; N];
        for row in 0..N {
            rstds[row] = simd.splat_f32s(layer.moments(&x[row]).0);
        }
        for start in (0..layer.width).step_by(S::F32_LANES) {
            let features = Features::load(simd, layer, affine, start);
            for row in 0..N {
                let (_, value) = features.of(simd, &x[row], rstds[row]);
                let y = &mut y[row * layer.width..(row + 1) * layer.width];
                store(simd, y, start, simd.select_f32s(simd.less_than_f32s(value, zero), zero, value));
            }
        }
    }
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Forward { layer, affine, x, y } = self;
        let (fours, others) = x.as_chunks().0.as_chunks::<ROWS>();
        let (y_of_fours, y_of_others) = y.split_at_mut(fours.len() * ROWS * layer.width);
        for (x, y) in fours.iter().zip(y_of_fours.chunks_exact_mut(ROWS * layer.width)) {
            Self::rows(simd, layer, affine, x, y);
        }
        for (&x, y) in others.iter().zip(y_of_others.chunks_exact_mut(layer.width)) {
            Self::rows(simd, layer, affine, &[x], y);
        }
    }
}

/// [`backward_input`] of one group with the processor's vectors.
struct Backward<'a> {
    layer: &'a Centred,
    affine: &'a [f32],
    x: &'a [f32],
    d_y: &'a [f32],
    d_x: &'a mut [f32],
    accumulate: bool,
}

impl Backward<'_> {
    /// The gradients to `N` points.
    #[inline(always)]
    fn rows<S: Simd, const N: usize>(simd: S, layer: &Centred, affine: &[f32], x: &[[f32; 3]; N], d_y: &[f32]) -> [[f32; 3]; N] {
        let zero = simd.splat_f32s(0.0);
        let (mut moments, mut rstds) = ([(0.0, [0.0; 3]); N], [zero; N]);
        for row in 0..N {
            moments[row] = layer.moments(&x[row]);
            rstds[row] = simd.splat_f32s(moments[row].0);
        }
        // Sums over the features of e times z, and e times each column. The columns have no mean: they take mean(e) to nothing.
        let (mut along, mut across) = ([zero; N], [[zero; 3]; N]);
        for start in (0..layer.width).step_by(S::F32_LANES) {
            let features = Features::load(simd, layer, affine, start);
            for row in 0..N {
                let (z, value) = features.of(simd, &x[row], rstds[row]);
                let d_y = load(simd, &d_y[row * layer.width..(row + 1) * layer.width], start);
                let e = simd.select_f32s(simd.greater_than_f32s(value, zero), simd.mul_f32s(features.gamma, d_y), zero);
                along[row] = simd.mul_add_e_f32s(e, z, along[row]);
                for i in 0..3 {
                    across[row][i] = simd.mul_add_e_f32s(e, features.columns[i], across[row][i]);
                }
            }
        }
        let mut d_x = [[0.0; 3]; N];
        for row in 0..N {
            let (rstd, with) = moments[row];
            let factor = simd.reduce_sum_f32s(along[row]) * rstd * rstd;
            for i in 0..3 {
                d_x[row][i] = rstd * (simd.reduce_sum_f32s(across[row][i]) - factor * with[i]);
            }
        }
        d_x
    }
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Backward { layer, affine, x, d_y, d_x, accumulate } = self;
        let (fours, others) = x.as_chunks().0.as_chunks::<ROWS>();
        let (d_y_of_fours, d_y_of_others) = d_y.split_at(fours.len() * ROWS * layer.width);
        let (d_x_of_fours, d_x_of_others) = d_x.split_at_mut(fours.len() * ROWS * 3);
        let put = |d_x: &mut [f32], gradients: &[[f32; 3]]| {
            for (d_x, &gradient) in d_x.iter_mut().zip(gradients.as_flattened()) {
                *d_x = gradient + if accumulate { *d_x } else { 0.0 };
            }
        };
        let rows = fours.iter().zip(d_y_of_fours.chunks_exact(ROWS * layer.width)).zip(d_x_of_fours.chunks_exact_mut(ROWS * 3));
        for ((x, d_y), d_x) in rows {
            put(d_x, &Self::rows(simd, layer, affine, x, d_y));
        }
        for ((&x, d_y), d_x) in others.iter().zip(d_y_of_others.chunks_exact(layer.width)).zip(d_x_of_others.chunks_exact_mut(3))
        {
            put(d_x, &Self::rows(simd, layer, affine, &[x], d_y));
        }
    }
}
