//! Novel views: rgb and depth of instances from given cameras.

use glam::DMat4;
use srn_gpu::wgpu;
use srn_plan::ops::pack_rgba8;
use srn_plan::{BufferId, Builder, PlanError, StageId, tiles};

use crate::camera::{Intrinsics, fixed24};
use crate::engine::{Engine, Runner, proof};
use crate::model::Model;
use crate::network::forward::{self, Instances};
use crate::network::streamed::OnHost;
use crate::network::{Batch, Network, Purpose, Saved, Trainable};
use crate::random::stream;
use crate::{Error, Rays, pixel_grid};

/// Rendered images.
#[derive(Clone, Debug, PartialEq)]
pub struct Rendering {
    /// Colours `[views, height, width, 3]`, about -1 to 1, not clamped.
    pub rgb: Vec<f32>,
    /// Depth of each ray's end point, z in its camera's frame, object units, `[views, height, width]`.
    pub depth: Vec<f32>,
}

/// Instance, `world_from_camera` and intrinsics of a view.
pub type View = (u32, DMat4, Intrinsics);

/// Views that are rendered at once, and instances whose weights are made.
const BATCH: usize = 8;

/// Renders any number of views of `[width, height]` pixels.
pub fn render_views(engine: &Engine, model: &Model, [width, height]: [u32; 2], views: &[View]) -> Result<Vec<Rendering>, Error> {
    let batch = views.len().min(BATCH);
    let mut renderer = Renderer::new(engine, model, batch as u32, width, height)?;
    let mut renders = Vec::new();
    for chunk in views.chunks(batch) {
        let filled = filled(chunk, batch);
        let instances: Vec<u32> = filled.iter().map(|view| view.0).collect();
        let cameras: Vec<_> = filled.iter().map(|view| (view.1, view.2)).collect();
        let Rendering { rgb, depth } = renderer.render(&instances, &cameras, 0)?;
        let pixels = (width * height) as usize;
        let each = rgb.chunks(3 * pixels).zip(depth.chunks(pixels)).take(chunk.len());
        renders.extend(each.map(|(rgb, depth)| Rendering { rgb: rgb.to_vec(), depth: depth.to_vec() }));
    }
    Ok(renders)
}

struct Handles {
    network: Network,
    packed: BufferId,
    instances: Instances,
    render: StageId,
    pack: StageId,
}

/// Renders a fixed number of views at a time, of a fixed size.
///
/// On a GPU, [`Renderer::encode`] and [`Renderer::encode_to_texture`] work on the caller's device inside the caller's frame.
pub struct Renderer {
    runner: Runner,
    handles: Handles,
    width: u32,
    height: u32,
    views: u32,
    instances: Option<Vec<u32>>,
}

impl Renderer {
    /// A renderer of `views` images of `width` × `height` pixels.
    ///
    /// A GPU that has rendered nothing before is compared with the CPU executor first, and refused where its views are wrong ([`Error::Adapter`]).
    pub fn new(engine: &Engine, model: &Model, views: u32, width: u32, height: u32) -> Result<Self, Error> {
        for (field, value) in [("views", views), ("width", width), ("height", height)] {
            if value == 0 {
                return Err(Error::Setting { field, what: "must be at least 1".into() });
            }
        }
        let work = if model.layout.is_baked() { "views of baked objects" } else { "views" };
        engine.prove(work, model, |engine| {
            const TRIED: usize = 3;
            let (side, middle) = (proof::SIDE, f64::from(proof::SIDE) / 2.0);
            let intrinsics = Intrinsics { fx: f64::from(side), fy: f64::from(side), cx: middle, cy: middle, pixel_center: 0.0 };
            let around = fixed24(model.metadata.orbit_radius.unwrap_or(1.3));
            let cameras: Vec<_> = around.into_iter().step_by(9).map(|camera| (camera, intrinsics)).collect();
            let mut renderer = Self::unproven(engine, model, TRIED as u32, side, side)?;
            let Rendering { rgb, depth } = renderer.render(&[0; TRIED], &cameras[..TRIED], 0)?;
            let parts = rgb.chunks(rgb.len() / TRIED).zip(depth.chunks(depth.len() / TRIED));
            let wide = |part: &[f32]| part.iter().copied().map(f64::from).collect();
            Ok(parts.map(|(rgb, depth)| vec![wide(rgb), wide(depth)]).collect())
        })?;
        Self::unproven(engine, model, views, width, height)
    }

    fn unproven(engine: &Engine, model: &Model, views: u32, width: u32, height: u32) -> Result<Self, Error> {
        let rays = Engine::rows([views, width, height])?;
        let size = [width, height];
        let on_host = OnHost::of(engine, model, 1);
        let (plan, mut handles) =
            engine.fit(rays, model.layout.features(), |b, tile_rows| build(b, model, views, size, tile_rows, &on_host))?;
        let mut runner = engine.prepare(plan)?;
        handles.instances.upload(&mut *runner, &handles.network, model)?;
        let slots: Vec<u32> = (0..views).collect();
        runner.write_u32(handles.network.slots, &slots)?;
        Ok(Renderer { runner, handles, width, height, views, instances: None })
    }

    /// Renders view `k` of instance `instances[k]` from `cameras[k]`: `world_from_camera` and intrinsics. `seed` draws the
    /// initial depths (spec 2).
    pub fn render(&mut self, instances: &[u32], cameras: &[(DMat4, Intrinsics)], seed: u64) -> Result<Rendering, Error> {
        self.set_views(instances, cameras, seed)?;
        self.runner.run(self.handles.render)?;
        let rgb = self.runner.read(self.handles.network.rgb)?;
        Ok(Rendering { rgb, depth: self.runner.read(self.handles.network.depth)? })
    }

    /// Sets what [`Renderer::encode`] renders.
    pub fn set_views(&mut self, instances: &[u32], cameras: &[(DMat4, Intrinsics)], seed: u64) -> Result<(), Error> {
        for (input, got) in [("instances", instances.len()), ("cameras", cameras.len())] {
            if got != self.views as usize {
                let what = format!("got {got}, this renderer makes {} views", self.views);
                return Err(Error::Input { input: input.into(), what });
            }
        }
        self.set_instances(instances)?;
        let mut random = stream(seed, 0);
        let mut rays = Rays::default();
        for (world_from_camera, intrinsics) in cameras {
            rays.push(world_from_camera, intrinsics, pixel_grid(self.width, self.height, 1), &mut random);
        }
        let network = &self.handles.network;
        self.runner.write_f64(network.world_from_camera, rays.world_from_camera.as_flattened())?;
        Ok(rays.write(&mut *self.runner, network)?)
    }

    /// Makes the weights of f for the instance of each view, where they are not those of the last call.
    fn set_instances(&mut self, instances: &[u32]) -> Result<(), Error> {
        let network = &self.handles.network;
        if let Some(instance) = instances.iter().find(|&&instance| instance >= network.instances) {
            let what = format!("number {instance}, but the model has {}", network.instances);
            return Err(Error::Input { input: "instances".into(), what });
        }
        if self.instances.as_deref() != Some(instances) {
            self.runner.write_u32(network.index, instances)?;
            self.handles.instances.run(&mut *self.runner)?;
            self.instances = Some(instances.to_vec());
        }
        Ok(())
    }

    /// Appends the rendering of the views set before to the caller's encoder; the results are in [`Renderer::rgb_buffer`] and
    /// [`Renderer::depth_buffer`] once it ran. `None` on the CPU.
    pub fn encode(&self, encoder: &mut wgpu::CommandEncoder) -> Option<()> {
        self.runner.as_gpu()?.encode(self.handles.render, encoder);
        Some(())
    }

    /// Like [`Renderer::encode`], then copies the first view to the top left corner of `texture`, an `Rgba8Unorm` or
    /// `Rgba8UnormSrgb` texture with `COPY_DST`, of at least the size of a view. `None` on the CPU.
    pub fn encode_to_texture(&self, encoder: &mut wgpu::CommandEncoder, texture: &wgpu::Texture) -> Option<()> {
        let executor = self.runner.as_gpu()?;
        executor.encode(self.handles.render, encoder);
        executor.encode(self.handles.pack, encoder);
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(4 * pack_rgba8::stride(self.width)),
            rows_per_image: None,
        };
        let source = wgpu::TexelCopyBufferInfo { buffer: executor.buffer(self.handles.packed), layout };
        let size = wgpu::Extent3d { width: self.width, height: self.height, depth_or_array_layers: 1 };
        encoder.copy_buffer_to_texture(source, texture.as_image_copy(), size);
        Some(())
    }

    /// The device buffer of the colours, `[views, height, width, 3]` as `f32`. `None` on the CPU.
    pub fn rgb_buffer(&self) -> Option<&wgpu::Buffer> {
        Some(self.runner.as_gpu()?.buffer(self.handles.network.rgb))
    }

    /// The device buffer of the depths, `[views, height, width]` as `f32`. `None` on the CPU.
    pub fn depth_buffer(&self) -> Option<&wgpu::Buffer> {
        Some(self.runner.as_gpu()?.buffer(self.handles.network.depth))
    }
}

/// The weights of each layer of f for these instances, `[instances, in·out + out]`, computed in `f64`, a few at a time.
pub(crate) fn scene_weights(model: &Model, instances: &[u32]) -> Result<Vec<Vec<f32>>, Error> {
    let batch = instances.len().min(BATCH);
    let mut renderer = Renderer::new(&Engine::cpu_f64(), model, batch as u32, 1, 1)?;
    let mut weights = vec![Vec::new(); model.layout.scene.len()];
    for chunk in instances.chunks(batch) {
        renderer.set_instances(&filled(chunk, batch))?;
        let Renderer { runner, handles, .. } = &mut renderer;
        for (weights, block) in weights.iter_mut().zip(&handles.network.scene) {
            let slots = runner.read(block.layer.weights)?;
            weights.extend_from_slice(&slots[..chunk.len() * (slots.len() / batch)]);
        }
    }
    Ok(weights)
}

/// The items, and copies of them up to `count`: a renderer's size is fixed, what is left at the end is fewer.
fn filled<T: Copy>(items: &[T], count: usize) -> Vec<T> {
    items.iter().cycle().take(count).copied().collect()
}

fn build(
    b: &mut Builder,
    model: &Model,
    views: u32,
    [width, height]: [u32; 2],
    tile_rows: u32,
    on_host: &OnHost,
) -> Result<Handles, PlanError> {
    let rays = width * height;
    let network =
        Network::new(b, model, Batch { images: views, rays, slots: views }, Trainable::Nothing, true, &on_host.parameters)?;
    let cut = tiles(views, rays, tile_rows);
    let most = cut.iter().map(|tile| tile.rows.count()).max().unwrap_or(1);
    let saved = Saved::new(b, &network, Purpose::Render, most)?;
    let packed = b.scratch_u32("packed rgba8", (pack_rgba8::stride(width) * height) as usize)?;
    let instances = Instances::new(b, &network, model, on_host)?;
    let render = b.stage("render");
    for &tile in &cut {
        forward::render(b, &network, &saved, tile)?;
    }
    let pack = b.stage("pack");
    pack_rgba8::forward(b, width, height, 0, network.rgb, packed)?;
    Ok(Handles { network, packed, instances, render, pack })
}
