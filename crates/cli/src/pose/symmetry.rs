//! Rotations after which an object looks the same: from which of such sides a picture was taken, nobody can say.

use std::f64::consts::TAU;

use glam::{DMat3, DMat4, DVec3};
use serde::Serialize;
use sigma_srn::camera::around84;
use sigma_srn::{Intrinsics, View};

use super::search::{On, render};
use super::views::Views;
use crate::common::Result;
use crate::progress;

/// Views that are compared.
const VIEWS: usize = 12;
/// Turns about each axis, degrees.
const TURNS: [u32; 15] = [30, 45, 60, 90, 120, 135, 150, 180, 210, 225, 240, 270, 300, 315, 330];
/// The part of the object's views that may differ: the sum of absolute differences, over that to empty pictures.
const LIMIT: f64 = 0.1;

/// The rotations about the world's origin that an object does not show.
#[derive(Clone, Debug, Serialize)]
pub struct Symmetries {
    /// Axis (x, y, z: 0, 1, 2) and angle in degrees.
    turns: Vec<(usize, u32)>,
    /// The axis about which any angle will do.
    round: Option<usize>,
}

impl Symmetries {
    /// Of an object that looks different from everywhere.
    pub fn none() -> Self {
        Symmetries { turns: vec![], round: None }
    }

    /// Those of the instance that these are views of, found by comparing the model's own from as far away; none where they do not count.
    pub fn of(on: On, views: &Views, count: bool) -> Result<Self> {
        let (Some(picture), Some(truth), true) = (views.pictures.first(), views.truths.first(), count) else {
            return Ok(Symmetries::none());
        };
        Symmetries::find(on, picture.shot.instance, picture.shot.intrinsics, truth.w_axis.truncate().length())
    }

    /// Those of an instance, found by comparing the model's own views from `radius` away.
    pub fn find(on: On, instance: u32, intrinsics: Intrinsics, radius: f64) -> Result<Self> {
        // Small pictures show it as well.
        let on = On { side: (on.side / 2).max(1), ..on };
        let Intrinsics { fx, fy, cx, cy, pixel_center } = intrinsics;
        let intrinsics = Intrinsics { fx: 0.5 * fx, fy: 0.5 * fy, cx: 0.5 * cx, cy: 0.5 * cy, pixel_center };
        let around = around84(radius);
        let cameras: Vec<DMat4> = (0..VIEWS).map(|k| around[k * around.len() / VIEWS]).collect();
        let seen = |turn: DMat4| -> Result<Vec<f32>> {
            let views: Vec<View> = cameras.iter().map(|camera| (instance, turn * *camera, intrinsics)).collect();
            Ok(render(on, &views)?.into_iter().flat_map(|view| view.rgb).collect())
        };
        let sum = |values: &mut dyn Iterator<Item = f32>| values.map(|value| f64::from(value.abs())).sum::<f64>();
        let plain = seen(DMat4::IDENTITY)?;
        let object = sum(&mut plain.iter().map(|value| value - 1.0));
        let mut turns = Vec::new();
        let bar = progress::bar(3 * TURNS.len() as u64, "symmetries");
        for axis in 0..3 {
            for degrees in TURNS {
                let turned = seen(DMat4::from_mat3(turn(axis, f64::from(degrees).to_radians())))?;
                if sum(&mut plain.iter().zip(&turned).map(|(a, b)| a - b)) <= LIMIT * object {
                    turns.push((axis, degrees));
                }
                bar.inc(1);
            }
        }
        bar.finish_and_clear();
        let round = (0..3).find(|&axis| turns.iter().filter(|turn| turn.0 == axis).count() == TURNS.len());
        Ok(Symmetries { turns, round })
    }

    /// Of all poses that look like `truth`, the one nearest to `pose`.
    pub fn nearest(&self, truth: &DMat4, pose: &DMat4) -> DMat4 {
        let rotations = self.turns.iter().map(|&(axis, degrees)| turn(axis, f64::from(degrees).to_radians()));
        let alike = std::iter::once(DMat3::IDENTITY).chain(rotations).map(|rotation| {
            let candidate = DMat4::from_mat3(rotation) * *truth;
            self.round.map_or(candidate, |axis| DMat4::from_mat3(turn(axis, best_angle(axis, &candidate, pose))) * candidate)
        });
        let closeness = |candidate: &DMat4| trace(&(DMat3::from_mat4(*pose).transpose() * DMat3::from_mat4(*candidate)));
        alike.max_by(|a, b| closeness(a).total_cmp(&closeness(b))).unwrap_or(*truth)
    }
}

fn trace(m: &DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

fn turn(axis: usize, angle: f64) -> DMat3 {
    DMat3::from_axis_angle([DVec3::X, DVec3::Y, DVec3::Z][axis], angle)
}

/// The angle about an axis that brings one camera's rotation nearest to another: where the trace of `Rᵀ turn(φ) C`, which is
/// `a cos φ + b sin φ + c`, is largest.
fn best_angle(axis: usize, from: &DMat4, to: &DMat4) -> f64 {
    let value = |angle: f64| trace(&(DMat3::from_mat4(*to).transpose() * turn(axis, angle) * DMat3::from_mat4(*from)));
    let [zero, quarter, half] = [0.0, 0.25, 0.5].map(|part| value(part * TAU));
    let constant = 0.5 * (zero + half);
    (quarter - constant).atan2(zero - constant)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::search::PoseError;
    use sigma_srn::camera::look_at_origin;

    #[test]
    fn the_nearest_of_what_looks_alike() {
        let truth = look_at_origin(DVec3::new(1.0, 0.4, 0.5));
        let half = Symmetries { turns: vec![(2, 180)], round: None };
        let other = DMat4::from_mat3(turn(2, 3.0)) * truth;
        let error = |symmetries: &Symmetries| PoseError::of(&other, &symmetries.nearest(&truth, &other)).rotation_deg;
        assert!((error(&Symmetries::none()) - 3f64.to_degrees()).abs() < 1e-9);
        assert!((error(&half) - (TAU / 2.0 - 3.0).to_degrees()).abs() < 1e-9);
        let round = Symmetries { turns: vec![(0, 180)], round: Some(2) };
        assert!(error(&round) < 1e-5);
        let upside_down = DMat4::from_mat3(turn(2, 0.7) * turn(0, TAU / 2.0)) * truth;
        assert!(PoseError::of(&upside_down, &round.nearest(&truth, &upside_down)).rotation_deg < 1e-5);
    }
}
