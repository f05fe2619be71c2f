//! Mesh files that are not as they should be.

use proptest::prelude::*;
use srn_data::mesh;
use std::fs;

mod spoil;
use spoil::{fuzz, spoiled};

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

/// A red square of an AC3D file.
const AC3D: &str = "AC3Db\nMATERIAL \"red\" rgb 1 0 0  amb 1 1 1  emis 0 0 0  spec 0 0 0  shi 8  trans 0\nOBJECT world\nkids 1\n\
    OBJECT poly\nname \"a square\"\ndata 3\nabc\ntexture \"wood.png\"\ntexrep 2 2\nloc 0 0 1\nrot 0 1 0 1 0 0 0 0 1\nnumvert 4\n\
    0 0 0\n1 0 0\n1 1 0\n0 1 0\nnumsurf 1\nSURF 0x20\nmat 0\nrefs 4\n0 0 0\n1 1 0\n2 1 1\n3 0 1\nkids 0\n";
/// A strip as TORCS has them.
const ACC: &str = "AC3Db\nMATERIAL \"m\" rgb 1 1 1\nOBJECT world\nkids 1\nOBJECT poly\ntexture \"paint.rgb\" base\n\
    texture \"wood.png\" shad\nnumvert 4\n0 0 0 0 0 1\n1 0 0 0 0 1\n0 1 0 0 1 0\n1 1 0 0 1 0\nnumsurf 1\nSURF 0x14\nmat 0\n\
    refs 4\n0 0 0 0 0\n1 1 0 0 0\n2 0 1 0 0\n3 1 1 0 0\nkids 0\n";
const VRML: &str = "#VRML V2.0 utf8\nDEF P Transform { translation 0 0 5 rotation 0 0 1 0.5 scale 2 2 2 children [ Shape {\n\
    appearance Appearance { material DEF RED Material { diffuseColor 1 0 0 } } geometry IndexedFaceSet { coord DEF POINTS Coordinate\n\
    { point [0 0 0, 1 0 0, 1 1 0, 0 1 0] } coordIndex [0, 1, 2, 3, -1] color Color { color [1 0 0, 0 1 0, 0 0 1, 1 1 1] } } } ] }\n\
    Switch { whichChoice 0 choice [ USE P, Shape { geometry IndexedFaceSet { coord USE POINTS coordIndex [0 1 2] } } ] }\n";
/// A part, a sub-file and the colours.
const LDRAW: [(&str, &str); 3] = [
    ("parts/part.dat", "0 A part\n1 16 0 0 0 1 0 0 0 1 0 0 0 1 s\\sub.dat\n4 4 0 0 0 1 0 0 1 1 0 0 1 0\n2 24 0 0 0 1 1 1\n"),
    ("parts/s/sub.dat", "3 16 0 0 0 1 0 0 0 1 0\n3 24 0 0 0 1 0 0 0 1 0\n3 0x20000FF 0 0 0 1 0 0 0 1 0\n"),
    ("LDConfig.ldr", "0 !COLOUR Red CODE 4 VALUE #FF0000 EDGE #330000\n0 !COLOUR Blue CODE 1 VALUE #0000FF EDGE 4\n"),
];

/// A text STL file of one triangle.
const STL: &str =
    "solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 2 0\nendloop\nendfacet\nendsolid x\n";

/// A 4×2 picture as SGI files have them, run-length encoded.
fn sgi() -> Vec<u8> {
    let mut bytes = vec![0; 512];
    for (at, value) in [(0, 0x01), (1, 0xda), (2, 1), (3, 1), (5, 3), (7, 4), (9, 2), (11, 3), (19, 255)] {
        bytes[at] = value;
    }
    let rows = 6u32; // 2 rows of 3 channels, each 4 equal bytes and the mark of the end
    bytes.extend((0..rows).flat_map(|row| (512 + 8 * rows + 3 * row).to_be_bytes()));
    bytes.extend((0..rows).flat_map(|_| 3u32.to_be_bytes()));
    bytes.extend((0..rows as u8).flat_map(|row| [4, 40 * row, 0]));
    bytes
}

fn png() -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(vec![]);
    image::RgbaImage::from_fn(5, 3, |x, y| image::Rgba([40 * x as u8, 80 * y as u8, 9, 255]))
        .write_to(&mut bytes, image::ImageFormat::Png)
        .unwrap();
    bytes.into_inner()
}

/// Reads the first file while any of them, in turn, is not as it should be.
fn survive(target: &str, files: &[(&str, Vec<u8>)]) {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    for (name, good) in files {
        fs::create_dir_all(path(name).parent().unwrap()).unwrap();
        fs::write(path(name), good).unwrap();
    }
    let mesh_file = path(files[0].0);
    let good = mesh::load(&mesh_file).unwrap().0;
    assert!(good.warnings.is_empty() && good.textures.len() < files.len(), "{target}: {:?}", good.warnings);
    fuzz(target, 400, &(0..files.len(), spoiled()), |(which, spoiled)| {
        for (k, (name, good)) in files.iter().enumerate() {
            let bytes = if k == which { spoiled.of(good) } else { good.clone() };
            fs::write(path(name), bytes).unwrap();
        }
        match mesh::load(&mesh_file) {
            Ok((mut mesh, up)) => {
                mesh.normalise(up);
                let is_finite =
                    |v: &mesh::Vertex| v.position.is_finite() && v.normal.is_finite() && v.colour.is_finite() && v.uv.is_finite();
                prop_assert!(mesh.vertices.iter().all(is_finite));
                prop_assert!(mesh.vertices.len() % 3 == 0 && !mesh.vertices.is_empty());
                prop_assert!(mesh.parts.iter().all(|part| part.vertices.end <= mesh.vertices.len()));
                prop_assert!(mesh.parts.iter().all(|part| part.texture.is_none_or(|texture| texture < mesh.textures.len())));
                prop_assert!(mesh.warnings.iter().all(|warning| !warning.contains('\n')), "{:?}", mesh.warnings);
            }
            Err(error) => prop_assert!(!error.to_string().contains('\n'), "{error}"),
        }
        Ok(())
    });
}

#[test]
fn fuzz_obj() {
    let material = "newmtl wood\nKd 0.5 0.25 0\nmap_Kd wood.png\n";
    let text = format!("mtllib things.mtl\nusemtl wood\n{OBJ}");
    survive("obj", &[("mesh.obj", text.into()), ("things.mtl", material.into()), ("wood.png", png())]);
}

#[test]
fn fuzz_ply() {
    survive("ply", &[("mesh.ply", PLY.into())]);
    survive("ply-binary", &[("mesh.ply", binary_ply())]);
}

#[test]
fn fuzz_stl() {
    survive("stl", &[("mesh.stl", STL.into())]);
    survive("stl-binary", &[("mesh.stl", binary_stl())]);
}

#[test]
fn fuzz_gltf() {
    let [text, binary] = gltf_files();
    survive("gltf", &[("mesh.gltf", text)]);
    survive("glb", &[("mesh.glb", binary)]);
}

#[test]
fn fuzz_ldraw() {
    // Whichever colour the part's name asks for.
    let colour = |code: u32| format!("0 !COLOUR Grey CODE {code} VALUE #8080{code:02} EDGE #333333\n");
    let mut files = LDRAW.map(|(name, text)| (name, text.to_owned()));
    files[2].1.extend((0..80).map(colour));
    survive("ldraw", &files.map(|(name, text)| (name, text.into_bytes())));
}

#[test]
fn fuzz_ac3d() {
    survive("ac3d", &[("mesh.ac", AC3D.into()), ("wood.png", png())]);
    survive("ac3d-torcs", &[("mesh.acc", ACC.into()), ("paint.rgb", sgi())]);
}

#[test]
fn fuzz_vrml() {
    survive("vrml", &[("mesh.wrl", VRML.into())]);
}
