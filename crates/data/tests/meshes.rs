//! Mesh files that are not as they should be.

use proptest::prelude::*;
use srn_data::mesh::{Mesh, Up};
use srn_data::{Result, gltf, obj, ply, stl};
use std::fs;
use std::path::Path;

mod spoil;
use spoil::{config, spoiled};

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
    property uchar green\nproperty uchar blue\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n\
    0 0 0 255 0 0\n1 0 0 255 0 0\n1 1 0 0 0 255\n0 1 0 0 0 255\n4 0 1 2 3\n3 0 1 2\n";
const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1 3 -1\n";

/// The same in little-endian binary.
fn binary_ply() -> Vec<u8> {
    let (head, _) = PLY.split_once("end_header\n").unwrap();
    let mut bytes = (head.replace("ascii", "binary_little_endian") + "end_header\n").into_bytes();
    for [x, y] in [[0.0f32, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]] {
        bytes.extend([x, y, 0.0].iter().flat_map(|x| x.to_le_bytes()).chain([9, 8, 7]));
    }
    for face in [&[0i32, 1, 2, 3][..], &[0, 1, 2]] {
        bytes.push(face.len() as u8);
        bytes.extend(face.iter().flat_map(|i| i.to_le_bytes()));
    }
    bytes
}

/// A square of two triangles.
fn binary_stl() -> Vec<u8> {
    let mut bytes = vec![0; 80];
    bytes.extend(2u32.to_le_bytes());
    for corners in [[[0.0f32, 0.0], [1.0, 0.0], [1.0, 1.0]], [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0]]] {
        bytes.extend([0; 12]);
        bytes.extend(corners.iter().flat_map(|[x, y]| [*x, *y, 0.0]).flat_map(f32::to_le_bytes).chain([0, 0]));
    }
    bytes
}

/// A triangle with its numbers in the text, and one with them in a binary chunk.
fn gltf_files() -> [Vec<u8>; 2] {
    let positions = [[0.0f32, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]].concat();
    let mut blob: Vec<u8> = positions.iter().flat_map(|x| x.to_le_bytes()).collect();
    blob.extend([0u16, 1, 2, 0].iter().flat_map(|i| i.to_le_bytes()));
    let json = |uri: &str| {
        let text = format!(
            r#"{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}],
            "nodes": [{{"translation": [0, 0, 3], "children": [1]}}, {{"mesh": 0}}],
            "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0, "NORMAL": 0}}, "indices": 1, "material": 0}}]}}],
            "materials": [{{"pbrMetallicRoughness": {{"baseColorFactor": [1, 0, 0.2, 1]}}}}],
            "accessors": [{{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 2, 0]}},
                          {{"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}}],
            "bufferViews": [{{"buffer": 0, "byteLength": 36}}, {{"buffer": 0, "byteOffset": 36, "byteLength": 6}}],
            "buffers": [{{{uri}"byteLength": 44}}]}}"#
        );
        let padding = (4 - text.len() % 4) % 4;
        text + &" ".repeat(padding)
    };
    let text =
        json("\"uri\": \"data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAAEAAAAAAAAABAAIAAAA=\", ");
    let inside = json("");
    let word = |n: usize| (n as u32).to_le_bytes();
    let chunk = |kind: &[u8; 4], bytes: &[u8]| [&word(bytes.len())[..], kind, bytes].concat();
    let chunks = [chunk(b"JSON", inside.as_bytes()), chunk(b"BIN\0", &blob)].concat();
    [text.into_bytes(), [b"glTF", &word(2)[..], &word(12 + chunks.len()), &chunks].concat()]
}

#[test]
fn no_file_makes_a_mesh_reader_panic() {
    let dir = tempfile::tempdir().unwrap();
    type Load = fn(&Path) -> Result<Mesh>;
    let [text, binary] = gltf_files();
    let meshes: [(&str, Load, Vec<u8>); 6] = [
        ("mesh.ply", ply::load, PLY.into()),
        ("binary.ply", ply::load, binary_ply()),
        ("mesh.stl", stl::load, binary_stl()),
        ("mesh.obj", obj::load, OBJ.into()),
        ("mesh.gltf", gltf::load, text),
        ("mesh.glb", gltf::load, binary),
    ];
    for (name, load, good) in meshes {
        let path = dir.path().join(name);
        fs::write(&path, &good).unwrap();
        assert!(load(&path).is_ok_and(|mesh| mesh.warnings.is_empty()), "{name}: {:?}", load(&path));
        let found = proptest::test_runner::TestRunner::new(config(400)).run(&spoiled(), |spoiled| {
            fs::write(&path, spoiled.of(&good)).unwrap();
            if let Ok(mut mesh) = load(&path) {
                mesh.normalise(Up::Z);
                prop_assert!(mesh.vertices.len() % 3 == 0 && !mesh.vertices.is_empty());
            }
            Ok(())
        });
        assert!(found.is_ok(), "{name}: {}", found.unwrap_err());
    }
}
