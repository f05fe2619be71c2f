//! Renders into a texture of an application's own wgpu device, inside the application's own command encoder.
//!
//! `cargo run --release -p sigma-srn --example render_to_texture -- assets/models/compact.safetensors`

use std::path::Path;

use sigma_srn::{Engine, Gpu, Intrinsics, Model, Renderer, camera, wgpu};

const SIDE: u32 = 64;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).unwrap_or_else(|| "assets/models/compact.safetensors".into());
    let model = Model::load(Path::new(&path))?;

    // The application's device and queue. A real one asks for its own features and limits; the renderer stays within them.
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))?;
    let descriptor = wgpu::DeviceDescriptor { required_limits: adapter.limits(), ..Default::default() };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))?;
    println!("adapter: {}", adapter.get_info().name);

    let engine = Engine::gpu(Gpu::from_device(device.clone(), queue.clone()));
    let mut renderer = Renderer::new(&engine, &model, 1, SIDE, SIDE)?;
    let intrinsics = Intrinsics { fx: 74.4, fy: 74.4, cx: 32.0, cy: 32.0, pixel_center: 0.0 };
    let eye = camera::fixed24(model.metadata.orbit_radius.unwrap_or(1.3))[1];
    renderer.set_views(&[0], &[(eye, intrinsics)], 0)?;

    // One frame of the application: the renderer's passes, then whatever else draws with the texture.
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("object"),
        size: wgpu::Extent3d { width: SIDE, height: SIDE, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: wgpu::TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::COPY_SRC | wgpu::TextureUsages::TEXTURE_BINDING,
        view_formats: &[],
    });
    let read_back = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("read back"),
        size: u64::from(4 * SIDE * SIDE),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
    renderer.encode_to_texture(&mut encoder, &texture).expect("the engine is a GPU");
    let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * SIDE), rows_per_image: None };
    let to = wgpu::TexelCopyBufferInfo { buffer: &read_back, layout };
    encoder.copy_texture_to_buffer(texture.as_image_copy(), to, texture.size());
    queue.submit([encoder.finish()]);

    read_back.map_async(wgpu::MapMode::Read, .., |result| result.expect("the buffer can be mapped"));
    device.poll(wgpu::PollType::wait_indefinitely())?;
    let bytes = read_back.get_mapped_range(..)?;
    let dark = bytes.chunks(4).filter(|pixel| pixel[..3].iter().any(|&value| value < 191)).count();
    println!("{}: {dark} of {} pixels of the texture are not white", model.instance_name(0), SIDE * SIDE);
    Ok(())
}
