//! Photographs: from what a camera has taken to what a search compares, and back. What of a photograph is the object is said by a mask or by transparency, or found from
//! a box around it ([`Boxed`]), in a video from where the object was before ([`Follower`]).

mod all;
mod boxed;
mod follow;
mod shown;
mod sightings;
mod template;

pub use all::All;
pub use boxed::{Anywhere, Boxed, Outcome, Pass, StartsOf};
pub use follow::{Follower, Looking, Observe, Open};
pub use shown::FoundObject;
pub use sightings::{Sighting, Sightings};
pub use srn_photo::{BoundingBox, Guess, Known, MARGIN, Photo, Pixels, Place, Square};

use glam::{DMat4, DQuat, DVec3};

use crate::{Engine, Error, Found, Intrinsics, Model, Outline, Progress, Query, Search};

/// How long objects are in a picture, as a share of their diagonal: about that of a cube, of a ball in its box, and seen along the
/// longest side.
const SPAN: f64 = 0.8;
/// Pixels to a side of the pictures that the paper's models take.
const SIDE: u32 = 64;

/// An object in a photograph: the square around it that a search compares views with.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Number of the instance that it shows.
    pub instance: u32,
    /// Pixels to a side.
    pub side: u32,
    /// Colours in [-1, 1], `[side, side, 3]`.
    pub rgb: Vec<f32>,
    /// How much each pixel counts `[side, side]`; `None`: all the same.
    pub weights: Option<Vec<f32>>,
    /// How much of each pixel is the object `[side, side]`, where it was cut out; the rest of it is white.
    pub coverage: Option<Vec<f32>>,
    /// How its mask is known to be wrong, in these pixels; see [`Query::outline`].
    pub outline: Outline,
    /// Intrinsics of the square.
    pub intrinsics: Intrinsics,
    /// How far the object is in object units, by the size of the square that was cut around it.
    pub distance: Option<f64>,
    /// Where the square lies in the photograph: first pixel, width and height.
    pub square: ([i64; 2], usize),
}

impl Shot {
    /// Of a square.
    pub fn of(square: Square, instance: u32) -> Self {
        let [fx, fy, cx, cy] = square.intrinsics.map(f64::from);
        Shot {
            instance,
            side: square.side as u32,
            rgb: square.rgb,
            weights: square.weights,
            coverage: square.coverage,
            outline: Outline::AS_GIVEN,
            intrinsics: Intrinsics { fx, fy, cx, cy, pixel_center: 0.0 },
            distance: square.cut.then(|| fx * SPAN * (1.0 + 2.0 * MARGIN) / square.side as f64),
            square: (square.corner, square.extent),
        }
    }

    /// Of what is in a box in a photograph with these intrinsics, `side` pixels square, by what is known of it; `None` where nothing in the box differs from what is around
    /// it, or nothing is around it.
    pub fn in_box(
        (photo, intrinsics): (&Photo, &Intrinsics),
        bounds: BoundingBox,
        known: Known,
        instance: u32,
        side: u32,
    ) -> Option<Self> {
        let &Intrinsics { fx, fy, cx, cy, pixel_center } = intrinsics;
        let mut photo = photo.clone();
        photo.cut_out_of(bounds, known)?;
        let square = photo.square([fx, fy, cx - pixel_center, cy - pixel_center], side as usize)?;
        Some(Shot::of(square, instance))
    }

    /// Of a picture that is such a square already, as views of data sets are.
    pub fn whole(rgb: Vec<f32>, intrinsics: Intrinsics, instance: u32, side: u32) -> Self {
        let square = ([0; 2], side as usize);
        let (weights, coverage, distance) = (None, None, None);
        Shot { instance, side, rgb, weights, coverage, outline: Outline::AS_GIVEN, intrinsics, distance, square }
    }

    /// How many pixels of the photograph, along a row, are one of the square's.
    pub fn pixels_of_photo(&self) -> f64 {
        self.square.1 as f64 / f64::from(self.side)
    }

    /// What a search takes.
    pub fn query(&self, starts: Vec<DMat4>) -> Query {
        Query {
            instance: self.instance,
            rgb: self.rgb.clone(),
            weights: self.weights.clone(),
            coverage: self.coverage.clone(),
            outline: self.outline,
            width: self.side,
            height: self.side,
            intrinsics: self.intrinsics,
            starts,
        }
    }

    /// Starts all around the object, as [`crate::camera::around2016`], which has it in the middle of the square; `radius` away, object units. `None`: by how large the object is in the
    /// photograph, else as far as the model's cameras were.
    pub fn around(&self, model: &Model, starts: fn(f64) -> Vec<DMat4>, radius: Option<f64>) -> Result<Vec<DMat4>, Error> {
        let radius = self.radius(model, radius)?;
        Ok(self.intrinsics.centred([self.side; 2], starts(radius)))
    }

    /// The camera that sees the side of the object that `world_from_camera` sees, in the middle of the square and as far away as its size says.
    pub fn facing(&self, model: &Model, world_from_camera: &DMat4) -> Result<DMat4, Error> {
        let radius = self.radius(model, None)?;
        Ok(self.intrinsics.centred([self.side; 2], vec![towards(world_from_camera, radius)]).remove(0))
    }

    fn radius(&self, model: &Model, given: Option<f64>) -> Result<f64, Error> {
        given.or(self.distance).or(model.metadata.orbit_radius).ok_or_else(|| Error::Setting {
            field: "radius",
            what: "the model does not say how far its cameras were: it must be given".into(),
        })
    }
}

/// The camera that sees the same side of the object in the middle of its picture, so far away.
fn towards(world_from_camera: &DMat4, radius: f64) -> DMat4 {
    let object = world_from_camera.inverse().transform_point3(DVec3::ZERO);
    let towards = *world_from_camera * DMat4::from_quat(DQuat::from_rotation_arc(DVec3::Z, object.normalize_or(DVec3::Z)));
    let [right, down, forward] = [towards.x_axis, towards.y_axis, towards.z_axis];
    DMat4::from_cols(right, down, forward, (-radius * forward.truncate()).extend(1.0))
}

impl Search {
    /// The pose of the object in a box in a photograph, with its intrinsics, that nobody has cut out, and the square that it was found in; by single searches, one after another ([`Boxed`]).
    /// `starts`: where a search for a square begins: [`Shot::around`], say. `observe` sees each of the searches.
    pub fn run_in_box(
        &self,
        engine: &Engine,
        model: &Model,
        instance: u32,
        photo: (&Photo, &Intrinsics),
        bounds: BoundingBox,
        starts: impl Fn(&Shot) -> Result<Vec<DMat4>, Error>,
        mut observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<(Shot, Found), Error> {
        let open = |known: Known| in_box(model, instance, photo, bounds, known);
        let single = self.single()?;
        let boxed = Boxed { engine, model, open: &|_, known| open(known), starts: &|_, shot| starts(shot) };
        let first = vec![open(Known::default())?];
        let mut pass = |_: &[usize], shots, starts: &[_]| single.shots(engine, model, shots, starts, &mut observe);
        let Outcome { shot, found, .. } = boxed.search(&[0], first, &mut pass)?.remove(0);
        Ok((shot, found))
    }

    /// The same where nothing is known of where in the photograph the object is: where it seems to be ([`Sightings`], [`Anywhere`]).
    pub fn run_anywhere(
        &self,
        engine: &Engine,
        model: &Model,
        instance: u32,
        photo: (&Photo, &Intrinsics),
        starts: impl Fn(&Shot) -> Result<Vec<DMat4>, Error>,
        mut observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<(Shot, Found), Error> {
        let single = self.single()?;
        let open = |bounds, known: Known| in_box(model, instance, photo, bounds, known);
        let mut pass = |_: &[usize], shots, starts: &[_]| single.shots(engine, model, shots, starts, &mut observe);
        let anywhere = Anywhere { engine, model, open: &open, starts: &starts, others: None };
        let found = anywhere.search(&Sightings::of(engine, model, instance, photo.0, &[])?, &mut pass)?;
        let nothing = || Error::Input { input: "photograph".into(), what: "nothing in it differs from what is around it".into() };
        found.map(|Outcome { shot, found, .. }| (shot, found)).ok_or_else(nothing)
    }

    /// All objects of the model that are anywhere in a photograph, with poses to be trusted ([`All`]).
    pub fn run_for_all(
        &self,
        engine: &Engine,
        model: &Model,
        photo: (&Photo, &Intrinsics),
        starts: impl Fn(&Shot) -> Result<Vec<DMat4>, Error>,
        mut observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<Vec<(Shot, Found)>, Error> {
        let single = self.single()?;
        let search = |instance: u32, sightings: &Sightings, place: Sighting, others: Option<Place>| {
            let open = |bounds, known: Known| in_box(model, instance, photo, bounds, known);
            let mut pass = |_: &[usize], shots, starts: &[_]| single.shots(engine, model, shots, starts, &mut observe);
            Anywhere { engine, model, open: &open, starts: &starts, others }.search_at(sightings, place, &mut pass)
        };
        let found = All { engine, model, photo: photo.0 }.search(0..model.layout.instances, |_| (), search)?;
        Ok(found.into_iter().map(|Outcome { shot, found, .. }| (shot, found)).collect())
    }

    /// Its first try alone.
    fn single(&self) -> Result<Search, Error> {
        let (first, _) = self.tries()?;
        Ok(Search { tries: vec![first.clone()], ..self.clone() })
    }

    /// Searches for objects as they stand, each from its own starts.
    pub fn shots(
        &self,
        engine: &Engine,
        model: &Model,
        shots: Vec<Shot>,
        starts: &[Vec<DMat4>],
        observe: Observe,
    ) -> Result<Vec<Outcome<()>>, Error> {
        let queries: Vec<Query> = shots.iter().zip(starts).map(|(shot, starts)| shot.query(starts.clone())).collect();
        let found = self.run(engine, model, &queries, observe)?;
        Ok(shots.into_iter().zip(found).map(|(shot, found)| Outcome { shot, found, log: () }).collect())
    }
}

/// The object in a box in a photograph, as the model takes it.
fn in_box(model: &Model, instance: u32, photo: (&Photo, &Intrinsics), bounds: BoundingBox, known: Known) -> Result<Shot, Error> {
    let side = model.metadata.side.unwrap_or(SIDE);
    Shot::in_box(photo, bounds, known, instance, side).ok_or_else(|| Error::Input {
        input: format!("box {:?}, {:?}", bounds.corner, bounds.size),
        what: "nothing in it differs from what is around it, or nothing is around it".into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ModelConfig;
    use crate::camera::{fixed24, pose_error};

    #[test]
    fn a_square_is_faced_from_the_side_that_a_pose_sees() {
        let model = Model::init(&ModelConfig { hidden: 4, latent: 2, instances: 1, tracing_steps: 1, density: true }, 0).unwrap();
        let intrinsics = Intrinsics { fx: 150.0, fy: 140.0, cx: -40.0, cy: 90.0, pixel_center: 0.0 };
        let shot = Shot::whole(vec![], intrinsics, 0, 64);
        assert!(shot.facing(&model, &DMat4::IDENTITY).unwrap_err().to_string().contains("radius"));
        let shot = Shot { distance: Some(2.5), ..shot };
        for camera in fixed24(1.3) {
            let looking_aside = camera * DMat4::from_rotation_y(0.3);
            for seen in [camera, looking_aside] {
                let facing = shot.facing(&model, &seen).unwrap();
                let DVec3 { x, y, z } = facing.inverse().transform_point3(DVec3::ZERO);
                assert!((150.0 * x / z - 40.0 - 32.0).abs() < 1e-9 && (140.0 * y / z + 90.0 - 32.0).abs() < 1e-9, "{facing}");
                let place = facing.w_axis.truncate();
                assert!((place - 2.5 / 1.3 * camera.w_axis.truncate()).length() < 1e-9, "{place}");
                // As starts all around are turned.
                let (angle, _) = pose_error(&facing, &shot.intrinsics.centred([64; 2], vec![camera])[0]);
                assert!(angle < 1e-4, "{angle}");
            }
        }
    }
}
