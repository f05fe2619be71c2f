//! Where an object lies in a picture, and how large it is there: a camera whose distance and aim are guesses is moved until its view shows the object
//! at the same place, as large. Else a view from the right side, but from too near, looks worse than one from a wrong side.

use glam::{DMat2, DMat4, DQuat, DVec2, DVec3};

use crate::camera::Intrinsics;
use crate::mask::has_outline;

/// How much darker than white a channel is that shows the object for certain (colours span 2). A fainter one counts less: its edges are half white.
const DARK: f64 = 0.7;
/// By which factor a camera comes nearer, or goes farther away, at most: another side of the object may be half as large.
const MOST: f64 = 1.5;

/// An object in a picture, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shown {
    centre: DVec2,
    /// Of the places of what is dark.
    covariance: DMat2,
}

impl Shown {
    /// What is darker than white. `rgb [pixels, 3]`, how much each pixel counts, and where it is. `None` where that is nothing, or of no size.
    pub fn of(rgb: &[f32], weights: &[f32], pixels: impl Iterator<Item = (u32, u32)>) -> Option<Self> {
        let (mut sum, mut first, mut second) = (0.0, DVec2::ZERO, DMat2::ZERO);
        for ((colours, &weight), (u, v)) in rgb.chunks_exact(3).zip(weights).zip(pixels) {
            let darkest = colours.iter().map(|&colour| 1.0 - f64::from(colour)).fold(0.0, f64::max);
            let (amount, place) = ((darkest / DARK).min(1.0) * f64::from(weight), DVec2::new(u.into(), v.into()));
            sum += amount;
            first += amount * place;
            second += amount * outer(place);
        }
        let centre = first / sum;
        let shown = Shown { centre, covariance: second * (1.0 / sum) - outer(centre) };
        (shown.spread() > 0.5).then_some(shown)
    }

    /// The root of the mean square distance from the centre.
    fn spread(&self) -> f64 {
        (self.covariance.x_axis.x + self.covariance.y_axis.y).sqrt()
    }

    /// The same in one direction.
    fn along(&self, direction: DVec2) -> f64 {
        direction.dot(self.covariance * direction).sqrt()
    }

    /// The whole object, of which this is in sight and the rest hidden on the side of `hidden`, if it has the shape of `now`: it is as large across, and ends where
    /// this ends on the other side. `guess` is by how much it is larger than that (logarithm of the factor), and how far it lies farther towards the hidden side, and aside, both in its own
    /// deviations.
    pub fn whole(&self, now: &Shown, hidden: DVec2, guess: DVec3) -> Shown {
        let towards = (hidden - self.centre).normalize_or_zero();
        let across = towards.perp();
        let larger = self.along(across) / now.along(across) * guess.x.exp();
        // Of what is as dark everywhere the end is √3 deviations from the centre.
        let shift = (3f64.sqrt() * (larger * now.along(towards) - self.along(towards))).max(0.0);
        let farther = larger * (guess.y * now.along(towards) * towards + guess.z * now.along(across) * across);
        Shown { centre: self.centre + shift * towards + farther, covariance: now.covariance * (larger * larger) }
    }

    /// The camera from which the object lies like this that lies like `now` as it is seen from this one: as much nearer or farther away, then turned about
    /// itself, so that it sees the same side.
    pub fn seen_by(&self, now: &Shown, world_from_camera: &DMat4, intrinsics: &Intrinsics) -> DMat4 {
        let larger = (self.spread() / now.spread()).clamp(1.0 / MOST, MOST);
        let origin = world_from_camera.inverse().transform_point3(DVec3::ZERO);
        let Intrinsics { fx, fy, cx, cy, pixel_center } = *intrinsics;
        let (focal, offset) = (DVec2::new(fx, fy), DVec2::new(cx, cy) - pixel_center);
        let pixel = focal * origin.truncate() / origin.z + offset;
        let ray = |pixel: DVec2| ((pixel - offset) / focal).extend(1.0).normalize();
        let turn = DQuat::from_rotation_arc(ray(self.centre + larger * (pixel - now.centre)), ray(pixel));
        let mut nearer = *world_from_camera;
        nearer.w_axis = (nearer.w_axis.truncate() / larger).extend(1.0);
        nearer * DMat4::from_quat(turn)
    }
}

fn outer(v: DVec2) -> DMat2 {
    DMat2::from_cols(v.x * v, v.y * v)
}

/// The middle of where an object in a picture meets what does not count, in pixels; `None` where it does not, or where none of its outline counts. `coverage` and
/// `weights [pixels]`, `width` pixels per row.
pub(super) fn hidden_side(coverage: &[f32], weights: &[f32], width: usize) -> Option<DVec2> {
    let is_object = |pixel: usize| weights[pixel] > 0.0 && coverage[pixel] >= 0.5;
    let is_hidden = |pixel: usize| weights[pixel] == 0.0;
    let right = (1..weights.len()).filter(|pixel| pixel % width != 0).map(|pixel| (pixel - 1, pixel));
    let below = (width..weights.len()).map(|pixel| (pixel - width, pixel));
    let meet = |&(one, other): &(usize, usize)| is_object(one) && is_hidden(other) || is_hidden(one) && is_object(other);
    let place = |pixel: usize| DVec2::new((pixel % width) as f64, (pixel / width) as f64);
    let places: Vec<DVec2> = right.chain(below).filter(meet).map(|(one, other)| 0.5 * (place(one) + place(other))).collect();
    let is_known = !places.is_empty() && has_outline(coverage, Some(weights));
    is_known.then(|| places.iter().sum::<DVec2>() / places.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::look_at_origin;

    const SIDE: u32 = 64;

    /// Points of an object, as bright as given, on white; seen by a camera.
    fn picture(world_from_camera: &DMat4, intrinsics: &Intrinsics) -> Vec<f32> {
        let mut rgb = vec![1.0; 3 * (SIDE * SIDE) as usize];
        let place = |k: i32| {
            DVec3::new(f64::from(k % 20) / 50.0 - 0.2, f64::from(k / 20 % 20) / 80.0 - 0.1, f64::from(k / 400) / 30.0 - 0.1)
        };
        for k in 0..2400 {
            let point = world_from_camera.inverse().transform_point3(place(k));
            let [u, v] = [intrinsics.fx * point.x / point.z + intrinsics.cx, intrinsics.fy * point.y / point.z + intrinsics.cy];
            rgb[3 * (v.round() as usize * SIDE as usize + u.round() as usize)] = -0.5;
        }
        rgb
    }

    fn shown(rgb: &[f32]) -> Option<Shown> {
        Shown::of(rgb, &[1.0; (SIDE * SIDE) as usize], crate::pixel_grid(SIDE, SIDE, 1))
    }

    #[test]
    fn a_camera_with_another_distance_and_aim_is_moved_to_the_right_ones() {
        let intrinsics = Intrinsics { fx: 74.4, fy: 70.0, cx: 30.0, cy: 33.0, pixel_center: 0.0 };
        let guess = look_at_origin(DVec3::new(0.9, -0.7, 0.6));
        for (times, [x, y]) in [(1.0, [0.0, 0.0]), (1.4, [0.05, -0.1]), (0.8, [-0.02, 0.06])] {
            // The same side: along the ray to the object, then turned.
            let mut camera = guess;
            camera.w_axis = (times * guess.w_axis.truncate()).extend(1.0);
            let truth = camera * DMat4::from_quat(DQuat::from_rotation_y(x) * DQuat::from_rotation_x(y));
            let [wanted, now] = [&truth, &guess].map(|pose| shown(&picture(pose, &intrinsics)).unwrap());
            let moved = wanted.seen_by(&now, &guess, &intrinsics);
            let (degrees, far) = crate::camera::pose_error(&moved, &truth);
            // From nearer, perspective makes its near side larger, too: 4 % of the distance.
            assert!(degrees < 0.5 && far < 0.05 * truth.w_axis.truncate().length(), "{times} {x} {y}: {degrees}° {far}");
        }
    }

    /// Half of the object behind something: from where it seems to be, half as large and beside where it is, to where it is.
    #[test]
    fn a_camera_is_moved_to_where_the_whole_object_would_be() {
        let intrinsics = Intrinsics { fx: 74.4, fy: 74.4, cx: 31.2, cy: 31.5, pixel_center: 0.0 };
        let truth = look_at_origin(DVec3::new(0.0, -1.3, 0.0));
        let mut guess = truth;
        guess.w_axis = (1.3 * truth.w_axis.truncate()).extend(1.0);
        let guess = guess * DMat4::from_quat(DQuat::from_rotation_y(0.1));
        let [rgb, now] = [&truth, &guess].map(|pose| picture(pose, &intrinsics));
        let coverage: Vec<f32> = rgb.chunks(3).map(|colours| f32::from(colours[0] < 1.0)).collect();
        let weights: Vec<f32> = (0..SIDE * SIDE).map(|pixel| f32::from(pixel % SIDE < SIDE / 2)).collect();
        let side = hidden_side(&coverage, &weights, SIDE as usize).unwrap();
        assert!((side.x - 31.5).abs() < 1e-9 && (side.y - 31.5).abs() < 3.0, "{side}");
        let in_sight = Shown::of(&rgb, &weights, crate::pixel_grid(SIDE, SIDE, 1)).unwrap();
        let now = shown(&now).unwrap();
        let errors = [in_sight, in_sight.whole(&now, side, DVec3::ZERO)].map(|wanted| {
            let (degrees, far) = crate::camera::pose_error(&wanted.seen_by(&now, &guess, &intrinsics), &truth);
            (degrees, far / 1.3)
        });
        assert!(errors[0].0 > 4.0 && errors[0].1 > 0.15, "{errors:?}");
        assert!(errors[1].0 < 1.0 && errors[1].1 < 0.05, "{errors:?}");
        // A guess by how much it is larger, and lies elsewhere: towards the right, where it is hidden, and down.
        let whole = |guess: DVec3| in_sight.whole(&now, side, guess);
        let [first, larger, shifted] = [DVec3::ZERO, DVec3::X * 1.2f64.ln(), DVec3::new(0.0, 0.5, 0.3)].map(whole);
        assert!((larger.spread() / first.spread() - 1.2).abs() < 1e-9);
        let by = [shifted.centre - first.centre, DVec2::new(0.5 * first.along(DVec2::X), 0.3 * first.along(DVec2::Y))];
        assert!((by[0].abs() - by[1]).abs().max_element() < 0.1 * by[1].length() && by[0].x > 0.0, "{by:?}");
        // Nothing is hidden; nothing of the outline is in sight.
        assert_eq!(hidden_side(&coverage, &[1.0; (SIDE * SIDE) as usize], SIDE as usize), None);
        assert_eq!(hidden_side(&[1.0; (SIDE * SIDE) as usize], &weights, SIDE as usize), None);
    }

    #[test]
    fn what_shows_nothing_or_a_point_has_no_size() {
        let mut rgb = vec![1.0; 3 * (SIDE * SIDE) as usize];
        assert_eq!(shown(&rgb), None);
        rgb[999] = 0.0;
        assert_eq!(shown(&rgb), None);
        rgb[3 * 900] = 0.0;
        assert!(shown(&rgb).is_some());
        rgb.fill(f32::NAN);
        assert_eq!(shown(&rgb), None);
    }
}
