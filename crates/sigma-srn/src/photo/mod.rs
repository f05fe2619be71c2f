//! Photographs: from what a camera has taken to what a search compares, and back. What of a photograph is the object is said by a mask or by transparency, or found from
//! a box around it ([`Boxed`]), in a video from where the object was before ([`Follower`]).

mod all;
mod behind;
mod boxed;
mod follow;
mod in_sight;
mod looked;
mod shown;
mod sightings;
mod template;

pub use all::All;
pub use boxed::{Anywhere, Boxed, Outcome, Pass, SightingsOf, StartsOf};
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

    /// Whether the object is in sight at a place in the photograph, in its pixels.
    fn shows(&self, at: [f64; 2]) -> bool {
        let [x, y] = [0, 1].map(|k| ((at[k] - self.square.0[k] as f64) / self.pixels_of_photo()).floor());
        let is_in = [x, y].iter().all(|x| (0.0..f64::from(self.side)).contains(x));
        let covered = |coverage: &Vec<f32>| coverage[y as usize * self.side as usize + x as usize];
        is_in && self.coverage.as_ref().is_some_and(|coverage| covered(coverage) > 0.5)
    }

    /// In half as many pixels to a side, where that is a whole number.
    fn halved(self) -> Self {
        if !self.side.is_multiple_of(2) {
            return self;
        }
        let (side, from) = (self.side as usize / 2, self.side as usize);
        let four = |i: usize| {
            let first = 2 * (i / side) * from + 2 * (i % side);
            [first, first + 1, first + from, first + from + 1]
        };
        let counts = |pixel: usize| self.weights.as_ref().map_or(1.0, |weights| weights[pixel]);
        let count = |i: usize| four(i).map(counts).iter().sum::<f32>();
        // What does not count may be anything.
        let mean = |i: usize, of: &dyn Fn(usize) -> f32| {
            let sum = four(i).map(|pixel| counts(pixel) * of(pixel)).iter().sum::<f32>();
            if count(i) > 0.0 { sum / count(i) } else { of(four(i)[0]) }
        };
        let pixels = || 0..side * side;
        let rgb = pixels().flat_map(|i| [0, 1, 2].map(|c| mean(i, &|pixel| self.rgb[3 * pixel + c]))).collect();
        let weights = self.weights.as_ref().map(|_| pixels().map(|i| 0.25 * count(i)).collect());
        let coverage = self.coverage.as_ref().map(|coverage| pixels().map(|i| mean(i, &|pixel| coverage[pixel])).collect());
        let Intrinsics { fx, fy, cx, cy, pixel_center } = self.intrinsics;
        // Edges of pixels are whole numbers, half a pixel before their centres.
        let [cx, cy] = [cx, cy].map(|c| 0.5 * (c - pixel_center + 0.5) - 0.5 + pixel_center);
        let intrinsics = Intrinsics { fx: 0.5 * fx, fy: 0.5 * fy, cx, cy, pixel_center };
        Shot { side: side as u32, rgb, weights, coverage, intrinsics, ..self }
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
        let sightings = |_, instance: u32| Sightings::in_box(engine, model, instance, photo.0, bounds).map(Some);
        let starts = |_, shot: &Shot| starts(shot);
        let boxed = Boxed {
            engine,
            model,
            open: &|_, known| open(known),
            starts: &starts,
            given: &|_| Some(bounds),
            sightings: &sightings,
        };
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
    fn in_half_as_many_pixels_the_object_is_where_it_was() {
        let intrinsics = Intrinsics { fx: 150.0, fy: 140.0, cx: 3.25, cy: 1.5, pixel_center: 0.0 };
        let rgb: Vec<f32> = (0..48).map(|k| (k % 7) as f32 / 7.0).collect();
        let weights: Vec<f32> = (0..16).map(|i| if i % 4 == 0 { 0.0 } else { 1.0 }).collect();
        let shot = Shot { weights: Some(weights), ..Shot::whole(rgb.clone(), intrinsics, 0, 4) };
        let half = shot.clone().halved();
        assert_eq!((half.side, half.rgb.len(), half.pixels_of_photo()), (2, 12, 2.0 * shot.pixels_of_photo()));
        assert_eq!(half.weights, Some(vec![0.5, 1.0, 0.5, 1.0]));
        // Of the first column only the second counts.
        let mean = |pixels: &[usize]| pixels.iter().map(|pixel| rgb[3 * pixel]).sum::<f32>() / pixels.len() as f32;
        assert!((half.rgb[0] - mean(&[1, 5])).abs() < 1e-6 && (half.rgb[3] - mean(&[2, 3, 6, 7])).abs() < 1e-6);
        for pixel_center in [0.0, 0.5] {
            let shot = Shot { intrinsics: Intrinsics { pixel_center, ..intrinsics }, ..shot.clone() };
            let half = shot.clone().halved().intrinsics;
            // The edge between the second and the third column, of half as many between the first and the second.
            let ray = |of: Intrinsics, edge: f64| (edge - 0.5 + of.pixel_center - of.cx) / of.fx;
            assert!((ray(shot.intrinsics, 2.0) - ray(half, 1.0)).abs() < 1e-12);
        }
        assert_eq!(Shot::whole(vec![0.0; 27], intrinsics, 0, 3).halved().side, 3);
    }

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
