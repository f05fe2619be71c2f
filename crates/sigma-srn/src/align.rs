//! Where an object lies in a picture, and how large it is there: a camera whose distance and aim are guesses is moved until its view shows the object
//! at the same place, as large. Else a view from the right side, but from too near, looks worse than one from a wrong side.

use glam::{DMat4, DQuat, DVec2, DVec3};

use crate::Intrinsics;

/// How much darker than white a channel is that shows the object for certain (colours span 2). A fainter one counts less: its edges are half white.
const DARK: f64 = 0.7;
/// By which factor a camera comes nearer, or goes farther away, at most: another side of the object may be half as large.
const MOST: f64 = 1.5;

/// An object in a picture, in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Shown {
    centre: DVec2,
    /// The root of the mean square distance from the centre.
    spread: f64,
}

impl Shown {
    /// What is darker than white. `rgb [pixels, 3]`, how much each pixel counts, and where it is. `None` where that is nothing, or of no size.
    pub(crate) fn of(rgb: &[f32], weights: &[f32], pixels: impl Iterator<Item = (u32, u32)>) -> Option<Self> {
        let (mut sum, mut first, mut second) = (0.0, DVec2::ZERO, 0.0);
        for ((colours, &weight), (u, v)) in rgb.chunks_exact(3).zip(weights).zip(pixels) {
            let darkest = colours.iter().map(|&colour| 1.0 - f64::from(colour)).fold(0.0, f64::max);
            let (amount, place) = ((darkest / DARK).min(1.0) * f64::from(weight), DVec2::new(u.into(), v.into()));
            sum += amount;
            first += amount * place;
            second += amount * place.length_squared();
        }
        let centre = first / sum;
        let spread = (second / sum - centre.length_squared()).sqrt();
        (spread > 0.5).then_some(Shown { centre, spread })
    }

    /// The camera from which the object lies like this that lies like `now` as it is seen from this one: as much nearer or farther away, then turned about
    /// itself, so that it sees the same side.
    pub(crate) fn seen_by(&self, now: &Shown, world_from_camera: &DMat4, intrinsics: &Intrinsics) -> DMat4 {
        let larger = (self.spread / now.spread).clamp(1.0 / MOST, MOST);
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
