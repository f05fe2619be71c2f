//! glTF meshes, text and binary (`.gltf`, `.glb`): base colours and base colour textures, nodes in their places.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part};
use glam::{DVec2, DVec3, Mat3, Mat4, Vec3};
use gltf::accessor::DataType;
use gltf::image::Format;
use gltf::mesh::Semantic;
use image::{DynamicImage, RgbaImage};
use std::collections::HashMap;
use std::path::Path;

/// Scenes do not nest deeper than this; a file that does is one whose nodes contain themselves.
const DEEPEST: usize = 64;

/// What a walk over the nodes needs.
struct Reader<'a> {
    path: &'a Path,
    buffers: Vec<gltf::buffer::Data>,
    mesh: Mesh,
    /// Nodes that were drawn: each stands in one place only.
    nodes: usize,
    /// By number of the image; `None` where it cannot be read.
    textures: HashMap<usize, Option<usize>>,
}

/// Reads the default scene of a file, or else all its nodes. What is no triangle, and textures that cannot be read, are left out
/// and named in [`Mesh::warnings`]; a file without any triangle is an error.
pub fn load(path: &Path) -> Result<Mesh> {
    let refused = |error: gltf::Error| Error::field(path, "glTF", "a glTF 2.0 file", error.to_string().replace('\n', " "));
    let bytes = read_bytes(path)?;
    check_attributes(path, &bytes)?;
    let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&bytes).map_err(refused)?;
    let buffers = gltf::import_buffers(&document, path.parent(), blob).map_err(refused)?;
    let mut reader = Reader { path, buffers, mesh: Mesh::default(), nodes: 0, textures: HashMap::new() };
    let scene = document.default_scene().or_else(|| document.scenes().next());
    let all = document.nodes().count();
    match scene {
        Some(scene) => scene.nodes().try_for_each(|node| reader.node(&node, Mat4::IDENTITY, 0, all))?,
        None => document.nodes().try_for_each(|node| reader.node(&node, Mat4::IDENTITY, DEEPEST, all))?,
    }
    reader.mesh.with_faces(path)
}

/// The crate's own checks take for granted that attributes exist.
fn check_attributes(path: &Path, bytes: &[u8]) -> Result<()> {
    let json = gltf::Glb::from_slice(bytes).map_or(bytes.into(), |glb| glb.json);
    // What is no JSON is told better by the crate.
    let Ok(root) = gltf::json::Root::from_slice(&json) else { return Ok(()) };
    let attributes = root.meshes.iter().flat_map(|mesh| &mesh.primitives).flat_map(|primitive| primitive.attributes.values());
    match attributes.map(|index| index.value()).find(|&index| index >= root.accessors.len()) {
        Some(index) => Err(Error::field(path, "attributes", format!("one of {} accessors", root.accessors.len()), index)),
        None => Ok(()),
    }
}

impl Reader<'_> {
    fn node(&mut self, node: &gltf::Node, parent: Mat4, depth: usize, all: usize) -> Result<()> {
        self.nodes += 1;
        if self.nodes > all {
            return Err(Error::field(self.path, "nodes", format!("each of {all} in one place"), "one in several"));
        }
        let placed = parent * Mat4::from_cols_array_2d(&node.transform().matrix());
        for primitive in node.mesh().iter().flat_map(|mesh| mesh.primitives()) {
            self.primitive(&primitive, placed);
            self.mesh.check_size(self.path)?;
        }
        // Without scenes the nodes stand side by side already.
        if depth < DEEPEST {
            node.children().try_for_each(|child| self.node(&child, placed, depth + 1, all))?;
        } else if depth > DEEPEST {
            return Err(Error::field(self.path, "nodes", format!("at most {DEEPEST} inside each other"), depth));
        }
        Ok(())
    }

    fn primitive(&mut self, primitive: &gltf::Primitive, placed: Mat4) {
        if primitive.mode() != gltf::mesh::Mode::Triangles {
            return self.mesh.warnings.push(format!("left out: {:?}, only triangles are drawn", primitive.mode()));
        }
        let material = primitive.material();
        let surface = material.pbr_metallic_roughness();
        let texture = surface.base_color_texture().and_then(|info| self.texture(&info.texture().source()));
        let set = surface.base_color_texture().map_or(0, |info| info.tex_coord());
        // Factors are linear, our colours as displayed.
        let [r, g, b, _] = surface.base_color_factor();
        let factor = Vec3::new(r, g, b).map(|c| c.clamp(0.0, 1.0).powf(1.0 / 2.2));
        let mut read = |semantic: Semantic| -> Vec<[f64; 4]> {
            let values = primitive.get(&semantic).map(|accessor| values(&accessor, &self.buffers));
            let refused = |error| self.mesh.warnings.push(format!("{semantic:?}: {error}"));
            values.transpose().map_err(refused).ok().flatten().unwrap_or_default()
        };
        let vector = |[x, y, z, _]: [f64; 4]| DVec3::new(x, y, z).as_vec3();
        let positions: Vec<_> = read(Semantic::Positions).into_iter().map(vector).collect();
        let normals: Vec<_> = read(Semantic::Normals).into_iter().map(vector).collect();
        let uvs: Vec<_> = read(Semantic::TexCoords(set)).into_iter().map(|[u, v, ..]| DVec2::new(u, v).as_vec2()).collect();
        let colours: Vec<_> = read(Semantic::Colors(0)).into_iter().map(vector).collect();
        let indices: Vec<usize> = match primitive.indices().map(|accessor| values(&accessor, &self.buffers)) {
            None => (0..positions.len()).collect(),
            Some(Ok(indices)) => indices.into_iter().map(|[i, ..]| i as usize).collect(),
            Some(Err(error)) => return self.mesh.warnings.push(format!("left out, indices: {error}")),
        };
        let turn = Mat3::from_mat4(placed).inverse().transpose();
        let start = self.mesh.vertices.len();
        let mut left_out = 0;
        for corners in indices.chunks_exact(3) {
            let Some(found) = corners.iter().map(|&i| positions.get(i).copied()).collect::<Option<Vec<_>>>() else {
                left_out += 1;
                continue;
            };
            let before = self.mesh.vertices.len();
            self.mesh.push_flat([0, 1, 2].map(|k| placed.transform_point3(found[k])), factor);
            for (vertex, &i) in self.mesh.vertices[before..].iter_mut().zip(corners) {
                let normal = normals.get(i).and_then(|&normal| (turn * normal).try_normalize());
                vertex.normal = normal.unwrap_or(vertex.normal);
                vertex.uv = uvs.get(i).copied().unwrap_or_default();
                vertex.colour *= colours.get(i).map_or(Vec3::ONE, |c| c.map(|c| c.clamp(0.0, 1.0).powf(1.0 / 2.2)));
            }
        }
        if left_out > 0 {
            self.mesh.warnings.push(format!("{left_out} faces left out: indices out of range"));
        }
        self.mesh.parts.push(Part { vertices: start..self.mesh.vertices.len(), texture });
    }

    fn texture(&mut self, picture: &gltf::Image) -> Option<usize> {
        if let Some(known) = self.textures.get(&picture.index()) {
            return *known;
        }
        let read = gltf::image::Data::from_source(picture.source(), self.path.parent(), &self.buffers)
            .map_err(|error| error.to_string())
            .and_then(|data| rgba(data).ok_or_else(|| "an unusual kind of pixels".into()));
        let found = match read {
            Ok(picture) => {
                self.mesh.textures.push(picture);
                Some(self.mesh.textures.len() - 1)
            }
            Err(error) => {
                self.mesh.warnings.push(format!("image {}: {error}", picture.index()));
                None
            }
        };
        self.textures.insert(picture.index(), found);
        found
    }
}

/// The numbers of an accessor, up to four in each, the missing ones 0. The crate's own iterators trust the file's strides and
/// counts; these do not.
fn values(accessor: &gltf::Accessor, buffers: &[gltf::buffer::Data]) -> std::result::Result<Vec<[f64; 4]>, String> {
    let (kind, wide) = (accessor.data_type(), accessor.dimensions().multiplicity());
    let (size, Some(view)) = (kind.size(), accessor.view()) else { return Err("no numbers".into()) };
    if accessor.sparse().is_some() || wide > 4 {
        return Err("sparse numbers and matrices are not read".into());
    }
    let bytes = buffers.get(view.buffer().index()).and_then(|buffer| buffer.get(view.offset()..)?.get(..view.length()));
    let rows = bytes.and_then(|bytes| bytes.get(accessor.offset()..)).ok_or("outside of the buffer")?;
    let stride = view.stride().unwrap_or(wide * size);
    let count = accessor.count();
    let whole = stride >= wide * size && count.checked_mul(stride).is_some_and(|all| all <= rows.len() + stride - wide * size);
    if !whole {
        return Err(format!("{count} times {stride} bytes, but there are {}", rows.len()));
    }
    // Whole numbers may stand for fractions.
    let fraction = |value: f64, most: f64| if accessor.normalized() { (value / most).max(-1.0) } else { value };
    let number = |bytes: &[u8]| match (kind, bytes) {
        (DataType::I8, &[a]) => fraction(f64::from(a as i8), 127.0),
        (DataType::U8, &[a]) => fraction(f64::from(a), 255.0),
        (DataType::I16, &[a, b]) => fraction(f64::from(i16::from_le_bytes([a, b])), 32767.0),
        (DataType::U16, &[a, b]) => fraction(f64::from(u16::from_le_bytes([a, b])), 65535.0),
        (DataType::U32, &[a, b, c, d]) => f64::from(u32::from_le_bytes([a, b, c, d])),
        (DataType::F32, &[a, b, c, d]) => f64::from(f32::from_le_bytes([a, b, c, d])),
        _ => f64::NAN,
    };
    let row = |i: usize| {
        let mut row = [0.0; 4];
        row.iter_mut().zip(rows[i * stride..].chunks_exact(size)).take(wide).for_each(|(value, bytes)| *value = number(bytes));
        row
    };
    Ok((0..count).map(row).collect())
}

fn rgba(data: gltf::image::Data) -> Option<RgbaImage> {
    let gltf::image::Data { pixels, format, width, height } = data;
    let picture = match format {
        Format::R8 => DynamicImage::ImageLuma8(image::ImageBuffer::from_raw(width, height, pixels)?),
        Format::R8G8 => DynamicImage::ImageLumaA8(image::ImageBuffer::from_raw(width, height, pixels)?),
        Format::R8G8B8 => DynamicImage::ImageRgb8(image::ImageBuffer::from_raw(width, height, pixels)?),
        Format::R8G8B8A8 => DynamicImage::ImageRgba8(image::ImageBuffer::from_raw(width, height, pixels)?),
        _ => return None,
    };
    Some(picture.into_rgba8())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A triangle, its node moved by (0, 0, 3), red; in binary form.
    pub(crate) fn triangle(extra: &str) -> Vec<u8> {
        let positions = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]].concat();
        let mut blob: Vec<u8> = positions.iter().flat_map(|x| x.to_le_bytes()).collect();
        blob.extend([0u16, 1, 2, 0].iter().flat_map(|i| i.to_le_bytes()));
        let mut json = format!(
            r#"{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}],
            "nodes": [{{"translation": [0, 0, 3], "children": [1]}}, {{"mesh": 0}}],
            "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0}}, "indices": 1, "material": 0}}]}}],
            "materials": [{{"pbrMetallicRoughness": {{"baseColorFactor": [1, 0, 0.2158605, 1]{extra}}}}}],
            "accessors": [{{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 2, 0]}},
                          {{"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}}],
            "bufferViews": [{{"buffer": 0, "byteLength": 36}}, {{"buffer": 0, "byteOffset": 36, "byteLength": 6}}],
            "buffers": [{{"byteLength": 44}}]}}"#
        );
        json += &" ".repeat((4 - json.len() % 4) % 4);
        let word = |n: usize| (n as u32).to_le_bytes();
        let chunk = |kind: &[u8; 4], bytes: &[u8]| [&word(bytes.len())[..], kind, bytes].concat();
        let chunks = [chunk(b"JSON", json.as_bytes()), chunk(b"BIN\0", &blob)].concat();
        [b"glTF", &word(2)[..], &word(12 + chunks.len()), &chunks].concat()
    }

    #[test]
    fn nodes_indices_and_colours() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mesh.glb");
        std::fs::write(&path, triangle("")).unwrap();
        let mesh = load(&path).unwrap();
        let positions: Vec<_> = mesh.vertices.iter().map(|v| v.position.to_array()).collect();
        assert_eq!(positions, [[0.0, 0.0, 3.0], [1.0, 0.0, 3.0], [0.0, 2.0, 3.0]]);
        let vertex = mesh.vertices[0];
        assert!(vertex.normal == Vec3::Z && vertex.colour.abs_diff_eq(Vec3::new(1.0, 0.0, 0.498), 2e-3), "{vertex:?}");

        for (bytes, word) in [(&b"glTF"[..], "glTF"), (b"{}", "glTF"), (&triangle("")[..500], "glTF"), (b"", "glTF")] {
            std::fs::write(&path, bytes).unwrap();
            let error = load(&path).unwrap_err().to_string();
            assert!(error.contains("mesh.glb") && error.contains(word) && !error.contains('\n'), "{error}");
        }
        // A node that holds itself, and one in two places: sixty such would be 2^60.
        let holds = br#"3], "children": [1]"#;
        for other in [br#"3], "children": [0]"#, br#"3],"children":[1,1]"#] {
            let mut bytes = triangle("");
            let at = bytes.windows(holds.len()).position(|window| window == holds).unwrap();
            bytes[at..at + holds.len()].copy_from_slice(other);
            std::fs::write(&path, &bytes).unwrap();
            let error = load(&path).unwrap_err().to_string();
            assert!(error.contains("nodes: expected each of 2 in one place"), "{error}");
        }
    }
}
