//! The camera, the conventions of its axes, and where to put it.

use glam::{DMat2, DMat4, DVec2, DVec3, DVec4};
use rand::{RngExt, SeedableRng};
use std::f64::consts::{PI, TAU};

/// A camera: pose, intrinsics, lens distortion and image size. Values stay as their file has them; [`Camera::pixel_centre`] says
/// how to read them, [`Camera::with_pixel_centre`] converts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Rigid map from camera axes (x right, y down, z forward) to world axes; the last column is the camera centre.
    pub world_from_camera: DMat4,
    /// Focal lengths and principal point `[fx, fy, cx, cy]` in pixels.
    pub intrinsics: [f64; 4],
    /// Image width and height in pixels.
    pub size: [usize; 2],
    /// Where the centre of pixel `(u, v)` lies: at `(u + offset, v + offset)`. 0 for SRN and BOP; 0.5 for COLMAP and OpenGL.
    pub pixel_centre: f64,
    /// Lens distortion `[k1, k2, p1, p2, k3]` in OpenCV's order and meaning; zeros for a pinhole.
    pub distortion: [f64; 5],
}

impl Camera {
    /// The pixel `(u, v)` (fractional; integers are pixel centres) where a world point appears, and its depth along z.
    pub fn project(&self, point: DVec3) -> (DVec2, f64) {
        let q = self.world_from_camera.inverse().transform_point3(point);
        (self.pixel(self.distort(DVec2::new(q.x, q.y) / q.z)), q.z)
    }

    /// The same camera, its principal point counted from another place of the first pixel.
    pub fn with_pixel_centre(mut self, pixel_centre: f64) -> Self {
        let [.., cx, cy] = &mut self.intrinsics;
        for c in [cx, cy] {
            *c += pixel_centre - self.pixel_centre;
        }
        self.pixel_centre = pixel_centre;
        self
    }

    /// Whether straight lines stay straight.
    pub fn is_pinhole(&self) -> bool {
        self.distortion == [0.0; 5]
    }

    /// The pixel of a point of the image plane at depth 1, after distortion.
    pub(crate) fn pixel(&self, distorted: DVec2) -> DVec2 {
        let [fx, fy, cx, cy] = self.intrinsics;
        DVec2::new(fx, fy) * distorted + DVec2::new(cx, cy) - self.pixel_centre
    }

    /// The inverse of [`Camera::pixel`].
    pub(crate) fn plane(&self, pixel: DVec2) -> DVec2 {
        let [fx, fy, cx, cy] = self.intrinsics;
        (pixel + self.pixel_centre - DVec2::new(cx, cy)) / DVec2::new(fx, fy)
    }

    /// Where the lens moves a point of the image plane at depth 1.
    pub(crate) fn distort(&self, p: DVec2) -> DVec2 {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = p.length_squared();
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let twice_xy = 2.0 * p.x * p.y;
        radial * p + DVec2::new(p1 * twice_xy + p2 * (r2 + 2.0 * p.x * p.x), p1 * (r2 + 2.0 * p.y * p.y) + p2 * twice_xy)
    }

    /// The inverse of [`Camera::distort`] by Newton's method; `None` where the lens model has none.
    pub(crate) fn undistort(&self, target: DVec2) -> Option<DVec2> {
        if self.is_pinhole() {
            return Some(target);
        }
        let [k1, k2, p1, p2, k3] = self.distortion;
        let mut p = target;
        for _ in 0..30 {
            let r2 = p.length_squared();
            let (radial, slope) = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
            let mixed = 2.0 * (p.x * p.y * slope + p1 * p.x + p2 * p.y);
            let x = radial + 2.0 * p.x * p.x * slope + 2.0 * p1 * p.y + 6.0 * p2 * p.x;
            let y = radial + 2.0 * p.y * p.y * slope + 6.0 * p1 * p.y + 2.0 * p2 * p.x;
            let error = self.distort(p) - target;
            if error.length() < 1e-12 * (1.0 + target.length()) {
                return (p.length() < self.lens_radius()).then_some(p);
            }
            p -= DMat2::from_cols(DVec2::new(x, mixed), DVec2::new(mixed, y)).inverse() * error;
        }
        None
    }

    /// How far from the axis, on the image plane at depth 1, the lens model still moves outwards: beyond it the polynomial folds
    /// back and would show things twice.
    pub(crate) fn lens_radius(&self) -> f64 {
        let [k1, k2, _, _, k3] = self.distortion;
        let rises = |r: f64| 1.0 + r * r * (3.0 * k1 + r * r * (5.0 * k2 + r * r * 7.0 * k3)) > 0.0;
        let steps = (1..1000).map(|i| 0.01 * f64::from(i));
        steps.take_while(|&r| rises(r)).last().filter(|&r| r < 9.99 - 0.005).unwrap_or(if rises(0.01) { f64::MAX } else { 0.0 })
    }
}

/// How the axes of a camera are named. All are right-handed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axes {
    /// x right, y down, z forward: OpenCV, COLMAP, BOP, SRN; ours.
    OpenCv,
    /// x right, y up, z backward: OpenGL, Blender, NeRF, nerfstudio, instant-ngp.
    OpenGl,
    /// x left, y up, z forward: PyTorch3D.
    PyTorch3d,
    /// x forward, y left, z up: the body frames of ROS.
    Ros,
}

impl Axes {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::OpenCv, Self::OpenGl, Self::PyTorch3d, Self::Ros];

    /// The name, as flags and files spell it.
    pub fn name(self) -> &'static str {
        match self {
            Self::OpenCv => "opencv",
            Self::OpenGl => "opengl",
            Self::PyTorch3d => "pytorch3d",
            Self::Ros => "ros",
        }
    }

    /// The name, as people write it.
    pub fn title(self) -> &'static str {
        match self {
            Self::OpenCv => "OpenCV",
            Self::OpenGl => "OpenGL",
            Self::PyTorch3d => "PyTorch3D",
            Self::Ros => "ROS",
        }
    }

    /// The rotation that takes coordinates of our camera (x right, y down, z forward) to coordinates of these axes.
    pub fn from_ours(self) -> DMat4 {
        let [right, down, forward] = match self {
            Self::OpenCv => [DVec3::X, DVec3::Y, DVec3::Z],
            Self::OpenGl => [DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z],
            Self::PyTorch3d => [DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z],
            Self::Ros => [DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X],
        };
        DMat4::from_cols(right.extend(0.0), down.extend(0.0), forward.extend(0.0), DVec4::W)
    }

    /// Our `world_from_camera` of a matrix in these axes.
    pub fn to_ours(self, world_from_camera: DMat4) -> DMat4 {
        world_from_camera * self.from_ours()
    }

    /// The matrix in these axes of our `world_from_camera`.
    pub fn of_ours(self, world_from_camera: DMat4) -> DMat4 {
        world_from_camera * self.from_ours().transpose()
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

/// The same cameras, displaced at random: each distance by up to the fraction `jitter`, and each aim off the origin by up to
/// `jitter / 2`, which is that fraction of an object's radius. A renderer that has only seen one distance and one aim is wrong wherever
/// a search passes by.
pub fn jittered(cameras: &[DMat4], jitter: f64, seed: u64) -> Vec<DMat4> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    let mut either_way = || rng.random_range(-1.0..=1.0f64);
    let mut displaced = |camera: &DMat4| {
        let distance = 1.0 + jitter * either_way();
        let aim = loop {
            let aim = DVec3::new(either_way(), either_way(), either_way());
            if aim.length() <= 1.0 {
                break 0.5 * jitter * aim;
            }
        };
        DMat4::from_translation(aim) * look_at_origin(distance * camera.w_axis.truncate() - aim)
    };
    cameras.iter().map(&mut displaced).collect()
}

/// The same cameras, each turned at random about its optical axis.
pub fn rolled(cameras: &[DMat4], seed: u64) -> Vec<DMat4> {
    let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
    cameras.iter().map(|camera| *camera * DMat4::from_rotation_z(rng.random_range(0.0..TAU))).collect()
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

/// Points around the outline of the sphere of radius 0.5 around the origin, where lines of sight touch it; none from inside.
pub(crate) fn unit_sphere_seen_from(eye: DVec3) -> Vec<DVec3> {
    let Some(towards) = eye.try_normalize().filter(|_| eye.length() > 0.5) else { return vec![] };
    let lift = 0.25 / eye.length();
    let (a, b) = towards.any_orthonormal_pair();
    let radius = (0.25 - lift * lift).sqrt();
    let point = |i: u32| {
        let (sin, cos) = (f64::from(i) * TAU / 48.0).sin_cos();
        lift * towards + radius * (cos * a + sin * b)
    };
    (0..48).map(point).collect()
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
    fn jitter_stays_within_its_bounds() {
        let cameras = uniform_sphere(500, 1.3, 7);
        assert_eq!(jittered(&cameras, 0.1, 1), jittered(&cameras, 0.1, 1));
        let (mut nearest, mut furthest, mut most_off) = (f64::MAX, 0.0f64, 0.0f64);
        for (was, is) in cameras.iter().zip(jittered(&cameras, 0.1, 1)) {
            assert!(rigid_error(&is) < 1e-12);
            let (was, is_at) = (was.w_axis.truncate(), is.w_axis.truncate());
            assert!(was.angle_between(is_at) < 1e-7, "only the distance changes");
            let off = is_at.length() * off_axis_deg(&is).to_radians().sin();
            (nearest, furthest, most_off) = (nearest.min(is_at.length()), furthest.max(is_at.length()), most_off.max(off));
        }
        assert!((1.17..1.18).contains(&nearest) && (1.42..1.4301).contains(&furthest), "{nearest} to {furthest}");
        assert!((0.045..0.0501).contains(&most_off), "{most_off}");
    }

    #[test]
    fn rolled_cameras_look_the_same_way_from_the_same_places() {
        let cameras = uniform_sphere(100, 1.3, 7);
        let mut quarters = [0; 4];
        for (was, is) in cameras.iter().zip(rolled(&cameras, 2)) {
            assert!(rigid_error(&is) < 1e-12 && was.w_axis == is.w_axis && (was.z_axis - is.z_axis).length() < 1e-12);
            let turned = was.x_axis.truncate().cross(is.x_axis.truncate()).dot(was.z_axis.truncate());
            let quarter = 2 * usize::from(turned > 0.0) + usize::from(was.x_axis.dot(is.x_axis) > 0.0);
            quarters[quarter] += 1;
        }
        assert!(quarters.iter().all(|&count| count > 10), "{quarters:?}");
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
            distortion: [0.0; 5],
        };
        let (pixel, depth) = camera(0.0).project(DVec3::new(0.0, 0.2, 0.1));
        assert!((pixel - DVec2::new(42.0, 27.0)).length() < 1e-9 && (depth - 2.0).abs() < 1e-12, "{pixel} {depth}");
        assert!((camera(0.5).project(DVec3::ZERO).0 - 31.5).length() < 1e-9);
    }

    #[test]
    fn the_lens_is_undone() {
        let camera = Camera {
            world_from_camera: DMat4::IDENTITY,
            intrinsics: [500.0, 510.0, 320.0, 240.0],
            size: [640, 480],
            pixel_centre: 0.5,
            distortion: [-0.28, 0.09, 1e-3, -2e-3, -0.01],
        };
        for p in [DVec2::ZERO, DVec2::new(0.3, -0.2), DVec2::new(-0.6, 0.45)] {
            let there = camera.distort(p);
            assert!(p == DVec2::ZERO || (there - p).length() > 1e-3);
            assert!((camera.undistort(there).unwrap() - p).length() < 1e-9, "{p}");
            assert!((camera.plane(camera.pixel(there)) - there).length() < 1e-12);
        }
        // A strong barrel lens folds back at r = 1 / √(3·0.5) = 0.816.
        let barrel = Camera { distortion: [-0.5, 0.0, 0.0, 0.0, 0.0], ..camera };
        assert!((barrel.lens_radius() - 0.816).abs() < 0.011, "{}", barrel.lens_radius());
        assert!(barrel.undistort(DVec2::new(0.9, 0.0)).is_none());
        assert_eq!(Camera { distortion: [0.1, 0.0, 0.0, 0.0, 0.0], ..camera }.lens_radius(), f64::MAX);
        // The same ray through the same pixel, whatever the first pixel's centre is called.
        let other = camera.with_pixel_centre(0.0);
        assert_eq!((other.intrinsics, other.pixel_centre), ([500.0, 510.0, 319.5, 239.5], 0.0));
        let point = DVec3::new(0.3, 0.2, 1.5);
        assert!((camera.project(point).0 - other.project(point).0).length() < 1e-9);
    }

    #[test]
    fn axes_are_right_handed_and_mean_what_they_say() {
        for axes in Axes::ALL {
            assert!(rigid_error(&axes.from_ours()) == 0.0, "{}", axes.name());
            let pose = look_at_origin(DVec3::new(0.3, 0.9, 0.5));
            assert!(axes.to_ours(axes.of_ours(pose)).abs_diff_eq(pose, 1e-15));
            assert_eq!(serde_json::to_value(axes).unwrap(), axes.name());
        }
        // OpenGL: the second column of a pose is up, the third points away from the object.
        let pose = Axes::OpenGl.of_ours(look_at_origin(2.0 * DVec3::X));
        assert!(pose.y_axis.abs_diff_eq(DVec4::Z, 1e-12) && pose.z_axis.abs_diff_eq(DVec4::X, 1e-12), "{pose}");
        let pose = Axes::Ros.of_ours(look_at_origin(2.0 * DVec3::X));
        assert!(pose.x_axis.abs_diff_eq(DVec4::NEG_X, 1e-12) && pose.z_axis.abs_diff_eq(DVec4::Z, 1e-12), "{pose}");
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
    fn the_outline_of_the_unit_sphere_touches_it() {
        let eye = DVec3::new(0.9, -0.4, 1.1);
        let angle = (0.5 / eye.length()).asin();
        for p in unit_sphere_seen_from(eye) {
            assert!((p.length() - 0.5).abs() < 1e-12 && ((p - eye).angle_between(-eye) - angle).abs() < 1e-12, "{p}");
        }
        assert!(unit_sphere_seen_from(DVec3::new(0.3, 0.3, 0.0)).is_empty());
    }

    #[test]
    fn the_default_focal_length_holds_the_unit_sphere() {
        let focal = fitting_focal_px(64, 1.3);
        // The silhouette of a sphere of radius 0.5 seen from 1.3: tan(asin(0.5 / 1.3)) = 5/12.
        assert!((focal - 31.0 * 12.0 / 5.0).abs() < 1e-9, "{focal}");
    }
}
