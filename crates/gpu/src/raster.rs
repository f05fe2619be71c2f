//! A rasteriser that turns coloured, textured triangles into anti-aliased pictures: what data sets are rendered with.
//!
//! Every picture is drawn four times as wide and high with four samples a pixel, then averaged: 64 samples a pixel.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use srn_plan::ExecutorError;

use crate::Gpu;

const SUPERSAMPLE: u32 = 4;
const SAMPLES: u32 = 4;
const COLOUR: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

/// A corner of a triangle, in object units.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Vertex {
    /// Position in the world.
    pub position: [f32; 3],
    /// Unit normal; either side of the surface.
    pub normal: [f32; 3],
    /// RGB in [0, 1], gamma-encoded; multiplies the texture.
    pub colour: [f32; 3],
    /// Texture coordinates, `(0, 0)` at the top left, repeating.
    pub uv: [f32; 2],
}

/// A picture on a surface.
#[derive(Debug, Clone, Copy)]
pub struct Texture<'a> {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// RGBA bytes, row-major, `4 · width · height`; surfaces are cut out where alpha is below one half.
    pub rgba: &'a [u8],
}

/// A run of vertices (three to a triangle) drawn with one texture, an index into the textures.
pub type Part = (Range<u32>, Option<usize>);

/// A square pinhole view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// 4×4, row-major, rigid: camera axes x right, y down, z forward to the world.
    pub world_from_camera: [f64; 16],
    /// `fx, fy, cx, cy` in pixels; the centre of pixel `(u, v)` lies at `(u, v)`.
    pub intrinsics: [f64; 4],
    /// Width and height of the picture in pixels.
    pub side: u32,
}

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum RasterError {
    /// The inputs do not fit together.
    #[error("{what}: expected {expected}, found {found}")]
    Input {
        /// Which input.
        what: String,
        /// What was expected.
        expected: u64,
        /// What was given.
        found: u64,
    },
    /// The device refused the work or was lost.
    #[error(transparent)]
    Device(#[from] ExecutorError),
}

/// Pipelines and targets. Pictures come out the same, bit for bit, each time on one device.
#[derive(Debug)]
pub struct Rasterizer {
    gpu: Gpu,
    pipeline: wgpu::RenderPipeline,
    sampler: wgpu::Sampler,
}

/// A mesh on the device.
#[derive(Debug)]
pub struct Model {
    vertices: wgpu::Buffer,
    parts: Vec<(Range<u32>, usize)>,
    textures: Vec<wgpu::BindGroup>,
}

#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct CameraUniform {
    camera_from_world: [[f32; 4]; 4],
    centre: [f32; 4],
    scale_shift: [f32; 4],
}

impl Rasterizer {
    /// Builds the pipeline; it needs no features and no more than the default limits.
    pub fn new(gpu: &Gpu) -> Result<Self, RasterError> {
        Ok(gpu.checked("raster/pipeline", || Self::build(gpu))?)
    }

    fn build(gpu: &Gpu) -> Self {
        let device = gpu.device();
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("raster"),
            source: wgpu::ShaderSource::Wgsl(include_str!("raster.wgsl").into()),
        });
        let attributes = wgpu::vertex_attr_array![0 => Float32x3, 1 => Float32x3, 2 => Float32x3, 3 => Float32x2];
        let pipeline = device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("raster"),
            layout: None,
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("vertex"),
                compilation_options: Default::default(),
                buffers: &[Some(wgpu::VertexBufferLayout {
                    array_stride: size_of::<Vertex>() as u64,
                    step_mode: wgpu::VertexStepMode::Vertex,
                    attributes: &attributes,
                })],
            },
            primitive: wgpu::PrimitiveState { cull_mode: None, ..Default::default() },
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH,
                depth_write_enabled: Some(true),
                depth_compare: Some(wgpu::CompareFunction::Greater),
                stencil: Default::default(),
                bias: Default::default(),
            }),
            multisample: wgpu::MultisampleState { count: SAMPLES, ..Default::default() },
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("fragment"),
                compilation_options: Default::default(),
                targets: &[Some(COLOUR.into())],
            }),
            multiview_mask: None,
            cache: None,
        });
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("raster"),
            address_mode_u: wgpu::AddressMode::Repeat,
            address_mode_v: wgpu::AddressMode::Repeat,
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            ..Default::default()
        });
        Self { gpu: gpu.clone(), pipeline, sampler }
    }

    /// Copies a mesh to the device.
    pub fn upload(&self, vertices: &[Vertex], parts: &[Part], textures: &[Texture]) -> Result<Model, RasterError> {
        let bytes = bytemuck::cast_slice::<_, u8>(vertices);
        check("bytes of vertices, at most", self.gpu.device().limits().max_buffer_size, bytes.len() as u64, |most, n| n <= most)?;
        for (range, texture) in parts {
            let end = u64::from(range.end.max(range.start));
            check("vertices that a part refers to, at most", vertices.len() as u64, end, |most, n| n <= most)?;
            let index = texture.map_or(0, |t| t as u64 + 1);
            check("textures that a part refers to, at most", textures.len() as u64, index, |most, n| n <= most)?;
        }
        let largest = u64::from(self.gpu.device().limits().max_texture_dimension_2d);
        for texture in textures {
            let [width, height] = [texture.width, texture.height].map(u64::from);
            check("texture side in pixels, at least", 1, width.min(height), |least, n| n >= least)?;
            check("texture side in pixels, at most", largest, width.max(height), |most, n| n <= most)?;
            check("bytes of a texture", 4 * width * height, texture.rgba.len() as u64, |a, b| a == b)?;
        }
        Ok(self.gpu.checked("raster/upload", || {
            let buffer = self.gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("raster vertices"),
                size: bytes.len().max(4) as u64,
                usage: wgpu::BufferUsages::VERTEX | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            self.gpu.queue().write_buffer(&buffer, 0, bytes);
            let white = Texture { width: 1, height: 1, rgba: &[255; 4] };
            let textures: Vec<_> = textures.iter().chain([&white]).map(|texture| self.texture(texture)).collect();
            let untextured = textures.len() - 1;
            let parts = parts.iter().map(|(range, texture)| (range.clone(), texture.unwrap_or(untextured))).collect();
            Model { vertices: buffer, parts, textures }
        })?)
    }

    /// Draws the model on white. Returns RGB bytes, row-major `[side, side, 3]`.
    pub fn render(&self, model: &Model, view: &View) -> Result<Vec<u8>, RasterError> {
        let largest = u64::from(self.gpu.device().limits().max_texture_dimension_2d / SUPERSAMPLE);
        check("picture side in pixels, at least", 1, view.side.into(), |least, n| n >= least)?;
        check("picture side in pixels, at most", largest, view.side.into(), |most, n| n <= most)?;
        let side = view.side * SUPERSAMPLE;
        let row_bytes = (4 * side).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let bytes = u64::from(row_bytes) * u64::from(side);
        check("bytes of a picture's samples, at most", self.gpu.device().limits().max_buffer_size, bytes, |most, n| n <= most)?;
        let size = wgpu::Extent3d { width: side, height: side, depth_or_array_layers: 1 };
        let copy = self.gpu.checked("raster/render", || {
            let target = |label, format, sample_count, usage| {
                self.gpu.device().create_texture(&wgpu::TextureDescriptor {
                    label: Some(label),
                    size,
                    mip_level_count: 1,
                    sample_count,
                    dimension: wgpu::TextureDimension::D2,
                    format,
                    usage,
                    view_formats: &[],
                })
            };
            let attachment = wgpu::TextureUsages::RENDER_ATTACHMENT;
            let samples = target("raster samples", COLOUR, SAMPLES, attachment).create_view(&Default::default());
            let depth = target("raster depth", DEPTH, SAMPLES, attachment).create_view(&Default::default());
            let picture = target("raster picture", COLOUR, 1, attachment | wgpu::TextureUsages::COPY_SRC);
            let copy = self.gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("raster copy"),
                size: bytes,
                usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            });
            // One for each picture: another thread may be drawing, too.
            let camera = self.gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("raster camera"),
                size: size_of::<CameraUniform>() as u64,
                usage: wgpu::BufferUsages::UNIFORM | wgpu::BufferUsages::COPY_DST,
                mapped_at_creation: false,
            });
            let camera_group = self.gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
                label: Some("raster camera"),
                layout: &self.pipeline.get_bind_group_layout(0),
                entries: &[wgpu::BindGroupEntry { binding: 0, resource: camera.as_entire_binding() }],
            });
            self.gpu.queue().write_buffer(&camera, 0, bytemuck::bytes_of(&camera_uniform(view)));
            let mut encoder = self.gpu.device().create_command_encoder(&Default::default());
            let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
                label: Some("raster"),
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &samples,
                    depth_slice: None,
                    resolve_target: Some(&picture.create_view(&Default::default())),
                    ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::WHITE), store: wgpu::StoreOp::Discard },
                })],
                depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                    view: &depth,
                    depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
                    stencil_ops: None,
                }),
                ..Default::default()
            });
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, &camera_group, &[]);
            pass.set_vertex_buffer(0, model.vertices.slice(..));
            for (range, texture) in &model.parts {
                pass.set_bind_group(1, &model.textures[*texture], &[]);
                pass.draw(range.clone(), 0..1);
            }
            drop(pass);
            encoder.copy_texture_to_buffer(
                picture.as_image_copy(),
                wgpu::TexelCopyBufferInfo {
                    buffer: &copy,
                    layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row_bytes), rows_per_image: None },
                },
                size,
            );
            self.gpu.queue().submit([encoder.finish()]);
            copy
        })?;
        let samples = self.gpu.download("raster/render", &copy, bytes)?;
        Ok(box_filter(&samples, row_bytes as usize, view.side as usize))
    }

    /// Uploads a texture with all its halved sizes, so that it stays smooth from afar.
    fn texture(&self, picture: &Texture) -> wgpu::BindGroup {
        let [mut width, mut height] = [picture.width, picture.height];
        let mip_level_count = width.max(height).ilog2() + 1;
        let texture = self.gpu.device().create_texture(&wgpu::TextureDescriptor {
            label: Some("raster albedo"),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: COLOUR,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let mut level = picture.rgba.to_vec();
        for mip_level in 0..mip_level_count {
            self.gpu.queue().write_texture(
                wgpu::TexelCopyTextureInfo { mip_level, ..texture.as_image_copy() },
                &level,
                wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * width), rows_per_image: None },
                wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            );
            level = halve(&level, width as usize, height as usize);
            [width, height] = [width, height].map(|n| (n / 2).max(1));
        }
        self.gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("raster albedo"),
            layout: &self.pipeline.get_bind_group_layout(1),
            entries: &[
                wgpu::BindGroupEntry {
                    binding: 0,
                    resource: wgpu::BindingResource::TextureView(&texture.create_view(&Default::default())),
                },
                wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::Sampler(&self.sampler) },
            ],
        })
    }
}

fn check(what: &str, expected: u64, found: u64, good: impl Fn(u64, u64) -> bool) -> Result<(), RasterError> {
    if good(expected, found) { Ok(()) } else { Err(RasterError::Input { what: what.into(), expected, found }) }
}

/// Inverts the rigid pose, and turns pixels into clip space: pixel `u` covers `u − 1/2 … u + 1/2`, the picture's left edge is −1.
fn camera_uniform(view: &View) -> CameraUniform {
    let m = |row: usize, column: usize| view.world_from_camera[4 * row + column];
    let mut camera_from_world = [[0.0; 4]; 4]; // column-major
    for axis in 0..3 {
        for column in 0..3 {
            camera_from_world[column][axis] = m(column, axis) as f32;
        }
        camera_from_world[3][axis] = -(0..3).map(|k| m(k, axis) * m(k, 3)).sum::<f64>() as f32;
    }
    camera_from_world[3][3] = 1.0;
    let [fx, fy, cx, cy] = view.intrinsics;
    let side = f64::from(view.side);
    let [left, top] = [cx, cy].map(|c| (2.0 * c + 1.0) / side - 1.0);
    CameraUniform {
        camera_from_world,
        centre: [m(0, 3) as f32, m(1, 3) as f32, m(2, 3) as f32, 1.0],
        scale_shift: [2.0 * fx / side, -2.0 * fy / side, left, -top].map(|x| x as f32),
    }
}

/// The means of 4×4 blocks, without alpha.
fn box_filter(rgba: &[u8], row_bytes: usize, side: usize) -> Vec<u8> {
    let n = SUPERSAMPLE as usize;
    let mean = |y: usize, x: usize, channel: usize| {
        let sample = |i: usize| u32::from(rgba[(y * n + i / n) * row_bytes + (x * n + i % n) * 4 + channel]);
        let count = SUPERSAMPLE * SUPERSAMPLE;
        (((0..n * n).map(sample).sum::<u32>() + count / 2) / count) as u8
    };
    let pixel = |i: usize| [0, 1, 2].map(|channel| mean(i / side, i % side, channel));
    (0..side * side).flat_map(pixel).collect()
}

/// The picture at half its size, at least one pixel each way; the last row or column of an odd size is dropped.
fn halve(rgba: &[u8], width: usize, height: usize) -> Vec<u8> {
    let [w, h] = [width, height].map(|n| (n / 2).max(1));
    let at = |x: usize, y: usize, c: usize| u32::from(rgba[4 * (y.min(height - 1) * width + x.min(width - 1)) + c]);
    let texel = |i: usize| {
        let [x, y] = [2 * (i % w), 2 * (i / w)];
        [0, 1, 2, 3].map(|c| ((at(x, y, c) + at(x + 1, y, c) + at(x, y + 1, c) + at(x + 1, y + 1, c) + 2) / 4) as u8)
    };
    (0..w * h).flat_map(texel).collect()
}
