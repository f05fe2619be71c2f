//! Objects that are their own mirror images: a picture of one is a second picture of it, from the mirrored camera.
//!
//! Two pictures show little of an object's far side. Which objects of a kind are symmetric, the codes know: fitted to the pictures
//! alone they show the far side as known objects have it, and where that explains the mirrored picture as well, the object is taken to be
//! symmetric.

use std::slice;

use glam::{DMat4, DVec3, dvec3};
use sigma_srn::{Engine, Model, unexplained};
use srn_data::LoadedView;

use super::{Shown, psnr_of_each, render};
use crate::common::{self, Result};

/// By how many dB the images of pictures may be explained worse than the pictures.
///
/// Of 13 chairs that the model of chairs does not know, `x` by 0 to 0.6 dB, the others by 3.5 dB and more; of 30 parts (`parts1157`) one
/// reflection of 21 by 0 to 1.9 dB, of three by 2.0 to 2.6 dB, all others by 3 dB and more.
const LIMIT: f64 = 2.0;
/// The part of the pictures that a code may leave unexplained: one that explains less does not know the object, nor its reflections.
/// Codes of those chairs and parts leave 0.09 to 0.54, that of a model of a hundred steps 1.4.
const UNEXPLAINED: f64 = 0.6;

/// A map of the world that only changes the signs of coordinates: a reflection, a half turn about an axis, or both.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reflection {
    /// The coordinates that it turns round: `x` the reflection in the plane x = 0, `xy` the half turn about z.
    pub name: &'static str,
    signs: DVec3,
}

/// All but the identity.
const REFLECTIONS: [Reflection; 7] = [
    Reflection { name: "x", signs: dvec3(-1.0, 1.0, 1.0) },
    Reflection { name: "y", signs: dvec3(1.0, -1.0, 1.0) },
    Reflection { name: "z", signs: dvec3(1.0, 1.0, -1.0) },
    Reflection { name: "xy", signs: dvec3(-1.0, -1.0, 1.0) },
    Reflection { name: "xz", signs: dvec3(-1.0, 1.0, -1.0) },
    Reflection { name: "yz", signs: dvec3(1.0, -1.0, -1.0) },
    Reflection { name: "xyz", signs: dvec3(-1.0, -1.0, -1.0) },
];

impl Reflection {
    /// What the view becomes under this map, `side` pixels square: `world_from_camera' = S · world_from_camera · F`. A camera has no mirror
    /// image, so where `S` reflects, `F` turns the camera's x round, and the picture left and right.
    fn image(self, view: &LoadedView, side: usize) -> LoadedView {
        let flip = self.signs.x * self.signs.y * self.signs.z;
        let (world_from_camera, _) = common::camera(view);
        let moved = DMat4::from_scale(self.signs) * world_from_camera * DMat4::from_scale(dvec3(flip, 1.0, 1.0));
        let mut image = LoadedView { world_from_camera: moved.transpose().to_cols_array(), ..view.clone() };
        if flip < 0.0 {
            let rows = view.rgb.chunks_exact(3 * side);
            image.rgb = rows.flat_map(|row| row.as_chunks::<3>().0.iter().rev().flatten().copied()).collect();
            image.intrinsics[2] = side as f32 - 1.0 - view.intrinsics[2];
        }
        image
    }
}

/// For each instance of a model whose codes are fitted to these views, its reflections.
pub fn reflections(engine: &Engine, fitted: &Model, views: &[Shown], side: u32) -> Result<Vec<Vec<Reflection>>> {
    let instances = fitted.layout.instances as usize;
    let sums = |of: &mut dyn Iterator<Item = f64>| {
        let mut sums = vec![0.0; instances];
        views.iter().zip(of).for_each(|((instance, _), value)| sums[*instance as usize] += value);
        sums
    };
    // In dB; an instance has as many images under a reflection as it has views.
    let shown = render(engine, fitted, views, side)?;
    let as_taken = sums(&mut psnr_of_each(&shown, views).into_iter());
    let pictures = shown.rgb.chunks(shown.rgb.len() / views.len()).zip(views);
    let unexplained = sums(&mut pictures.map(|(rgb, (_, view))| unexplained(&view.rgb, None, rgb)));
    let counts = sums(&mut views.iter().map(|_| 1.0));

    let mut found = vec![vec![]; instances];
    for reflection in &REFLECTIONS {
        let images = images(views, side, |_| slice::from_ref(reflection));
        let images: Vec<Shown> = images.iter().map(|(instance, view)| (*instance, view)).collect();
        let as_images = sums(&mut psnr_of_each(&render(engine, fitted, &images, side)?, &images).into_iter());
        for (k, of) in found.iter_mut().enumerate() {
            if unexplained[k] < UNEXPLAINED * counts[k] && as_images[k] > as_taken[k] - LIMIT * counts[k] {
                of.push(*reflection);
            }
        }
    }
    Ok(found)
}

/// The images of each view under the reflections of its instance.
pub fn images<'a>(views: &[Shown], side: u32, reflections: impl Fn(u32) -> &'a [Reflection]) -> Vec<(u32, LoadedView)> {
    let of = |&(instance, view): &Shown<'_>| -> Vec<_> {
        reflections(instance).iter().map(|reflection| (instance, reflection.image(view, side as usize))).collect()
    };
    views.iter().flat_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use srn_data::SrnSet;

    /// Where a camera sees a point, in pixels.
    fn pixel(view: &LoadedView, point: DVec3) -> (f64, f64) {
        let (world_from_camera, intrinsics) = common::camera(view);
        let seen = world_from_camera.inverse().transform_point3(point);
        (intrinsics.fx * seen.x / seen.z + intrinsics.cx, intrinsics.fy * seen.y / seen.z + intrinsics.cy)
    }

    #[test]
    fn an_image_shows_mapped_points_where_the_view_shows_points() {
        let side = 4;
        let rgb: Vec<f32> = (0..3 * side * side).map(|value| value as f32).collect();
        let pose = DMat4::from_translation(dvec3(0.1, -0.2, -1.3)) * DMat4::from_rotation_x(0.1) * DMat4::from_rotation_y(-0.2);
        let world_from_camera = pose.transpose().to_cols_array();
        let view = LoadedView { name: String::new(), rgb: rgb.clone(), world_from_camera, intrinsics: [5.0, 5.5, 1.7, 2.1] };
        for reflection in REFLECTIONS {
            let image = reflection.image(&view, side);
            let point = dvec3(0.2, 0.1, -0.3);
            let ((u, v), (image_u, image_v)) = (pixel(&view, point), pixel(&image, reflection.signs * point));
            let flipped = reflection.name.len() % 2 == 1;
            let expected = if flipped { side as f64 - 1.0 - u } else { u };
            assert!((image_u - expected).abs() < 1e-6 && (image_v - v).abs() < 1e-9, "{reflection:?}");
            assert_eq!(image.rgb[..3], if flipped { [9.0, 10.0, 11.0] } else { [0.0, 1.0, 2.0] }, "{reflection:?}");
            let (camera, _) = common::camera(&image);
            assert!((camera.determinant() - 1.0).abs() < 1e-12, "{reflection:?} leaves a camera a camera");
            let back = reflection.image(&image, side);
            assert_eq!(back.rgb, rgb, "{reflection:?}");
            assert!(DMat4::from_cols_array(&back.world_from_camera).abs_diff_eq(pose.transpose(), 1e-12), "{reflection:?}");
        }
    }

    /// The objects of the asset model, each with two views. The turret is symmetric about a diagonal, the valve not at all.
    #[test]
    fn asset_objects_have_the_reflections_of_their_meshes() {
        let assets = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets"));
        let model = Model::load(&assets.join("models/compact.safetensors")).unwrap();
        let set = SrnSet::open(assets.join("dataset/test")).unwrap().load(64).unwrap();
        let views: Vec<Shown> =
            set.instances.iter().flat_map(|of| [5, 14].map(|k| (model.instance(&of.name).unwrap(), &of.views[k]))).collect();
        let found = reflections(&Engine::cpu(), &model, &views, 64).unwrap();
        let names: Vec<_> = (0..)
            .zip(&found)
            .map(|(k, of)| (model.instance_name(k), of.iter().map(|reflection| reflection.name).collect()))
            .collect();
        let expected = |name: &str| match name {
            "valve" | "turret" => vec![],
            "forklift" => vec!["y"],
            _ => vec!["x"],
        };
        assert_eq!(names, names.iter().map(|(name, _)| (name.clone(), expected(name))).collect::<Vec<_>>());
    }
}
