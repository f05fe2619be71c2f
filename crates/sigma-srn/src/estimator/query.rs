//! What is wanted: an image with what is known of it, and where the search for its pose starts.

use std::borrow::Cow;
use std::iter::{self, zip};

use glam::{DMat4, DVec2};

use super::align::hidden_side;
use super::options::{Options, Phase};
use super::settle::AROUND;
use crate::camera::{Intrinsics, Pose6};
use crate::mask::{Outline, has_outline, known, outlines, with_outline};
use crate::model::Model;
use crate::pixel_grid;

/// How far starts are turned that the search adds, in degrees. Not the 30° of `neighbor4`: one of them would be turned back to where it came from.
pub(super) const TURN_DEG: f64 = 40.0;

/// How far a closer look turns a camera, in degrees: half as far as those of `around84` are apart.
const CLOSER_DEG: f64 = 15.0;

/// By which factors it moves one nearer, and farther away: where a distance is a fifth wrong, a descent then begins less than a tenth off.
const CLOSER_BY: [f64; 2] = [0.88, 1.0 / 0.88];

/// How many [`closer_looks`] there are of a camera.
pub(super) const CLOSER_LOOKS: usize = 9;

/// How many times as many hypotheses go on, while rays are few, of a partly hidden object, or of many starts: what is in sight looks the same from more sides, and
/// among more of them more wrong ones look right.
const OF_DOUBTFUL: usize = 2;

/// More starts than this are many: of all rolls.
const MANY_STARTS: usize = 168;

/// Less than this of an object in sight is taken for this much: of what it says of a pose nothing is known.
const LEAST_IN_SIGHT: f64 = 0.1;

/// An image whose camera pose is wanted.
#[derive(Clone, Debug)]
pub struct Query {
    /// Number of the instance that it shows.
    pub instance: u32,
    /// Colours in [-1, 1], `[height, width, 3]`, white background.
    pub rgb: Vec<f32>,
    /// How much each pixel counts `[height, width]`, from 0, not at all: where something stands before the object, say. `None`: all
    /// the same. GMSD takes none.
    pub weights: Option<Vec<f32>>,
    /// How much of each pixel the object covers `[height, width]`, 0 to 1; the rest of it is white. Where it is known, a phase may make up
    /// for the light of the image, see [`Phase::light`], and for an outline that is not exact, see [`Phase::outlines`].
    pub coverage: Option<Vec<f32>>,
    /// How its outline is known to be wrong: the search begins with the mask made right by as much.
    pub outline: Outline,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Intrinsics of this image.
    pub intrinsics: Intrinsics,
    /// Where the search starts: `world_from_camera`.
    pub starts: Vec<DMat4>,
}

impl Query {
    /// Pixels that have a ray, as columns and rows.
    pub(crate) fn rays(&self, stride: u32) -> impl Iterator<Item = (u32, u32)> + use<> {
        pixel_grid(self.width, self.height, stride)
    }

    /// The same by number.
    pub(crate) fn pixels(&self, stride: u32) -> impl Iterator<Item = usize> + use<> {
        let width = self.width;
        self.rays(stride).map(move |(u, v)| (v * width + u) as usize)
    }

    /// The image with its mask made right.
    pub(crate) fn seen(&self, outline: Outline) -> Seen<'_> {
        let Query { rgb, coverage, weights, width, .. } = self;
        let (width, weights) = (*width as usize, weights.as_deref());
        let Some(coverage) = coverage.as_deref().filter(|_| outline != Outline::AS_GIVEN) else {
            let coverage = coverage.as_deref().unwrap_or_default();
            return Seen { rgb: rgb.into(), coverage: coverage.into(), weights: weights.map(Cow::from) };
        };
        let (rgb, coverage) = with_outline(rgb, coverage, weights, width, outline);
        let weights = match outline.missing {
            DVec2::ZERO => weights.map(Cow::from),
            missing => {
                let mut known = known(&coverage, weights, width, missing);
                zip(&mut known, weights.into_iter().flatten()).for_each(|(known, weight)| *known *= weight);
                Some(known.into())
            }
        };
        Seen { rgb: rgb.into(), coverage: coverage.into(), weights }
    }

    /// Whether rays of this stride see a pixel that counts.
    pub(crate) fn sees(&self, stride: u32) -> bool {
        self.pixels(stride).any(|pixel| self.weights.as_ref().is_none_or(|weights| weights[pixel] > 0.0))
    }

    /// Whether the mask has an outline that may be wrong.
    pub(crate) fn has_outline(&self) -> bool {
        self.coverage.as_ref().is_some_and(|coverage| has_outline(coverage, self.weights.as_deref()))
    }

    /// See [`Estimate::in_sight`](super::Estimate::in_sight): by how much each pixel counts.
    pub(crate) fn in_sight(&self, pose: &Pose6, weights: Option<&[f32]>) -> f64 {
        let Some(weights) = weights else { return 1.0 };
        let Intrinsics { fx, fy, cx, cy, pixel_center } = self.intrinsics;
        let centre = pose.to_matrix().inverse().w_axis;
        let is_inside = |(u, v): (u32, u32)| {
            let [x, y] = [(u, fx, cx), (v, fy, cy)].map(|(at, f, c)| (f64::from(at) + pixel_center - c) / f);
            (x * centre.z - centre.x).hypot(y * centre.z - centre.y) < 0.5
        };
        let inside: Vec<f64> =
            zip(self.rays(1), weights).filter(|(at, _)| is_inside(*at)).map(|(_, weight)| f64::from(weight.min(1.0))).collect();
        if inside.is_empty() { 1.0 } else { (inside.iter().sum::<f64>() / inside.len() as f64).max(LEAST_IN_SIGHT) }
    }

    /// On which side something is before the object, see [`hidden_side`].
    pub(crate) fn hidden_side(&self) -> Option<DVec2> {
        hidden_side(self.coverage.as_ref()?, self.weights.as_ref()?, self.width as usize)
    }

    /// The starts, and those that are added.
    pub(crate) fn all_starts(&self, options: &Options) -> Vec<DMat4> {
        let around =
            (self.starts.len() < options.min_starts).then(|| self.starts.iter().flat_map(|start| turned(start, TURN_DEG)));
        self.starts.iter().copied().chain(around.into_iter().flatten()).collect()
    }

    /// How many hypotheses enter a phase, see [`Phase::keep`].
    pub(super) fn keep(&self, phase: &Phase) -> usize {
        if phase.outlines {
            return if self.has_outline() { phase.keep } else { 0 };
        }
        let is_wide = phase.stride > 1 && (self.starts.len() > MANY_STARTS || self.hidden_side().is_some());
        phase.keep.saturating_mul(if is_wide { OF_DOUBTFUL } else { 1 })
    }

    /// How many rays there are in the phase in which there are the most.
    pub(crate) fn most_rays(&self, options: &Options) -> usize {
        let starts = self.all_starts(options);
        // A look renders each place once, with rays half as far apart where it makes other views of that.
        let places = starts.chunk_by(|one, other| one.w_axis == other.w_axis).count();
        let look = options.first_look().map(|(look, _)| places * self.rays(look.stride.div_ceil(2)).count());
        let others = options.phases.iter().skip(usize::from(look.is_some())).map(|phase| {
            let tried = if phase.outlines { outlines().count() } else { 1 } * if phase.closer_look { CLOSER_LOOKS } else { 1 };
            tried * starts.len().min(self.keep(phase)) * self.rays(phase.stride).count()
        });
        let last = options.phases.last().filter(|_| options.settle > 0);
        let settling = last.map(|last| AROUND * self.rays(last.stride).count());
        look.into_iter().chain(others).chain(settling).max().unwrap_or(0)
    }

    /// Says what is wrong with it.
    pub(crate) fn check(&self, model: &Model, options: &Options) -> Result<(), String> {
        let &Query { width, height, .. } = self;
        let pixels = width as usize * height as usize;
        if self.rgb.len() != 3 * pixels || self.rgb.is_empty() {
            return Err(format!("{} values for {width} × {height} pixels of 3", self.rgb.len()));
        }
        if self.instance >= model.layout.instances {
            return Err(format!("instance {}, but the model has {}", self.instance, model.layout.instances));
        }
        if self.starts.is_empty() {
            return Err("no starts".into());
        }
        if self.starts.iter().any(|start| !start.is_finite()) {
            return Err("a start has values that are not finite".into());
        }
        if options.phases.iter().any(|phase| self.rays(phase.stride).next().is_none()) {
            return Err(format!("a stride larger than {width} × {height} pixels"));
        }
        if self.coverage.as_ref().is_some_and(|c| c.len() != pixels || c.iter().any(|cover| !(0.0..=1.0).contains(cover))) {
            return Err(format!("needs a coverage of {pixels} values from 0 to 1"));
        }
        let side = f64::from(width.max(height));
        let Outline { dilation, cut, missing, undecided } = self.outline;
        if let Some(by) =
            [dilation, cut.x, cut.y, missing.x, missing.y, undecided].into_iter().find(|by| by.is_nan() || by.abs() > side)
        {
            return Err(format!("a mask whose outline is {by} pixels off, where the image has {side}"));
        }
        if let Some(weights) = &self.weights {
            if weights.len() != pixels || weights.iter().any(|weight| !(0.0..f32::INFINITY).contains(weight)) {
                return Err(format!("needs {pixels} weights of 0 or more, finite"));
            }
            if options.phases.iter().any(|phase| !self.sees(phase.stride)) {
                return Err("too few pixels count: a phase of the search sees none of them".into());
            }
        }
        Ok(())
    }
}

/// An image as it is compared: with its mask made right.
pub(crate) struct Seen<'a> {
    /// Colours, see [`Query::rgb`].
    pub rgb: Cow<'a, [f32]>,
    /// How much the object covers, see [`Query::coverage`]; empty where that is not known.
    pub coverage: Cow<'a, [f32]>,
    /// How much each pixel counts, see [`Query::weights`].
    pub weights: Option<Cow<'a, [f32]>>,
}

impl Seen<'_> {
    fn weight(&self, pixel: usize) -> f32 {
        self.weights.as_ref().map_or(1.0, |weights| weights[pixel])
    }

    /// Weights of the rays of these pixels, scaled to a mean of 1: losses of pictures with masks and without are then of one kind.
    pub fn ray_weights(&self, pixels: impl Iterator<Item = usize>) -> Vec<f32> {
        let weights: Vec<f32> = pixels.map(|pixel| self.weight(pixel)).collect();
        let mean = weights.iter().sum::<f32>() / weights.len() as f32;
        weights.into_iter().map(|weight| weight / mean).collect()
    }

    /// How many of the pixels that count the object covers.
    pub fn area(&self) -> f64 {
        self.coverage.iter().enumerate().map(|(pixel, cover)| f64::from(cover * self.weight(pixel))).sum()
    }
}

/// A camera as it is, [`turned`] by 15°, and nearer and farther away.
pub(super) fn closer_looks(world_from_camera: &DMat4) -> impl Iterator<Item = DMat4> {
    let as_it_is = *world_from_camera;
    let moved = move |by: f64| DMat4 { w_axis: (by * as_it_is.w_axis.truncate()).extend(1.0), ..as_it_is };
    iter::once(as_it_is).chain(turned(world_from_camera, CLOSER_DEG)).chain(CLOSER_BY.map(moved))
}

/// A camera turned about the object, to either side about each of its axes.
pub(super) fn turned(world_from_camera: &DMat4, degrees: f64) -> impl Iterator<Item = DMat4> {
    let axes = [world_from_camera.x_axis, world_from_camera.y_axis, world_from_camera.z_axis];
    let turns = axes.into_iter().flat_map(move |axis| {
        [-degrees, degrees].map(|angle| DMat4::from_axis_angle(axis.truncate().normalize(), angle.to_radians()))
    });
    turns.map(|turn| turn * *world_from_camera)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::Effort;

    fn blank() -> Query {
        Query {
            instance: 0,
            rgb: vec![1.0; 3 * 64 * 64],
            weights: None,
            coverage: None,
            outline: Outline::AS_GIVEN,
            width: 64,
            height: 64,
            intrinsics: Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.5 },
            starts: vec![],
        }
    }

    #[test]
    fn added_starts_are_40_degrees_away_on_the_same_sphere() {
        let start = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        let added: Vec<DMat4> = turned(&start, TURN_DEG).collect();
        assert_eq!(added.len(), 6);
        for (k, pose) in added.iter().enumerate() {
            let (degrees, _) = crate::camera::pose_error(pose, &start);
            let [near, far] = [&start, pose].map(|pose| pose.w_axis.truncate().length());
            assert!((degrees - 40.0).abs() < 1e-6 && (near - far).abs() < 1e-12, "{k}: {degrees}°");
            assert!(added[..k].iter().all(|other| crate::camera::pose_error(pose, other).0 > 40.0), "{k}");
        }
    }

    #[test]
    fn of_an_object_that_is_partly_hidden_or_of_many_starts_twice_as_many_go_on_while_rays_are_few() {
        let disc = |pixel: i32| f32::from(((pixel % 64 - 32).pow(2) + (pixel / 64 - 32).pow(2)) < 400);
        let coverage = Some((0..64 * 64).map(disc).collect());
        let whole = Query { coverage, ..blank() };
        let half = Query { weights: Some((0..64 * 64).map(|pixel| f32::from(pixel % 64 < 32)).collect()), ..whole.clone() };
        let keep = |query: &Query| Options::of(Effort::Fast).phases.iter().map(|phase| query.keep(phase)).collect::<Vec<_>>();
        assert_eq!(keep(&whole), [usize::MAX, 12, 6, 2, 1, 1, 1]);
        assert_eq!(keep(&half), [usize::MAX, 24, 12, 4, 1, 1, 1]);
        assert_eq!(keep(&blank()), [usize::MAX, 12, 6, 2, 0, 1, 1]);
        let from = |starts: usize, query: &Query| keep(&Query { starts: vec![DMat4::IDENTITY; starts], ..query.clone() });
        assert_eq!([0, 1].map(|more| from(MANY_STARTS + more, &whole)), [keep(&whole), keep(&half)]);
        assert_eq!(from(MANY_STARTS + 1, &half), keep(&half), "not four times as many");
    }

    #[test]
    fn of_an_object_as_much_is_in_sight_as_counts_of_the_disc_around_it() {
        let query = blank();
        let pose = Pose6::from_matrix(&crate::camera::look_at_origin(glam::DVec3::new(0.0, 1.3, 0.0)));
        let in_sight = |counts: &dyn Fn(f64, f64) -> bool| {
            let weight = |pixel: u32| f32::from(counts(f64::from(pixel % 64) - 31.5, f64::from(pixel / 64) - 31.5));
            query.in_sight(&pose, Some(&(0..64 * 64).map(weight).collect::<Vec<_>>()))
        };
        assert_eq!(query.in_sight(&pose, None), 1.0);
        // The disc has a radius of 0.5 · 74.4 / 1.3 pixels, 28.6.
        assert_eq!([28.5, 27.0].map(|radius| in_sight(&|x, y| x.hypot(y) < radius) == 1.0), [false, false]);
        assert_eq!(in_sight(&|x, y| x.hypot(y) < 28.7), 1.0);
        assert_eq!([in_sight(&|x, _| x > 0.0), in_sight(&|_, y| y < 0.0)], [0.5; 2]);
        assert_eq!(in_sight(&|x, y| x.hypot(y) > 28.7), LEAST_IN_SIGHT);
        // Beside the picture is no disc.
        let aside = crate::camera::look_at_origin(glam::DVec3::new(0.0, 1.3, 0.0)) * DMat4::from_rotation_y(1.5);
        assert_eq!(query.in_sight(&Pose6::from_matrix(&aside), Some(&[0.0; 64 * 64])), 1.0);
    }

    #[test]
    fn no_added_start_is_the_pose_that_others_were_turned_away_from() {
        let truth = crate::camera::look_at_origin(glam::DVec3::new(0.9, -0.7, 0.6));
        for start in crate::camera::neighbor4(&truth).iter().flat_map(|start| turned(start, TURN_DEG)) {
            let (degrees, _) = crate::camera::pose_error(&start, &truth);
            assert!(degrees > 5.0, "{degrees}°");
        }
    }
}
