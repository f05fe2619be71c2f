//! The pinhole camera and where to put it.

use glam::{DMat4, DVec2, DVec3, DVec4};
use rand::{RngExt, SeedableRng};
use std::f64::consts::{PI, TAU};

/// A pinhole camera: pose, intrinsics and image size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Rigid map from camera axes (x right, y down, z forward) to world axes; the last column is the camera centre.
    pub world_from_camera: DMat4,
    /// Focal lengths and principal point `[fx, fy, cx, cy]` in pixels.
    pub intrinsics: [f64; 4],
    /// Image width and height in pixels.
    pub size: [usize; 2],
    /// Where the centre of pixel `(u, v)` lies: at `(u + offset, v + offset)`. 0 for SRN data; 0.5 elsewhere.
    pub pixel_centre: f64,
}

impl Camera {
    /// The pixel `(u, v)` (fractional; integers are pixel centres) where a world point appears, and its depth along z.
    pub fn project(&self, point: DVec3) -> (DVec2, f64) {
        let q = self.world_from_camera.inverse().transform_point3(point);
        let [fx, fy, cx, cy] = self.intrinsics;
        let pixel = DVec2::new(fx * q.x / q.z + cx, fy * q.y / q.z + cy);
        (pixel - self.pixel_centre, q.z)
    }
}

/// The pose of a camera at `centre` that looks at the origin without roll: its x axis is horizontal. Above the poles x points
/// along world +y, the limit from azimuth 0.
pub fn look_at_origin(centre: DVec3) -> DMat4 {
    let azimuth = centre.y.atan2(centre.x);
    let right = DVec3::new(-azimuth.sin(), azimuth.cos(), 0.0);
    let forward = -centre.normalize();
    let down = forward.cross(right);
    DMat4::from_cols(right.extend(0.0), down.extend(0.0), forward.extend(0.0), centre.extend(1.0))
}

/// `n` cameras that look at the origin from random places, uniform over the area of the sphere. The seed decides everything.
pub fn uniform_sphere(n: usize, radius: f64, seed: u64) -> Vec<DMat4> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut camera = || {
        // Archimedes: the height of a uniform point on the sphere is itself uniform.
        let (z, azimuth) = (rng.random_range(-1.0..1.0f64), rng.random_range(0.0..TAU));
        let ring = (1.0 - z * z).sqrt();
        look_at_origin(radius * DVec3::new(ring * azimuth.cos(), ring * azimuth.sin(), z))
    };
    (0..n).map(|_| camera()).collect()
}

/// `n` cameras that look at the origin along the spherical spiral of the SRN test sets: from pole to pole in equal steps of the
/// polar angle θ while the azimuth turns by `40·θ/π` radians. SRN walks only the upper half; here the whole sphere is walked,
/// as the training cameras see it all. Steps are centred, so that no camera sits on a pole.
pub fn spiral(n: usize, radius: f64) -> Vec<DMat4> {
    let camera = |k: usize| {
        let t = (k as f64 + 0.5) / n as f64;
        let (polar, azimuth) = (PI * t, 40.0 * t);
        look_at_origin(radius * DVec3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()))
    };
    (0..n).map(camera).collect()
}

/// How far a 4×4 matrix is from a rigid motion: the largest of `|RᵀR − 1|`, or 2 for a mirrored (left-handed) rotation, and of
/// the last row's distance from `0 0 0 1`. Not a number if an entry is not.
pub fn rigid_error(m: &DMat4) -> f64 {
    let r = glam::DMat3::from_mat4(*m);
    let gram = r.transpose() * r - glam::DMat3::IDENTITY;
    let last_row = m.row(3) - DVec4::W;
    if m.is_nan() {
        return f64::NAN;
    }
    let errors = gram.to_cols_array().into_iter().chain(last_row.to_array());
    let worst = errors.map(f64::abs).fold(0.0, f64::max);
    if r.determinant() < 0.0 { worst.max(2.0) } else { worst }
}

/// The angle in degrees between the viewing direction and the direction to the origin.
pub fn off_axis_deg(world_from_camera: &DMat4) -> f64 {
    let (forward, centre) = (world_from_camera.z_axis.truncate(), world_from_camera.w_axis.truncate());
    forward.angle_between(-centre).to_degrees()
}

/// The focal length in pixels at which the sphere of radius 0.5 around the origin (it holds every unit-diagonal object) just
/// fits into a square image of `side` pixels, seen from `radius` by a camera with its principal point at `side / 2`.
pub fn fitting_focal_px(side: usize, radius: f64) -> f64 {
    let half_angle = (0.5 / radius).min(0.99).asin();
    (side as f64 / 2.0 - 1.0) / half_angle.tan()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(cameras: &[DMat4], radius: f64) {
        for m in cameras {
            assert!(rigid_error(m) < 1e-12, "{m}");
            assert!((m.w_axis.truncate().length() - radius).abs() < 1e-12);
            assert!(off_axis_deg(m) < 1e-5);
            assert!(m.x_axis.z.abs() < 1e-12, "rolled: {m}");
            assert!(m.y_axis.z <= 1e-12, "upside down: {m}");
        }
    }

    #[test]
    fn cameras_look_at_the_origin_upright() {
        check(&uniform_sphere(500, 1.3, 7), 1.3);
        check(&spiral(251, 2.0), 2.0);
        let poles = [DVec3::Z, -DVec3::Z, DVec3::X, -DVec3::Y].map(|p| look_at_origin(1.3 * p));
        check(&poles, 1.3);
    }

    #[test]
    fn the_seed_decides() {
        assert_eq!(uniform_sphere(20, 1.0, 3), uniform_sphere(20, 1.0, 3));
        assert_ne!(uniform_sphere(20, 1.0, 3), uniform_sphere(20, 1.0, 4));
    }

    #[test]
    fn both_samplers_cover_the_sphere() {
        // 26 directions of a cube's faces, edges and corners: a camera lies within 25° of each.
        for cameras in [uniform_sphere(200, 1.0, 1), spiral(200, 1.0)] {
            for i in (0..27).filter(|&i| i != 13) {
                let d = DVec3::new((i % 3) as f64 - 1.0, (i / 3 % 3) as f64 - 1.0, (i / 9) as f64 - 1.0).normalize();
                let nearest = cameras.iter().map(|m| m.w_axis.truncate().angle_between(d)).fold(f64::MAX, f64::min);
                assert!(nearest.to_degrees() < 25.0, "{d}: {}", nearest.to_degrees());
            }
        }
        // Uniform over the area: the mean direction vanishes and each third of the heights holds a third.
        let many = uniform_sphere(20_000, 1.0, 5);
        let mean = many.iter().map(|m| m.w_axis.truncate()).sum::<DVec3>() / many.len() as f64;
        assert!(mean.length() < 0.02, "{mean}");
        let middle = many.iter().filter(|m| m.w_axis.z.abs() < 1.0 / 3.0).count() as f64 / many.len() as f64;
        assert!((middle - 1.0 / 3.0).abs() < 0.015, "{middle}");
    }

    #[test]
    fn projection_has_x_right_and_z_up() {
        // From +x the viewer sees world +y on the right and world +z on top.
        let camera = |pixel_centre| Camera {
            world_from_camera: look_at_origin(2.0 * DVec3::X),
            intrinsics: [100.0, 100.0, 32.0, 32.0],
            size: [64, 64],
            pixel_centre,
        };
        let (pixel, depth) = camera(0.0).project(DVec3::new(0.0, 0.2, 0.1));
        assert!((pixel - DVec2::new(42.0, 27.0)).length() < 1e-9 && (depth - 2.0).abs() < 1e-12, "{pixel} {depth}");
        assert!((camera(0.5).project(DVec3::ZERO).0 - 31.5).length() < 1e-9);
    }

    #[test]
    fn rigid_error_sees_scale_mirror_and_nan() {
        let good = look_at_origin(DVec3::new(1.0, 2.0, 0.5));
        let mirrored = good * DMat4::from_scale(DVec3::new(1.0, 1.0, -1.0));
        assert!(rigid_error(&(good * DMat4::from_scale(DVec3::splat(1.1)))) > 0.1);
        assert!(rigid_error(&mirrored) >= 2.0);
        let mut nan = good;
        nan.y_axis.x = f64::NAN;
        assert!(rigid_error(&nan).is_nan());
    }

    #[test]
    fn the_default_focal_length_holds_the_unit_sphere() {
        let focal = fitting_focal_px(64, 1.3);
        // The silhouette of a sphere of radius 0.5 seen from 1.3: tan(asin(0.5 / 1.3)) = 5/12.
        assert!((focal - 31.0 * 12.0 / 5.0).abs() < 1e-9, "{focal}");
    }
}
