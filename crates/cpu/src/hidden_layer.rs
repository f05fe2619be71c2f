//! A linear layer and its layer norm as one, a few rows at a time: the one finds in the first cache what the other left there.

use srn_shaders::{LayerNormParams, LinearParams};

use crate::Real;
use crate::chain::RowWise;
use crate::ops::{layer_norm_relu, linear};

/// `linear/forward` from `x` to `z`, then `layer_norm_relu/forward` from there to `y`, of a block of rows; `x` is what `y` holds where it is
/// not given.
pub(crate) fn forward<T: Real>(
    p: LinearParams,
    norm: LayerNormParams,
    x: Option<&[T]>,
    weights: &[T],
    slots: &[u32],
    affine: &[T],
    z: &mut [T],
    y: &mut [T],
    stats: &mut [T],
) {
    let [ins, outs] = [p.in_features, p.out_features].map(|size| size as usize);
    linear::with_forward(p, weights, slots, 0, |at_a_time, layer| {
        for rows in parts(z.len() / outs, at_a_time) {
            let z = &mut z[rows.start * outs..rows.end * outs];
            layer(&x.unwrap_or(y)[rows.start * ins..rows.end * ins], z, &[]);
            let stats = &mut stats[2 * rows.start..2 * rows.end];
            layer_norm_relu::forward(norm.block(rows.clone()), z, affine, &mut y[rows.start * outs..rows.end * outs], stats);
        }
    });
}

/// `linear/backward_input` from `d_after` to `d_y`, then `layer_norm_relu/backward_input` from there to `d_z`, of a block of rows; `d_after` is
/// what `d_z` holds where it is not given.
pub(crate) fn backward<T: Real>(
    p: LinearParams,
    norm: LayerNormParams,
    d_after: Option<&[T]>,
    weights: &[T],
    slots: &[u32],
    z: &[T],
    stats: &[T],
    affine: &[T],
    d_y: &mut [T],
    d_z: &mut [T],
) {
    let [ins, outs] = [p.in_features, p.out_features].map(|size| size as usize);
    linear::with_backward_input(p, weights, slots, 0, 0..outs, |at_a_time, layer| {
        for rows in parts(z.len() / ins, at_a_time) {
            let values = rows.start * ins..rows.end * ins;
            let (z, d_y, stats) = (&z[values.clone()], &mut d_y[values.clone()], &stats[2 * rows.start..2 * rows.end]);
            layer(&d_after.unwrap_or(d_z)[rows.start * outs..rows.end * outs], d_y, z);
            layer_norm_relu::backward_input(norm.block(rows), z, stats, affine, d_y, &mut d_z[values]);
        }
    });
}

/// `rows` rows, so many at a time.
fn parts(rows: usize, at_a_time: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    (0..rows).step_by(at_a_time).map(move |first| first..rows.min(first.saturating_add(at_a_time)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chain::alone;

    fn values<T: Real>(count: usize, seed: usize) -> Vec<T> {
        (0..count).map(|k| T::of((((k + seed) * 7919) % 251) as f64 / 125.0 - 1.0)).collect()
    }

    /// Outputs of both passes, in place or not, of `rows` rows from `ins` to `outs` features.
    fn both<T: Real>([rows, ins, outs]: [usize; 3], in_place: bool, accumulate: bool, one_by_one: bool) -> [Vec<T>; 5] {
        let linear = LinearParams {
            groups: 1,
            rows_per_group: rows as u32,
            in_features: ins as u32,
            out_features: outs as u32,
            chunk_outs: outs as u32,
            chunks: 1,
            accumulate: accumulate.into(),
            ..bytemuck::Zeroable::zeroed()
        };
        let norm =
            |features: usize| LayerNormParams { rows: rows as u32, features: features as u32, ..bytemuck::Zeroable::zeroed() };
        let (weights, affine) = (values::<T>(outs * ins + outs, 3), values::<T>(2 * ins.max(outs), 4));
        let (x, mut z, mut stats) = (values::<T>(rows * ins, 1), values::<T>(rows * outs, 5), values::<T>(2 * rows, 6));
        let mut y = if in_place { x.clone() } else { values(rows * outs, 7) };
        let input = (!in_place).then_some(&x[..]);
        if one_by_one {
            linear::forward(linear, &x, &weights, &[0], &mut z);
            layer_norm_relu::forward(norm(outs), &z, &affine, &mut y, &mut stats);
        } else {
            alone(|| forward(linear, norm(outs), input, &weights, &[0], &affine, &mut z, &mut y, &mut stats));
        }

        let (before, seen, after) = (values::<T>(rows * ins, 8), values::<T>(2 * rows, 9), values::<T>(rows * outs, 10));
        let (mut d_y, mut d_z) = (values::<T>(rows * ins, 11), values::<T>(rows * ins, 12));
        if in_place {
            d_z.clone_from(&after);
        }
        let given = (!in_place).then_some(&after[..]);
        if one_by_one {
            linear::backward_input(linear, &after, &weights, &[0], &mut d_y);
            layer_norm_relu::backward_input(norm(ins), &before, &seen, &affine, &d_y, &mut d_z);
        } else {
            alone(|| {
                backward(linear, norm(ins), given, &weights, &[0], &before, &seen, &affine, &mut d_y, &mut d_z);
            });
        }
        [z, y, stats, d_y, d_z]
    }

    #[test]
    fn a_layer_and_its_norm_are_the_two_ops() {
        let sizes = [
            ([1, 16, 16], true),
            ([130, 64, 64], true),
            ([50, 48, 80], false),
            ([13, 272, 96], false),
            ([55, 256, 256], true),
            ([7, 528, 64], false),
            ([9, 20, 24], false),
            ([7, 24, 40], false),
        ];
        for ((size, in_place), accumulate) in sizes.into_iter().flat_map(|case| [(case, false), (case, true)]) {
            let (ours, oracle) = (both::<f32>(size, in_place, accumulate, false), both::<f64>(size, in_place, accumulate, true));
            for (what, (ours, oracle)) in ["z", "y", "stats", "d_y", "d_z"].into_iter().zip(ours.iter().zip(&oracle)) {
                let largest = oracle.iter().fold(1.0, |largest: f64, value| largest.max(value.abs()));
                for (k, (&ours, &oracle)) in ours.iter().zip(oracle).enumerate() {
                    let off = (f64::from(ours) - oracle).abs() / largest;
                    assert!(off < 2e-5, "{size:?}, accumulate {accumulate}, {what}[{k}]: {ours} instead of {oracle}");
                }
            }
        }
    }
}
