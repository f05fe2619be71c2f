//! How poses are written outside: the axes of their cameras, and the frame and units that they are in.

use std::path::{Path, PathBuf};

use clap::Args;
use glam::DMat4;
use sigma_srn::Confidence;
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
    use glam::{DQuat, DVec3, DVec4};
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
}
