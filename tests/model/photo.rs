//! Photographs whose objects nobody has cut out.

use std::path::Path;

use glam::{DMat4, DVec3};
use sigma_srn::photo::{Anywhere, BoundingBox, Boxed, FoundObject, Known, Outcome, Photo, Shot, Sightings};
use sigma_srn::{Doubt, Effort, Engine, Error, Found, Intrinsics, Model, Search, camera};

/// Of the pictures in `assets/scenes`.
const INTRINSICS: Intrinsics = Intrinsics { fx: 297.6, fy: 297.6, cx: 128.0, cy: 128.0, pixel_center: 0.0 };
const INTRINSICS_OF_HEAP: Intrinsics = Intrinsics { fx: 600.0, fy: 600.0, cx: 320.0, cy: 240.0, pixel_center: 0.0 };
const FORKLIFT: BoundingBox = BoundingBox { corner: [35.0, 64.0], size: [194.0, 130.0] };

fn search(photo: &Photo, intrinsics: &Intrinsics, bounds: BoundingBox) -> Result<(Shot, Found, FoundObject), Error> {
    let model = Model::load(Path::new("../assets/models/compact.safetensors")).unwrap();
    let engine = Engine::cpu();
    let starts = |shot: &Shot| shot.around(&model, camera::around2016, None);
    let (search, instance) = (Search::of(Effort::Fast), model.instance("forklift").unwrap());
    let (shot, found) = search.run_in_box(&engine, &model, instance, (photo, intrinsics), bounds, starts, |_| Ok(()))?;
    let object = FoundObject::of(&shot, &found.world_from_camera, &engine, &model, 1)?;
    Ok((shot, found, object))
}

fn scene() -> Photo {
    opened("../assets/scenes/forklift.png")
}

fn heap() -> Photo {
    opened("../assets/scenes/heap.png")
}

fn opened(path: &str) -> Photo {
    let picture = image::open(path).unwrap().to_rgba8();
    Photo::from_rgba8(picture.width() as usize, picture.height() as usize, &picture).unwrap()
}

/// The model's objects in the heap, and where the camera is.
fn in_heap(model: &Model) -> Vec<(u32, DMat4)> {
    let truths = std::fs::read_to_string("../assets/scenes/heap.txt").unwrap();
    let truth = |line: &str| {
        let (name, rows) = line.split_once(' ').unwrap();
        let rows: Vec<f64> = rows.split(' ').map(|number| number.parse().unwrap()).collect();
        model.instance(name).ok().map(|instance| (instance, DMat4::from_cols_slice(&rows).transpose()))
    };
    truths.lines().filter_map(truth).collect()
}

/// Among others, nothing known of its pose; whatever place of a pixel intrinsics count from.
#[test]
fn an_object_is_found_in_a_box() {
    let truth = srn_data::srn::read_pose(Path::new("../assets/scenes/forklift.txt")).unwrap();
    let opengl = Intrinsics { cx: 128.5, cy: 128.5, pixel_center: 0.5, ..INTRINSICS };
    let [(shot, found, object), (other, ..)] =
        [INTRINSICS, opengl].map(|intrinsics| search(&scene(), &intrinsics, FORKLIFT).unwrap());
    assert_eq!((shot.rgb, shot.intrinsics), (other.rgb, other.intrinsics));
    let (angle, distance) = camera::pose_error(&found.world_from_camera, &truth);
    // 0.2° and 0.005 here.
    assert!(angle < 0.6 && distance < 0.015 && found.is_trusted(), "{angle} {distance} {:?}", found.doubt);
    let bounds = object.bounds().unwrap();
    for k in 0..2 {
        let ends = [bounds.corner[k] - FORKLIFT.corner[k], bounds.size[k] - FORKLIFT.size[k]];
        assert!(ends.iter().all(|off| off.abs() < 8.0), "{bounds:?}");
    }
    // Its forks do not fill the box, nor does it cover what lies outside.
    assert!(object.covers([150.0, 150.0]) && !object.covers([50.0, 80.0]) && !object.covers([150.0, 20.0]));
    // However much of what was cut out it explains, it is not to be trusted where a box goes further than its outline.
    let model = Model::load(Path::new("../assets/models/compact.safetensors")).unwrap();
    let engine = Engine::cpu();
    let photo = scene();
    let open = |_, known: Known| cut_out((&photo, &INTRINSICS), FORKLIFT, known, shot.instance);
    let mut pass = finding(&found);
    let mut doubt = |given: Option<BoundingBox>| {
        let (given, starts, sightings) = (|_| given, |_, _: &Shot| Ok(vec![]), |_, _| Ok(None));
        let boxed = Boxed { engine: &engine, model: &model, open: &open, starts: &starts, given: &given, sightings: &sightings };
        boxed.search(&[0], vec![open(0, Known::default()).unwrap()], &mut pass).unwrap().remove(0).found.doubt
    };
    let taller = |part: f64| BoundingBox { size: [194.0, 130.0 * part], ..FORKLIFT };
    assert_eq!(
        [None, Some(FORKLIFT), Some(taller(0.8)), Some(taller(1.15))].map(&mut doubt),
        [None, None, None, Some(Doubt::Inside)]
    );
}

fn cut_out(photo: (&Photo, &Intrinsics), bounds: BoundingBox, known: Known, instance: u32) -> Result<Shot, Error> {
    let shot = Shot::in_box(photo, bounds, known, instance, 64);
    shot.ok_or_else(|| Error::Input { input: "box".into(), what: "empty".into() })
}

type Outcomes = Result<Vec<Outcome<()>>, Error>;

/// Searches that all end where this one did.
fn finding(found: &Found) -> impl FnMut(&[usize], Vec<Shot>, &[Vec<DMat4>]) -> Outcomes {
    let outcome = |shot| Outcome { shot, found: found.clone(), log: () };
    move |_, shots, _| Ok(shots.into_iter().map(outcome).collect())
}

/// As in its box, where nobody says where it is.
#[test]
fn an_object_is_found_anywhere() {
    let truth = srn_data::srn::read_pose(Path::new("../assets/scenes/forklift.txt")).unwrap();
    let model = Model::load(Path::new("../assets/models/compact.safetensors")).unwrap();
    let (engine, search, instance) = (Engine::cpu(), Search::of(Effort::Fast), model.instance("forklift").unwrap());
    let photo = scene();
    let sightings = Sightings::of(&engine, &model, instance, &photo, &[]).unwrap();
    let first = sightings.likeliest(1).remove(0);
    assert!(first.bounds.overlap(&FORKLIFT) > 0.5, "{:?}", first.bounds);
    let starts = |shot: &Shot| shot.around(&model, camera::around2016, None);
    let (shot, found) = search.run_anywhere(&engine, &model, instance, (&photo, &INTRINSICS), starts, |_| Ok(())).unwrap();
    let (angle, distance) = camera::pose_error(&found.world_from_camera, &truth);
    assert!(angle < 0.6 && distance < 0.015 && found.is_trusted(), "{angle} {distance} {:?}", found.doubt);
    // The side that was sighted is turned towards the right one.
    let facing = |side: &DMat4| shot.facing(&model, side).unwrap();
    let off = |side: &DMat4| camera::pose_error(&facing(side), &facing(&truth)).0;
    let sides = sightings.sides(first.clone()).unwrap();
    let [sighted, turned] = [&first, &sides[0]].map(|sighting| off(&sighting.side));
    assert!(turned < 0.9 * sighted, "{sighted} {turned}");
    // Less speaks for wrong poses, and something else for a better one: next to it, or all around the object from it.
    let evidence = |pose: &DMat4| sightings.evidence(&shot, pose).unwrap();
    for degrees in [12.0f64, -70.0, 180.0] {
        let wrong = DMat4::from_rotation_z(degrees.to_radians()) * truth;
        assert!(evidence(&wrong) < 0.97 * evidence(&truth), "{degrees}: {} of {}", evidence(&wrong), evidence(&truth));
        let rival = sightings.rivals(&shot, &wrong, &sides).unwrap().remove(0);
        let [before, after] = [&wrong, &rival.side].map(off);
        assert!(after < before.min(40.0), "{degrees}: {before} {after}");
    }
    // However much of a picture a pose explains, it is not to be trusted where the photograph shows the object elsewhere.
    let aside = Found { world_from_camera: truth * DMat4::from_translation(DVec3::new(0.4, 0.0, 0.0)), ..found };
    let open = |bounds, known: Known| cut_out((&photo, &INTRINSICS), bounds, known, instance);
    let mut pass = finding(&aside);
    let anywhere = Anywhere { engine: &engine, model: &model, open: &open, starts: &|_| Ok(vec![]), others: None };
    let told = anywhere.search(&sightings, &mut pass).unwrap().unwrap().found;
    assert_eq!((aside.doubt, told.doubt), (None, Some(Doubt::Unlikely)));
    let grey = Photo::from_rgba8(64, 48, &[120, 130, 140, 255].repeat(64 * 48)).unwrap();
    let nothing = search.run_anywhere(&engine, &model, instance, (&grey, &INTRINSICS), starts, |_| Ok(()));
    let said = nothing.map(|(_, found)| found.is_trusted());
    assert!(
        said.as_ref().is_ok_and(|is_trusted| !is_trusted) || said.is_err_and(|error| error.to_string().contains("nothing in it"))
    );
}

/// By a box around what is in sight of it, half of which lies behind two others of which nothing is known.
#[test]
fn an_object_is_found_behind_others() {
    let model = Model::load(Path::new("../assets/models/compact.safetensors")).unwrap();
    let (engine, search, instance) = (Engine::cpu(), Search::of(Effort::Fast), model.instance("sensor").unwrap());
    let photo = (&heap(), &INTRINSICS_OF_HEAP);
    let bounds = BoundingBox { corner: [394.0, 196.0], size: [152.0, 78.0] };
    let starts = |shot: &Shot| shot.around(&model, camera::fixed24, None);
    let (shot, found) = search.run_in_box(&engine, &model, instance, photo, bounds, starts, |_| Ok(())).unwrap();
    let (_, truth) = in_heap(&model).into_iter().find(|(of, _)| *of == instance).unwrap();
    let (angle, distance) = camera::pose_error(&found.world_from_camera, &truth);
    // 0.5° and 0.02 here.
    assert!(angle < 2.0 && distance < 0.1 && found.is_trusted(), "{angle} {distance} {:?}", found.doubt);
    let object = FoundObject::of(&shot, &found.world_from_camera, &engine, &model, 1).unwrap();
    assert!(object.bounds().unwrap().size[1] > 1.2 * bounds.size[1], "{:?}", object.bounds());
    let sightings = Sightings::in_box(&engine, &model, instance, photo.0, bounds).unwrap();
    let turned = DMat4::from_rotation_z(1.5) * truth;
    let [right, wrong] = [truth, turned].map(|pose| sightings.evidence(&shot, &pose).unwrap());
    assert!(wrong < 0.8 * right, "{wrong} {right}");
    // However much of what was cut out it explains, it is not to be trusted where more in the box speaks for another side.
    let open = |_, known: Known| cut_out(photo, bounds, known, instance);
    let (starts, given) = (|_, _: &Shot| Ok(vec![]), |_| None);
    let sightings = |_, instance| Sightings::in_box(&engine, &model, instance, photo.0, bounds).map(Some);
    let boxed = Boxed { engine: &engine, model: &model, open: &open, starts: &starts, given: &given, sightings: &sightings };
    let doubt = |pose: DMat4| {
        let found = Found { world_from_camera: pose, ..found.clone() };
        boxed.search(&[0], vec![shot.clone()], &mut finding(&found)).unwrap().remove(0).found.doubt
    };
    assert_eq!([found.world_from_camera, turned].map(doubt), [None, Some(Doubt::Unlikely)]);
}

/// Three of a heap: two of one kind and one colour, one before the other, and what is beside them.
#[test]
fn all_objects_of_a_model_are_found_that_are_there() {
    const NAMES: [&str; 2] = ["bucket", "steering"];
    let model = Model::load(Path::new("../assets/models/compact.safetensors")).unwrap();
    let model = model.bake(&NAMES.map(|name| model.instance(name).unwrap())).unwrap();
    let photo = (&heap(), &INTRINSICS_OF_HEAP);
    let starts = |shot: &Shot| shot.around(&model, camera::around2016, None);
    let engine = Engine::cpu();
    let found = Search::of(Effort::Fast).run_for_all(&engine, &model, photo, starts, |_| Ok(())).unwrap();
    let mut truths = in_heap(&model);
    assert_eq!((found.len(), truths.len()), (3, 3));
    for (shot, found) in found {
        let off = |truth: &DMat4| camera::pose_error(&found.world_from_camera, truth);
        let is_it = |(instance, truth): &(u32, DMat4)| *instance == shot.instance && off(truth).0 < 5.0;
        let (_, truth) = truths.remove(truths.iter().position(is_it).unwrap());
        assert!(found.is_trusted() && off(&truth).1 < 0.15, "{:?}", off(&truth));
    }
}

#[test]
fn a_box_with_nothing_in_it_is_named() {
    let outside = BoundingBox { corner: [300.0, 10.0], ..FORKLIFT };
    let error = search(&scene(), &INTRINSICS, outside).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("300") && error.contains("nothing in it"), "{error}");
}
