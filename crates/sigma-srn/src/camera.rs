//! Cameras and poses (spec 1): OpenCV axes, `world_from_camera`, world z up, the object at the origin.

use glam::{DMat3, DMat4, DQuat, DVec3};

/// Pinhole intrinsics in pixels, with the place of a pixel's centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along u.
    pub fx: f64,
    /// Focal length along v.
    pub fy: f64,
    /// Principal point, u.
    pub cx: f64,
    /// Principal point, v.
    pub cy: f64,
    /// What is added to a pixel's integer coordinates to get its centre: 0 for SRN data, 0.5 for COLMAP and OpenGL.
    pub pixel_center: f64,
}

impl Intrinsics {
    /// The four numbers as the kernels take them.
    pub fn to_array(&self) -> [f32; 4] {
        [self.fx, self.fy, self.cx, self.cy].map(|value| value as f32)
    }

    /// Cameras that look at the object's centre, turned so that it appears in the middle of a picture of `[width, height]` pixels: the
    /// principal point of one that was cut out may lie anywhere beside it.
    pub fn centred(&self, size: [u32; 2], cameras: Vec<DMat4>) -> Vec<DMat4> {
        let [x, y] = size.map(|side| f64::from(side) / 2.0);
        let ray = DVec3::new((x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0).normalize();
        let turn = DMat4::from_quat(DQuat::from_rotation_arc(ray, DVec3::Z));
        cameras.into_iter().map(|camera| camera * turn).collect()
    }
}

/// The six numbers that pose estimation moves (spec 1): three angles in radians, `R = Rx(θ1)·Ry(θ2)·Rz(θ3)`, then the camera
/// centre in object units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose6(pub [f64; 6]);

impl Pose6 {
    /// `world_from_camera` as a 4×4 matrix.
    pub fn to_matrix(self) -> DMat4 {
        let [a, b, c, x, y, z] = self.0;
        let rotation = DMat3::from_rotation_x(a) * DMat3::from_rotation_y(b) * DMat3::from_rotation_z(c);
        let mut matrix = DMat4::from_mat3(rotation);
        matrix.w_axis = DVec3::new(x, y, z).extend(1.0);
        matrix
    }

    /// The six numbers of a rigid `world_from_camera`; at θ2 = ±90° the one with θ3 = 0.
    pub fn from_matrix(world_from_camera: &DMat4) -> Self {
        let r = |row: usize, column: usize| world_from_camera.col(column)[row];
        let (a, c) = if r(0, 2).abs() < 1.0 - 1e-12 {
            ((-r(1, 2)).atan2(r(2, 2)), (-r(0, 1)).atan2(r(0, 0)))
        } else {
            (r(2, 1).atan2(r(1, 1)), 0.0)
        };
        let t = world_from_camera.w_axis;
        Pose6([a, r(0, 2).clamp(-1.0, 1.0).asin(), c, t.x, t.y, t.z])
    }

    /// How far the camera is from the world's origin, object units.
    pub fn distance(self) -> f64 {
        let [.., x, y, z] = self.0;
        DVec3::new(x, y, z).length()
    }

    /// The turn between two poses in degrees.
    pub fn degrees_from(self, other: Pose6) -> f64 {
        pose_error(&self.to_matrix(), &other.to_matrix()).0
    }

    /// As the kernels take it.
    pub fn to_f32(self) -> [f32; 6] {
        self.0.map(|value| value as f32)
    }
}

/// A camera at `eye` that looks at the origin without roll: its y axis points down in the world as far as possible.
pub fn look_at_origin(eye: DVec3) -> DMat4 {
    let forward = -eye.normalize();
    let side = forward.cross(DVec3::Z);
    // Straight above or below, every roll is as good: take the world's x axis to the right.
    let right = if side.length() < 1e-9 { DVec3::X } else { side.normalize() };
    DMat4::from_cols(right.extend(0.0), forward.cross(right).extend(0.0), forward.extend(0.0), eye.extend(1.0))
}

/// Cameras at `radius` that look at the origin without roll, `azimuths` of them at each elevation.
fn rings(radius: f64, elevations_deg: &[f64], azimuths: u32) -> Vec<DMat4> {
    let ring = |elevation: &f64| {
        let (z, horizontal) = elevation.to_radians().sin_cos();
        (0..azimuths).map(move |k| {
            let (y, x) = (f64::from(k) * std::f64::consts::TAU / f64::from(azimuths)).sin_cos();
            look_at_origin(radius * DVec3::new(horizontal * x, horizontal * y, z))
        })
    };
    elevations_deg.iter().flat_map(ring).collect()
}

/// Starts `fixed24` (spec 4): 8 azimuths × elevations 45°, 0°, −45° at `radius`, looking at the origin.
pub fn fixed24(radius: f64) -> Vec<DMat4> {
    rings(radius, &[45.0, 0.0, -45.0], 8)
}

/// Starts `around84`: 12 azimuths × elevations from 85° to −85° at `radius`, looking at the origin. Near the poles the azimuths are
/// rolls. No view without roll is farther than 21° from one of them.
pub fn around84(radius: f64) -> Vec<DMat4> {
    rings(radius, &[85.0, 60.0, 30.0, 0.0, -30.0, -60.0, -85.0], 12)
}

/// Starts `around2016`: 84 places evenly around the object at `radius`, looking at the origin, each with 24 rolls, one after the other: for cameras that need not be
/// upright, and objects that need not stand. No view of the object's centre is farther than 17° from one of them.
pub fn around2016(radius: f64) -> Vec<DMat4> {
    const PLACES: u32 = 84;
    const ROLLS: u32 = 24;
    let rolls = |eye: DVec3| {
        let roll = |k| DMat4::from_rotation_z(f64::from(k) * std::f64::consts::TAU / f64::from(ROLLS));
        (0..ROLLS).map(move |k| look_at_origin(eye) * roll(k))
    };
    spiral(PLACES).flat_map(|direction| rolls(radius * direction)).collect()
}

/// Directions evenly over the sphere: heights in equal steps, each turned from the one before by the golden angle.
fn spiral(count: u32) -> impl Iterator<Item = DVec3> {
    let golden_angle = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count).map(move |k| {
        let z = 1.0 - (2.0 * f64::from(k) + 1.0) / f64::from(count);
        let (y, x) = (golden_angle * f64::from(k)).sin_cos();
        let horizontal = (1.0 - z * z).sqrt();
        DVec3::new(horizontal * x, horizontal * y, z)
    })
}

/// Starts `neighbor4` (spec 4): the rough pose turned about the world origin by 30°, down and up about its own x axis, right and
/// left about the world's z axis.
pub fn neighbor4(rough: &DMat4) -> Vec<DMat4> {
    let own_x = rough.x_axis.truncate().normalize();
    [(own_x, 30.0f64), (own_x, -30.0), (DVec3::Z, 30.0), (DVec3::Z, -30.0)]
        .into_iter()
        .map(|(axis, degrees)| DMat4::from_axis_angle(axis, degrees.to_radians()) * *rough)
        .collect()
}

/// Errors of an estimate (spec 4): rotation in degrees, translation in object units.
pub fn pose_error(estimate: &DMat4, truth: &DMat4) -> (f64, f64) {
    let relative = DMat3::from_mat4(*estimate) * DMat3::from_mat4(*truth).transpose();
    let trace = relative.x_axis.x + relative.y_axis.y + relative.z_axis.z;
    let rotation = ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees();
    (rotation, (estimate.w_axis - truth.w_axis).truncate().length())
}

/// Row-major 3×4, as the kernels take it.
pub fn to_rows(matrix: &DMat4) -> [f64; 12] {
    let mut rows = [0.0; 12];
    for row in 0..3 {
        for column in 0..4 {
            rows[4 * row + column] = matrix.col(column)[row];
        }
    }
    rows
}

/// The rigid motion nearest to a row-major 3×4 matrix that rounding has left nearly rigid.
pub fn from_rows(rows: &[f32]) -> DMat4 {
    let column = |k: usize| DVec3::new(rows[k].into(), rows[4 + k].into(), rows[8 + k].into());
    let rotation = DQuat::from_mat3(&DMat3::from_cols(column(0), column(1), column(2))).normalize();
    DMat4::from_rotation_translation(rotation, column(3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_matrix_is_the_one_in_the_specification() {
        let angles = [0.3, -0.7, 1.1];
        let [(s1, c1), (s2, c2), (s3, c3)] = angles.map(f64::sin_cos);
        let m = Pose6([0.3, -0.7, 1.1, 1.0, 2.0, 3.0]).to_matrix();
        let expected = [
            [c2 * c3, -c2 * s3, s2, 1.0],
            [c1 * s3 + c3 * s1 * s2, c1 * c3 - s1 * s2 * s3, -c2 * s1, 2.0],
            [s1 * s3 - c1 * c3 * s2, c3 * s1 + c1 * s2 * s3, c1 * c2, 3.0],
        ];
        for row in 0..3 {
            for column in 0..4 {
                assert!((m.col(column)[row] - expected[row][column]).abs() < 1e-12, "{row} {column}");
            }
        }
    }

    #[test]
    fn six_numbers_and_matrix_are_inverse_to_each_other() {
        let mut poses = fixed24(1.3);
        poses.extend(neighbor4(&look_at_origin(DVec3::new(0.4, 0.9, -0.8))));
        for matrix in poses {
            let again = Pose6::from_matrix(&matrix).to_matrix();
            assert!(again.abs_diff_eq(matrix, 1e-7), "{matrix} {again}");
            assert!((matrix.determinant() - 1.0).abs() < 1e-12);
            let origin = matrix.inverse().transform_point3(DVec3::ZERO);
            assert!(origin.x.abs() < 1e-9 && origin.y.abs() < 1e-9 && origin.z > 0.0, "the origin is on the optical axis");
        }
    }

    #[test]
    fn no_view_is_far_from_a_start() {
        let farthest = |starts: &[DMat4], roll: f64| {
            let view = |(k, direction)| look_at_origin(1.3 * direction) * DMat4::from_rotation_z(roll * f64::from(k));
            let nearest = |view: DMat4| starts.iter().map(|start| pose_error(start, &view).0).fold(f64::INFINITY, f64::min);
            (0..).zip(spiral(2000)).map(view).map(nearest).fold(0.0, f64::max)
        };
        let upright = farthest(&around84(1.3), 0.0);
        let rolled = farthest(&around2016(1.3), 1.0);
        println!("upright {upright:.1}°, rolled {rolled:.1}°");
        assert!(upright < 21.0 && rolled < 17.0, "{upright}° {rolled}°");
        assert_eq!([around84(1.3).len(), around2016(1.3).len()], [84, 2016]);
    }

    #[test]
    fn errors_of_a_known_rotation() {
        let truth = look_at_origin(DVec3::new(1.0, 0.5, 0.7));
        for start in neighbor4(&truth) {
            let (rotation, translation) = pose_error(&start, &truth);
            assert!((rotation - 30.0).abs() < 1e-9 && translation > 0.2);
        }
        assert_eq!(pose_error(&truth, &truth).1, 0.0);
        let (up, down) = (neighbor4(&truth)[1], neighbor4(&truth)[0]);
        assert!(up.w_axis.z > truth.w_axis.z && down.w_axis.z < truth.w_axis.z, "up is up");
    }
}
