//! How sure an estimate is. The second derivatives `B` of the loss say how a pose error shows in the picture, and so in which
//! directions it can hide. The renderer does not know the object exactly; how far off that leaves the poses, only known ones can tell.

mod deviation;
mod doubt;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

pub use self::deviation::{Confidence, Known, Matrix6, WITHIN_95, fit, motion};
pub(crate) use self::deviation::{moved, promise};
pub use self::doubt::{Doubt, LEAST_UNEXPLAINED, UNEXPLAINED, unexplained, unexplained_doubt};
pub(crate) use self::doubt::{ELSEWHERE_DEG, explains_colours, hidden_doubt};

/// What estimates of known poses told of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// The covariance of an estimate is this times `loss · B⁻¹`,
    pub curvature: f64,
    /// and these variances on its diagonal: what the errors of all estimates have in common;
    pub floor: [f64; 6],
    /// by instance, so many times both together, where the errors at one object tell of those at another view of it. Others: 1.
    #[serde(default)]
    pub sizes: BTreeMap<String, f64>,
    /// Part of a picture that an estimate to be trusted leaves unexplained at most.
    pub unexplained: f64,
    /// By instance, the part of a picture that its true poses leave unexplained at most: the network knows one object better than another.
    #[serde(default)]
    pub at_truth: BTreeMap<String, f64>,
    /// How many times that an estimate to be trusted leaves unexplained at most.
    #[serde(default)]
    pub above_truth: f64,
    /// How much higher, as a part, the loss must be at the next best pose elsewhere for an estimate to be trusted.
    pub rival: f64,
    /// Number of estimates that this is from.
    pub views: u32,
    /// How large and how far away their objects were.
    #[serde(default)]
    pub seen: Option<Seen>,
}

/// How the estimates of a [`Calibration`] see their objects, the medians.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// Distance of the camera from the object's centre, object units.
    pub distance: f64,
    /// See [`Estimate::extent`](crate::Estimate::extent).
    pub extent: f64,
}

/// What the tests of both parts need.
#[cfg(test)]
mod tests {
    use glam::DMat4;

    use super::*;
    use crate::camera::Pose6;
    use crate::estimator::{Estimate, Ranked};

    /// A positive matrix with unlike scales.
    pub fn curvature() -> Matrix6 {
        let factor: Matrix6 =
            std::array::from_fn(|i| std::array::from_fn(|j| ((3 * i + 5 * j) % 7) as f64 - 3.0 + if i == j { 9.0 } else { 0.0 }));
        std::array::from_fn(|i| std::array::from_fn(|j| (0..6).map(|k| factor[i][k] * factor[j][k]).sum()))
    }

    pub fn estimate(pose: DMat4) -> Estimate {
        let pose = Pose6::from_matrix(&pose);
        let ranked = |start, loss, pose| Ranked { start, loss, phases: 4, pose };
        let turned = Pose6::from_matrix(&(DMat4::from_rotation_z(1.0) * pose.to_matrix()));
        let ranking = vec![ranked(7, 2.0, pose), ranked(3, 2.1, pose), ranked(5, 3.0, turned)];
        Estimate {
            pose,
            loss: 2.0,
            curvature: Some(curvature()),
            light: None,
            outline: None,
            is_without_outline: false,
            in_sight: 1.0,
            target: vec![],
            weights: None,
            width: 64,
            extent: 0.5,
            ranking,
        }
    }

    pub fn calibration(curvature: f64, floor: [f64; 6]) -> Calibration {
        let (sizes, at_truth) = (BTreeMap::new(), BTreeMap::new());
        Calibration { curvature, floor, sizes, unexplained: 1.0, at_truth, above_truth: 0.0, rival: 0.0, views: 1, seen: None }
    }
}
