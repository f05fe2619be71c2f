//! How sure an estimate is. The second derivatives `B` of the loss say how a pose error shows in the picture, and so in which
//! directions it can hide; how large the errors are, with what the renderer does not know of the object, only known poses can tell.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::estimator::{Estimate, Ranked};

/// What estimates of known poses told of a model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Factor from `loss · B⁻¹` to the covariance of an estimate.
    pub covariance: f64,
    /// Part of a picture that an estimate to be trusted leaves unexplained at most.
    pub unexplained: f64,
    /// How much higher, as a part, the loss must be at the next best pose elsewhere for an estimate to be trusted.
    pub rival: f64,
    /// Number of estimates that this is from.
    pub views: u32,
}

/// What the squared distance of six normal numbers from their mean, in units of their covariance, is below in 95 % of all cases.
pub const WITHIN_95: f64 = 12.591_587;

/// How far apart poses are that are not the same minimum: a turn about the object in degrees.
const ELSEWHERE_DEG: f64 = 10.0;

/// The motion `(ω, υ)` about the object that takes one pose to another, in the axes of the first one's camera: the camera turned about the
/// object's centre by `ω` (radians), then shifted by `υ` (object units).
pub fn motion(from: &DMat4, to: &DMat4) -> [f64; 6] {
    let camera_from_world = DMat3::from_mat4(*from).transpose();
    let turn = camera_from_world * DMat3::from_mat4(*to);
    let shift = camera_from_world * to.w_axis.truncate() - turn * (camera_from_world * from.w_axis.truncate());
    let [a, b, c] = DQuat::from_mat3(&turn).normalize().to_scaled_axis().to_array();
    [a, b, c, shift.x, shift.y, shift.z]
}

impl Estimate {
    /// Covariance of the motion from the estimated pose to the true one, see [`motion`]. `None` without second derivatives, or where they
    /// are not those of a minimum.
    pub fn covariance(&self, calibration: &Calibration) -> Option<[[f64; 6]; 6]> {
        let inverse = inverse(self.curvature.as_ref()?)?;
        Some(inverse.map(|row| row.map(|value| calibration.covariance * self.loss * value)))
    }

    /// Squared distance of a pose from the estimate in units of `loss · B⁻¹`: over [`Calibration::covariance`], in units of the
    /// covariance. `None` where that is none.
    pub fn squared_distance(&self, pose: &DMat4) -> Option<f64> {
        let curvature = self.curvature.as_ref()?;
        inverse(curvature)?;
        let xi = motion(&self.pose.to_matrix(), pose);
        let product = curvature.iter().zip(xi).map(|(row, x)| x * row.iter().zip(xi).map(|(b, x)| b * x).sum::<f64>());
        Some(product.sum::<f64>() / self.loss)
    }

    /// Whether a pose lies within the ellipsoid that 95 % of all true poses lie in, if the errors are normal.
    pub fn states(&self, pose: &DMat4, calibration: &Calibration) -> Option<bool> {
        Some(self.squared_distance(pose)? <= WITHIN_95 * calibration.covariance)
    }

    /// The best of the other starts that went as far as the winner, but to a pose elsewhere, and by which part its loss is higher.
    pub fn rival(&self) -> Option<(&Ranked, f64)> {
        let winner = self.ranking.first()?;
        let is_elsewhere = |other: &&Ranked| {
            let [a, b, c, ..] = motion(&winner.pose.to_matrix(), &other.pose.to_matrix());
            other.phases == winner.phases && DVec3::new(a, b, c).length().to_degrees() > ELSEWHERE_DEG
        };
        let rival = self.ranking[1..].iter().find(is_elsewhere)?;
        Some((rival, rival.loss / self.loss - 1.0))
    }
}

/// Standard deviations of an estimate: of the turn in degrees, and of the camera's place in object units; each the root of the sum over
/// three axes.
pub fn deviations(pose: &DMat4, covariance: &[[f64; 6]; 6]) -> (f64, f64) {
    let [turn, turn_shift, shift] = blocks(covariance);
    let trace = |m: DMat3| m.x_axis.x + m.y_axis.y + m.z_axis.z;
    // The camera's place moves by ω × c + υ.
    let DVec3 { x, y, z } = DMat3::from_mat4(*pose).transpose() * pose.w_axis.truncate();
    let cross = DMat3::from_cols(DVec3::new(0.0, -z, y), DVec3::new(z, 0.0, -x), DVec3::new(-y, x, 0.0));
    let place = cross * turn * cross.transpose() + cross * turn_shift + (cross * turn_shift).transpose() + shift;
    (trace(turn).sqrt().to_degrees(), trace(place).sqrt())
}

/// The blocks of a symmetric matrix: above left, above right, below right.
fn blocks(m: &[[f64; 6]; 6]) -> [DMat3; 3] {
    [(0, 0), (0, 3), (3, 3)].map(|(row, column)| {
        let at = |i: usize| DVec3::new(m[row][column + i], m[row + 1][column + i], m[row + 2][column + i]);
        DMat3::from_cols(at(0), at(1), at(2))
    })
}

/// The inverse of a symmetric positive matrix, by its blocks.
fn inverse(m: &[[f64; 6]; 6]) -> Option<[[f64; 6]; 6]> {
    let [a, b, d] = blocks(m);
    let is_positive = |m: &DMat3| {
        let minor = m.x_axis.x * m.y_axis.y - m.x_axis.y * m.y_axis.x;
        m.is_finite() && m.x_axis.x > 0.0 && minor > 0.0 && m.determinant() > 0.0
    };
    let d = Some(d).filter(is_positive)?.inverse();
    let a = Some(a - b * d * b.transpose()).filter(is_positive)?.inverse();
    let b = -(a * b * d);
    let d = d + b.transpose() * a.inverse() * b;
    let at = |row: usize, column: usize| match (row < 3, column < 3) {
        (true, true) => a.col(column)[row],
        (true, false) => b.col(column - 3)[row],
        (false, true) => b.col(row - 3)[column],
        (false, false) => d.col(column - 3)[row - 3],
    };
    Some(std::array::from_fn(|row| std::array::from_fn(|column| at(row, column))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Pose6, camera::look_at_origin};

    /// A positive matrix with unlike scales.
    fn curvature() -> [[f64; 6]; 6] {
        let factor: [[f64; 6]; 6] =
            std::array::from_fn(|i| std::array::from_fn(|j| ((3 * i + 5 * j) % 7) as f64 - 3.0 + if i == j { 9.0 } else { 0.0 }));
        std::array::from_fn(|i| std::array::from_fn(|j| (0..6).map(|k| factor[i][k] * factor[j][k]).sum()))
    }

    fn estimate(pose: DMat4) -> Estimate {
        let pose = Pose6::from_matrix(&pose);
        let ranked = |start, loss, pose| Ranked { start, loss, phases: 4, pose };
        let turned = Pose6::from_matrix(&(DMat4::from_rotation_z(1.0) * pose.to_matrix()));
        let ranking = vec![ranked(7, 2.0, pose), ranked(3, 2.1, pose), ranked(5, 3.0, turned)];
        Estimate { pose, loss: 2.0, curvature: Some(curvature()), ranking }
    }

    #[test]
    fn a_motion_does_what_it_says() {
        let from = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let (omega, upsilon) = (DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.02, 0.03, -0.05));
        let rotation = DMat3::from_mat4(from);
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(omega));
        let place = rotation * (turn * (rotation.transpose() * from.w_axis.truncate()) + upsilon);
        let to = DMat4::from_mat3_translation(rotation * turn, place);
        let expected = [0.1, -0.2, 0.3, 0.02, 0.03, -0.05];
        assert!(motion(&from, &to).iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-12), "{:?}", motion(&from, &to));
    }

    #[test]
    fn the_inverse_is_one() {
        let m = curvature();
        let product = inverse(&m).unwrap();
        for i in 0..6 {
            for j in 0..6 {
                let entry: f64 = (0..6).map(|k| m[i][k] * product[k][j]).sum();
                assert!((entry - f64::from(i == j)).abs() < 1e-9, "{i} {j} {entry}");
            }
        }
        let mut saddle = m;
        saddle[2][2] = -1.0;
        assert_eq!((inverse(&saddle), inverse(&[[f64::NAN; 6]; 6])), (None, None));
    }

    #[test]
    fn distances_are_those_of_the_covariance() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let estimate = estimate(pose);
        let other = look_at_origin(DVec3::new(1.1, -0.5, 0.5));
        let calibration = Calibration { covariance: 0.5, unexplained: 1.0, rival: 0.0, views: 1 };
        let covariance = estimate.covariance(&calibration).unwrap();
        let (xi, precision) = (motion(&pose, &other), inverse(&covariance).unwrap());
        let direct: f64 = (0..6).map(|i| (0..6).map(|j| xi[i] * precision[i][j] * xi[j]).sum::<f64>()).sum();
        let distance = estimate.squared_distance(&other).unwrap() / calibration.covariance;
        assert!((distance / direct - 1.0).abs() < 1e-9, "{distance} {direct}");
        assert_eq!(estimate.squared_distance(&estimate.pose.to_matrix()).map(|d| d < 1e-20), Some(true));
    }

    #[test]
    fn deviations_are_those_of_random_motions() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let covariance =
            estimate(pose).covariance(&Calibration { covariance: 1e-5, unexplained: 1.0, rival: 0.0, views: 1 }).unwrap();
        // The sum over the covariance's principal directions, here those of a Cholesky factor, is that of all.
        let mut lower = [[0.0; 6]; 6];
        for i in 0..6 {
            for j in 0..=i {
                let sum: f64 = covariance[i][j] - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
                lower[i][j] = if i == j { sum.sqrt() } else { sum / lower[j][j] };
            }
        }
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

    #[test]
    fn a_rival_is_elsewhere() {
        let estimate = estimate(look_at_origin(DVec3::new(1.0, -0.6, 0.5)));
        let (rival, higher) = estimate.rival().unwrap();
        assert_eq!((rival.start, higher), (5, 0.5));
    }
}
