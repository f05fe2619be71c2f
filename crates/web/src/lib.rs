//! This crate owns what a browser page calls: views of a model's objects, and the pose of an object in a picture, on the browser's GPU. It
//! does not know the page.
//!
//! The library blocks where it waits for the GPU; in a browser WebAssembly is suspended there instead, and the page goes on
//! ([JS Promise Integration](https://github.com/WebAssembly/js-promise-integration)). So functions that wait give the page a promise. One
//! of them may run at a time.
#![cfg(target_family = "wasm")]
#![expect(deprecated, reason = "so `jspi` marks what is new")]

use std::path::Path;

use glam::DMat4;
use js_sys::futures::jspi_block_on_promise;
use js_sys::{Function, Promise};
use sigma_srn::camera::{around2016, neighbor4};
use sigma_srn::photo::{BoundingBox, FoundObject, Photo, Shot};
use sigma_srn::{Effort, Engine, Gpu, Intrinsics, Model, Options, Progress, Renderer, Search, wgpu};
use wasm_bindgen::prelude::*;

/// A model on an executor.
#[wasm_bindgen]
pub struct Session {
    engine: Engine,
    model: Model,
    renderer: Option<Renderer>,
}

#[wasm_bindgen]
impl Session {
    /// From the bytes of a model's file; `on_gpu`: on the browser's GPU, else on one thread of the CPU.
    pub async fn open(model: Vec<u8>, on_gpu: bool) -> Result<Session, JsError> {
        let model = Model::from_bytes(&model, "", Path::new("model"))?;
        let engine = if on_gpu { Engine::gpu(open_gpu().await?).or_cpu() } else { Engine::cpu() };
        Ok(Session { engine, model, renderer: None })
    }

    /// What computes.
    pub fn executor(&self) -> String {
        self.engine.to_string()
    }

    /// Names of the objects that the model knows.
    pub fn instances(&self) -> Vec<String> {
        (0..self.model.layout.instances).map(|number| self.model.instance_name(number)).collect()
    }

    /// Distance of the cameras that the model was trained with from the object's centre, object units.
    pub fn distance(&self) -> f64 {
        self.model.metadata.orbit_radius.unwrap_or(1.3)
    }

    /// Pixels to a side of the pictures that are compared.
    pub fn side(&self) -> u32 {
        self.model.metadata.side.unwrap_or(64)
    }

    /// A picture of [`Session::side`] × [`Session::side`] pixels, RGBA, from `world_from_camera` (4 × 4, row by row), with the intrinsics `fx, fy, cx, cy` in its pixels.
    #[wasm_bindgen(jspi)]
    pub fn render(&mut self, instance: u32, world_from_camera: &[f64], intrinsics: &[f64]) -> Result<Vec<u8>, JsError> {
        let &[fx, fy, cx, cy] = intrinsics else { return Err(JsError::new("intrinsics are four numbers")) };
        let camera = (pose(world_from_camera)?, Intrinsics { fx, fy, cx, cy, pixel_center: 0.0 });
        let side = self.side();
        let renderer = match &mut self.renderer {
            Some(renderer) => renderer,
            none => none.insert(Renderer::new(&self.engine, &self.model, 1, side, side)?),
        };
        Ok(to_rgba(&renderer.render(&[instance], &[camera], 0)?.rgb))
    }

    /// The pose of an object in a photograph of RGBA pixels, `width` to a row, with the focal length `focal` in pixels and the principal point in its middle.
    /// `bounds`: a box around the object (left edge, top edge, width and height in pixels), which is found in there; no number at all: it is looked for in all of the photograph. Without them the
    /// object is before white, in the middle square, or before nothing: where anything is transparent, the square is cut around what is not. Light and outline of what is cut out, by either, are made up for.
    /// `rough`: where the camera is within some 30° (4 × 4, row by row); of what is cut out it says from which side the object is seen. If there is none, it is looked for all around.
    /// `observe` is called with steps done, steps in all, and the best loss so far; a promise that it gives is waited for.
    #[wasm_bindgen(jspi)]
    pub fn estimate(
        &mut self,
        instance: u32,
        rgba: &[u8],
        width: u32,
        focal: f64,
        bounds: Option<Vec<f64>>,
        rough: Option<Vec<f64>>,
        is_fast: bool,
        observe: &Function,
    ) -> Result<Found, JsError> {
        let height = rgba.len() / 4 / (width as usize).max(1);
        let photo = Photo::from_rgba8(width as usize, height, rgba).ok_or(JsError::new("rows of RGBA pixels are expected"))?;
        if !(f64::MIN_POSITIVE..f64::INFINITY).contains(&focal) {
            return Err(JsError::new(&format!("a focal length of {focal} pixels")));
        }
        let middle = [width as usize, height].map(|pixels| pixels as f64 / 2.0);
        let intrinsics = Intrinsics { fx: focal, fy: focal, cx: middle[0], cy: middle[1], pixel_center: 0.0 };
        let rough = rough.as_deref().map(pose).transpose()?;
        let model = &self.model;
        let starts = |shot: &Shot| match &rough {
            Some(rough) if shot.distance.is_some() => Ok(neighbor4(&shot.facing(model, rough)?)),
            Some(rough) => Ok(neighbor4(rough)),
            None => shot.around(model, around2016, None),
        };
        // No exhaustive one after it: the page shows the doubt, and who looks at it decides.
        let search = Search::from(Options::of(if is_fast { Effort::Fast } else { Effort::Normal }));
        let observe = |progress: Progress| {
            let losses = progress.descent.losses()?;
            let best = losses.into_iter().fold(f64::INFINITY, f64::min);
            let answer = observe.call3(&JsValue::NULL, &progress.step.into(), &progress.steps.into(), &best.into());
            // What the page makes of it is the page's affair.
            if let Some(promise) = answer.ok().and_then(|answer| answer.dyn_into::<Promise>().ok()) {
                drop(jspi_block_on_promise(&promise));
            }
            Ok(())
        };
        let (shot, found) = match bounds.as_deref() {
            Some(&[x, y, width, height]) => {
                let bounds = BoundingBox { corner: [x, y], size: [width, height] };
                search.run_in_box(&self.engine, model, instance, (&photo, &intrinsics), bounds, starts, observe)?
            }
            Some([]) => search.run_anywhere(&self.engine, model, instance, (&photo, &intrinsics), starts, observe)?,
            Some(_) => return Err(JsError::new("a box has four numbers")),
            None => {
                let square = photo.square([focal, focal, middle[0], middle[1]], self.side() as usize);
                let shot = Shot::of(square.ok_or(JsError::new("all of the picture is transparent"))?, instance);
                let found = search.run(&self.engine, model, &[shot.query(starts(&shot)?)], observe)?.remove(0);
                (shot, found)
            }
        };
        let object = FoundObject::of(&shot, &found.world_from_camera, &self.engine, model, 1)?;
        let covers = |i: usize| object.covers([i % width as usize, i / width as usize].map(|x| x as f64 + 0.5));
        let Intrinsics { fx, fy, cx, cy, .. } = shot.intrinsics;
        Ok(Found {
            world_from_camera: found.world_from_camera.transpose().to_cols_array().to_vec(),
            doubt: found.doubt.map(|doubt| doubt.to_string()),
            rotation_deg: found.confidence.map(|confidence| confidence.rotation_deg),
            translation: found.confidence.map(|confidence| confidence.translation),
            picture: to_rgba(&shot.rgb),
            view: to_rgba(&found.view),
            intrinsics: vec![fx, fy, cx, cy],
            object: (0..rgba.len() / 4).map(|i| u8::from(covers(i))).collect(),
        })
    }
}

/// A pose that was found.
#[wasm_bindgen(getter_with_clone)]
pub struct Found {
    /// 4 × 4, row by row.
    pub world_from_camera: Vec<f64>,
    /// Why it is not to be trusted, if it is not.
    pub doubt: Option<String>,
    /// Standard deviation of the rotation, degrees, if the model is calibrated.
    pub rotation_deg: Option<f64>,
    /// Standard deviation of the camera's place, object units.
    pub translation: Option<f64>,
    /// The square of the photograph that was compared, RGBA on white.
    pub picture: Vec<u8>,
    /// The model's view from there, RGBA.
    pub view: Vec<u8>,
    /// `fx, fy, cx, cy` of both, in their pixels.
    pub intrinsics: Vec<f64>,
    /// For each pixel of the photograph 1 where the model shows the object, 0 where not.
    pub object: Vec<u8>,
}

/// The browser's GPU, with what the kernels can use of it.
async fn open_gpu() -> Result<Gpu, JsError> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let options = wgpu::RequestAdapterOptions { power_preference: wgpu::PowerPreference::HighPerformance, ..Default::default() };
    let adapter = instance.request_adapter(&options).await?;
    let (device, queue) = adapter
        .request_device(&wgpu::DeviceDescriptor {
            label: Some("sigma-srn"),
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY,
            required_limits: adapter.limits(),
            ..Default::default()
        })
        .await?;
    Ok(Gpu::from_device(device, queue))
}

fn pose(world_from_camera: &[f64]) -> Result<DMat4, JsError> {
    let rows: &[f64; 16] = world_from_camera.try_into().map_err(|_| JsError::new("a pose has 16 numbers"))?;
    Ok(DMat4::from_cols_array(rows).transpose())
}

fn to_rgba(rgb: &[f32]) -> Vec<u8> {
    let byte = |value: f32| (127.5 * (value + 1.0)).round().clamp(0.0, 255.0) as u8;
    rgb.chunks_exact(3).flat_map(|pixel| [byte(pixel[0]), byte(pixel[1]), byte(pixel[2]), 255]).collect()
}
