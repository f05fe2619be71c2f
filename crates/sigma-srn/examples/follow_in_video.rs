//! Follows an object through the frames of a video that nobody has cut out, by a box around it in the first frame.
//!
//! `cargo run --release -p sigma-srn --example follow_in_video -- MODEL INSTANCE FOCAL X Y WIDTH HEIGHT FRAME...`

use std::error::Error;
use std::path::Path;

use sigma_srn::camera::around2016;
use sigma_srn::photo::{BoundingBox, Follower, Known, Looking, Photo, Shot, Sightings};
use sigma_srn::{Effort, Engine, Intrinsics, Model, Search, Tracked, Tracker};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, instance, focal, x, y, width, height, frames @ ..] = &arguments[..] else {
        return Err("expected MODEL INSTANCE FOCAL X Y WIDTH HEIGHT FRAME...".into());
    };
    let model = Model::load(Path::new(model))?;
    let (instance, focal) = (model.instance(instance)?, focal.parse()?);
    let bounds = BoundingBox { corner: [x.parse()?, y.parse()?], size: [width.parse()?, height.parse()?] };
    let (engine, why) = Engine::automatic();
    println!("{why}");

    let search = Search::of(Effort::Fast);
    let mut tracker = Tracker::new(&engine, &model, instance, search.clone(), None)?;
    let mut follower = Follower::new(bounds);
    for frame in frames {
        let picture = image::open(frame)?.to_rgba8();
        let [width, height] = [picture.width(), picture.height()];
        let photo = Photo::from_rgba8(width as usize, height as usize, &picture).ok_or("an empty picture")?;
        let [cx, cy] = [width, height].map(|pixels| f64::from(pixels) / 2.0);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx, cy, pixel_center: 0.0 };
        // What the follower wants to see of the frame.
        let open = |bounds: BoundingBox, known: Known| -> Result<Shot, Box<dyn Error>> {
            let side = model.metadata.side.unwrap_or(64);
            Ok(Shot::in_box((&photo, &intrinsics), bounds, known, instance, side).ok_or("nothing in the box")?)
        };
        let starts = |shot: &Shot| -> Result<_, Box<dyn Error>> { Ok(shot.around(&model, around2016, None)?) };
        let sightings = || Ok(Sightings::of(&engine, &model, instance, &photo, &[])?);
        let looking =
            Looking { engine: &engine, model: &model, search: &search, starts: &starts, open: &open, sightings: &sightings };
        let shot = follower.open(&open).ok();
        let Some((_, tracked)) = follower.next(shot, &mut tracker, &looking, &mut |_| Ok(()))? else {
            println!("{frame}: nothing to be seen");
            continue;
        };
        let Tracked { found, is_searched } = tracked;
        let how = if is_searched { "searched for" } else { "followed" };
        let verdict = found.doubt.map_or("trusted".into(), |doubt| format!("not to be trusted: {doubt}"));
        println!("{frame}: {how}, camera at {:.3}, {verdict}", found.world_from_camera.w_axis.truncate());
    }
    Ok(())
}
