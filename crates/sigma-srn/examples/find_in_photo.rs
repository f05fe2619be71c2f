//! Finds the pose of an object in a photograph that nobody has cut out, by a box around it, as detectors give one.
//!
//! `cargo run --release -p sigma-srn --example find_in_photo`

use std::error::Error;
use std::path::Path;

use sigma_srn::camera::around2016;
use sigma_srn::photo::{BoundingBox, FoundObject, Photo, Shot};
use sigma_srn::{Effort, Engine, Intrinsics, Model, Search};

fn main() -> Result<(), Box<dyn Error>> {
    let model = Model::load(Path::new("assets/models/compact.safetensors"))?;
    let (engine, why) = Engine::automatic();
    println!("{why}");

    let picture = image::open("assets/scenes/chicken.png")?.to_rgba8();
    let photo = Photo::from_rgba8(picture.width() as usize, picture.height() as usize, &picture).ok_or("an empty picture")?;
    let intrinsics = Intrinsics { fx: 297.6, fy: 297.6, cx: 128.0, cy: 128.0, pixel_center: 0.0 };
    let bounds = BoundingBox { corner: [75.0, 37.0], size: [114.0, 189.0] };

    let search = Search::of(Effort::Fast);
    let starts = |shot: &Shot| shot.around(&model, around2016, None);
    let instance = model.instance("chicken")?;
    let (shot, found) = search.run_in_box(&engine, &model, instance, (&photo, &intrinsics), bounds, starts, |_| Ok(()))?;
    match found.doubt {
        Some(doubt) => println!("not to be trusted: {doubt}"),
        None => println!("world_from_camera = {}", found.world_from_camera),
    }
    // Where it is in the photograph, as the model shows it.
    let object = FoundObject::of(&shot, &found.world_from_camera, &engine, &model, 1)?;
    for y in (4..256).step_by(12) {
        println!(
            "{}",
            (3..256).step_by(6).map(|x| if object.covers([x, y].map(f64::from)) { '#' } else { '.' }).collect::<String>()
        );
    }
    Ok(())
}
