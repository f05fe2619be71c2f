//! STL meshes, binary and text: triangles without colours.

use crate::error::{At, Error, Result};
use crate::mesh::{Mesh, Part};
use glam::Vec3;
use std::path::Path;

/// STL has no colours; this grey shows the shading.
const GREY: Vec3 = Vec3::splat(0.6);

/// Reads an STL file. Triangles that are not finite or have no area are left out; a file without any is an error.
pub fn load(path: &Path) -> Result<Mesh> {
    let mut file = std::io::BufReader::new(std::fs::File::open(path).at(path)?);
    let refused = |error: std::io::Error| Error::field(path, "STL", "triangles in binary or text", error);
    let mut mesh = Mesh::default();
    for triangle in stl_io::create_stl_reader(&mut file).map_err(refused)? {
        mesh.push_flat(triangle.map_err(refused)?.vertices.map(|v| Vec3::from_array(v.0)), GREY);
    }
    mesh.parts.push(Part { vertices: 0..mesh.vertices.len(), texture: None });
    mesh.with_faces(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_and_binary_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]];
        let triangle = |vertices: [[f32; 3]; 3]| stl_io::Triangle {
            normal: stl_io::Normal::new([0.0; 3]),
            vertices: vertices.map(stl_io::Vertex::new),
        };
        let mut binary = vec![];
        // The second has no area, the third is no triangle.
        let mesh = [triangle(corners), triangle([corners[0], corners[1], corners[0]]), triangle([[f32::NAN; 3]; 3])];
        stl_io::write_stl(&mut binary, mesh.iter()).unwrap();
        let text =
            b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 2 0\nendloop\nendfacet\nendsolid x\n";
        for bytes in [&binary[..], text] {
            let path = dir.path().join("mesh.stl");
            std::fs::write(&path, bytes).unwrap();
            let mesh = load(&path).unwrap();
            assert_eq!(mesh.vertices.iter().map(|v| v.position.to_array()).collect::<Vec<_>>(), corners);
            assert_eq!((mesh.vertices[0].normal, mesh.parts.len()), (Vec3::Z, 1));
            assert_eq!(mesh.warnings.len(), usize::from(bytes == binary), "{:?}", mesh.warnings);
            std::fs::write(&path, &bytes[..90]).unwrap();
            let error = load(&path).unwrap_err().to_string();
            assert!(error.contains("mesh.stl") && error.contains("STL"), "{error}");
        }
    }
}
