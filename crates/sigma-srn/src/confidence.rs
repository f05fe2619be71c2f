//! How sure an estimate is. The second derivatives `B` of the loss say how a pose error shows in the picture, and so in which
//! directions it can hide. The renderer does not know the object exactly; how far off that leaves the poses, only known ones can tell.

use std::collections::BTreeMap;

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::estimator::{Estimate, Ranked};
use crate::model::{Metadata, Model};
use crate::unseen::Unseen;

/// A symmetric matrix over a motion, see [`motion`].
pub type Matrix6 = [[f64; 6]; 6];

/// An estimate whose true pose is known.
#[derive(Clone, Debug)]
pub struct Known {
    /// Name of the object.
    pub instance: String,
    /// From the estimate to the true pose, see [`motion`].
    pub motion: [f64; 6],
    /// See [`Estimate::shape`].
    pub shape: Matrix6,
}

/// What estimates of known poses told of a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// The covariance of an estimate is this times `loss · B⁻¹`,
    pub curvature: f64,
    /// and these variances on its diagonal: what the errors of all estimates have in common;
    pub floor: [f64; 6],
    /// by instance, so many times both together, where the errors at one object tell of those at another view of it. Others: 1.
    #[serde(default)]
    pub sizes: BTreeMap<String, f64>,
    /// Part of a picture that an estimate to be trusted leaves unexplained at most.
    pub unexplained: f64,
    /// By instance, the part of a picture that its true poses leave unexplained at most: the network knows one object better than another.
    #[serde(default)]
    pub at_truth: BTreeMap<String, f64>,
    /// How many times that an estimate to be trusted leaves unexplained at most.
    #[serde(default)]
    pub above_truth: f64,
    /// How much higher, as a part, the loss must be at the next best pose elsewhere for an estimate to be trusted.
    pub rival: f64,
    /// Number of estimates that this is from.
    pub views: u32,
    /// How large and how far away their objects were.
    #[serde(default)]
    pub seen: Option<Seen>,
}

/// How the estimates of a [`Calibration`] see their objects, the medians.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// Distance of the camera from the object's centre, object units.
    pub distance: f64,
    /// See [`Estimate::extent`].
    pub extent: f64,
}

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
    /// It explains the picture by much of the object, and by nearly all of its outline, lying where the picture does not count: there may be
    /// anything, and of what is left in sight many poses are right.
    Hidden,
}

impl std::fmt::Display for Doubt {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Doubt::Loss => "the loss is no number",
            Doubt::Unexplained => "too much is unexplained",
            Doubt::Distance => "nearer or farther than the model knows",
            Doubt::Small => "too small in the picture",
            Doubt::Rival => "another pose does nearly as well",
            Doubt::Hidden => "too much of the object lies behind the mask, its outline too",
        })
    }
}

/// How far off a pose may be, provided that it is no other one altogether.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Confidence {
    /// Standard deviation of the rotation about all axes, degrees.
    pub rotation_deg: f64,
    /// Standard deviation of the camera's place, object units.
    pub translation: f64,
    /// Covariance of the motion from the estimate to the truth: a turn about the object's centre (rad), then a shift (object units), both in
    /// the axes (OpenCV's) of the estimated camera.
    pub covariance: Matrix6,
}

impl Confidence {
    /// Of an estimate for an instance of `model`, if it is calibrated.
    pub fn of(model: &Model, instance: u32, estimate: &Estimate) -> Option<Self> {
        let covariance = estimate.covariance(&model.instance_name(instance), model.metadata.calibration.as_ref()?)?;
        let (rotation_deg, translation) = deviations(&estimate.pose.to_matrix(), &covariance);
        Some(Confidence { rotation_deg, translation, covariance })
    }
}

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

    /// [`Calibration::floor`] for an estimate. In a smaller picture of the object errors grow as a pixel does; and how far away it is, which
    /// shows in how large it is, is known to a part of the distance.
    fn floor_of(&self, estimate: &Estimate) -> [f64; 6] {
        let Some(seen) = self.seen else { return self.floor };
        let pixel = (seen.extent / estimate.extent).max(1.0);
        let farther = (estimate.pose.distance() / seen.distance).max(1.0);
        let [a, b, c, x, y, z] = self.floor.map(|variance| pixel * pixel * variance);
        [a, b, c, x, y, farther * farther * z]
    }
}

/// What the squared distance of six normal numbers from their mean, in units of their covariance, is below in 95 % of all cases.
pub const WITHIN_95: f64 = 12.591_587;

/// How far apart poses are that are not the same minimum: a turn about the object in degrees.
const ELSEWHERE_DEG: f64 = 10.0;

/// The motion `(ω, υ)` about the object that takes one pose to another, in the axes of the first one's camera: the camera turned about the
/// object's centre by `ω` (radians), then shifted by `υ` (object units).
pub fn motion(from: &DMat4, to: &DMat4) -> [f64; 6] {
    let camera_from_world = DMat3::from_mat4(*from).transpose();
    let turn = camera_from_world * DMat3::from_mat4(*to);
    let shift = camera_from_world * to.w_axis.truncate() - turn * (camera_from_world * from.w_axis.truncate());
    let [a, b, c] = DQuat::from_mat3(&turn).normalize().to_scaled_axis().to_array();
    [a, b, c, shift.x, shift.y, shift.z]
}

/// Where a mask says where the object ends: how much larger all variances are; by how many pixels the outline is still off when it has been
/// found; and by which part of that, since what is cut away, or left on, is hardly the same all around (the latter two are standard deviations). By pictures
/// whose masks were made wrong (`docs/accuracy.md`).
const CUT_OUT: f64 = 2.0;
const OUTLINE: f64 = 0.25;
const OF_MOVED: f64 = 0.3;

/// What a picture may leave unexplained where there is no calibration.
const UNEXPLAINED: f64 = 0.25;
/// How much higher, as a part, the loss must be at another pose of an object that the model was not trained on (`docs/accuracy.md`).
const UNSEEN_RIVAL: f64 = 0.3;

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

/// The doubt where more than a tenth of what a view shows `[height, width, 3]` lies where a picture does not count (`weights`, `[height, width]`), and hardly
/// any of its outline where it does.
pub(crate) fn hidden_doubt(weights: &[f32], view: &[f32], width: usize) -> Option<Doubt> {
    let counts = |pixel: usize| f64::from(weights[pixel].clamp(0.0, 1.0));
    let darkness: Vec<f64> =
        view.chunks_exact(3).map(|pixel| pixel.iter().map(|colour| f64::from(1.0 - colour.clamp(-1.0, 1.0))).sum()).collect();
    let in_sight = (0..darkness.len()).map(|pixel| counts(pixel) * darkness[pixel]).sum::<f64>() / darkness.iter().sum::<f64>();
    let is_object = |pixel: usize| darkness[pixel] > SHOWN;
    let right = (1..darkness.len()).filter(|pixel| pixel % width != 0).map(|pixel| (pixel - 1, pixel));
    let below = (width..darkness.len()).map(|pixel| (pixel - width, pixel));
    let outline: Vec<f64> = right
        .chain(below)
        .filter(|&(one, other)| is_object(one) != is_object(other))
        .map(|(one, other)| counts(one).min(counts(other)))
        .collect();
    let has_outline = outline.iter().sum::<f64>() > HIDDEN * outline.len() as f64;
    (in_sight < 1.0 - HIDDEN && !has_outline).then_some(Doubt::Hidden)
}

impl Estimate {
    /// Why it is not to be trusted, if it is not: an estimate for an instance of `model`, whose view from there leaves so much of
    /// [`Estimate::target`] [`unexplained`]. Without a calibration a quarter may be.
    pub fn doubt(&self, model: &Model, instance: u32, unexplained: f64) -> Option<Doubt> {
        let picture = match &model.metadata.calibration {
            Some(calibration) => {
                calibration.doubt(&model.instance_name(instance), unexplained, self.rival().map(|(_, higher)| higher))
            }
            None => unexplained_doubt(unexplained, UNEXPLAINED),
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

    /// `loss · B⁻¹`, the shape of the estimate's errors. `None` without second derivatives, or where they are not those of a minimum.
    pub fn shape(&self) -> Option<Matrix6> {
        let lower = cholesky(self.curvature.as_ref()?)?;
        // Row k of L⁻¹ᵀ is the solution for the k-th unit vector.
        let columns: Matrix6 = std::array::from_fn(|k| forward(&lower, std::array::from_fn(|i| f64::from(i == k))));
        let entry = |i: usize, j: usize| columns[i].iter().zip(&columns[j]).map(|(a, b)| a * b).sum::<f64>();
        Some(std::array::from_fn(|i| std::array::from_fn(|j| self.loss * entry(i, j))))
    }

    /// Covariance of the motion from the estimated pose of this instance to the true one; `None` where there is no [`Estimate::shape`].
    pub fn covariance(&self, instance: &str, calibration: &Calibration) -> Option<Matrix6> {
        let size = calibration.sizes.get(instance).copied().unwrap_or(1.0);
        let mixed = mixed(&self.shape()?, calibration.curvature, &calibration.floor_of(self));
        let Some(outline) = self.outline else { return Some(mixed.map(|row| row.map(|entry| size * entry))) };
        // The views that a calibration is from have no masks. An object whose outline is taken to be farther out seems larger, and nearer.
        let mut covariance = mixed.map(|row| row.map(|entry| CUT_OUT * size * entry));
        let radius = 0.5 * self.extent * f64::from(self.width);
        covariance[5][5] += (self.pose.distance() * OUTLINE.hypot(OF_MOVED * outline.length()) / radius).powi(2);
        Some(covariance)
    }

    /// Whether a pose lies within the ellipsoid that 95 % of all true poses of this instance lie in, if the errors are normal.
    pub fn states(&self, pose: &DMat4, instance: &str, calibration: &Calibration) -> Option<bool> {
        let (_, squared) = distance(&self.covariance(instance, calibration)?, &motion(&self.pose.to_matrix(), pose))?;
        Some(squared <= WITHIN_95)
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
        let has_rival = self.estimate.rival().is_some_and(|(_, higher)| higher < UNSEEN_RIVAL);
        let picture = unexplained_doubt(unexplained, most).or(has_rival.then_some(Doubt::Rival));
        self.estimate.doubt_besides(&model.metadata, picture)
    }
}

/// `curvature`, `floor` and `sizes` of a [`Calibration`]: the most likely mixture of what depends on the view and what does not, and what the
/// errors at each object say of the next one there; then enlarged until 95 % of the motions lie within the ellipsoids that say so.
pub fn fit(known: &[Known]) -> Option<(f64, [f64; 6], BTreeMap<String, f64>)> {
    let count = known.len() as f64;
    let mean = |of: &dyn Fn(&Known) -> f64| known.iter().map(of).sum::<f64>() / count;
    let squares: [f64; 6] = std::array::from_fn(|k| mean(&|known| known.motion[k] * known.motion[k]));
    // Either part alone is as large as the errors are: the mixture is looked for between them and a thousandth.
    let whole = mean(&|known| distance(&known.shape, &known.motion).map_or(f64::NAN, |(_, squared)| squared / 6.0));
    if squares.contains(&0.0) || !whole.is_finite() {
        return None;
    }
    let parts = || std::iter::once(0.0).chain((0..=24).map(|k| 10f64.powf(-3.0 + f64::from(k) / 8.0)));
    let distances = |a: f64, b: f64| -> Option<Vec<(f64, f64)>> {
        let floor = squares.map(|square| b * square);
        known.iter().map(|known| distance(&mixed(&known.shape, a * whole, &floor), &known.motion)).collect()
    };
    let unlikely =
        |distances: &[(f64, f64)]| distances.iter().map(|(log_determinant, squared)| log_determinant + squared).sum::<f64>();
    let mixtures = parts().flat_map(|a| parts().map(move |b| (a, b)));
    let likely = mixtures.filter_map(|(a, b)| distances(a, b).map(|distances| (unlikely(&distances), a, b)));
    let (_, a, b) = likely.min_by(|one, other| one.0.total_cmp(&other.0))?;
    let squared: Vec<f64> = distances(a, b)?.into_iter().map(|(_, squared)| squared).collect();
    let factor = within_95(squared.clone());
    let (sizes, of_others) = sizes(known, &squared);
    let of_each = within_95(squared.iter().zip(&of_others).map(|(squared, size)| squared / size).collect());
    let sizes = sizes.into_iter().map(|(instance, size)| (instance, size * of_each / factor)).collect();
    Some((factor * a * whole, squares.map(|square| factor * b * square), sizes))
}

/// By how much ellipsoids are to be enlarged for 95 % of these squared distances to lie within, and of the next one.
fn within_95(mut squared: Vec<f64>) -> f64 {
    squared.sort_by(f64::total_cmp);
    // The next one is as likely to lie anywhere between these: below the rank that 95 % of n + 1 are.
    let rank = (0.95 * (squared.len() as f64 + 1.0)).ceil() as usize;
    // The view of that rank itself lies within, however the ellipsoid is rounded.
    (1.0 + 1e-9) * squared[rank.min(squared.len()) - 1] / WITHIN_95
}

/// How large the squared distances at each object are, drawn to the mean of all by as many views more as make those left out one by one the
/// most likely; none if each object is like all. With them, for each view, the size by the other views of its object.
fn sizes(known: &[Known], squared: &[f64]) -> (BTreeMap<String, f64>, Vec<f64>) {
    let mean = squared.iter().sum::<f64>() / squared.len() as f64;
    let mut sums = BTreeMap::<&str, (f64, f64)>::new();
    for (known, squared) in known.iter().zip(squared) {
        let (views, sum) = sums.entry(&known.instance).or_default();
        (*views, *sum) = (*views + 1.0, *sum + squared);
    }
    let alike = vec![1.0; known.len()];
    let of_others = |more: f64| -> Vec<f64> {
        let of = |(known, squared): (&Known, &f64)| {
            let (views, sum) = sums[&*known.instance];
            (more + (sum - squared) / mean) / (more + views - 1.0)
        };
        known.iter().zip(squared).map(of).collect()
    };
    let unlikely = |sizes: &[f64]| {
        sizes.iter().zip(squared).map(|(size, squared)| 6.0 * size.ln() + 6.0 * squared / mean / size).sum::<f64>()
    };
    let candidates = (0..=5).map(|k| f64::from(1 << k)).map(|more| (more, of_others(more)));
    match candidates.min_by(|(_, one), (_, other)| unlikely(one).total_cmp(&unlikely(other))) {
        Some((more, of_others)) if unlikely(&of_others) < unlikely(&alike) => {
            let size = |(views, sum): (f64, f64)| (more + sum / mean) / (more + views);
            (sums.into_iter().map(|(instance, sums)| (instance.to_string(), size(sums))).collect(), of_others)
        }
        _ => (BTreeMap::new(), alike),
    }
}

/// Standard deviations of an estimate: of the turn in degrees, and of the camera's place in object units; each the root of the sum over
/// three axes.
fn deviations(pose: &DMat4, covariance: &Matrix6) -> (f64, f64) {
    let block = |row: usize, column: usize| {
        let at = |i: usize| DVec3::from_array([0, 1, 2].map(|k| covariance[row + k][column + i]));
        DMat3::from_cols(at(0), at(1), at(2))
    };
    let [turn, turn_shift, shift] = [block(0, 0), block(0, 3), block(3, 3)];
    let trace = |m: DMat3| m.x_axis.x + m.y_axis.y + m.z_axis.z;
    // The camera's place moves by ω × c + υ.
    let DVec3 { x, y, z } = DMat3::from_mat4(*pose).transpose() * pose.w_axis.truncate();
    let cross = DMat3::from_cols(DVec3::new(0.0, -z, y), DVec3::new(z, 0.0, -x), DVec3::new(-y, x, 0.0));
    let place = cross * turn * cross.transpose() + cross * turn_shift + (cross * turn_shift).transpose() + shift;
    (trace(turn).sqrt().to_degrees(), trace(place).sqrt())
}

fn mixed(shape: &Matrix6, curvature: f64, floor: &[f64; 6]) -> Matrix6 {
    let entry = |i: usize, j: usize| curvature * shape[i][j] + if i == j { floor[i] } else { 0.0 };
    std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)))
}

/// The logarithm of a covariance's determinant, and the squared distance of a motion from none in its units; `None` if it is not positive.
fn distance(covariance: &Matrix6, motion: &[f64; 6]) -> Option<(f64, f64)> {
    let lower = cholesky(covariance)?;
    let log_determinant = (0..6).map(|k| 2.0 * lower[k][k].ln()).sum();
    Some((log_determinant, forward(&lower, *motion).iter().map(|x| x * x).sum()))
}

/// `L` of `L Lᵀ = m`; `None` if `m` is not positive.
fn cholesky(m: &Matrix6) -> Option<Matrix6> {
    let mut lower = [[0.0; 6]; 6];
    for i in 0..6 {
        for j in 0..=i {
            let sum = m[i][j] - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            // Also where it is no number.
            if i == j && !(sum > 0.0 && sum.is_finite()) {
                return None;
            }
            lower[i][j] = if i == j { sum.sqrt() } else { sum / lower[j][j] };
        }
    }
    Some(lower)
}

/// By how much second derivatives and a gradient promise a lower loss, `½ gᵀ B⁻¹ g`: nothing where they are not those near a minimum.
pub(crate) fn promise(curvature: &Matrix6, gradient: &[f64; 6]) -> f64 {
    let squares = |lower: Matrix6| forward(&lower, *gradient).iter().map(|x| x * x).sum::<f64>();
    cholesky(curvature).map_or(0.0, |lower| 0.5 * squares(lower))
}

/// `L⁻¹ x`.
fn forward(lower: &Matrix6, mut x: [f64; 6]) -> [f64; 6] {
    for i in 0..6 {
        let known: f64 = (0..i).map(|k| lower[i][k] * x[k]).sum();
        x[i] = (x[i] - known) / lower[i][i];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Pose6, look_at_origin};
    use crate::mask::Outline;
    use crate::model::ModelConfig;
    use crate::random::{normal, stream};

    /// A positive matrix with unlike scales.
    fn curvature() -> Matrix6 {
        let factor: Matrix6 =
            std::array::from_fn(|i| std::array::from_fn(|j| ((3 * i + 5 * j) % 7) as f64 - 3.0 + if i == j { 9.0 } else { 0.0 }));
        std::array::from_fn(|i| std::array::from_fn(|j| (0..6).map(|k| factor[i][k] * factor[j][k]).sum()))
    }

    fn estimate(pose: DMat4) -> Estimate {
        let pose = Pose6::from_matrix(&pose);
        let ranked = |start, loss, pose| Ranked { start, loss, phases: 4, pose };
        let turned = Pose6::from_matrix(&(DMat4::from_rotation_z(1.0) * pose.to_matrix()));
        let ranking = vec![ranked(7, 2.0, pose), ranked(3, 2.1, pose), ranked(5, 3.0, turned)];
        Estimate {
            pose,
            loss: 2.0,
            curvature: Some(curvature()),
            light: None,
            outline: None,
            target: vec![],
            width: 64,
            extent: 0.5,
            ranking,
        }
    }

    #[test]
    fn second_derivatives_promise_what_the_way_to_the_minimum_brings() {
        let way = [0.1, -0.2, 0.0, 0.3, 0.05, -0.4];
        let product = |by: &[f64; 6]| curvature().map(|row| row.iter().zip(by).map(|(b, x)| b * x).sum::<f64>());
        let gradient = product(&way);
        let brings = 0.5 * gradient.iter().zip(&way).map(|(g, x)| g * x).sum::<f64>();
        assert!((promise(&curvature(), &gradient) / brings - 1.0).abs() < 1e-12);
        let saddle: Matrix6 = std::array::from_fn(|i| std::array::from_fn(|j| if i != j { 0.0 } else { 2.0 - i as f64 }));
        assert_eq!([promise(&saddle, &gradient), promise(&[[f64::NAN; 6]; 6], &gradient)], [0.0; 2]);
    }

    #[test]
    fn an_object_of_which_much_is_hidden_is_trusted_by_its_outline() {
        // A grey square of 8 × 8 pixels in the middle of 16 × 16.
        let inside =
            |pixel: usize, first: usize, last: usize| [pixel % 16, pixel / 16].map(|x| (first..last).contains(&x)) == [true; 2];
        let view: Vec<f32> = (0..3 * 256).map(|value| if inside(value / 3, 4, 12) { 0.0 } else { 1.0 }).collect();
        let doubt = |counts: &dyn Fn(usize) -> bool| {
            let weights: Vec<f32> = (0..256).map(|pixel| if counts(pixel) { 1.0 } else { 0.0 }).collect();
            hidden_doubt(&weights, &view, 16)
        };
        // All of it and nothing else; all but a rim of it; its left half, with what is around it, and without.
        assert_eq!(doubt(&|pixel| inside(pixel, 4, 12)), None);
        assert_eq!(doubt(&|pixel| inside(pixel, 5, 11)), Some(Doubt::Hidden));
        assert_eq!(doubt(&|pixel| pixel % 16 < 8), None);
        assert_eq!(doubt(&|pixel| inside(pixel, 4, 12) && pixel % 16 < 8), Some(Doubt::Hidden));
        // An object that fills the picture has no outline there.
        assert_eq!(hidden_doubt(&[1.0, 1.0, 0.0, 1.0], &[0.0; 12], 2), Some(Doubt::Hidden));
        assert_eq!(hidden_doubt(&[1.0; 4], &[0.0; 12], 2), None);
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

    /// Where a picture shows the object smaller than those of the calibration, all errors grow; where it is farther away, that along the view.
    #[test]
    fn what_is_far_away_is_less_sure() {
        let far = estimate(look_at_origin(DVec3::new(0.0, 2.6, 0.0)));
        let known = calibration(0.0, [1.0; 6]);
        let variances = |seen| {
            let covariance = far.covariance("", &Calibration { seen, ..known.clone() }).unwrap();
            [0, 3, 5].map(|k| (1e6 * covariance[k][k]).round() / 1e6)
        };
        assert_eq!(variances(None), [1.0; 3]);
        assert_eq!(variances(Some(Seen { distance: 1.3, extent: 0.5 })), [1.0, 1.0, 4.0]);
        assert_eq!(variances(Some(Seen { distance: 1.3, extent: 1.5 })), [9.0, 9.0, 36.0]);
        assert_eq!(variances(Some(Seen { distance: 5.2, extent: 0.1 })), [1.0; 3]);
        let known = Calibration { seen: Some(Seen { distance: 1.3, extent: 0.9 }), ..known };
        assert_eq!([0.4, 0.5].map(|extent| known.is_small(extent)), [true, false]);
    }

    /// Where a mask says where the object ends all errors grow, and an outline that may be a quarter of a pixel off moves the camera by as large a part of
    /// its distance as that is of half the object's diagonal.
    #[test]
    fn a_mask_leaves_a_pose_less_sure() {
        let variances = |outline| {
            let estimate = Estimate { outline, ..estimate(look_at_origin(DVec3::new(0.0, 1.3, 0.0))) };
            let covariance = estimate.covariance("", &calibration(0.0, [1e-4; 6])).unwrap();
            [0, 4, 5].map(|k| (1e12 * covariance[k][k]).round())
        };
        assert_eq!(variances(None), [1e8; 3]);
        for (dilation, off) in [(0.0, 0.25), (2.0, 0.65), (-2.0, 0.65)] {
            // In pixels, 0.65² = 0.25² + (0.3 · 2)².
            let along: f64 = off * 1.3 / 16.0;
            let outline = Outline { dilation, ..Outline::AS_GIVEN };
            assert_eq!(variances(Some(outline)), [2e8, 2e8, (2e8 + 1e12 * along * along).round()], "{dilation}");
        }
    }

    fn calibration(curvature: f64, floor: [f64; 6]) -> Calibration {
        let (sizes, at_truth) = (BTreeMap::new(), BTreeMap::new());
        Calibration { curvature, floor, sizes, unexplained: 1.0, at_truth, above_truth: 0.0, rival: 0.0, views: 1, seen: None }
    }

    #[test]
    fn a_motion_does_what_it_says() {
        let from = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let (omega, upsilon) = (DVec3::new(0.1, -0.2, 0.3), DVec3::new(0.02, 0.03, -0.05));
        let rotation = DMat3::from_mat4(from);
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(omega));
        let place = rotation * (turn * (rotation.transpose() * from.w_axis.truncate()) + upsilon);
        let to = DMat4::from_mat3_translation(rotation * turn, place);
        let expected = [0.1, -0.2, 0.3, 0.02, 0.03, -0.05];
        assert!(motion(&from, &to).iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-12), "{:?}", motion(&from, &to));
    }

    #[test]
    fn the_shape_is_the_inverse() {
        let mut estimate = estimate(look_at_origin(DVec3::new(1.0, -0.6, 0.5)));
        let (m, shape) = (curvature(), estimate.shape().unwrap());
        for i in 0..6 {
            for j in 0..6 {
                let entry: f64 = (0..6).map(|k| m[i][k] * shape[k][j]).sum();
                assert!((entry - 2.0 * f64::from(i == j)).abs() < 1e-9, "{i} {j} {entry}");
            }
        }
        for entry in [-1.0, f64::NAN] {
            estimate.curvature.as_mut().unwrap()[2][2] = entry;
            assert_eq!(estimate.shape(), None);
        }
    }

    #[test]
    fn ellipsoids_end_where_they_say() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let estimate = estimate(pose);
        // The object's centre stays: a turn alone, and of the covariance only its variance about that axis.
        let floor = [1e-4, 1e10, 1e10, 1e10, 1e10, 1e10];
        let turned = |angle: f64| {
            let turn = DMat3::from_axis_angle(pose.x_axis.truncate(), angle);
            DMat4::from_mat3_translation(turn * DMat3::from_mat4(pose), turn * pose.w_axis.truncate())
        };
        let edge = (1e-4 * WITHIN_95).sqrt();
        let states = |angle| estimate.states(&turned(angle), "box", &calibration(0.0, floor));
        assert_eq!((states(0.99 * edge), states(1.01 * edge)), (Some(true), Some(false)));
    }

    #[test]
    fn deviations_are_those_of_random_motions() {
        let pose = look_at_origin(DVec3::new(1.0, -0.6, 0.5));
        let covariance = estimate(pose).covariance("box", &calibration(1e-5, [1e-6; 6])).unwrap();
        // The sum over the columns of a factor is that over all directions.
        let lower = cholesky(&covariance).unwrap();
        let centre = DMat3::from_mat4(pose).transpose() * pose.w_axis.truncate();
        let (mut turns, mut places) = (0.0, 0.0);
        for k in 0..6 {
            let omega = DVec3::from_array([0, 1, 2].map(|i| lower[i][k]));
            let upsilon = DVec3::from_array([3, 4, 5].map(|i| lower[i][k]));
            turns += omega.length_squared();
            places += (omega.cross(centre) + upsilon).length_squared();
        }
        let (turn, place) = deviations(&pose, &covariance);
        assert!(
            (turn / turns.sqrt().to_degrees() - 1.0).abs() < 1e-9 && (place / places.sqrt() - 1.0).abs() < 1e-9,
            "{turn} {place}"
        );
    }

    /// Errors of both kinds in a known mixture, larger at some objects.
    fn drawn(count: usize, size_of: impl Fn(usize) -> f64, seed: u64) -> Vec<Known> {
        let mut random = stream(1, seed);
        let floor = [4e-4, 1e-4, 1e-4, 1e-5, 1e-5, 4e-5];
        let one = |k: usize| {
            let size = 10f64.powf(normal(&mut random));
            let m = curvature();
            let shape: Matrix6 = std::array::from_fn(|i| std::array::from_fn(|j| size * m[i][j] * 1e-6));
            let lower = cholesky(&mixed(&shape, 0.3, &floor)).unwrap();
            let numbers: [f64; 6] = std::array::from_fn(|_| size_of(k % 100).sqrt() * normal(&mut random));
            let motion = std::array::from_fn(|i| (0..6).map(|k| lower[i][k] * numbers[k]).sum());
            Known { instance: (k % 100).to_string(), motion, shape }
        };
        (0..count).map(one).collect()
    }

    /// The part of views that lie within the ellipsoids that the fit of others makes.
    fn share(found: &(f64, [f64; 6], BTreeMap<String, f64>), others: &[Known]) -> f64 {
        let (curvature, floor, sizes) = found;
        let inside = |known: &&Known| {
            let size = sizes.get(&known.instance).unwrap_or(&1.0);
            distance(&mixed(&known.shape, *curvature, floor), &known.motion).unwrap().1 <= size * WITHIN_95
        };
        others.iter().filter(inside).count() as f64 / others.len() as f64
    }

    #[test]
    fn the_fit_finds_the_mixture() {
        let found = fit(&drawn(400, |_| 1.0, 2)).unwrap();
        assert!((0.2..0.45).contains(&found.0), "{found:?}");
        let share = share(&found, &drawn(2000, |_| 1.0, 3));
        assert!((0.93..0.97).contains(&share) && found.2.values().all(|size| (0.5..2.0).contains(size)), "{share} {found:?}");
        let nowhere = Known { instance: "box".into(), motion: [0.0; 6], shape: curvature() };
        assert_eq!((fit(&[]), fit(&[nowhere])), (None, None));
    }

    #[test]
    fn an_object_that_is_known_badly_has_an_ellipsoid_of_its_own() {
        let size_of = |k: usize| if k < 10 { 16.0 } else { 1.0 };
        let found = fit(&drawn(600, size_of, 4)).unwrap();
        let of = |bad: bool| -> Vec<Known> {
            drawn(4000, size_of, 5).into_iter().filter(|known| (known.instance.len() == 1) == bad).collect()
        };
        let (bad, good) = (share(&found, &of(true)), share(&found, &of(false)));
        assert!((0.8..1.0).contains(&bad) && (0.93..0.98).contains(&good), "{bad} {good} {found:?}");
        // One ellipsoid for all would leave most of them out.
        let alike = (found.0, found.1, BTreeMap::new());
        assert!(share(&alike, &of(true)) < 0.75, "{}", share(&alike, &of(true)));
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
