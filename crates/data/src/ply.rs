//! PLY meshes, text and binary, with colours or a texture at the vertices, as BOP's models have them.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part, Textures, triangles_of};
use glam::{Vec2, Vec3};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};
use std::path::Path;

/// Reads a PLY file. Faces may have any number of corners; those whose indices are out of range are left out and counted in
/// [`Mesh::warnings`]. A file without any face, a cloud of points for one, is an error.
pub fn load(path: &Path) -> Result<Mesh> {
    let bytes = read_bytes(path)?;
    let refused =
        |error: ply_rs_bw::parser::ParseError| Error::field(path, "PLY", "a PLY file", error.to_string().replace('\n', " "));
    let parser = Parser::<DefaultElement>::new();
    let header = parser.read_ply_header(&mut &bytes[..]).map_err(refused)?;
    // Every vertex and every face takes bytes; a header that promises more would only fill the memory.
    if let Some((name, element)) = header.elements.iter().find(|(_, element)| element.count > bytes.len()) {
        return Err(Error::field(path, format!("element {name}"), format!("at most {}", bytes.len()), element.count));
    }
    let ply = parser.read_ply(&mut &bytes[..]).map_err(refused)?;
    let (none, mut mesh) = (vec![], Mesh::default());
    let elements = |name: &str| ply.payload.get(name).unwrap_or(&none);
    let vertices = elements("vertex");
    let number = |vertex: &DefaultElement, name: &str| vertex.get(name).and_then(Property::to_f32_lossy);
    let vector = |vertex: &DefaultElement, names: [&str; 3]| {
        Some(Vec3::new(number(vertex, names[0])?, number(vertex, names[1])?, number(vertex, names[2])?))
    };
    let uv = |vertex: &DefaultElement| {
        let named = |u: &str, v: &str| Some(Vec2::new(number(vertex, u)?, 1.0 - number(vertex, v)?));
        named("texture_u", "texture_v").or_else(|| named("s", "t")).or_else(|| named("u", "v"))
    };
    let colour = |vertex: &DefaultElement| {
        let channel = |name: &str| vertex.get(name).and_then(Property::to_u8_color_lossy).map(|c| f32::from(c) / 255.0);
        Some(Vec3::new(channel("red")?, channel("green")?, channel("blue")?))
    };
    let has_uv = vertices.first().and_then(uv).is_some();
    let picture = header.comments.iter().find_map(|comment| comment.trim().strip_prefix("TextureFile ")).filter(|_| has_uv);
    let texture = picture.and_then(|name| Textures::beside(path).find(&mut mesh, name.trim()));
    let plain = if texture.is_some() { Vec3::ONE } else { Vec3::splat(0.6) };
    let mut left_out = 0;
    for face in elements("face") {
        let corners =
            ["vertex_indices", "vertex_index"].iter().find_map(|name| face.get(*name)?.to_u32_list()).unwrap_or_default();
        let found: Option<Vec<_>> = corners.iter().map(|&i| vertices.get(i as usize)).collect();
        let Some(found) = found.filter(|corners| corners.len() >= 3) else {
            left_out += 1;
            continue;
        };
        let positions: Option<Vec<_>> = found.iter().map(|v| vector(v, ["x", "y", "z"])).collect();
        let Some(positions) = positions else { continue };
        for corners in triangles_of(&positions) {
            let before = mesh.vertices.len();
            mesh.push_flat(corners.map(|i| positions[i]), plain);
            for (vertex, from) in mesh.vertices[before..].iter_mut().zip(corners.map(|i| found[i])) {
                vertex.normal = vector(from, ["nx", "ny", "nz"]).and_then(Vec3::try_normalize).unwrap_or(vertex.normal);
                match texture {
                    Some(_) => vertex.uv = uv(from).unwrap_or_default(),
                    None => vertex.colour = colour(from).unwrap_or(plain),
                }
            }
        }
    }
    if left_out > 0 {
        mesh.warnings.push(format!("{left_out} faces left out: indices out of range"));
    }
    mesh.parts.push(Part { vertices: 0..mesh.vertices.len(), texture });
    mesh.with_faces(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: &str = "ply\nformat ascii 1.0\ncomment TextureFile wood.png\nelement vertex 4\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n\
        property list uchar int vertex_indices\nend_header\n0 0 0 255 0 0\n1 0 0 255 0 0\n1 1 0 0 0 255\n0 1 0 0 0 255\n4 0 1 2 3\n3 0 1 9\n";

    fn read(text: &str) -> Result<Mesh> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("mesh.ply");
        std::fs::write(&path, text).unwrap();
        image::RgbaImage::new(2, 2).save(dir.path().join("wood.png")).unwrap();
        load(&path)
    }

    #[test]
    fn polygons_colours_and_bad_faces() {
        let mesh = read(SQUARE).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.parts.len(), mesh.warnings.len()), (6, 1, 1), "{:?}", mesh.warnings);
        assert_eq!([mesh.vertices[0].colour, mesh.vertices[2].colour], [Vec3::X, Vec3::Z]);
        assert!(mesh.vertices.iter().all(|v| v.normal == Vec3::Z) && mesh.textures.is_empty());
    }

    #[test]
    fn textures_as_bop_has_them() {
        let textured = SQUARE
            .replace(
                "property uchar red\nproperty uchar green\nproperty uchar blue",
                "property float texture_u\nproperty float texture_v",
            )
            .replace(" 255 0 0", " 0.25 0")
            .replace(" 0 0 255", " 0.25 1");
        let mesh = read(&textured).unwrap();
        assert_eq!((mesh.textures.len(), mesh.parts[0].texture), (1, Some(0)));
        assert_eq!([mesh.vertices[0].uv, mesh.vertices[2].uv], [Vec2::new(0.25, 1.0), Vec2::new(0.25, 0.0)]);
    }

    #[test]
    fn bad_files_are_refused() {
        let no_faces = SQUARE.replace("element face 2", "element face 0");
        let huge = SQUARE.replace("element vertex 4", "element vertex 4000000000");
        for (text, word) in
            [("", "PLY"), ("ply\n", "PLY"), (&SQUARE[..200], "PLY"), (&no_faces, "at least one"), (&huge, "4000000000")]
        {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains("mesh.ply") && error.contains(word) && !error.contains('\n'), "{word}: {error}");
        }
    }
}
