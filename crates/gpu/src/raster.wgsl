// Shaded triangles: colour = albedo · (ambient + diffuse · (1 + n·l) / 2), n the normal on the viewer's side, l towards a light
// that is fixed to the world, so that a surface point keeps its colour from view to view.
// vertex: one corner, world to clip space. fragment: one sample of one triangle.
// in: vertices, camera, albedo texture; out: RGBA, as displayed (gamma-encoded), OVERWRITES.

struct Camera {
    camera_from_world: mat4x4<f32>,
    centre: vec4<f32>,     // camera centre in the world; w unused
    scale_shift: vec4<f32>, // ndc = scale · (x, y) / z + shift
}

@group(0) @binding(0) var<uniform> camera: Camera;
@group(1) @binding(0) var albedo: texture_2d<f32>;
@group(1) @binding(1) var albedo_sampler: sampler;

struct Corner {
    @builtin(position) clip: vec4<f32>,
    @location(0) world: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) colour: vec3<f32>,
    @location(3) uv: vec2<f32>,
}

const NEAR: f32 = 0.01;
const LIGHT: vec3<f32> = vec3<f32>(0.2494, -0.5486, 0.7980); // unit; the brightness of axis-aligned faces is evenly spread
const AMBIENT: f32 = 0.4;
const DIFFUSE: f32 = 0.6;

@vertex
fn vertex(
    @location(0) position: vec3<f32>,
    @location(1) normal: vec3<f32>,
    @location(2) colour: vec3<f32>,
    @location(3) uv: vec2<f32>,
) -> Corner {
    let q = (camera.camera_from_world * vec4<f32>(position, 1.0)).xyz;
    let xy = camera.scale_shift.xy * q.xy + camera.scale_shift.zw * q.z;
    // Depth NEAR / z: the far plane is at infinity, the nearest is 1.
    return Corner(vec4<f32>(xy, NEAR, q.z), position, normal, colour, uv);
}

@fragment
fn fragment(in: Corner) -> @location(0) vec4<f32> {
    let texel = textureSample(albedo, albedo_sampler, in.uv);
    if texel.a < 0.5 {
        discard;
    }
    let towards_viewer = camera.centre.xyz - in.world;
    let n = normalize(select(-in.normal, in.normal, dot(in.normal, towards_viewer) >= 0.0));
    let shade = AMBIENT + DIFFUSE * 0.5 * (1.0 + dot(n, LIGHT));
    return vec4<f32>(texel.rgb * in.colour * shade, 1.0);
}
