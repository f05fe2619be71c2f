//! Views whose poses were found by a model of the object, and are fitted along with it.
//!
//! The networks learn a picture as well from a pose that is some degrees off, and are wrong from then on. So poses descend as the networks
//! do, by a few steps in between; views whose poses are known hold the frame.

use glam::{DMat4, DQuat};
use serde::Serialize;
use sigma_srn::camera::pose_error;
use sigma_srn::photo::Shot;
use sigma_srn::{Engine, Model, Options, Phase, Query, estimate};
use srn_data::LoadedView;

use crate::common::{Result, camera};

/// Steps of a descent, at all pixels. It begins anew each time, for the loss has become another one.
const STEPS: u32 = 4;
/// How far poses go of the way to where the descent ends. The networks' shape is a little other from step to step, and poses that follow it all
/// the way wander with it.
const SHARE: f64 = 0.2;

/// Where a pose has come to.
#[derive(Debug, Serialize)]
pub struct Moved {
    pub instance: String,
    pub view: String,
    /// Rows.
    pub world_from_camera: [[f64; 4]; 4],
    /// The angle from where it was.
    pub moved_deg: f64,
}

impl Moved {
    /// From one view to the other, which is the same with another pose.
    pub fn between(instance: String, before: &LoadedView, after: &LoadedView) -> Self {
        let [from, to] = [before, after].map(|view| camera(view).0);
        let (moved_deg, _) = pose_error(&to, &from);
        Moved { instance, view: after.name.clone(), world_from_camera: to.transpose().to_cols_array_2d(), moved_deg }
    }
}

/// Moves the poses of these views of the model's instances a part of the way to where a few steps of a descent lead, `side` pixels square.
pub fn descend(engine: &Engine, model: &Model, views: &mut [(u32, LoadedView)], side: u32) -> Result<()> {
    if views.is_empty() {
        return Ok(());
    }
    let queries: Vec<Query> = views.iter().map(|(instance, view)| query(*instance, view, side)).collect();
    let phase = Phase { steps: STEPS, stride: 1, keep: 1, light: false, closer_look: false, outlines: false };
    let options = Options { phases: vec![phase], min_starts: 0, align: false, anew: 0, settle: 0, ..Options::default() };
    for ((_, view), estimate) in views.iter_mut().zip(estimate(engine, model, &queries, &options, |_| Ok(()))?) {
        let (from, to) = (camera(view).0, estimate.pose.to_matrix());
        let rotation = DQuat::from_mat4(&from).slerp(DQuat::from_mat4(&to), SHARE);
        let centre = from.w_axis.truncate().lerp(to.w_axis.truncate(), SHARE);
        view.world_from_camera = DMat4::from_rotation_translation(rotation, centre).transpose().to_cols_array();
    }
    Ok(())
}

/// From where it is.
fn query(instance: u32, view: &LoadedView, side: u32) -> Query {
    let (world_from_camera, intrinsics): (DMat4, _) = camera(view);
    Shot::whole(view.rgb.clone(), intrinsics, instance, side).query(vec![world_from_camera])
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use glam::DVec3;
    use srn_data::SrnSet;

    use super::*;

    #[test]
    fn poses_move_towards_the_truth() {
        let assets = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets"));
        let model = Model::load(&assets.join("models/compact.safetensors")).unwrap();
        let set = SrnSet::open(assets.join("dataset/test")).unwrap().load(64).unwrap();
        let off = DMat4::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 4_f64.to_radians());
        let views = set.instances.iter().map(|of| (model.instance(&of.name).unwrap(), of.views[6].clone()));
        let (truths, mut views): (Vec<_>, Vec<_>) = views
            .map(|(instance, view)| {
                let truth = camera(&view).0;
                (truth, (instance, LoadedView { world_from_camera: (off * truth).transpose().to_cols_array(), ..view }))
            })
            .unzip();
        // A part of the way each time: 4° · 0.8³ = 2.0°, and the first steps do not lead all the way.
        (0..3).for_each(|_| descend(&Engine::cpu(), &model, &mut views, 64).unwrap());
        for ((instance, view), truth) in views.iter().zip(&truths) {
            let (degrees, _) = pose_error(&camera(view).0, truth);
            assert!(degrees < 3.0, "{}: {degrees}", model.instance_name(*instance));
        }
        descend(&Engine::cpu(), &model, &mut [], 64).unwrap();
    }
}
