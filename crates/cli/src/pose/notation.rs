//! How poses are written outside: the axes of their cameras, and the frame and units that they are in.

use std::path::{Path, PathBuf};

use clap::Args;
use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::Serialize;
use sigma_srn::Confidence;
use sigma_srn::confidence::Matrix6;
use srn_data::camera::Axes;
use srn_data::capture::{FrameRecord, moved};

use super::search::PoseError;
use crate::common::{Result, axes};

/// Flags that say how poses are given and printed. Those inside of data sets are as data sets are: OpenCV's axes, the object's frame.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Poses")]
pub struct NotationArgs {
    /// Axes of the cameras in all poses given and printed: opencv (x right, y down, z forward), opengl (x right, y up, z back),
    /// pytorch3d (x left, y up, z forward) or ros (x forward, y left, z up).
    #[arg(long, value_name = "AXES", default_value = Axes::OpenCv.name(), value_parser = axes)]
    pub convention: Axes,
    /// The frame.json that `sigma-data import` wrote: poses are given and printed in the frame and units of the source that it tells
    /// of. Default: the data set's frame, in object units.
    #[arg(long, value_name = "FILE")]
    pub frame: Option<PathBuf>,
}

/// Poses from the outside to ours, and back.
#[derive(Clone, Copy, Debug)]
pub struct Notation {
    /// Axes of the cameras.
    pub axes: Axes,
    world_from_source: DMat4,
}

/// The object as the camera has it: a `PoseWithCovariance` of ROS.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ObjectPose {
    /// The origin of the frame that poses are in.
    position: [f64; 3],
    /// Quaternion (x, y, z, w) of the rotation that takes directions in that frame to the camera's axes.
    orientation: [f64; 4],
    /// Of the position, then of a turn (rad) about the camera's axes; if the model is calibrated.
    covariance: Option<Matrix6>,
}

impl Default for Notation {
    /// As inside.
    fn default() -> Self {
        Notation { axes: Axes::OpenCv, world_from_source: DMat4::IDENTITY }
    }
}

impl NotationArgs {
    /// Reads the file of --frame.
    pub fn open(&self) -> Result<Notation> {
        Ok(self.source(None)?.unwrap_or(Notation { axes: self.convention, ..Notation::default() }))
    }

    /// How poses are written in the source of the instance in folder `dir`, if it was imported, or in that of --frame.
    pub fn source(&self, dir: Option<&Path>) -> Result<Option<Notation>> {
        let record = match (&self.frame, dir) {
            (Some(file), _) => Some(FrameRecord::open(file)?),
            (None, Some(dir)) => FrameRecord::read(dir)?,
            (None, None) => None,
        };
        Ok(record.map(|record| Notation { axes: self.convention, world_from_source: record.matrix() }))
    }
}

impl Notation {
    /// Our `world_from_camera` of a pose from outside.
    pub fn ours(&self, pose: DMat4) -> DMat4 {
        moved(&self.world_from_source, &self.axes.to_ours(pose))
    }

    /// Our `world_from_camera` as the outside wants it.
    pub fn written(&self, world_from_camera: &DMat4) -> DMat4 {
        moved(&self.world_from_source.inverse(), &self.axes.of_ours(*world_from_camera))
    }

    /// One object unit, outside.
    pub fn unit(&self) -> f64 {
        1.0 / self.world_from_source.x_axis.truncate().length()
    }

    /// A deviation, from object units.
    pub fn confidence(&self, of: Confidence) -> Confidence {
        let unit = |k: usize| if k < 3 { 1.0 } else { self.unit() };
        let covariance = std::array::from_fn(|i| std::array::from_fn(|k| unit(i) * unit(k) * of.covariance[i][k]));
        Confidence { translation: self.unit() * of.translation, covariance, ..of }
    }

    /// The object in the camera, of our `world_from_camera` and, in object units, how far off it may be.
    pub fn object(&self, world_from_camera: &DMat4, confidence: Option<Confidence>) -> ObjectPose {
        let camera_from_source = self.written(world_from_camera).inverse();
        let position = camera_from_source.w_axis.truncate();
        // The camera moves about the object's centre by (ω, υ); in its axes the object's origin, at an arm `a` from there, then moves by a × ω - υ and the object
        // turns by -ω.
        let axes_from_ours = DMat3::from_mat4(self.axes.from_ours());
        let centre = self.unit() * (axes_from_ours * world_from_camera.inverse().w_axis.truncate());
        let columns: [[f64; 6]; 6] = std::array::from_fn(|k| {
            let unit = |first: usize| DVec3::from_array(std::array::from_fn(|i| f64::from(u8::from(first + i == k))));
            let [turn, shift] = [unit(0), unit(3)].map(|v| axes_from_ours * v);
            let [[x, y, z], [a, b, c]] = [(position - centre).cross(turn) - shift, -turn].map(|v| v.to_array());
            [x, y, z, a, b, c]
        });
        let of = |covariance: Matrix6| {
            let entry = |i: usize, j: usize| -> f64 {
                (0..36).map(|n| (n / 6, n % 6)).map(|(k, l)| columns[k][i] * covariance[k][l] * columns[l][j]).sum()
            };
            std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
        };
        ObjectPose {
            position: position.to_array(),
            orientation: DQuat::from_mat4(&camera_from_source).normalize().to_array(),
            covariance: confidence.map(|confidence| of(self.confidence(confidence).covariance)),
        }
    }

    /// An error, from object units.
    pub fn error(&self, of: PoseError) -> PoseError {
        PoseError { translation: self.unit() * of.translation, ..of }
    }

    /// The matrix as rows.
    pub fn rows(&self, world_from_camera: &DMat4) -> [[f64; 4]; 4] {
        self.written(world_from_camera).transpose().to_cols_array_2d()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec4;
    use sigma_srn::confidence;
    use srn_data::camera::look_at_origin;

    #[test]
    fn there_and_back() {
        let pose = look_at_origin(DVec3::new(0.3, 0.9, 0.5));
        // An object of 250 mm, at (100, 0, 20), turned.
        let turn = DQuat::from_rotation_x(0.4);
        let source_from_world = DMat4::from_scale_rotation_translation(DVec3::splat(250.0), turn, DVec3::new(100.0, 0.0, 20.0));
        for axes in Axes::ALL {
            let notation = Notation { axes, world_from_source: source_from_world.inverse() };
            let written = notation.written(&pose);
            assert!(notation.ours(written).abs_diff_eq(pose, 1e-12));
            assert!(written.w_axis.truncate().abs_diff_eq(source_from_world.transform_point3(pose.w_axis.truncate()), 1e-9));
            assert!((notation.unit() - 250.0).abs() < 1e-9 && (written.determinant() - 1.0).abs() < 1e-12);
        }
        let notation = Notation { axes: Axes::OpenCv, world_from_source: source_from_world.inverse() };
        let covariance = std::array::from_fn(|i| std::array::from_fn(|k| f64::from(u8::from(i == k))));
        let written = notation.confidence(Confidence { rotation_deg: 1.0, translation: 0.02, covariance });
        assert!(written.rotation_deg == 1.0 && (written.translation - 5.0).abs() < 1e-9);
        let apart = |k: usize, variance: f64| (written.covariance[k][k] / variance - 1.0).abs();
        assert!(apart(2, 1.0) < 1e-9 && apart(3, 62_500.0) < 1e-9, "{:?}", written.covariance);
        let plain = Notation { axes: Axes::OpenGl, world_from_source: DMat4::IDENTITY };
        assert_eq!(plain.written(&look_at_origin(2.0 * DVec3::X)).z_axis, DVec4::X);
    }

    /// A single motion has the covariance of itself with itself: the object's must be that of how it moves in the camera.
    #[test]
    fn the_object_moves_against_the_camera() {
        let pose = look_at_origin(DVec3::new(0.3, 0.9, 0.5));
        let turn = DQuat::from_rotation_x(0.4);
        let source_from_world = DMat4::from_scale_rotation_translation(DVec3::splat(250.0), turn, DVec3::new(100.0, 0.0, 20.0));
        let (omega, upsilon) = (DVec3::new(1e-6, -2e-6, 3e-6), DVec3::new(2e-6, 1e-6, -4e-6));
        let rotation = DMat3::from_mat4(pose);
        let turned = rotation * DMat3::from_quat(DQuat::from_scaled_axis(omega));
        let place = turned * (rotation.transpose() * pose.w_axis.truncate()) + rotation * upsilon;
        let moved = DMat4::from_mat3_translation(turned, place);
        let motion = [omega.x, omega.y, omega.z, upsilon.x, upsilon.y, upsilon.z];
        assert!(confidence::motion(&pose, &moved).iter().zip(motion).all(|(a, b)| (a - b).abs() < 1e-12));
        let covariance = std::array::from_fn(|i| std::array::from_fn(|j| motion[i] * motion[j]));
        for (axes, world_from_source) in [(Axes::OpenCv, DMat4::IDENTITY), (Axes::Ros, source_from_world.inverse())] {
            let notation = Notation { axes, world_from_source };
            let confidence = Confidence { rotation_deg: 0.0, translation: 0.0, covariance };
            let [before, after] = [pose, moved].map(|pose| notation.object(&pose, Some(confidence)));
            let [one, other] = [before, after].map(|object| DQuat::from_array(object.orientation));
            let shift = DVec3::from_array(after.position) - DVec3::from_array(before.position);
            let moved = [shift, (other * one.inverse()).to_scaled_axis()].map(|v| v.to_array()).concat();
            for (i, row) in before.covariance.unwrap().into_iter().enumerate() {
                for (j, entry) in row.into_iter().enumerate() {
                    let size = moved[i].abs().max(1e-6) * moved[j].abs().max(1e-6);
                    assert!((entry - moved[i] * moved[j]).abs() < 1e-4 * size, "{axes:?} {i} {j}: {entry} {moved:?}");
                }
            }
            // What is at the origin of the frame is there.
            let origin = notation.written(&pose).inverse().transform_point3(DVec3::ZERO);
            assert!(origin.abs_diff_eq(DVec3::from_array(before.position), 1e-9));
            assert!(notation.object(&pose, None).covariance.is_none());
        }
    }
}
