//! Finds the pose of a view again, from starts that are 30° away.
//!
//! `cargo run --release -p sigma-srn --example refine_pose -- assets/models/compact.safetensors`

use std::path::Path;

use sigma_srn::photo::Shot;
use sigma_srn::{Engine, Intrinsics, Model, Renderer, Search, camera};

fn main() -> Result<(), sigma_srn::Error> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "assets/models/compact.safetensors".into());
    let model = Model::load(Path::new(&path))?;
    let (engine, why) = Engine::automatic();
    println!("{why}");

    // The "photograph": a render from a pose that the search does not know.
    const SIDE: u32 = 64;
    let intrinsics = Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.0 };
    let truth = camera::fixed24(model.metadata.orbit_radius.unwrap_or(1.3))[3];
    let rgb = Renderer::new(&engine, &model, 1, SIDE, SIDE)?.render(&[0], &[(truth, intrinsics)], 0)?.rgb;

    let query = Shot::whole(rgb, intrinsics, 0, SIDE).query(camera::neighbor4(&truth));
    let found = Search::default().run(&engine, &model, &[query], |progress| {
        if progress.step % 10 == 0 {
            println!("step {} of {}: {} hypotheses", progress.step, progress.steps, progress.hypotheses.len());
        }
        Ok(())
    })?;
    let (rotation, translation) = camera::pose_error(&found[0].world_from_camera, &truth);
    println!("start {} won with a loss of {:.4}", found[0].estimate.ranking[0].start, found[0].estimate.loss);
    println!("error: {rotation:.2}° and {translation:.3} object units");
    Ok(())
}
