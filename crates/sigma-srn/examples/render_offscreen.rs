//! Renders an instance from eight sides and prints what it saw. No window, no GPU needed.
//!
//! `cargo run --release -p sigma-srn --example render_offscreen -- assets/models/compact.safetensors`

use std::path::Path;

use sigma_srn::{Engine, Intrinsics, Model, Renderer, camera};

fn main() -> Result<(), sigma_srn::Error> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "assets/models/compact.safetensors".into());
    let model = Model::load(Path::new(&path))?;
    let (engine, why) = Engine::automatic();
    println!("{why}");

    const SIDE: u32 = 64;
    let intrinsics = Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.0 };
    let cameras: Vec<_> = camera::fixed24(model.metadata.orbit_radius.unwrap_or(1.3))
        .into_iter()
        .take(8)
        .map(|world_from_camera| (world_from_camera, intrinsics))
        .collect();
    let mut renderer = Renderer::new(&engine, &model, cameras.len() as u32, SIDE, SIDE)?;
    let images = renderer.render(&[0; 8], &cameras, 0)?;

    let pixels = (SIDE * SIDE) as usize;
    for (view, (rgb, depth)) in images.rgb.chunks(3 * pixels).zip(images.depth.chunks(pixels)).enumerate() {
        let dark = rgb.chunks(3).filter(|pixel| pixel.iter().any(|&value| value < 0.5)).count();
        let centre = depth[pixels / 2 + SIDE as usize / 2];
        println!(
            "{} from side {view}: {dark} of {pixels} pixels are not white, depth at the centre {centre:.2}",
            model.instance_name(0)
        );
    }
    Ok(())
}
