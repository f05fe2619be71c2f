//! Follows an object through the frames of a video: a camera that goes about it, six degrees from one frame to the next.
//!
//! `cargo run --release -p sigma-srn --example follow_frames -- assets/models/compact.safetensors`

use std::path::Path;

use sigma_srn::photo::Shot;
use sigma_srn::{Effort, Engine, Intrinsics, Model, Renderer, Search, Tracked, Tracker, camera};

fn main() -> Result<(), sigma_srn::Error> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "assets/models/compact.safetensors".into());
    let model = Model::load(Path::new(&path))?;
    let (engine, why) = Engine::automatic();
    println!("{why}");

    // The "video": renders from poses that the tracker does not know.
    const SIDE: u32 = 64;
    let intrinsics = Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.0 };
    let radius = model.metadata.orbit_radius.unwrap_or(1.3);
    let mut renderer = Renderer::new(&engine, &model, 1, SIDE, SIDE)?;

    // For the first frame, and for those in which it was lost.
    let search = Search::of(Effort::Fast);
    let mut tracker = Tracker::new(&engine, &model, 0, search, None)?;
    for frame in 0..20 {
        let angle = 0.1 * f64::from(frame);
        let truth = camera::look_at_origin(glam::DVec3::new(radius * angle.cos(), radius * angle.sin(), 0.4));
        let rgb = renderer.render(&[0], &[(truth, intrinsics)], 0)?.rgb;
        let query = Shot::whole(rgb, intrinsics, 0, SIDE).query(camera::around2016(radius));
        let Tracked { found, is_searched } = tracker.next(query, |_| Ok(()))?;
        let (rotation, translation) = camera::pose_error(&found.world_from_camera, &truth);
        let how = if is_searched { "searched for" } else { "followed" };
        let verdict = found.doubt.map_or("trusted".into(), |doubt| format!("not to be trusted: {doubt}"));
        println!("frame {frame}: {how}, {rotation:.2}° and {translation:.3} off, {verdict}, {:.2} s", found.seconds);
    }
    Ok(())
}
