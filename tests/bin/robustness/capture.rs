//! Photographs from a walk around an object on a table in a room, with their cameras and with true masks, and what `sigma-data masks` makes of them.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::time::Instant;
use std::{fs, io};

use glam::{DMat4, DQuat, DVec3, Mat3, Quat, Vec2, Vec3};
use image::{GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use serde_json::json;
use srn_data::camera;
use srn_data::mesh::{self, Mesh, Part, Vertex};
use srn_gpu::raster::{Part as RasterPart, Rasterizer, Texture, Vertex as RasterVertex, View};

use crate::{LDRAW, OBJECTS, OUT, Programs, Result, mean, median, said};

/// Photographs of each walk, their width and height, and how far across they see, in degrees.
const VIEWS: usize = 48;
const SIDE: u32 = 512;
const ACROSS: f64 = 50.0;
/// The two rounds of a walk stand so high above the horizon, in degrees; cameras are so far away, in diagonals of the object.
const HEIGHTS: [f64; 2] = [18.0, 48.0];
const DISTANCE: f64 = 1.6;
/// Other things on the table.
const OTHERS: usize = 6;
/// Deviation of the noise of each pixel.
const NOISE: f64 = 3.0;
const TEXTURE: u32 = 1024;
/// Fewer pixels of an object are nothing to cut out: others stand before it.
const HARDLY: usize = 500;

/// Photographs of one object: `transforms.json`, `images/`, and `truth/` with true masks.
pub struct Capture {
    name: &'static str,
    folder: PathBuf,
}

/// Has masks made, and says how much of what is the mask's or the truth's is both, of each photograph; a line of a table.
pub fn masked(programs: &Programs, capture: &Capture) -> Result<String> {
    let Capture { name, ref folder } = *capture;
    let (out, begin) = (folder.join("masks"), Instant::now());
    let mut masks = programs.command("sigma-data");
    let output = masks.arg("masks").arg(folder).args(["--convention", "opencv", "--force", "--out"]).arg(&out).output()?;
    if !output.status.success() {
        return Err(said(&output));
    }
    let seconds = begin.elapsed().as_secs_f64();
    let (mut shares, mut hidden) = (vec![], 0);
    for view in 0..VIEWS {
        let truth = image::open(folder.join(format!("truth/{view:03}.png")))?.to_luma8();
        let path = out.join(format!("{view:03}.png.png"));
        let made = if path.exists() { image::open(path)?.to_luma8() } else { GrayImage::new(SIDE, SIDE) };
        let count = |both: fn(bool, bool) -> bool| {
            truth.iter().zip(made.iter()).filter(|(truth, made)| both(**truth > 127, **made > 127)).count() as f64
        };
        let all = count(|truth, made| truth || made);
        if truth.iter().filter(|truth| **truth > 127).count() < HARDLY {
            hidden += 1;
        } else {
            shares.push(count(|truth, made| truth && made) / all);
        }
    }
    shares.sort_by(f64::total_cmp);
    Ok(format!(
        "| {name} | {} | {:.3} / {:.3} / {:.3} | {} | {seconds:.0} s |",
        VIEWS - hidden,
        mean(&shares),
        median(&shares),
        shares[0],
        shares.iter().filter(|share| **share < 0.9).count(),
    ))
}

/// Photographs all objects.
pub fn taken(random: &mut Pcg64Mcg) -> Result<Vec<Capture>> {
    let gpu = srn_gpu::Gpu::open(None)?;
    let rasterizer = Rasterizer::new(&gpu)?;
    let load = |(_, file): (&str, &str)| -> Result<Mesh> {
        let path = if file.ends_with(".dat") { format!("{LDRAW}/{file}") } else { file.into() };
        let (mut mesh, up) = mesh::load(Path::new(&path))?;
        mesh.normalise(up);
        Ok(mesh)
    };
    let meshes = OBJECTS.into_iter().map(load).collect::<Result<Vec<_>>>()?;
    (0..OBJECTS.len()).map(|object| walk(&rasterizer, &meshes, object, random)).collect()
}

fn walk(rasterizer: &Rasterizer, meshes: &[Mesh], object: usize, random: &mut Pcg64Mcg) -> Result<Capture> {
    let name = OBJECTS[object].0;
    let folder = Path::new(OUT).join("captures").join(name);
    match fs::remove_dir_all(&folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
        _ => {}
    }
    for kind in ["images", "truth"] {
        fs::create_dir_all(folder.join(kind))?;
    }
    let own = &meshes[object];
    let floor = own.bounds()[0].z;
    let mut scene = own.clone();
    let count = scene.vertices.len();
    add(&mut scene, &table(floor, own, object, random), Mat3::IDENTITY, Vec3::ZERO);
    for k in 0..OTHERS {
        let other = &meshes[(object + random.random_range(1..meshes.len())) % meshes.len()];
        let angle = TAU as f32 * (k as f32 + random.random_range(0.0..0.6)) / OTHERS as f32;
        let (size, far) = (random.random_range(0.5..1.1), random.random_range(1.1..1.9));
        let turn = Mat3::from_quat(Quat::from_rotation_z(random.random_range(0.0..TAU as f32))) * size;
        let at = Vec3::new(far * angle.cos(), far * angle.sin(), floor - size * other.bounds()[0].z);
        add(&mut scene, other, turn, at);
    }
    // What is the object is black, all else white.
    let mut truth = scene.clone();
    truth.parts.iter_mut().for_each(|part| part.texture = None);
    for (i, vertex) in truth.vertices.iter_mut().enumerate() {
        vertex.colour = if i < count { Vec3::ZERO } else { Vec3::splat(4.0) };
    }
    let [scene, truth] = [&scene, &truth].map(|mesh| uploaded(rasterizer, mesh));
    let (scene, truth) = (scene?, truth?);
    let focal = 0.5 * f64::from(SIDE) / (0.5 * ACROSS.to_radians()).tan();
    let middle = 0.5 * f64::from(SIDE) - 0.5;
    let mut frames = vec![];
    for view in 0..VIEWS {
        let round = view * HEIGHTS.len() / VIEWS;
        let angle = TAU * (view as f64 + random.random_range(-0.3..0.3)) * HEIGHTS.len() as f64 / VIEWS as f64;
        let height = (HEIGHTS[round] + random.random_range(-5.0..5.0)).to_radians();
        let far = DISTANCE * random.random_range(0.9..1.15);
        let aim = DVec3::from_array([(); 3].map(|()| random.random_range(-0.08..0.08)));
        let eye = far * DVec3::new(angle.cos() * height.cos(), angle.sin() * height.cos(), height.sin());
        let roll = DMat4::from_quat(DQuat::from_rotation_z(random.random_range(-0.09..0.09)));
        let pose = DMat4::from_translation(aim) * camera::look_at_origin(eye) * roll;
        let seen =
            View { world_from_camera: pose.transpose().to_cols_array(), intrinsics: [focal, focal, middle, middle], side: SIDE };
        let mut picture = RgbImage::from_raw(SIDE, SIDE, rasterizer.render(&scene, &seen)?).ok_or("no picture")?;
        for value in picture.iter_mut() {
            let (u, v): (f64, f64) = (1.0 - random.random::<f64>(), random.random());
            let noise = NOISE * (-2.0 * u.ln()).sqrt() * (TAU * v).cos();
            *value = (f64::from(*value) + noise).round().clamp(0.0, 255.0) as u8;
        }
        let mask = RgbImage::from_raw(SIDE, SIDE, rasterizer.render(&truth, &seen)?).ok_or("no picture")?;
        let mask = GrayImage::from_fn(SIDE, SIDE, |x, y| Luma([255 * u8::from(mask.get_pixel(x, y)[0] < 128)]));
        picture.save(folder.join(format!("images/{view:03}.png")))?;
        mask.save(folder.join(format!("truth/{view:03}.png")))?;
        frames.push(json!({
            "file_path": format!("images/{view:03}.png"),
            "transform_matrix": pose.transpose().to_cols_array_2d(),
        }));
    }
    let size = f64::from(SIDE);
    let transforms = json!({
        "camera_model": "OPENCV", "w": SIDE, "h": SIDE, "fl_x": focal, "fl_y": focal, "cx": 0.5 * size, "cy": 0.5 * size, "frames": frames,
    });
    fs::write(folder.join("transforms.json"), serde_json::to_string_pretty(&transforms)?)?;
    Ok(Capture { name, folder })
}

/// Adds a mesh, turned, scaled and moved.
fn add(scene: &mut Mesh, other: &Mesh, turn: Mat3, at: Vec3) {
    let (vertices, textures) = (scene.vertices.len(), scene.textures.len());
    let placed = |vertex: &Vertex| Vertex {
        position: turn * vertex.position + at,
        normal: (turn * vertex.normal).normalize_or_zero(),
        ..*vertex
    };
    scene.vertices.extend(other.vertices.iter().map(placed));
    scene.textures.extend(other.textures.iter().cloned());
    let moved = |part: &Part| Part {
        vertices: part.vertices.start + vertices..part.vertices.end + vertices,
        texture: part.texture.map(|texture| texture + textures),
    };
    scene.parts.extend(other.parts.iter().map(moved));
}

/// A table with the object's shadow, and walls behind.
fn table(floor: f32, own: &Mesh, kind: usize, random: &mut Pcg64Mcg) -> Mesh {
    const HALF: f32 = 2.2;
    const WALL: f32 = 5.0;
    let [low, high] = own.bounds();
    let foot = 0.5 * (high - low).truncate();
    let shadow = |at: Vec2| {
        let off = (at / (foot * 1.25)).length();
        1.0 - 0.55 * (-(off * off * off * off)).exp()
    };
    let mut mesh = Mesh::default();
    let cloth = pattern(kind, random);
    let lit = RgbaImage::from_fn(TEXTURE, TEXTURE, |x, y| {
        let at = Vec2::new(x as f32, y as f32) / TEXTURE as f32 * 2.0 * HALF - HALF;
        let Rgb(colour) = *cloth.get_pixel(x, y);
        let [r, g, b] = colour.map(|c| (f32::from(c) * shadow(at)) as u8);
        Rgba([r, g, b, 255])
    });
    let walls = pattern(kind + 1, random);
    let walls = RgbaImage::from_fn(TEXTURE, TEXTURE, |x, y| {
        let Rgb([r, g, b]) = *walls.get_pixel(x, y);
        Rgba([r, g, b, 255])
    });
    mesh.textures = vec![lit, walls];
    let mut quad = |corners: [Vec3; 4], texture: usize| {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        let uvs = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]].map(Vec2::from);
        let first = mesh.vertices.len();
        for k in [0, 1, 2, 0, 2, 3] {
            mesh.vertices.push(Vertex { position: corners[k], normal, colour: Vec3::ONE, uv: uvs[k] });
        }
        mesh.parts.push(Part { vertices: first..first + 6, texture: Some(texture) });
    };
    quad([[-HALF, -HALF], [HALF, -HALF], [HALF, HALF], [-HALF, HALF]].map(|[x, y]| Vec3::new(x, y, floor)), 0);
    let corner = |k: usize| [[-WALL, -WALL], [WALL, -WALL], [WALL, WALL], [-WALL, WALL]][k % 4];
    for k in 0..4 {
        let [[ax, ay], [bx, by]] = [corner(k), corner(k + 1)];
        quad([Vec3::new(ax, ay, -3.0), Vec3::new(bx, by, -3.0), Vec3::new(bx, by, 4.0), Vec3::new(ax, ay, 4.0)], 1);
    }
    let ground = floor - 1.5;
    quad([[-WALL, -WALL], [WALL, -WALL], [WALL, WALL], [-WALL, WALL]].map(|[x, y]| Vec3::new(x, y, ground)), 1);
    mesh
}

/// Cloth, newspaper, a board of squares.
fn pattern(kind: usize, random: &mut Pcg64Mcg) -> RgbImage {
    let base: [f64; 3] = [(); 3].map(|()| random.random_range(60.0..210.0));
    let mut noise = |cells: u32| {
        let coarse = RgbImage::from_fn(cells, cells, |_, _| Rgb([(); 3].map(|()| random.random())));
        image::imageops::resize(&coarse, TEXTURE, TEXTURE, image::imageops::FilterType::CatmullRom)
    };
    let (smooth, fine, lines) = (noise(12), noise(200), noise(60));
    RgbImage::from_fn(TEXTURE, TEXTURE, |x, y| {
        let of = |noise: &RgbImage, c: usize| (f64::from(noise.get_pixel(x, y)[c]) - 128.0) / 128.0;
        let colour = |c: usize| match kind % 3 {
            0 => base[c] + 35.0 * of(&smooth, 0) + 12.0 * of(&fine, c),
            1 => {
                let is_ink = of(&lines, 0) > 0.0 && (y / 6).is_multiple_of(2) && of(&fine, 1) > -0.3;
                if is_ink { 60.0 } else { 215.0 + 20.0 * of(&smooth, c) }
            }
            _ => (if (x / 32 + y / 32).is_multiple_of(2) { 30.0 } else { 225.0 }) + 8.0 * of(&fine, 0),
        };
        Rgb([0, 1, 2].map(|c| colour(c).clamp(0.0, 255.0) as u8))
    })
}

fn uploaded(rasterizer: &Rasterizer, mesh: &Mesh) -> Result<srn_gpu::raster::Model> {
    let vertex = |v: &Vertex| RasterVertex {
        position: v.position.to_array(),
        normal: v.normal.to_array(),
        colour: v.colour.to_array(),
        uv: v.uv.to_array(),
    };
    let vertices: Vec<_> = mesh.vertices.iter().map(vertex).collect();
    let part = |part: &Part| -> RasterPart { (part.vertices.start as u32..part.vertices.end as u32, part.texture) };
    let textures: Vec<_> =
        mesh.textures.iter().map(|t| Texture { width: t.width(), height: t.height(), rgba: t.as_raw() }).collect();
    Ok(rasterizer.upload(&vertices, &mesh.parts.iter().map(part).collect::<Vec<_>>(), &textures)?)
}
