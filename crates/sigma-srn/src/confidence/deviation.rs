//! How far off a pose may be.

use std::collections::BTreeMap;

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Serialize;

use crate::cholesky::{cholesky, forward};
use crate::confidence::Calibration;
use crate::estimator::Estimate;
use crate::model::Model;

/// A symmetric matrix over a motion, see [`motion`].
pub type Matrix6 = [[f64; 6]; 6];

/// An estimate whose true pose is known.
#[derive(Clone, Debug)]
pub struct Known {
    /// Name of the object.
    pub instance: String,
    /// From the estimate to the true pose, see [`motion`].
    pub motion: [f64; 6],
    /// See [`Estimate::shape`].
    pub shape: Matrix6,
}

/// How far off a pose may be, provided that it is no other one altogether.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Confidence {
    /// Standard deviation of the rotation about all axes, degrees.
    pub rotation_deg: f64,
    /// Standard deviation of the camera's place, object units.
    pub translation: f64,
    /// Covariance of the motion from the estimate to the truth: a turn about the object's centre (rad), then a shift (object units), both in
    /// the axes (OpenCV's) of the estimated camera.
    pub covariance: Matrix6,
}

impl Confidence {
    /// Of an estimate for an instance of `model`, if it is calibrated.
    pub fn of(model: &Model, instance: u32, estimate: &Estimate) -> Option<Self> {
        let covariance = estimate.covariance(&model.instance_name(instance), model.metadata.calibration.as_ref()?)?;
        let (rotation_deg, translation) = deviations(&estimate.pose.to_matrix(), &covariance);
        Some(Confidence { rotation_deg, translation, covariance })
    }
}

/// What the squared distance of six normal numbers from their mean, in units of their covariance, is below in 95 % of all cases.
pub const WITHIN_95: f64 = 12.591_587;

/// How much larger variances are where a mask hides all around the object: by pictures of objects on a table (`docs/accuracy.md`).
const WITHOUT_OUTLINE: f64 = 8.0;
/// Where a mask says where the object ends: by how many pixels one side of the outline may still be off when it has been found, by which part of what
/// it was moved by, and by which part of a cut that was not made (standard deviations). By pictures whose masks were made wrong (`docs/accuracy.md`).
const OUTLINE: f64 = 0.2;
const OF_MOVED: f64 = 0.3;
const OF_UNDECIDED: f64 = 0.5;

/// The motion `(ω, υ)` about the object that takes one pose to another, in the axes of the first one's camera: the camera turned about the
/// object's centre by `ω` (radians), then shifted by `υ` (object units).
pub fn motion(from: &DMat4, to: &DMat4) -> [f64; 6] {
    let camera_from_world = DMat3::from_mat4(*from).transpose();
    let turn = camera_from_world * DMat3::from_mat4(*to);
    let shift = camera_from_world * to.w_axis.truncate() - turn * (camera_from_world * from.w_axis.truncate());
    let [a, b, c] = DQuat::from_mat3(&turn).normalize().to_scaled_axis().to_array();
    [a, b, c, shift.x, shift.y, shift.z]
}

/// The pose that a [`motion`] takes this one to.
pub(crate) fn moved(from: &DMat4, motion: &[f64; 6]) -> DMat4 {
    let [a, b, c, x, y, z] = *motion;
    let (axes, turn) = (DMat3::from_mat4(*from), DMat3::from_quat(DQuat::from_scaled_axis(DVec3::new(a, b, c))));
    let place = axes * (turn * (axes.transpose() * from.w_axis.truncate()) + DVec3::new(x, y, z));
    DMat4::from_mat3_translation(axes * turn, place)
}

impl Calibration {
    /// [`Calibration::floor`] for an estimate: how far away it is, which shows in how large it is, is known to a part of the distance.
    fn floor_of(&self, estimate: &Estimate) -> [f64; 6] {
        let farther = self.seen.map_or(1.0, |seen| (estimate.pose.distance() / seen.distance).max(1.0));
        let [a, b, c, x, y, z] = self.floor;
        [a, b, c, x, y, farther * farther * z]
    }

    /// How much larger variances are where an object is smaller in the picture than those of the calibration. The square of a pixel's size would do if errors
    /// grew as a pixel does; by views from farther away (`docs/accuracy.md`) they grow faster.
    fn of_pixels(&self, estimate: &Estimate) -> f64 {
        self.seen.map_or(1.0, |seen| (seen.extent / estimate.extent).max(1.0).powi(3))
    }
}

impl Estimate {
    /// `loss · B⁻¹`, the shape of the estimate's errors. `None` without second derivatives, or where they are not those of a minimum.
    pub fn shape(&self) -> Option<Matrix6> {
        let lower = cholesky(self.curvature.as_ref()?)?;
        // Row k of L⁻¹ᵀ is the solution for the k-th unit vector.
        let columns: Matrix6 = std::array::from_fn(|k| forward(&lower, std::array::from_fn(|i| f64::from(i == k))));
        let entry = |i: usize, j: usize| columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum::<f64>();
        Some(std::array::from_fn(|i| std::array::from_fn(|j| self.loss * entry(i, j))))
    }

    /// Covariance of the motion from the estimated pose of this instance to the true one; `None` where there is no [`Estimate::shape`].
    pub fn covariance(&self, instance: &str, calibration: &Calibration) -> Option<Matrix6> {
        // Second derivatives know of the pixels that are missing where a part is hidden, but not of all: errors of the model average over fewer, and
        // what is left says less of how far away it is. So much covers them (`docs/accuracy.md`).
        let of_picture = if self.is_without_outline { WITHOUT_OUTLINE } else { 1.0 / self.in_sight };
        let size = of_picture * calibration.of_pixels(self) * calibration.sizes.get(instance).copied().unwrap_or(1.0);
        let mixed = mixed(&self.shape()?, calibration.curvature, &calibration.floor_of(self));
        let mut covariance = mixed.map(|row| row.map(|entry| size * entry));
        if let Some(outline) = self.outline {
            // The views that a calibration is from have no masks. With one side farther out an object's middle is half as far to that side, it is as much
            // larger, so nearer, and turned as such a shift looks.
            let off = OUTLINE.hypot(OF_MOVED * outline.moved()).hypot(OF_UNDECIDED * outline.undecided);
            let part = off / (0.5 * self.extent * f64::from(self.width));
            for (k, size) in [1.0, 1.0, 1.0, 0.5, 0.5, self.pose.distance()].into_iter().enumerate() {
                covariance[k][k] += (size * part).powi(2);
            }
        }
        Some(covariance)
    }

    /// Whether a pose lies within the ellipsoid that 95 % of all true poses of this instance lie in, if the errors are normal.
    pub fn states(&self, pose: &DMat4, instance: &str, calibration: &Calibration) -> Option<bool> {
        let (_, squared) = distance(&self.covariance(instance, calibration)?, &motion(&self.pose.to_matrix(), pose))?;
        Some(squared <= WITHIN_95)
    }
}

/// `curvature`, `floor` and `sizes` of a [`Calibration`]: the most likely mixture of what depends on the view and what does not, and what the
/// errors at each object say of the next one there; then enlarged until 95 % of the motions lie within the ellipsoids that say so.
pub fn fit(known: &[Known]) -> Option<(f64, [f64; 6], BTreeMap<String, f64>)> {
    let count = known.len() as f64;
    let mean = |of: &dyn Fn(&Known) -> f64| known.iter().map(of).sum::<f64>() / count;
    let squares: [f64; 6] = std::array::from_fn(|k| mean(&|known| known.motion[k] * known.motion[k]));
    // Either part alone is as large as the errors are: the mixture is looked for between them and a thousandth.
    let whole = mean(&|known| distance(&known.shape, &known.motion).map_or(f64::NAN, |(_, squared)| squared / 6.0));
    if squares.contains(&0.0) || !whole.is_finite() {
        return None;
    }
    let parts = || std::iter::once(0.0).chain((0..=24).map(|k| 10f64.powf(-3.0 + f64::from(k) / 8.0)));
    let distances = |a: f64, b: f64| -> Option<Vec<(f64, f64)>> {
        let floor = squares.map(|square| b * square);
        known.iter().map(|known| distance(&mixed(&known.shape, a * whole, &floor), &known.motion)).collect()
    };
    let unlikely =
        |distances: &[(f64, f64)]| distances.iter().map(|(log_determinant, squared)| log_determinant + squared).sum::<f64>();
    let mixtures = parts().flat_map(|a| parts().map(move |b| (a, b)));
    let likely = mixtures.filter_map(|(a, b)| distances(a, b).map(|distances| (unlikely(&distances), a, b)));
    let (_, a, b) = likely.min_by(|one, other| one.0.total_cmp(&other.0))?;
    let squared: Vec<f64> = distances(a, b)?.into_iter().map(|(_, squared)| squared).collect();
    let factor = within_95(squared.clone());
    let (sizes, of_others) = sizes(known, &squared);
    let of_each = within_95(squared.iter().zip(&of_others).map(|(squared, size)| squared / size).collect());
    let sizes = sizes.into_iter().map(|(instance, size)| (instance, size * of_each / factor)).collect();
    Some((factor * a * whole, squares.map(|square| factor * b * square), sizes))
}

/// By how much ellipsoids are to be enlarged for 95 % of these squared distances to lie within, and of the next one.
fn within_95(mut squared: Vec<f64>) -> f64 {
    squared.sort_by(f64::total_cmp);
    // The next one is as likely to lie anywhere between these: below the rank that 95 % of n + 1 are.
    let rank = (0.95 * (squared.len() as f64 + 1.0)).ceil() as usize;
    // The view of that rank itself lies within, however the ellipsoid is rounded.
    (1.0 + 1e-9) * squared[rank.min(squared.len()) - 1] / WITHIN_95
}

/// How large the squared distances at each object are, drawn to the mean of all by as many views more as make those left out one by one the
/// most likely; none if each object is like all. With them, for each view, the size by the other views of its object.
fn sizes(known: &[Known], squared: &[f64]) -> (BTreeMap<String, f64>, Vec<f64>) {
    let mean = squared.iter().sum::<f64>() / squared.len() as f64;
    let mut sums = BTreeMap::<&str, (f64, f64)>::new();
    for (known, squared) in known.iter().zip(squared) {
        let (views, sum) = sums.entry(&known.instance).or_default();
        (*views, *sum) = (*views + 1.0, *sum + squared);
    }
    let alike = vec![1.0; known.len()];
    let of_others = |more: f64| -> Vec<f64> {
        let of = |(known, squared): (&Known, &f64)| {
            let (views, sum) = sums[&*known.instance];
            (more + (sum - squared) / mean) / (more + views - 1.0)
        };
        known.iter().zip(squared).map(of).collect()
    };
    let unlikely = |sizes: &[f64]| {
        sizes.iter().zip(squared).map(|(size, squared)| 6.0 * size.ln() + 6.0 * squared / mean / size).sum::<f64>()
    };
    let candidates = (0..=5).map(|k| f64::from(1 << k)).map(|more| (more, of_others(more)));
    match candidates.min_by(|(_, one), (_, other)| unlikely(one).total_cmp(&unlikely(other))) {
        Some((more, of_others)) if unlikely(&of_others) < unlikely(&alike) => {
            let size = |(views, sum): (f64, f64)| (more + sum / mean) / (more + views);
            (sums.into_iter().map(|(instance, sums)| (instance.to_string(), size(sums))).collect(), of_others)
        }
        _ => (BTreeMap::new(), alike),
    }
}

/// Standard deviations of an estimate: of the turn in degrees, and of the camera's place in object units; each the root of the sum over
/// three axes.
fn deviations(pose: &DMat4, covariance: &Matrix6) -> (f64, f64) {
    let block = |row: usize, column: usize| {
        let at = |i: usize| DVec3::from_array([0, 1, 2].map(|k| covariance[row + k][column + i]));
        DMat3::from_cols(at(0), at(1), at(2))
    };
    let [turn, turn_shift, shift] = [block(0, 0), block(0, 3), block(3, 3)];
    let trace = |m: DMat3| m.x_axis.x + m.y_axis.y + m.z_axis.z;
    // The camera's place moves by ω × c + υ.
    let DVec3 { x, y, z } = DMat3::from_mat4(*pose).transpose() * pose.w_axis.truncate();
    let cross = DMat3::from_cols(DVec3::new(0.0, -z, y), DVec3::new(z, 0.0, -x), DVec3::new(-y, x, 0.0));
    let place = cross * turn * cross.transpose() + cross * turn_shift + (cross * turn_shift).transpose() + shift;
    (trace(turn).sqrt().to_degrees(), trace(place).sqrt())
}

fn mixed(shape: &Matrix6, curvature: f64, floor: &[f64; 6]) -> Matrix6 {
    let entry = |i: usize, j: usize| curvature * shape[i][j] + if i == j { floor[i] } else { 0.0 };
    std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
}

/// The logarithm of a covariance's determinant, and the squared distance of a motion from none in its units; `None` if it is not positive.
fn distance(covariance: &Matrix6, motion: &[f64; 6]) -> Option<(f64, f64)> {
    let lower = cholesky(covariance)?;
    let log_determinant = (0..6).map(|k| 2.0 * lower[k][k].ln()).sum();
    Some((log_determinant, forward(&lower, *motion).iter().map(|x| x * x).sum()))
}

/// By how much second derivatives and a gradient promise a lower loss, `½ gᵀ B⁻¹ g`: nothing where they are not those near a minimum.
pub(crate) fn promise(curvature: &Matrix6, gradient: &[f64; 6]) -> f64 {
    let squares = |lower: Matrix6| forward(&lower, *gradient).iter().map(|x| x * x).sum::<f64>();
    cholesky(curvature).map_or(0.0, |lower| 0.5 * squares(lower))
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;
    use crate::camera::look_at_origin;
    use crate::confidence::Seen;
    use crate::confidence::tests::{calibration, curvature, estimate};
    use crate::mask::Outline;
    use crate::random::{normal, stream};

    #[test]
    fn second_derivatives_promise_what_the_way_to_the_minimum_brings() {
        let way = [0.1, -0.2, 0.0, 0.3, 0.05, -0.4];
        let product = |by: &[f64; 6]| curvature().map(|row| row.iter().zip(by).map(|(b, x)| b * x).sum::<f64>());
        let gradient = product(&way);
        let brings = 0.5 * gradient.iter().zip(&way).map(|(g, x)| g * x).sum::<f64>();
        assert!((promise(&curvature(), &gradient) / brings - 1.0).abs() < 1e-12);
        let saddle: Matrix6 = std::array::from_fn(|i| std::array::from_fn(|j| if i != j { 0.0 } else { 2.0 - i as f64 }));
        assert_eq!([promise(&saddle, &gradient), promise(&[[f64::NAN; 6]; 6], &gradient)], [0.0; 2]);
    }

    /// Where a picture shows the object smaller than those of the calibration, all errors grow; where it is farther away, that along the view.
    #[test]
    fn what_is_far_away_is_less_sure() {
        let far = estimate(look_at_origin(DVec3::new(0.0, 2.6, 0.0)));
        let known = calibration(0.0, [1.0; 6]);
        let variances = |seen| {
            let covariance = far.covariance("", &Calibration { seen, ..known.clone() }).unwrap();
            [0, 3, 5].map(|k| (1e6 * covariance[k][k]).round() / 1e6)
        };
        assert_eq!(variances(None), [1.0; 3]);
        assert_eq!(variances(Some(Seen { distance: 1.3, extent: 0.5 })), [1.0, 1.0, 4.0]);
        assert_eq!(variances(Some(Seen { distance: 1.3, extent: 1.5 })), [27.0, 27.0, 108.0]);
        assert_eq!(variances(Some(Seen { distance: 5.2, extent: 0.1 })), [1.0; 3]);
        let known = Calibration { seen: Some(Seen { distance: 1.3, extent: 0.9 }), ..known };
        assert_eq!([0.4, 0.5].map(|extent| known.is_small(extent)), [true, false]);
    }

    #[test]
    fn what_is_half_hidden_is_less_sure() {
        let at = estimate(look_at_origin(DVec3::new(0.0, 1.3, 0.0)));
        let variances = |is_without_outline, in_sight| {
            let estimate = Estimate { is_without_outline, in_sight, ..at.clone() };
            let covariance = estimate.covariance("", &calibration(0.0, [1e-4; 6])).unwrap();
            [0, 5].map(|k| (1e4 * covariance[k][k]).round())
        };
        assert_eq!([1.0, 0.5, 0.25].map(|in_sight| variances(false, in_sight)), [[1.0; 2], [2.0; 2], [4.0; 2]]);
        // What hides all around it has a factor of its own.
        assert_eq!([1.0, 0.5].map(|in_sight| variances(true, in_sight)), [[8.0; 2]; 2]);
    }

    /// An outline that may be a fifth of a pixel off on one side turns the object by as large a part as that is of half its diagonal, moves it by half that,
    /// and the camera by that part of its distance.
    #[test]
    fn a_mask_leaves_a_pose_less_sure() {
        let deviations = |outline| {
            let estimate = Estimate { outline, ..estimate(look_at_origin(DVec3::new(0.0, 1.3, 0.0))) };
            let covariance = estimate.covariance("", &calibration(0.0, [1e-4; 6])).unwrap();
            // In pixels, of which 16 are half the diagonal.
            [0, 2, 4, 5].map(|k| (1e9 * 16.0 * (covariance[k][k] - 1e-4).sqrt()).round() / 1e9)
        };
        assert_eq!(deviations(None), [0.0; 4]);
        let moved = |dilation, undecided| Outline { dilation, undecided, ..Outline::AS_GIVEN };
        // 0.2² = 0.04, (0.3 · 2)² = 0.36, (0.5 · 2)² = 1.
        for (outline, off) in [
            (Outline::AS_GIVEN, 0.2),
            (moved(2.0, 0.0), 0.4f64.sqrt()),
            (moved(-2.0, 0.0), 0.4f64.sqrt()),
            (moved(0.0, 2.0), 1.04f64.sqrt()),
            (Outline { cut: DVec2::new(0.0, 2.0), ..moved(2.0, 2.0) }, 1.76f64.sqrt()),
        ] {
            let expected = [off, off, 0.5 * off, 1.3 * off].map(|pixels| (1e9 * pixels).round() / 1e9);
            assert_eq!(deviations(Some(outline)), expected, "{outline:?}");
        }
    }

    #[test]
    fn a_motion_does_what_it_says() {
        let from = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let by = [0.1, -0.2, 0.3, 0.02, 0.03, -0.05];
        let to = moved(&from, &by);
        assert!(motion(&from, &to).iter().zip(by).all(|(x, y)| (x - y).abs() < 1e-12), "{:?}", motion(&from, &to));
        // The object's centre as either camera sees it: a turn leaves it in place, a shift of the camera moves it the other way.
        let [before, turned, shifted] = [[0.0; 6], [0.1, -0.2, 0.3, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.02, 0.03, -0.05]]
            .map(|by| moved(&from, &by).inverse().w_axis.truncate());
        assert!((turned - before).length() < 1e-12 && (shifted - before + DVec3::new(0.02, 0.03, -0.05)).length() < 1e-12);
    }

    #[test]
    fn the_shape_is_the_inverse() {
        let mut estimate = estimate(look_at_origin(DVec3::new(1.0, -0.6, 0.5)));
        let (m, shape) = (curvature(), estimate.shape().unwrap());
        for i in 0..6 {
            for j in 0..6 {
                let entry: f64 = (0..6).map(|k| m[i][k] * shape[k][j]).sum();
                assert!((entry - 2.0 * f64::from(i == j)).abs() < 1e-9, "{i} {j} {entry}");
            }
        }
        for entry in [-1.0, f64::NAN] {
            estimate.curvature.as_mut().unwrap()[2][2] = entry;
            assert_eq!(estimate.shape(), None);
        }
    }

    #[test]
    fn ellipsoids_end_where_they_say() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let estimate = estimate(pose);
        // The object's centre stays: a turn alone, and of the covariance only its variance about that axis.
        let floor = [1e-4, 1e10, 1e10, 1e10, 1e10, 1e10];
        let turned = |angle: f64| {
            let turn = DMat3::from_axis_angle(pose.x_axis.truncate(), angle);
            DMat4::from_mat3_translation(turn * DMat3::from_mat4(pose), turn * pose.w_axis.truncate())
        };
        let edge = (1e-4 * WITHIN_95).sqrt();
        let states = |angle| estimate.states(&turned(angle), "box", &calibration(0.0, floor));
        assert_eq!((states(0.99 * edge), states(1.01 * edge)), (Some(true), Some(false)));
    }

    #[test]
    fn deviations_are_those_of_random_motions() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let covariance = estimate(pose).covariance("box", &calibration(1e-5, [1e-6; 6])).unwrap();
        // The sum over the columns of a factor is that over all directions.
        let lower = cholesky(&covariance).unwrap();
        let centre = DMat3::from_mat4(pose).transpose() * pose.w_axis.truncate();
        let (mut turns, mut places) = (0.0, 0.0);
        for k in 0..6 {
            let omega = DVec3::from_array([0, 1, 2].map(|i| lower[i][k]));
            let upsilon = DVec3::from_array([3, 4, 5].map(|i| lower[i][k]));
            turns += omega.length_squared();
            places += (omega.cross(centre) + upsilon).length_squared();
        }
        let (turn, place) = deviations(&pose, &covariance);
        assert!(
            (turn / turns.sqrt().to_degrees() - 1.0).abs() < 1e-9 && (place / places.sqrt() - 1.0).abs() < 1e-9,
            "{turn} {place}"
        );
    }

    /// Errors of both kinds in a known mixture, larger at some objects.
    fn drawn(count: usize, size_of: impl Fn(usize) -> f64, seed: u64) -> Vec<Known> {
        let mut random = stream(1, seed);
        let floor = [4e-4, 1e-4, 1e-4, 1e-5, 1e-5, 4e-5];
        let one = |k: usize| {
            let size = 10f64.powf(normal(&mut random));
            let m = curvature();
            let shape: Matrix6 = std::array::from_fn(|i| std::array::from_fn(|j| size * m[i][j] * 1e-6));
            let lower = cholesky(&mixed(&shape, 0.3, &floor)).unwrap();
            let numbers: [f64; 6] = std::array::from_fn(|_| size_of(k % 100).sqrt() * normal(&mut random));
            let motion = std::array::from_fn(|i| (0..6).map(|k| lower[i][k] * numbers[k]).sum());
            Known { instance: (k % 100).to_string(), motion, shape }
        };
        (0..count).map(one).collect()
    }

    /// The part of views that lie within the ellipsoids that the fit of others makes.
    fn share(found: &(f64, [f64; 6], BTreeMap<String, f64>), others: &[Known]) -> f64 {
        let (curvature, floor, sizes) = found;
        let inside = |known: &&Known| {
            let size = sizes.get(&known.instance).unwrap_or(&1.0);
            distance(&mixed(&known.shape, *curvature, floor), &known.motion).unwrap().1 <= size * WITHIN_95
        };
        others.iter().filter(inside).count() as f64 / others.len() as f64
    }

    #[test]
    fn the_fit_finds_the_mixture() {
        let found = fit(&drawn(400, |_| 1.0, 2)).unwrap();
        assert!((0.2..0.45).contains(&found.0), "{found:?}");
        let share = share(&found, &drawn(2000, |_| 1.0, 3));
        assert!((0.93..0.97).contains(&share) && found.2.values().all(|size| (0.5..2.0).contains(size)), "{share} {found:?}");
        let nowhere = Known { instance: "box".into(), motion: [0.0; 6], shape: curvature() };
        assert_eq!((fit(&[]), fit(&[nowhere])), (None, None));
    }

    #[test]
    fn an_object_that_is_known_badly_has_an_ellipsoid_of_its_own() {
        let size_of = |k: usize| if k < 10 { 16.0 } else { 1.0 };
        let found = fit(&drawn(600, size_of, 4)).unwrap();
        let of = |bad: bool| -> Vec<Known> {
            drawn(4000, size_of, 5).into_iter().filter(|known| (known.instance.len() == 1) == bad).collect()
        };
        let (bad, good) = (share(&found, &of(true)), share(&found, &of(false)));
        assert!((0.8..1.0).contains(&bad) && (0.93..0.98).contains(&good), "{bad} {good} {found:?}");
        // One ellipsoid for all would leave most of them out.
        let alike = (found.0, found.1, BTreeMap::new());
        assert!(share(&alike, &of(true)) < 0.75, "{}", share(&alike, &of(true)));
    }
}
