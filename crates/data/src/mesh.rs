//! Triangles with colours and textures, ready to be drawn.

use crate::error::{At, Error, Result, read_bytes};
use crate::{ac3d, gltf, ldraw, obj, ply, stl, vrml};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use image::{DynamicImage, ImageDecoder, ImageReader, Limits, RgbaImage};
use image_extras::sgi::SgiDecoder;
use rand::{RngExt, SeedableRng};
use std::collections::HashMap;
use std::io::Cursor;
use std::ops::Range;
use std::path::Path;

/// How far [`Mesh::vary`] goes: logarithms of the factors along the axes, narrower or wider at the ends by this part, shifted to the front
/// or back by this part of the height, and the logarithm of the power of each colour.
const STRETCH: f32 = 0.25;
const TAPER: f32 = 0.2;
const LEAN: f32 = 0.1;
const BRIGHTNESS: f32 = 0.5;

/// A corner of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vertex {
    /// Position in object units.
    pub position: Vec3,
    /// Unit normal; either side of the surface.
    pub normal: Vec3,
    /// RGB in [0, 1], as displayed (gamma-encoded); multiplies the texture.
    pub colour: Vec3,
    /// Texture coordinates, `(0, 0)` at the top left of the picture, repeating.
    pub uv: Vec2,
}

/// Consecutive vertices drawn with one texture.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Vertices of the part, three to a triangle.
    pub vertices: Range<usize>,
    /// Index into [`Mesh::textures`].
    pub texture: Option<usize>,
}

/// A triangle soup: vertices `3i, 3i+1, 3i+2` are a triangle, in either winding.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// The corners.
    pub vertices: Vec<Vertex>,
    /// The vertices, divided by texture.
    pub parts: Vec<Part>,
    /// The textures.
    pub textures: Vec<RgbaImage>,
    /// What was left out of the file, one line each.
    pub warnings: Vec<String>,
    /// Triangles left out, for their corners are no numbers, or too large for any.
    not_finite: usize,
}

/// Which axis of a file points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Up {
    /// +y, usual in OBJ files.
    Y,
    /// +z.
    Z,
    /// −y, LDraw.
    MinusY,
}

impl From<Up> for Mat3 {
    /// The rotation from the file's axes to ours, which leaves x as it is.
    fn from(up: Up) -> Self {
        Mat3::from_cols_array(&match up {
            Up::Y => [1., 0., 0., 0., 0., 1., 0., -1., 0.],
            Up::MinusY => [1., 0., 0., 0., 0., -1., 0., 1., 0.],
            Up::Z => [1., 0., 0., 0., 1., 0., 0., 0., 1.],
        })
    }
}

/// Endings of the files that [`load`] reads, in lower case.
pub const ENDINGS: [&str; 9] = ["obj", "stl", "ply", "gltf", "glb", "ac", "acc", "wrl", "dat"];

/// Files in which a part can be placed many times may describe more triangles than fit into memory.
const MOST_TRIANGLES: usize = 1 << 23;

/// Reads a mesh of any format, in the file's own axes and units. Returns with it which axis usually points up in such files.
pub fn load(path: &Path) -> Result<(Mesh, Up)> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    Ok(match ending.as_str() {
        "dat" => (ldraw::Library::of_part(path)?.load(path, None)?, Up::MinusY),
        "ac" | "acc" => (ac3d::load(path)?, Up::Y),
        "obj" => (obj::load(path)?, Up::Y),
        "gltf" | "glb" => (gltf::load(path)?, Up::Y),
        "wrl" => (vrml::load(path)?, Up::Y),
        "stl" => (stl::load(path)?, Up::Z),
        "ply" => (ply::load(path)?, Up::Z),
        _ => return Err(Error::field(path, "ending", format!("one of .{}", ENDINGS.join(", .")), format!("\".{ending}\""))),
    })
}

impl Mesh {
    /// Adds a triangle with a flat normal to the last part. Degenerate triangles are dropped.
    pub(crate) fn push_flat(&mut self, corners: [Vec3; 3], colour: Vec3) {
        let across = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        self.not_finite += usize::from(!across.is_finite());
        let normal = across.normalize_or_zero();
        if normal != Vec3::ZERO {
            self.vertices.extend(corners.map(|position| Vertex { position, normal, colour, uv: Vec2::ZERO }));
        }
    }

    /// The mesh, if it has a triangle. Texture coordinates and colours that are no numbers become 0, as positions were seen to
    /// be numbers before.
    pub(crate) fn with_faces(mut self, path: &Path) -> Result<Self> {
        for vertex in &mut self.vertices {
            vertex.uv = if vertex.uv.is_finite() { vertex.uv } else { Vec2::ZERO };
            vertex.colour = if vertex.colour.is_finite() { vertex.colour } else { Vec3::ZERO };
        }
        if self.not_finite > 0 {
            self.warnings.push(format!("{} faces left out: corners that are no numbers, or too large", self.not_finite));
        }
        if self.vertices.is_empty() {
            let found = self.warnings.first().map_or("none".into(), |why| format!("none: {why}"));
            return Err(Error::field(path, "faces", "at least one", found));
        }
        Ok(self)
    }

    /// An error where the mesh has grown beyond all measure.
    pub(crate) fn check_size(&self, path: &Path) -> Result<()> {
        let expected = || format!("at most {MOST_TRIANGLES} triangles");
        if self.vertices.len() > 3 * MOST_TRIANGLES { Err(Error::field(path, "faces", expected(), "more")) } else { Ok(()) }
    }

    /// The corners of the bounding box.
    pub fn bounds(&self) -> [Vec3; 2] {
        let positions = || self.vertices.iter().map(|v| v.position);
        [positions().fold(Vec3::MAX, Vec3::min), positions().fold(Vec3::MIN, Vec3::max)]
    }

    /// Turns the mesh z-up, moves its bounding box to the origin and scales the box's diagonal to 1. `turn` is which axis of
    /// the file points up, or the whole rotation from the file's axes to ours.
    pub fn normalise(&mut self, turn: impl Into<Mat3>) {
        let turn = turn.into();
        let [low, high] = self.bounds();
        let scale = 1.0 / (high - low).length().max(f32::MIN_POSITIVE);
        let placed = Affine3A::from_mat3(turn * scale) * Affine3A::from_translation(-0.5 * (low + high));
        for vertex in &mut self.vertices {
            vertex.position = placed.transform_point3(vertex.position);
            vertex.normal = turn * vertex.normal;
        }
    }

    /// Another object of the kind: stretched, tapered and recoloured at random. For a mesh that was normalised, as it is afterwards. The
    /// seed decides everything.
    pub fn vary(&mut self, seed: u64) {
        let mut rng = rand_pcg::Pcg64::seed_from_u64(seed);
        let mut either_way = |most: f32| rng.random_range(-most..=most);
        let stretch = Vec3::from_array([(); 3].map(|()| either_way(STRETCH).exp()));
        let [taper, lean] = [TAPER, LEAN].map(&mut either_way);
        let height = self.bounds()[1].z.max(f32::MIN_POSITIVE);
        // Of the place `p`: its derivative turns normals too, as the inverse transposed.
        for vertex in &mut self.vertices {
            let Vec3 { x, y, z } = vertex.position;
            let wide = 1.0 + taper * z / height;
            vertex.position = stretch * Vec3::new(wide * x, wide * y + lean * z, z);
            let along_z = Vec3::new(taper * x / height, taper * y / height + lean, 1.0);
            let derivative = Mat3::from_cols(wide * Vec3::X, wide * Vec3::Y, along_z);
            vertex.normal =
                ((Mat3::from_diagonal(stretch) * derivative).inverse().transpose() * vertex.normal).normalize_or_zero();
        }
        self.normalise(Mat3::IDENTITY);
        // About the grey axis, then brighter or darker.
        let hue = Mat3::from_axis_angle(Vec3::ONE.normalize(), either_way(std::f32::consts::PI));
        let power = either_way(BRIGHTNESS).exp();
        let other = |colour: Vec3| (hue * colour).clamp(Vec3::ZERO, Vec3::ONE).powf(power);
        for part in self.parts.iter().filter(|part| part.texture.is_none()) {
            self.vertices[part.vertices.clone()].iter_mut().for_each(|vertex| vertex.colour = other(vertex.colour));
        }
        for pixel in self.textures.iter_mut().flat_map(|texture| texture.pixels_mut()) {
            let [r, g, b, a] = pixel.0;
            let [r, g, b] = (255.0 * other(Vec3::new(r.into(), g.into(), b.into()) / 255.0)).round().to_array().map(|x| x as u8);
            pixel.0 = [r, g, b, a];
        }
    }
}

/// Cuts a polygon into triangles, each three indices of corners. Polygons need not be convex, nor quite flat.
pub(crate) fn triangles_of(corners: &[Vec3]) -> Vec<[usize; 3]> {
    let mut left: Vec<usize> = (0..corners.len()).collect();
    let next = |i: usize| corners[(i + 1) % corners.len()];
    // Newell's: twice the area of what the polygon covers, along its normal.
    let normal: Vec3 = corners.iter().enumerate().map(|(i, &corner)| corner.cross(next(i))).sum();
    let turn = |[a, b, c]: [usize; 3]| (corners[b] - corners[a]).cross(corners[c] - corners[b]).dot(normal);
    let mut triangles = vec![];
    // Beyond this many corners the search for ears would take too long; no such polygon was found in any model.
    while left.len() > 3 && corners.len() <= 400 {
        let n = left.len();
        let around = |i: usize| [left[(i + n - 1) % n], left[i], left[(i + 1) % n]];
        let is_inside = |[a, b, c]: [usize; 3], p: usize| {
            ![a, b, c].contains(&p) && turn([a, b, p]) > 0.0 && turn([b, c, p]) > 0.0 && turn([c, a, p]) > 0.0
        };
        if (0..n).all(|i| turn(around(i)) >= 0.0) {
            break; // convex
        }
        let is_ear = |&i: &usize| turn(around(i)) > 0.0 && !left.iter().any(|&p| is_inside(around(i), p));
        // A polygon that crosses itself may have none.
        let Some(ear) = (0..n).find(is_ear) else { break };
        triangles.push(around(ear));
        left.remove(ear);
    }
    triangles.extend((2..left.len()).map(|i| [left[0], left[i - 1], left[i]]));
    triangles
}

/// The textures that a file names, each read once.
pub(crate) struct Textures<'a> {
    folder: &'a Path,
    found: HashMap<String, Option<usize>>,
}

impl<'a> Textures<'a> {
    /// Names are relative to the folder of this file.
    pub(crate) fn beside(file: &'a Path) -> Self {
        Self { folder: file.parent().unwrap_or(Path::new("")), found: HashMap::new() }
    }

    /// The index of a texture among those of the mesh. What cannot be read becomes a warning of the mesh.
    pub(crate) fn find(&mut self, mesh: &mut Mesh, name: &str) -> Option<usize> {
        if let Some(known) = self.found.get(name) {
            return *known;
        }
        let path = self.folder.join(name.replace('\\', "/"));
        // A path is often one of the author's machine.
        let beside = path.file_name().map(|file| self.folder.join(file)).filter(|beside| !path.exists() && beside.exists());
        let found = match read_picture(&beside.unwrap_or(path)) {
            Ok(picture) => {
                mesh.textures.push(picture);
                Some(mesh.textures.len() - 1)
            }
            Err(error) => {
                mesh.warnings.push(format!("texture {error}"));
                None
            }
        };
        self.found.insert(name.into(), found);
        found
    }
}

/// Reads a picture; its first bytes say which kind it is.
fn read_picture(path: &Path) -> Result<RgbaImage> {
    let bytes = read_bytes(path)?;
    let picture = if bytes.starts_with(&[0x01, 0xda]) {
        SgiDecoder::new(Cursor::new(bytes)).and_then(|mut decoder| {
            decoder.set_limits(Limits::default())?;
            DynamicImage::from_decoder(decoder)
        })
    } else {
        let mut reader = ImageReader::new(Cursor::new(bytes));
        reader.limits(Limits::default());
        reader.with_guessed_format().at(path)?.decode()
    };
    Ok(picture.at(path)?.into_rgba8())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polygons_are_cut_into_what_they_cover() {
        let area = |corners: &[Vec3], [a, b, c]: [usize; 3]| {
            (corners[b] - corners[a]).cross(corners[c] - corners[a]).dot(Vec3::new(1.0, 2.0, 2.0) / 3.0) / 2.0
        };
        // In a tilted plane: two axes that are perpendicular, of length 1.
        let place = |[x, y]: [f32; 2]| x * Vec3::new(2.0, 1.0, -2.0) / 3.0 + y * Vec3::new(-2.0, 2.0, -1.0) / 3.0;
        let arrow = [[0.0, 0.0], [4.0, -3.0], [1.0, 0.0], [4.0, 3.0]];
        let square = [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]];
        let arch = [[0.0, 0.0], [1.0, 0.0], [1.0, 3.0], [2.0, 3.0], [2.0, 0.0], [3.0, 0.0], [3.0, 4.0], [0.0, 4.0]];
        for (shape, expected) in [(&arrow[..], 3.0), (&square, 4.0), (&arch, 9.0), (&square[..3], 2.0)] {
            for shift in 0..shape.len() {
                let mut corners: Vec<_> = shape.iter().copied().map(place).collect();
                corners.rotate_left(shift);
                for winding in [1.0, -1.0] {
                    let triangles = triangles_of(&corners);
                    let areas: Vec<f32> = triangles.iter().map(|&t| winding * area(&corners, t)).collect();
                    assert_eq!(triangles.len(), corners.len() - 2);
                    assert!(areas.iter().all(|&area| area > 0.0), "{shape:?} {shift}: {areas:?}");
                    assert!((areas.iter().sum::<f32>() - expected).abs() < 1e-5, "{shape:?} {shift}: {areas:?}");
                    corners.reverse();
                }
            }
        }
        assert_eq!((triangles_of(&[]), triangles_of(&[Vec3::ONE; 2])), (vec![], vec![]));
        assert_eq!(triangles_of(&[Vec3::NAN; 5]).len(), 3);
    }

    #[test]
    fn pictures_are_known_by_their_first_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("picture.png");
        // SGI, one byte a channel, not compressed, 2×1 pixels, three channels, one after the other.
        let mut sgi = vec![0; 512];
        for (at, value) in [(0, 0x01), (1, 0xda), (3, 1), (5, 3), (7, 2), (9, 1), (11, 3), (19, 255)] {
            sgi[at] = value;
        }
        sgi.extend([1, 4, 2, 5, 3, 6]);
        std::fs::write(&path, &sgi).unwrap();
        assert_eq!(read_picture(&path).unwrap().as_raw(), &[1, 2, 3, 255, 4, 5, 6, 255]);
        for (bytes, word) in [(&sgi[..513], "picture.png"), (&sgi[..2], "picture.png"), (b"", "format")] {
            std::fs::write(&path, bytes).unwrap();
            let error = read_picture(&path).unwrap_err().to_string();
            assert!(error.contains("picture.png") && error.contains(word) && !error.contains('\n'), "{error}");
        }
        // 65535 × 65535 pixels in 518 bytes are refused before they take memory.
        sgi[6..10].fill(255);
        std::fs::write(&path, &sgi).unwrap();
        let error = read_picture(&path).unwrap_err().to_string();
        assert!(error.contains("picture.png") && error.to_lowercase().contains("memory"), "{error}");
    }

    #[test]
    fn normalise_centres_scales_and_turns() {
        for (up, top) in [(Up::Y, Vec3::Y), (Up::Z, Vec3::Z), (Up::MinusY, -Vec3::Y)] {
            let mut mesh = Mesh::default();
            let shift = Vec3::new(5.0, -2.0, 1.0);
            mesh.push_flat([shift, shift + 2.0 * Vec3::X, shift + 3.0 * top], Vec3::ONE);
            mesh.normalise(up);
            let [low, high] = mesh.bounds();
            assert!((low + high).length() < 1e-6 && ((high - low).length() - 1.0).abs() < 1e-6);
            let apex = mesh.vertices[2];
            assert!((apex.position.z - 1.5 / 13f32.sqrt()).abs() < 1e-6, "{up:?}: {apex:?}");
            // The turn is a rotation: flat normals keep agreeing with the winding.
            let [a, b, c] = [0, 1, 2].map(|i| mesh.vertices[i].position);
            assert!((b - a).cross(c - a).normalize().dot(apex.normal) > 0.999_99);
        }
    }

    #[test]
    fn a_varied_mesh_is_another_of_its_kind() {
        let mut mesh = Mesh::default();
        for side in [-1.0, 1.0] {
            mesh.push_flat([side * Vec3::ONE, side * Vec3::new(1.0, 1.0, -1.0), side * Vec3::new(1.0, -1.0, 1.0)], Vec3::X);
        }
        // So small that it stays flat.
        let corner = Vec3::new(0.3, -0.4, 0.5);
        mesh.push_flat([corner, corner + 1e-2 * Vec3::X, corner + 1e-2 * Vec3::new(0.2, 0.6, 0.7)], Vec3::new(0.9, 0.8, 0.1));
        mesh.parts = vec![Part { vertices: 0..6, texture: Some(0) }, Part { vertices: 6..9, texture: None }];
        mesh.textures = vec![RgbaImage::from_pixel(1, 1, image::Rgba([200, 40, 90, 7]))];
        mesh.normalise(Mat3::IDENTITY);
        let varied = |seed| {
            let mut varied = mesh.clone();
            varied.vary(seed);
            varied
        };
        assert_eq!(varied(1).vertices, varied(1).vertices);
        for seed in 0..20 {
            let other = varied(seed);
            let [low, high] = other.bounds();
            assert!((low + high).length() < 1e-6 && ((high - low).length() - 1.0).abs() < 1e-6);
            let box_of = |mesh: &Mesh| mesh.bounds()[1] / mesh.bounds()[1].z;
            assert!((box_of(&other) - box_of(&mesh)).length() > 1e-3, "{seed}: {low} {high}");
            let [a, b, c] = [6, 7, 8].map(|i| other.vertices[i].position);
            let normal = other.vertices[6].normal;
            assert!((b - a).cross(c - a).normalize().dot(normal) > 0.999, "{seed}: {normal}");
            // The texture colours its part, else the vertices do.
            assert_eq!(other.vertices[0].colour, Vec3::X);
            let colour = other.vertices[6].colour;
            assert!(colour != mesh.vertices[6].colour && colour.min_element() >= 0.0 && colour.max_element() <= 1.0, "{colour}");
            let pixel = other.textures[0].get_pixel(0, 0);
            assert!(pixel != mesh.textures[0].get_pixel(0, 0) && pixel[3] == 7, "{pixel:?}");
        }
    }
}
