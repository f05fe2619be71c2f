//! Where in a photograph an object may be, of which nothing is known but how the model shows it, or a box around what is in sight of it: template matching over places, sizes, sides and rolls.

use std::iter::zip;

use glam::{DMat4, DQuat, DVec3};
use srn_photo::{Photo, Place};

use super::in_sight::InSight;
use super::looked::{Looked, Match};
use super::template::{ROLLS, SIDE, Template, Templates, WIDER, rolled_view};
use super::{BoundingBox, FoundObject, Shot, towards};
use crate::camera::{around2016, pose_error};
use crate::renderer::render_views;
use crate::{Engine, Error, Intrinsics, Model, View};

/// The longer side of what is looked at has at most so many pixels.
pub(super) const FINEST: f64 = 640.0;
/// Where less than this speaks for an object it is hardly ever (`docs/tried.md`).
pub(super) const LIKELY: f32 = 17.0;
/// Where less speaks for a pose that was found it is not to be trusted.
pub(super) const TOLD: f32 = 16.0;
/// Nor where, in a box, so many times as much speaks for the object from another side, or turned a little: for right ones it was 1.15 times at most, for most wrong ones it is more (`docs/tried.md`).
const OUTDONE: f32 = 1.2;

/// Two that have more than this part of both boxes in common are one.
const SAME: f64 = 0.4;
/// Degrees between sides that are not the same.
const ELSEWHERE_DEG: f64 = 30.0;
/// So many sides are tried at a place; what speaks for them is at least so much of what does for the one that was sighted.
const SIDES: usize = 6;
const NEARLY: f32 = 0.9;
/// By so many degrees a side is turned, at first and at last, and at most so often.
const TURN_DEG: f64 = 12.0;
const LEAST_TURN_DEG: f64 = 6.0;
const TURNS: usize = 12;

/// A photograph as it was looked at for an object, and where that may be.
pub struct Sightings<'a> {
    engine: &'a Engine,
    model: &'a Model,
    instance: u32,
    looked: Looked,
    /// So many pixels of what is looked at are one of the photograph.
    finer: f64,
    /// The model's, and the cameras that see them.
    views: Vec<Vec<f32>>,
    cameras: Vec<DMat4>,
    templates: Templates,
    /// The likeliest first.
    matches: Vec<Match>,
}

/// Where in a photograph the object may be.
#[derive(Clone)]
pub struct Sighting {
    /// What it would cover.
    pub object: FoundObject,
    /// A box around that.
    pub bounds: BoundingBox,
    /// A `world_from_camera` that sees it from the same side, in the middle of its picture.
    pub side: DMat4,
    found: Match,
}

impl<'a> Sightings<'a> {
    /// Of an instance of `model`. It is found where its diagonal is an eleventh or more of the photograph's longer side, and what `others` cover says nothing.
    pub fn of(engine: &'a Engine, model: &'a Model, instance: u32, photo: &Photo, others: &[FoundObject]) -> Result<Self, Error> {
        let is_other = |at: [f64; 2]| others.iter().any(|other| other.covers(at));
        let is_other: Option<Place> = if others.is_empty() { None } else { Some(&is_other) };
        Sightings::new(engine, model, instance, photo, is_other, None)
    }

    /// Of an instance of `model` in a box around what is in sight of it; the rest of it may be hidden.
    pub fn in_box(
        engine: &'a Engine,
        model: &'a Model,
        instance: u32,
        photo: &Photo,
        bounds: BoundingBox,
    ) -> Result<Self, Error> {
        Sightings::new(engine, model, instance, photo, None, Some(bounds))
    }

    fn new(
        engine: &'a Engine,
        model: &'a Model,
        instance: u32,
        photo: &Photo,
        is_other: Option<Place>,
        bounds: Option<BoundingBox>,
    ) -> Result<Self, Error> {
        let radius = model.metadata.orbit_radius.unwrap_or(1.3);
        let cameras: Vec<DMat4> = around2016(radius).into_iter().step_by(ROLLS).collect();
        let size = photo.size().map(|pixels| pixels as f64);
        let finer = (FINEST / size[0].max(size[1])).min(1.0);
        let [width, height] = size.map(|pixels| (finer * pixels).round().max(1.0) as usize);
        let is_other = is_other.map(|is_other| move |at: [f64; 2]| is_other(at.map(|at| at / finer)));
        let is_other = is_other.as_ref().map(|is_other| is_other as Place);
        let in_sight = bounds.map(|BoundingBox { corner, size }| InSight::of(corner, size, finer));
        let looked = Looked::at(photo.pixels().area_resample(width, height), is_other, in_sight);
        let views = views_from(engine, model, instance, &cameras)?;
        let templates = Templates::of(&views, looked.own());
        let matches = looked.matches(&templates);
        Ok(Sightings { engine, model, instance, looked, finer, views, cameras, templates, matches })
    }

    /// The likeliest places, the likeliest first, at most so many.
    pub fn likeliest(&self, most: usize) -> Vec<Sighting> {
        let mut likeliest: Vec<Sighting> = Vec::new();
        for sighting in self.matches.iter().filter_map(|found| self.sighting(found)) {
            if likeliest.len() == most {
                break;
            }
            if likeliest.iter().all(|other| sighting.bounds.overlap(&other.bounds) < SAME) {
                likeliest.push(sighting);
            }
        }
        likeliest
    }

    /// The likeliest of them from so many sides, the likeliest first.
    pub(super) fn apart(&self, most: usize) -> Vec<Sighting> {
        let mut sides: Vec<Sighting> = Vec::new();
        for sighting in self.matches.iter().filter_map(|found| self.sighting(found)) {
            if sides.len() == most {
                break;
            }
            if sides.iter().all(|other| sighting.is_elsewhere(other)) {
                sides.push(sighting);
            }
        }
        sides
    }

    /// From which sides the object may be seen at a place, each turned for as long as more speaks for it; the likeliest first, and at least the one that was sighted.
    pub fn sides(&self, place: Sighting) -> Result<Vec<Sighting>, Error> {
        let least = NEARLY * place.found.evidence;
        let all = self.looked.all_around(place.found, &self.templates);
        let mut sides = vec![place];
        for found in all.iter().take_while(|found| found.evidence > least) {
            if sides.len() < SIDES
                && let Some(sighting) = self.sighting(found)
                && sighting.bounds.overlap(&sides[0].bounds) >= SAME
                && sides.iter().all(|other| sighting.is_elsewhere(other))
            {
                sides.push(sighting);
            }
        }
        let sides = sides.into_iter().map(|side| self.turned(side)).collect::<Result<_, _>>()?;
        Ok(likeliest_first(sides))
    }

    /// What looks more like the object than it does from a pose that was found in a part of the photograph, the likeliest first: the same turned, or another of the sides that were sighted there.
    pub fn rivals(&self, shot: &Shot, world_from_camera: &DMat4, sides: &[Sighting]) -> Result<Vec<Sighting>, Error> {
        // What is judged anew may have moved a little, and is seen from as far away as it is.
        let focal = self.finer * shot.pixels_of_photo() * shot.intrinsics.fx;
        let anew = |at: Match, side: &DMat4| -> Result<Option<Sighting>, Error> {
            let side = towards(side, focal / f64::from(at.diagonal));
            let view = self.views_from(&[side])?.remove(0);
            let at = self.looked.settled(at, &self.template(&view));
            Ok(self.seen(at, &view, side))
        };
        let Some(found) = anew(self.place(shot, world_from_camera), world_from_camera)? else { return Ok(vec![]) };
        let mut rivals: Vec<Sighting> = self.next_to(&found, TURN_DEG)?.into_iter().collect();
        for side in sides.iter().filter(|side| side.is_elsewhere(&found)) {
            rivals.extend(anew(side.found, &side.side)?);
        }
        rivals.retain(|rival| rival.found.evidence > found.found.evidence);
        Ok(likeliest_first(rivals))
    }

    /// Turned for as long as more speaks for it, in smaller steps at last.
    fn turned(&self, sighting: Sighting) -> Result<Sighting, Error> {
        let (mut best, mut degrees) = (sighting, TURN_DEG);
        for _ in 0..TURNS {
            match self.next_to(&best, degrees)? {
                Some(likelier) => best = likelier,
                None if degrees > LEAST_TURN_DEG => degrees = LEAST_TURN_DEG,
                None => break,
            }
        }
        Ok(best)
    }

    /// What looks more like the object of the same turned by so many degrees about the object's middle.
    fn next_to(&self, sighting: &Sighting, degrees: f64) -> Result<Option<Sighting>, Error> {
        let turns = [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]);
        let turned = |axis| DMat4::from_axis_angle(sighting.side.transform_vector3(axis), degrees.to_radians()) * sighting.side;
        let cameras: Vec<DMat4> = turns.map(turned).collect();
        let views = self.views_from(&cameras)?;
        let judged =
            zip(&views, cameras).map(|(view, side)| (self.looked.settled(sighting.found, &self.template(view)), view, side));
        let likeliest = judged.max_by(|(a, ..), (b, ..)| a.evidence.total_cmp(&b.evidence));
        let likelier = likeliest.filter(|(found, ..)| found.evidence > sighting.found.evidence);
        Ok(likelier.and_then(|(found, view, side)| self.seen(found, view, side)))
    }

    fn template(&self, view: &[f32]) -> Template {
        Template::of(view, self.looked.own())
    }

    fn views_from(&self, cameras: &[DMat4]) -> Result<Vec<Vec<f32>>, Error> {
        views_from(self.engine, self.model, self.instance, cameras)
    }

    /// How much speaks for a pose that was found in a part of the photograph.
    pub fn evidence(&self, shot: &Shot, world_from_camera: &DMat4) -> Result<f32, Error> {
        let at = self.place(shot, world_from_camera);
        let view = self.views_from(&[towards(world_from_camera, world_from_camera.w_axis.truncate().length())])?.remove(0);
        Ok(self.looked.judged(at, &self.template(&view)).evidence)
    }

    /// Whether so much more speaks for the object as it was sighted than for a pose that was found in a part of the photograph that this is hardly right.
    pub(super) fn is_outdone(&self, shot: &Shot, world_from_camera: &DMat4) -> Result<bool, Error> {
        let own = self.evidence(shot, world_from_camera)?;
        Ok(self.matches.first().is_some_and(|likeliest| likeliest.evidence > OUTDONE * own))
    }

    /// What a pose that was found in a part of the photograph shows of the object there, and where it looks like it, up to how bright it is lit.
    pub(super) fn likeness(&self, shot: &Shot, world_from_camera: &DMat4) -> Result<Option<Likeness>, Error> {
        let at = self.place(shot, world_from_camera);
        let side = towards(world_from_camera, world_from_camera.w_axis.truncate().length());
        let view = self.views_from(&[side])?.remove(0);
        let is_like = self.looked.likeness(at, &view);
        Ok(self.seen(at, &view, side).map(|Sighting { object, bounds, .. }| Likeness { object, bounds, is_like }))
    }

    /// A `world_from_camera` that sees the object where it was sighted, in a part of the photograph.
    pub(super) fn pose(&self, shot: &Shot, sighting: &Sighting) -> DMat4 {
        let Intrinsics { fx, fy, cx, cy, pixel_center } = shot.intrinsics;
        let (corner, pixels) = (shot.square.0, shot.pixels_of_photo());
        let Match { middle, diagonal, .. } = sighting.found;
        let [x, y] = [0, 1].map(|k| (f64::from(middle[k]) / self.finer - corner[k] as f64) / pixels - 0.5 + pixel_center);
        let ray = DVec3::new((x - cx) / fx, (y - cy) / fy, 1.0).normalize();
        let facing = towards(&sighting.side, self.finer * pixels * fx / f64::from(diagonal));
        facing * DMat4::from_quat(DQuat::from_rotation_arc(ray, DVec3::Z))
    }

    /// Where in the photograph such a pose shows the object.
    fn place(&self, shot: &Shot, world_from_camera: &DMat4) -> Match {
        let Intrinsics { fx, fy, cx, cy, pixel_center } = shot.intrinsics;
        let object = world_from_camera.inverse().transform_point3(DVec3::ZERO);
        // Edges of pixels are whole numbers.
        let middle = [fx * object.x / object.z + cx, fy * object.y / object.z + cy].map(|c| c - pixel_center + 0.5);
        let (corner, pixels) = (shot.square.0, shot.pixels_of_photo());
        let middle = [0, 1].map(|k| (self.finer * (corner[k] as f64 + pixels * middle[k])) as f32);
        let diagonal = (self.finer * pixels * fx / object.length()) as f32;
        Match { middle, diagonal, template: 0, roll: 0.0, evidence: 0.0 }
    }

    /// `None` where the model shows nothing.
    fn sighting(&self, found: &Match) -> Option<Sighting> {
        let view = found.template / ROLLS;
        self.seen(
            *found,
            &rolled_view(&self.views[view], found.roll),
            self.cameras[view] * DMat4::from_rotation_z(found.roll.into()),
        )
    }

    fn seen(&self, found: Match, view: &[f32], side: DMat4) -> Option<Sighting> {
        let wide = WIDER * f64::from(found.diagonal) / self.finer;
        let corner = found.middle.map(|at| f64::from(at) / self.finer - 0.5 * wide);
        let object = FoundObject::in_square(view, SIDE, corner, wide);
        let bounds = object.bounds()?;
        Some(Sighting { object, bounds, side, found })
    }
}

impl Sighting {
    /// Whether enough speaks for it that the object may be there.
    pub fn is_likely(&self) -> bool {
        self.found.evidence >= LIKELY
    }

    /// How much speaks for it: more for what is there than for most of what is not, of whichever object.
    pub fn evidence(&self) -> f32 {
        self.found.evidence
    }

    fn is_elsewhere(&self, other: &Self) -> bool {
        pose_error(&self.side, &other.side).0 > ELSEWHERE_DEG
    }
}

/// What a pose shows of an object in a photograph, and where the photograph is like that.
pub(super) struct Likeness {
    /// What it covers.
    pub object: FoundObject,
    /// A box around that.
    pub bounds: BoundingBox,
    /// Of each cell of the view.
    is_like: Vec<bool>,
}

impl Likeness {
    /// Whether the photograph shows the object at a place, in its pixels. Of white within its outline nobody knows, nor of what is not like it.
    pub fn shows(&self, at: [f64; 2]) -> Option<bool> {
        let is_like = || self.object.cell_of(at, SIDE).is_some_and(|cell| self.is_like[cell]);
        self.object.shows(at).and_then(|shows| if shows { is_like().then_some(true) } else { Some(false) })
    }
}

/// What a model shows of an instance from cameras that have it in the middle, as templates are made of it.
fn views_from(engine: &Engine, model: &Model, instance: u32, cameras: &[DMat4]) -> Result<Vec<Vec<f32>>, Error> {
    let view = |camera: &DMat4| {
        let (focal, middle) = (SIDE as f64 * camera.w_axis.truncate().length() / WIDER, 0.5 * SIDE as f64);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, pixel_center: 0.5 };
        (instance, *camera, intrinsics)
    };
    let views: Vec<View> = cameras.iter().map(view).collect();
    let views = render_views(engine, model, [SIDE as u32; 2], &views)?;
    Ok(views.into_iter().map(|view| view.rgb).collect())
}

fn likeliest_first(mut sightings: Vec<Sighting>) -> Vec<Sighting> {
    sightings.sort_by(|a, b| b.found.evidence.total_cmp(&a.found.evidence));
    sightings
}
