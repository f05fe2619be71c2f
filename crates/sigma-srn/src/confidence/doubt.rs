//! Whether a pose is to be trusted.

use serde::Serialize;

use crate::confidence::Calibration;
use crate::estimator::{Estimate, Ranked};
use crate::light::{COVERED, NOISE};
use crate::model::{Metadata, Model};
use crate::unseen::Unseen;

/// Why an estimate is not to be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Doubt {
    /// The loss is no number.
    Loss,
    /// It leaves more of the picture unexplained than true poses do.
    Unexplained,
    /// The camera is nearer to the object, or farther from it, than the model knows, see [`Metadata::knows_distance`](crate::Metadata::knows_distance):
    /// from close by, a part of one surface explains any picture of one colour, and what the network shows there is a guess.
    Distance,
    /// The object is less than half as large in the picture as in those that the model was calibrated with.
    Small,
    /// A pose elsewhere explains the picture nearly as well.
    Rival,
    /// It explains the picture by much of the object lying where the picture does not count, and of what is in sight neither its outline nor its colours
    /// tell: many poses are right.
    Hidden,
    /// Too little in the photograph in which it was looked for speaks for the object there, see [`Sightings::evidence`](crate::photo::Sightings::evidence); or too much in its box for the object seen from
    /// another side.
    Unlikely,
    /// Its outline ends far inside the box that was given around the object.
    Inside,
}

impl std::fmt::Display for Doubt {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Doubt::Loss => "the loss is no number",
            Doubt::Unexplained => "too much is unexplained",
            Doubt::Distance => "nearer or farther than the model knows",
            Doubt::Small => "too small in the picture",
            Doubt::Rival => "another pose does nearly as well",
            Doubt::Hidden => "too much of the object lies behind the mask, and what is in sight does not tell",
            Doubt::Unlikely => "too little in the photograph speaks for it",
            Doubt::Inside => "its outline ends far inside the box",
        })
    }
}

/// What a picture may leave unexplained where there is no calibration.
pub const UNEXPLAINED: f64 = 0.25;
/// What it may leave there in any case: as little tells no wrong pose from a mask that is not exact.
pub const LEAST_UNEXPLAINED: f64 = 0.12;
/// How many times that what pictures of the object leave that its training has looked at, see [`Metadata::unexplained`] (`docs/accuracy.md`).
const ABOVE_LEARNT: f64 = 1.6;
/// How much higher, as a part, the loss must be at another pose of an object that the model was not trained on, or that is partly hidden (`docs/accuracy.md`).
const RIVAL: f64 = 0.3;

/// How far apart poses are that are not the same minimum: a turn about the object in degrees.
pub(crate) const ELSEWHERE_DEG: f64 = 10.0;

impl Calibration {
    /// Why an estimate of this instance is not to be trusted, by what it leaves unexplained and by its rival, if there is one. An instance that
    /// is not in `at_truth` is taken for one as good as half of those that are.
    pub fn doubt(&self, instance: &str, unexplained: f64, rival_higher: Option<f64>) -> Option<Doubt> {
        let mut all: Vec<f64> = self.at_truth.values().copied().collect();
        all.sort_by(f64::total_cmp);
        let most = self.at_truth.get(instance).or(all.get(all.len() / 2));
        let is_explained = unexplained <= self.unexplained && most.is_none_or(|most| unexplained <= self.above_truth * most);
        match rival_higher {
            _ if !is_explained => Some(Doubt::Unexplained),
            Some(higher) if higher < self.rival => Some(Doubt::Rival),
            _ => None,
        }
    }

    /// Whether an object is so small in a picture that these estimates say little of it.
    pub fn is_small(&self, extent: f64) -> bool {
        self.seen.is_some_and(|seen| 2.0 * extent < seen.extent)
    }
}

impl Estimate {
    /// Why it is not to be trusted, if it is not: an estimate for an instance of `model`, whose view from there leaves so much of
    /// [`Estimate::target`] [`unexplained`]. Without a calibration a quarter may be, or less, see [`Metadata::unexplained`].
    pub fn doubt(&self, model: &Model, instance: u32, unexplained: f64) -> Option<Doubt> {
        let picture = match &model.metadata.calibration {
            Some(calibration) => {
                calibration.doubt(&model.instance_name(instance), unexplained, self.rival().map(|(_, higher)| higher))
            }
            None => {
                let learnt = model.metadata.unexplained.get(&model.instance_name(instance));
                let most = learnt.map_or(UNEXPLAINED, |most| (ABOVE_LEARNT * most).clamp(LEAST_UNEXPLAINED, UNEXPLAINED));
                unexplained_doubt(unexplained, most)
            }
        };
        self.doubt_besides(&model.metadata, picture)
    }

    /// The same, given what the picture says: the loss must be a number, and the object seen as the model knows it.
    fn doubt_besides(&self, metadata: &Metadata, picture: Option<Doubt>) -> Option<Doubt> {
        let is_unknown = !metadata.knows_distance(self.pose.distance());
        let is_small = metadata.calibration.as_ref().is_some_and(|known| known.is_small(self.extent));
        match picture {
            _ if !self.loss.is_finite() => Some(Doubt::Loss),
            None | Some(Doubt::Rival) if is_unknown => Some(Doubt::Distance),
            None | Some(Doubt::Rival) if is_small => Some(Doubt::Small),
            doubt => doubt,
        }
    }

    /// The best of the other starts that went as far as the winner, but to a pose elsewhere, and by which part its loss is higher.
    pub fn rival(&self) -> Option<(&Ranked, f64)> {
        let winner = self.ranking.first()?;
        let is_rival = |other: &&Ranked| other.phases == winner.phases && winner.pose.degrees_from(other.pose) > ELSEWHERE_DEG;
        let rival = self.ranking[1..].iter().find(is_rival)?;
        Some((rival, rival.loss / self.loss - 1.0))
    }
}

impl Unseen {
    /// The same as [`Estimate::doubt`], for an object that `model` was not trained on: its code bends to the picture at a wrong pose too, so what
    /// matters more than what is unexplained is whether the other known objects that it began with led to the same pose.
    pub fn doubt(&self, model: &Model, unexplained: f64) -> Option<Doubt> {
        let most = model.metadata.calibration.as_ref().map_or(UNEXPLAINED, |calibration| calibration.unexplained);
        let has_rival = self.estimate.rival().is_some_and(|(_, higher)| higher < RIVAL);
        let picture = unexplained_doubt(unexplained, most).or(has_rival.then_some(Doubt::Rival));
        self.estimate.doubt_besides(&model.metadata, picture)
    }
}

/// The part of a picture `[height, width, 3]` that a view leaves unexplained: the sum of absolute differences, over that to a white picture, of
/// the pixels that count (`weights`, `[height, width]`). 0: equal; 1: no better than nothing; not a number where one is in the view.
pub fn unexplained(rgb: &[f32], weights: Option<&[f32]>, view: &[f32]) -> f64 {
    let weight = |value: usize| weights.map_or(1.0, |weights| weights[value / 3]);
    let sum = |difference: &dyn Fn(usize) -> f32| {
        (0..rgb.len()).map(|value| f64::from(weight(value) * difference(value).abs())).sum::<f64>()
    };
    sum(&|value| rgb[value] - view[value].clamp(-1.0, 1.0)) / sum(&|value| rgb[value] - 1.0)
}

/// The doubt where more than `most` of a picture is [`unexplained`], also where that is no number.
pub fn unexplained_doubt(unexplained: f64, most: f64) -> Option<Doubt> {
    (unexplained.is_nan() || unexplained > most).then_some(Doubt::Unexplained)
}

/// How much darker than white a pixel is that shows an object, all channels together (they span 6).
const SHOWN: f64 = 0.3;
/// The part of an object that may lie where a picture does not count, where no more of its outline lies where it does. Of 80 searches for ten objects
/// all around which nothing counted, right poses hid 0.03 to 0.13 of the object, wrong ones 0.11 to 0.77 (`docs/accuracy.md`).
const HIDDEN: f64 = 0.1;

/// The doubt where more than a tenth of what a view `[height, width, 3]` shows lies where a picture does not count (`weights`, `[height, width]`): hardly any of
/// its outline lies where it does, or the view does not explain the object's colours, or a rival does nearly as well.
pub(crate) fn hidden_doubt(
    weights: &[f32],
    view: &[f32],
    width: usize,
    explains_colours: bool,
    rival_higher: Option<f64>,
) -> Option<Doubt> {
    let counts = |pixel: usize| f64::from(weights[pixel].clamp(0.0, 1.0));
    let darkness = darkness(view);
    let in_sight = (0..darkness.len()).map(|pixel| counts(pixel) * darkness[pixel]).sum::<f64>() / darkness.iter().sum::<f64>();
    if in_sight.is_nan() || in_sight >= 1.0 - HIDDEN {
        return None;
    }
    let is_object = |pixel: usize| darkness[pixel] > SHOWN;
    let right = (1..darkness.len()).filter(|pixel| pixel % width != 0).map(|pixel| (pixel - 1, pixel));
    let below = (width..darkness.len()).map(|pixel| (pixel - width, pixel));
    let outline: Vec<f64> = right
        .chain(below)
        .filter(|&(one, other)| is_object(one) != is_object(other))
        .map(|(one, other)| counts(one).min(counts(other)))
        .collect();
    let has_outline = outline.iter().sum::<f64>() > HIDDEN * outline.len() as f64;
    match rival_higher {
        _ if !has_outline || !explains_colours => Some(Doubt::Hidden),
        Some(higher) if higher < RIVAL => Some(Doubt::Rival),
        _ => None,
    }
}

/// How much darker than white each pixel is, all channels together.
fn darkness(rgb: &[f32]) -> Vec<f64> {
    rgb.chunks_exact(3).map(|pixel| pixel.iter().map(|colour| f64::from(1.0 - colour.clamp(-1.0, 1.0))).sum()).collect()
}

/// Whether a view `[pixels, 3]` is nearer to a picture `rgb` than one colour is, the mean of the object's own: where the object covers the picture
/// (`coverage [pixels]`), the view shows it, and the picture counts (`weights [pixels]`). Where it does so nowhere, nothing speaks against it.
pub(crate) fn explains_colours(rgb: &[f32], coverage: &[f32], weights: &[f32], view: &[f32]) -> bool {
    let shown = darkness(view);
    let both = |pixel: &usize| coverage[*pixel] >= COVERED && weights[*pixel] > 0.0 && shown[*pixel] > SHOWN;
    let pixels: Vec<usize> = (0..coverage.len()).filter(both).collect();
    let mean = |of: &dyn Fn(usize) -> f64| pixels.iter().map(|&pixel| of(pixel)).sum::<f64>() / pixels.len() as f64;
    let (mut left, mut variance) = (0.0, 0.0);
    for channel in 0..3 {
        let colour = |pixel: usize| f64::from(rgb[3 * pixel + channel]);
        let average = mean(&colour);
        left += mean(&|pixel| (colour(pixel) - f64::from(view[3 * pixel + channel].clamp(-1.0, 1.0))).powi(2));
        variance += mean(&|pixel| (colour(pixel) - average).powi(2)) + NOISE;
    }
    pixels.is_empty() || left <= variance
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use glam::DVec3;

    use super::*;
    use crate::camera::look_at_origin;
    use crate::confidence::Seen;
    use crate::confidence::tests::{calibration, estimate};
    use crate::model::ModelConfig;

    #[test]
    fn an_object_of_which_much_is_hidden_is_trusted_by_what_is_in_sight() {
        // A grey square of 8 × 8 pixels in the middle of 16 × 16.
        let inside =
            |pixel: usize, first: usize, last: usize| [pixel % 16, pixel / 16].map(|x| (first..last).contains(&x)) == [true; 2];
        let view: Vec<f32> = (0..3 * 256).map(|value| if inside(value / 3, 4, 12) { 0.0 } else { 1.0 }).collect();
        let doubt = |counts: &dyn Fn(usize) -> bool| {
            let weights: Vec<f32> = (0..256).map(|pixel| if counts(pixel) { 1.0 } else { 0.0 }).collect();
            hidden_doubt(&weights, &view, 16, true, None)
        };
        // All of it and nothing else; all but a rim of it; its left half, with what is around it, and without.
        assert_eq!(doubt(&|pixel| inside(pixel, 4, 12)), None);
        assert_eq!(doubt(&|pixel| inside(pixel, 5, 11)), Some(Doubt::Hidden));
        assert_eq!(doubt(&|pixel| pixel % 16 < 8), None);
        assert_eq!(doubt(&|pixel| inside(pixel, 4, 12) && pixel % 16 < 8), Some(Doubt::Hidden));
        // An object that fills the picture has no outline there.
        assert_eq!(hidden_doubt(&[1.0, 1.0, 0.0, 1.0], &[0.0; 12], 2, true, None), Some(Doubt::Hidden));
        assert_eq!(hidden_doubt(&[1.0; 4], &[0.0; 12], 2, true, None), None);
        // Its left half, with what is around it; then all of it: colours and rivals count only where something is hidden.
        let half: Vec<f32> = (0..256).map(|pixel| if pixel % 16 < 8 { 1.0 } else { 0.0 }).collect();
        for (explains, rival, doubt) in [
            (true, Some(0.4), None),
            (true, Some(0.2), Some(Doubt::Rival)),
            (false, Some(0.4), Some(Doubt::Hidden)),
            (false, None, Some(Doubt::Hidden)),
        ] {
            assert_eq!(hidden_doubt(&half, &view, 16, explains, rival), doubt, "{explains} {rival:?}");
            assert_eq!(hidden_doubt(&[1.0; 256], &view, 16, explains, rival), None);
        }
    }

    #[test]
    fn a_view_explains_colours_that_it_is_nearer_to_than_one_colour_is() {
        // Stripes; their background, and what does not count, say nothing.
        let picture: Vec<f32> = (0..300).map(|value| if value / 3 % 2 == 0 { -0.6 } else { 0.2 }).collect();
        let (mut coverage, mut weights) = ([1.0; 100], [1.0; 100]);
        coverage[..20].fill(0.5);
        weights[20..40].fill(0.0);
        let explains = |view: &dyn Fn(f32) -> f32| {
            let mut view: Vec<f32> = picture.iter().map(|&colour| view(colour)).collect();
            view[..120].fill(-1.0);
            explains_colours(&picture, &coverage, &weights, &view)
        };
        assert_eq!([0.0, 0.3, 0.5].map(|off| explains(&|colour| colour + off)), [true, true, false]);
        assert!(!explains(&|colour| -0.4 - colour), "the stripes the other way round");
        // It shows the object nowhere, or the picture does not.
        assert!(explains(&|_| 1.0) && explains_colours(&picture, &[], &weights, &picture));
    }

    #[test]
    fn an_estimate_is_trusted_by_what_its_object_allows() {
        let at_truth = [("well", 0.1), ("usual", 0.2), ("badly", 0.5)].map(|(name, most)| (name.to_string(), most));
        let known = Calibration {
            unexplained: 0.9,
            at_truth: at_truth.into(),
            above_truth: 1.5,
            rival: 0.1,
            ..calibration(1.0, [1.0; 6])
        };
        let cases =
            [("well", 0.14, true), ("well", 0.16, false), ("badly", 0.7, true), ("new", 0.29, true), ("new", 0.31, false)];
        for (instance, unexplained, trusted) in cases {
            let doubt = (!trusted).then_some(Doubt::Unexplained);
            assert_eq!(known.doubt(instance, unexplained, None), doubt, "{instance} {unexplained}");
        }
        assert_eq!([0.2, 0.05].map(|higher| known.doubt("well", 0.1, Some(higher))), [None, Some(Doubt::Rival)]);
        assert_eq!(known.doubt("well", f64::NAN, Some(0.05)), Some(Doubt::Unexplained));
        let old = Calibration { at_truth: BTreeMap::new(), ..known };
        assert_eq!([0.8, 1.0].map(|part| old.doubt("well", part, None)), [None, Some(Doubt::Unexplained)]);
    }

    #[test]
    fn a_pose_is_trusted_where_nothing_speaks_against_it() {
        let config = ModelConfig { hidden: 4, latent: 2, instances: 1, tracing_steps: 1, density: true };
        let plain = Model::init(&config, 0).unwrap();
        let model = |calibration: Option<Calibration>| {
            let metadata = Metadata { ray_sphere: Some(1.3), calibration, ..plain.metadata.clone() };
            Model { metadata, ..plain.clone() }
        };
        let learnt = |most: f64| {
            let model = model(None);
            let unexplained = [(plain.instance_name(0), most)].into();
            Model { metadata: Metadata { unexplained, ..model.metadata.clone() }, ..model }
        };
        let seen = Some(Seen { distance: 1.3, extent: 0.5 });
        let calibrated = model(Some(Calibration { unexplained: 0.5, rival: 0.4, seen, ..calibration(1.0, [1.0; 6]) }));
        let strict = model(Some(Calibration { unexplained: 0.5, rival: 0.6, seen, ..calibration(1.0, [1.0; 6]) }));
        let at = |distance: f64| estimate(look_at_origin(DVec3::new(0.0, distance, 0.0)));
        let small = Estimate { extent: 0.2, ..at(1.3) };
        let broken = Estimate { loss: f64::INFINITY, ..at(1.3) };
        // A rival's loss is half as much higher.
        for (model, estimate, part, doubt) in [
            (&calibrated, at(1.3), 0.4, None),
            (&calibrated, at(1.3), 0.6, Some(Doubt::Unexplained)),
            (&calibrated, at(0.6), 0.4, Some(Doubt::Distance)),
            (&calibrated, at(0.6), 0.6, Some(Doubt::Unexplained)),
            (&calibrated, small.clone(), 0.4, Some(Doubt::Small)),
            (&calibrated, broken, 0.4, Some(Doubt::Loss)),
            (&strict, at(1.3), 0.4, Some(Doubt::Rival)),
            (&strict, small.clone(), 0.4, Some(Doubt::Small)),
            (&model(None), at(1.3), 0.2, None),
            (&model(None), small, 0.2, None),
            (&model(None), at(1.3), 0.3, Some(Doubt::Unexplained)),
            (&model(None), at(0.6), 0.2, Some(Doubt::Distance)),
            (&learnt(0.1), at(1.3), 0.15, None),
            (&learnt(0.1), at(1.3), 0.17, Some(Doubt::Unexplained)),
            (&learnt(0.2), at(1.3), 0.3, Some(Doubt::Unexplained)),
            (&learnt(0.05), at(1.3), 0.11, None),
            (&learnt(0.05), at(1.3), 0.13, Some(Doubt::Unexplained)),
            (&learnt(0.1), at(0.6), 0.15, Some(Doubt::Distance)),
        ] {
            assert_eq!(estimate.doubt(model, 0, part), doubt, "{part} {:?}", estimate.pose);
        }
        // Of an object that the model does not know other limits hold.
        let unseen = |higher: f64| {
            let mut estimate = at(1.3);
            estimate.ranking[2].loss = (1.0 + higher) * estimate.loss;
            Unseen { estimate, model: plain.clone(), nearest: 0 }
        };
        assert_eq!([0.2, 0.4].map(|higher| unseen(higher).doubt(&strict, 0.4)), [Some(Doubt::Rival), None]);
        assert_eq!([&strict, &model(None)].map(|model| unseen(0.4).doubt(model, 0.4)), [None, Some(Doubt::Unexplained)]);
    }

    #[test]
    fn a_rival_is_elsewhere() {
        let estimate = estimate(look_at_origin(DVec3::new(1.0, -0.6, 0.5)));
        let (rival, higher) = estimate.rival().unwrap();
        assert_eq!((rival.start, higher), (5, 0.5));
    }

    #[test]
    fn unexplained_is_relative_to_an_empty_picture() {
        let picture = [0.5, 1.0, -0.5];
        assert_eq!(unexplained(&picture, None, &picture), 0.0);
        assert_eq!(unexplained(&picture, None, &[1.0, 1.7, 1.0]), 1.0);
        assert_eq!(unexplained(&picture, None, &[0.5, 1.0, -1.5]), 0.25);
        assert!(unexplained(&picture, None, &[0.5, f32::NAN, -0.5]).is_nan() && unexplained(&[1.0; 3], None, &[1.0; 3]).is_nan());
        let two = [0.5, 1.0, -0.5, -1.0, -1.0, -1.0];
        assert_eq!(unexplained(&two, Some(&[1.0, 0.0]), &[0.5, 1.0, -1.5, 1.0, 1.0, 1.0]), 0.25);
    }
}
