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
use sigma_srn::{Effort, Engine, Gpu, Intrinsics, Model, Options, Outline, Query, Renderer, Search, wgpu};
use wasm_bindgen::prelude::*;

/// A model on an executor.
#[wasm_bindgen]
pub struct Session {
    engine: Engine,
    model: Model,
    renderer: Option<(u32, Renderer)>,
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

    /// A picture of `side` × `side` pixels, RGBA, from `world_from_camera` (4 × 4, row by row), with the focal length `focal` in pixels.
    #[wasm_bindgen(jspi)]
    pub fn render(&mut self, instance: u32, world_from_camera: &[f64], side: u32, focal: f64) -> Result<Vec<u8>, JsError> {
        let camera = (pose(world_from_camera)?, intrinsics(side, focal)?);
        Ok(to_rgba(&self.view(instance, camera, side)?))
    }

    /// The pose of an object in a picture of `side` × `side` RGBA pixels, white or transparent where it is not, with the focal length `focal` in pixels.
    /// Light and outline of a cut out object, that is where anything is transparent, are made up for.
    /// `rough`: where the camera is within some 30° (4 × 4, row by row); if there is none, it is looked for all around.
    /// `observe` is called with steps done, steps in all, and the best loss so far; a promise that it gives is waited for.
    #[wasm_bindgen(jspi)]
    pub fn estimate(
        &mut self,
        instance: u32,
        rgba: &[u8],
        side: u32,
        focal: f64,
        rough: Option<Vec<f64>>,
        is_fast: bool,
        observe: &Function,
    ) -> Result<Found, JsError> {
        let intrinsics = intrinsics(side, focal)?;
        let coverage: Vec<f32> = rgba.chunks_exact(4).map(|pixel| f32::from(pixel[3]) / 255.0).collect();
        // On white.
        let colour = |value: u8, covered: f32| 1.0 - covered * (2.0 - f32::from(value) / 127.5);
        let pixels = rgba.chunks_exact(4).zip(&coverage);
        let rgb = pixels.flat_map(|(pixel, &covered)| [0, 1, 2].map(|k| colour(pixel[k], covered))).collect();
        let starts = match rough {
            Some(rough) => neighbor4(&pose(&rough)?),
            None => around2016(self.distance()),
        };
        let query = Query {
            instance,
            rgb,
            weights: None,
            coverage: coverage.iter().any(|&covered| covered < 1.0).then_some(coverage),
            outline: Outline::AS_GIVEN,
            width: side,
            height: side,
            intrinsics,
            starts,
        };
        // No exhaustive one after it: the page shows the doubt, and who looks at it decides.
        let search = Search::from(Options::of(if is_fast { Effort::Fast } else { Effort::Normal }));
        let found = search.run(&self.engine, &self.model, &[query], |progress| {
            let losses = progress.descent.losses()?;
            let best = losses.into_iter().fold(f64::INFINITY, f64::min);
            let answer = observe.call3(&JsValue::NULL, &progress.step.into(), &progress.steps.into(), &best.into());
            // What the page makes of it is the page's affair.
            if let Some(promise) = answer.ok().and_then(|answer| answer.dyn_into::<Promise>().ok()) {
                drop(jspi_block_on_promise(&promise));
            }
            Ok(())
        })?;
        let found = &found[0];
        Ok(Found {
            world_from_camera: found.world_from_camera.transpose().to_cols_array().to_vec(),
            doubt: found.doubt.map(|doubt| doubt.to_string()),
            rotation_deg: found.confidence.map(|confidence| confidence.rotation_deg),
            translation: found.confidence.map(|confidence| confidence.translation),
            view: to_rgba(&found.view),
        })
    }
}

impl Session {
    /// The model's view `[side, side, 3]`.
    fn view(&mut self, instance: u32, camera: (DMat4, Intrinsics), side: u32) -> Result<Vec<f32>, sigma_srn::Error> {
        let renderer = match self.renderer.take().filter(|(known, _)| *known == side) {
            Some((_, renderer)) => renderer,
            None => Renderer::new(&self.engine, &self.model, 1, side, side)?,
        };
        let (_, renderer) = self.renderer.insert((side, renderer));
        Ok(renderer.render(&[instance], &[camera], 0)?.rgb)
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
    /// The model's view from there, RGBA.
    pub view: Vec<u8>,
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

/// Those of a square picture, the principal point in its middle.
fn intrinsics(side: u32, focal: f64) -> Result<Intrinsics, JsError> {
    if !(f64::MIN_POSITIVE..f64::INFINITY).contains(&focal) {
        return Err(JsError::new(&format!("a focal length of {focal} pixels")));
    }
    let middle = f64::from(side) / 2.0;
    Ok(Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, pixel_center: 0.0 })
}

fn to_rgba(rgb: &[f32]) -> Vec<u8> {
    let byte = |value: f32| (127.5 * (value + 1.0)).round().clamp(0.0, 255.0) as u8;
    rgb.chunks_exact(3).flat_map(|pixel| [byte(pixel[0]), byte(pixel[1]), byte(pixel[2]), 255]).collect()
}
