//! A place to see an object from. However a camera is turned there, what it sees is one view, turned: of many rolls, or aims, one is rendered.

use glam::{DMat3, DMat4, DVec2, DVec3};

use crate::camera::Intrinsics;

/// A view from a place.
pub(super) struct Place<'a> {
    /// What rays on a grid of pixels see `[rows, columns, 3]`.
    pub rgb: &'a [f32],
    /// Rays per row.
    pub columns: usize,
    /// How many pixels they are apart; the first is as far from the edge as in [`pixel_grid`](crate::pixel_grid).
    pub stride: u32,
    /// The camera.
    pub world_from_camera: DMat4,
    /// Its intrinsics.
    pub intrinsics: Intrinsics,
}

impl Place<'_> {
    /// What another camera with the same intrinsics sees at `pixels`, `[pixels, 3]`: from this place as it is, from elsewhere as if the object were a picture in the plane through
    /// the world's origin that faces this place. Beside the view all is white.
    pub fn seen_by(&self, world_from_camera: &DMat4, pixels: impl Iterator<Item = (u32, u32)>) -> Vec<f32> {
        let Intrinsics { fx, fy, cx, cy, pixel_center } = self.intrinsics;
        let [(own, place), (turned, eye)] =
            [&self.world_from_camera, world_from_camera].map(|camera| (DMat3::from_mat4(*camera), camera.w_axis.truncate()));
        // The ray `eye + t · r` meets the plane `place · X = 0` at `t = -(place · eye) / (place · r)`.
        let beside = |r: DVec3| if eye == place { DVec3::ZERO } else { place.dot(r) / place.dot(eye) * (eye - place) };
        let towards = |r: DVec3| own.transpose() * (r - beside(r));
        let onto = DMat3::from_cols(towards(turned.x_axis), towards(turned.y_axis), towards(turned.z_axis));
        let first = f64::from(self.stride / 2) + pixel_center;
        let colours = pixels.flat_map(|(u, v)| {
            let [u, v] = [(u, cx, fx), (v, cy, fy)].map(|(at, c, f)| (f64::from(at) + pixel_center - c) / f);
            let at = onto * DVec3::new(u, v, 1.0);
            let pixel = DVec2::new(fx * at.x / at.z + cx, fy * at.y / at.z + cy);
            if at.z > 0.0 { self.colour((pixel - first) / f64::from(self.stride)) } else { [1.0; 3] }
        });
        colours.collect()
    }

    /// The colour between the rays around a place on their grid, in columns and rows.
    fn colour(&self, at: DVec2) -> [f32; 3] {
        let (corner, rows) = (at.floor(), self.rgb.len() / 3 / self.columns);
        let part = (at - corner).as_vec2();
        let ray = |right: f64, below: f64| {
            let [x, y] = [corner.x + right, corner.y + below];
            let is_inside = x >= 0.0 && y >= 0.0 && x < self.columns as f64 && y < rows as f64;
            let first = || 3 * (y as usize * self.columns + x as usize);
            if is_inside { self.rgb[first()..][..3].try_into().expect("three of them") } else { [1.0; 3] }
        };
        let between =
            |a: [f32; 3], b: [f32; 3], part: f32| [0, 1, 2].map(|channel: usize| a[channel] + part * (b[channel] - a[channel]));
        let row = |below: f64| between(ray(0.0, below), ray(1.0, below), part.x);
        between(row(0.0), row(1.0), part.y)
    }
}

#[cfg(test)]
mod tests {
    use std::iter::zip;

    use super::*;
    use crate::camera::look_at_origin;
    use crate::pixel_grid;

    const SIDE: u32 = 64;
    const INTRINSICS: Intrinsics = Intrinsics { fx: 74.4, fy: 70.0, cx: 30.0, cy: 33.0, pixel_center: 0.5 };

    /// What a camera sees of a picture in the plane through the origin that faces `place`, at every `stride`-th pixel.
    fn picture(place: DVec3, camera: &DMat4, stride: u32) -> Vec<f32> {
        let (n, eye) = (place.normalize(), camera.w_axis.truncate());
        let colour = |(u, v): (u32, u32)| {
            let Intrinsics { fx, fy, cx, cy, pixel_center } = INTRINSICS;
            let at = DVec3::new((f64::from(u) + pixel_center - cx) / fx, (f64::from(v) + pixel_center - cy) / fy, 1.0);
            let ray = camera.transform_vector3(at);
            let x = eye - n.dot(eye) / n.dot(ray) * ray;
            [x.x, x.y, x.z].map(|at| (6.0 * at).sin() as f32)
        };
        pixel_grid(SIDE, SIDE, stride).flat_map(colour).collect()
    }

    #[test]
    fn other_cameras_see_the_same_turned_and_scaled() {
        let at = look_at_origin(DVec3::new(0.9, -0.7, 0.6));
        let place = at.w_axis.truncate();
        for stride in [1, 2] {
            let rgb = picture(place, &at, stride);
            let view =
                Place { rgb: &rgb, columns: (SIDE / stride) as usize, stride, world_from_camera: at, intrinsics: INTRINSICS };
            assert_eq!(view.seen_by(&at, pixel_grid(SIDE, SIDE, stride)).len(), rgb.len());
            let mut nearer = at;
            nearer.w_axis = (0.8 * place).extend(1.0);
            let mut beside = at;
            beside.w_axis += 0.05 * at.x_axis;
            let turned = at * DMat4::from_rotation_z(0.7) * DMat4::from_rotation_x(0.03);
            for camera in [at, nearer, beside, turned] {
                let wanted = picture(place, &camera, 1);
                let seen = view.seen_by(&camera, pixel_grid(SIDE, SIDE, 1));
                // In the corners the view has ended.
                let is_inside = |(u, v): &(u32, u32)| (f64::from(*u) - 31.5).hypot(f64::from(*v) - 31.5) < 20.0;
                let colours = pixel_grid(SIDE, SIDE, 1).zip(seen.chunks(3).zip(wanted.chunks(3)));
                let off = colours.filter(|(at, _)| is_inside(at)).flat_map(|(_, (seen, wanted))| zip(seen, wanted));
                let most = off.map(|(seen, wanted)| (seen - wanted).abs()).fold(0.0, f32::max);
                assert!(most < 4e-3 * (stride * stride) as f32, "{stride}: {most}");
            }
        }
    }

    #[test]
    fn beside_the_view_and_behind_the_camera_all_is_white() {
        let at = look_at_origin(DVec3::new(0.9, -0.7, 0.6));
        let rgb = vec![-0.5; 3 * (SIDE * SIDE) as usize];
        let view = Place { rgb: &rgb, columns: SIDE as usize, stride: 1, world_from_camera: at, intrinsics: INTRINSICS };
        let share = |view: &Place, camera: &DMat4| {
            let seen = view.seen_by(camera, pixel_grid(SIDE, SIDE, 1));
            seen.iter().filter(|colour| **colour == 1.0).count() as f32 / seen.len() as f32
        };
        assert_eq!(share(&view, &at), 0.0);
        let aside = share(&view, &(at * DMat4::from_rotation_y(0.4)));
        assert!(aside > 0.3 && aside < 0.7, "{aside}");
        assert_eq!(share(&view, &(at * DMat4::from_rotation_y(3.0))), 1.0);
        // Within the object, at its centre, a camera sees as well.
        let view = Place { world_from_camera: DMat4::IDENTITY, ..view };
        assert!(view.seen_by(&DMat4::IDENTITY, pixel_grid(SIDE, SIDE, 1)).iter().all(|colour| (colour + 0.5).abs() < 1e-6));
    }
}
