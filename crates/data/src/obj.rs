//! Wavefront OBJ with MTL materials and textures.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part, Textures};
use glam::{Vec2, Vec3};
use std::path::Path;

/// Reads an OBJ file, its materials and its textures. Faces with indices out of range, materials and textures that cannot be
/// read are left out and named in [`Mesh::warnings`]; a file without any face is an error. Normals are kept where the file has
/// them, else flat; a textured surface takes its colour from the texture alone.
pub fn load(path: &Path) -> Result<Mesh> {
    let text = String::from_utf8_lossy(&read_bytes(path)?).into_owned();
    let mut mesh = Mesh::default();
    let text = tidy(&text, &mut mesh.warnings);
    let folder = path.parent().unwrap_or(Path::new(""));
    let material_warnings = std::cell::RefCell::new(vec![]);
    let options = tobj::LoadOptions { single_index: false, triangulate: true, ignore_points: true, ignore_lines: true };
    let (models, materials) = tobj::load_obj_buf(&mut text.as_bytes(), &options, |name| {
        let mut warnings = material_warnings.borrow_mut();
        let bytes =
            read_bytes(&folder.join(name)).map_err(|error| warnings.push(format!("materials {error}"))).unwrap_or_default();
        let found = materials(&String::from_utf8_lossy(&bytes), |what| warnings.push(format!("{}: {what}", name.display())));
        let numbers = found.iter().enumerate().map(|(number, material)| (material.name.clone(), number)).collect();
        Ok((found, numbers))
    })
    .map_err(|error| Error::field(path, "OBJ", "a Wavefront OBJ file", error))?;
    let materials = materials.unwrap_or_default();
    mesh.warnings.extend(material_warnings.into_inner());

    let mut textures = Textures::beside(path);
    for model in &models {
        let shape = &model.mesh;
        let material = shape.material_id.and_then(|id| materials.get(id));
        let picture = material.and_then(|m| m.diffuse_texture.as_deref()).filter(|_| !shape.texcoords.is_empty());
        let texture = picture.and_then(|name| textures.find(&mut mesh, name));
        let plain = material.and_then(|m| m.diffuse).map_or(Vec3::splat(0.6), |[r, g, b]| Vec3::new(r, g, b));
        let colour = if texture.is_some() { Vec3::ONE } else { plain };
        let at3 = |v: &[f32], i: u32| v.get(3 * i as usize..).and_then(|v| v.get(..3)).map(Vec3::from_slice).unwrap_or_default();
        let at2 = |v: &[f32], i: u32| v.get(2 * i as usize..).and_then(|v| v.get(..2)).map(Vec2::from_slice).unwrap_or_default();
        let start = mesh.vertices.len();
        let corners = |values: &[u32], at: usize| values.get(at..at + 3).and_then(|v| v.try_into().ok()).unwrap_or([u32::MAX; 3]);
        for first in (0..shape.indices.len()).step_by(3) {
            let before = mesh.vertices.len();
            let positions = corners(&shape.indices, first).map(|i| at3(&shape.positions, i));
            mesh.push_flat(positions, colour);
            let normals = corners(&shape.normal_indices, first).map(|i| at3(&shape.normals, i).normalize_or_zero());
            let uvs = corners(&shape.texcoord_indices, first).map(|i| at2(&shape.texcoords, i));
            for ((vertex, normal), uv) in mesh.vertices[before..].iter_mut().zip(normals).zip(uvs) {
                vertex.normal = if normal == Vec3::ZERO { vertex.normal } else { normal };
                vertex.uv = Vec2::new(uv.x, 1.0 - uv.y); // OBJ has v upwards
            }
        }
        mesh.parts.push(Part { vertices: start..mesh.vertices.len(), texture });
    }
    mesh.with_faces(path)
}

/// The text with all vertices first, all indices absolute, and every face left out that refers to what the file does not have:
/// tobj refuses a whole file for one bad index, and for a face that stands before its vertices.
fn tidy(text: &str, warnings: &mut Vec<String>) -> String {
    let key = |line: &str| ["v", "vt", "vn"].iter().position(|&key| line.split_whitespace().next() == Some(key));
    let mut totals = [0i64; 3];
    text.lines().filter_map(key).for_each(|k| totals[k] += 1);
    let mut counts = [0i64; 3]; // up to here: negative indices count back from them
    let [mut vertices, mut rest] = [String::with_capacity(text.len()), String::new()];
    for (number, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace().take_while(|word| !word.starts_with('#'));
        if let Some(k) = key(line) {
            counts[k] += 1;
            vertices.extend([line, "\n"]);
        } else if words.next() == Some("f") {
            let index = |(k, index): (usize, &str)| match index.parse::<i64>() {
                Ok(i) if k < 3 && i > 0 && i <= totals[k] => Some(i.to_string()),
                Ok(i) if k < 3 && i < 0 && -i <= counts[k] => Some((counts[k] + 1 + i).to_string()),
                _ => (index.is_empty() && k > 0).then(String::new),
            };
            let corner = |corner: &str| Some(corner.split('/').enumerate().map(index).collect::<Option<Vec<_>>>()?.join("/"));
            match words.map(corner).collect::<Option<Vec<_>>>() {
                Some(face) => rest.extend(["f ", &face.join(" "), "\n"]),
                None => warnings.push(format!("line {}: face left out, index out of range: {}", number + 1, line.trim())),
            }
        } else {
            rest.extend([line, "\n"]);
        }
    }
    vertices + &rest
}

/// The names, colours and textures of an MTL file. tobj's own reader gives up a whole file for one line that it cannot read, or
/// panics.
fn materials(text: &str, mut warn: impl FnMut(String)) -> Vec<tobj::Material> {
    let mut found: Vec<tobj::Material> = vec![];
    for (number, line) in text.lines().enumerate() {
        let (key, rest) = line.trim().split_once(char::is_whitespace).unwrap_or((line.trim(), ""));
        match (key, found.last_mut()) {
            ("newmtl", _) => found.push(tobj::Material { name: rest.trim().into(), ..Default::default() }),
            ("Kd", Some(material)) => {
                let colour: Option<Vec<f32>> = rest.split_whitespace().take(3).map(|word| word.parse().ok()).collect();
                material.diffuse = colour.and_then(|colour| colour.try_into().ok());
                if material.diffuse.is_none() {
                    warn(format!("line {}: expected a colour: {}", number + 1, line.trim()));
                }
            }
            ("map_Kd", Some(material)) => material.diffuse_texture = Some(rest.trim().into()),
            _ => {}
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::write;

    /// Two squares in the plane z = 0: the first red, the second textured.
    const OBJ: &str = "mtllib my things.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n\
        usemtl red\nf 1 2 3 4\nusemtl wood\nf 1/1 2/2 3/3 4/4\n";
    const MTL: &str = "newmtl red\nKd 1 0.25 0\n\nnewmtl wood\nKd 0.1 0.1 0.1\nmap_Kd old oak.png\n";

    fn loaded(obj: &str) -> Result<Mesh> {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path().join("my things.mtl"), MTL).unwrap();
        image::RgbImage::from_pixel(2, 1, image::Rgb([7, 8, 9])).save(dir.path().join("old oak.png")).unwrap();
        write(dir.path().join("mesh.obj"), obj).unwrap();
        load(&dir.path().join("mesh.obj"))
    }

    #[test]
    fn colours_textures_and_coordinates() {
        let mesh = loaded(OBJ).unwrap();
        assert!(mesh.warnings.is_empty(), "{:?}", mesh.warnings);
        assert_eq!(mesh.parts, [Part { vertices: 0..6, texture: None }, Part { vertices: 6..12, texture: Some(0) }]);
        assert_eq!(mesh.textures[0].as_raw(), &[7, 8, 9, 255, 7, 8, 9, 255]);
        assert!(mesh.vertices[..6].iter().all(|v| v.colour == Vec3::new(1.0, 0.25, 0.0) && v.normal == Vec3::Z));
        // Textures are not darkened by Kd; v points down.
        assert!(mesh.vertices[6..].iter().all(|v| v.colour == Vec3::ONE && v.uv == Vec2::new(v.position.x, 1.0 - v.position.y)));
    }

    #[test]
    fn corners_without_texture_coordinates_leave_the_others_alone() {
        let mesh = loaded(&OBJ.replace("usemtl wood\n", "usemtl wood\nf 1 2 3\n")).unwrap();
        let textured = &mesh.vertices[9..];
        assert!(textured.iter().all(|v| v.uv == Vec2::new(v.position.x, 1.0 - v.position.y)), "{textured:?}");
    }

    #[test]
    fn faces_with_bad_indices_are_left_out() {
        for bad in ["f 1 2 5", "f 1 2 0", "f -5 -1 -2", "f 1/9 2/1 3/1", "f 1//1 2//1 3//1", "f 1 2 x"] {
            let mesh = loaded(&format!("{OBJ}{bad}\n")).unwrap();
            assert_eq!(mesh.vertices.len(), 12, "{bad}");
            assert!(mesh.warnings.len() == 1 && mesh.warnings[0].contains("line 14") && mesh.warnings[0].contains(bad), "{bad}");
        }
        let mesh = loaded(&format!("{OBJ}f -4 -3 -2\n")).unwrap();
        assert_eq!((mesh.vertices.len(), mesh.warnings.len()), (15, 0), "a face that counts back from the end is good");
        let mesh = loaded("f 1 2 3\nusemtl red\nf 1 2 3\nv 0 0 0\nv 1 0 0\nv 1 1 0\n").unwrap();
        assert_eq!((mesh.vertices.len(), mesh.warnings.len()), (6, 0), "vertices may come last");
        let error = loaded("v 0 0 0\nf 1 2 3\n").unwrap_err().to_string();
        assert!(error.contains("mesh.obj") && error.contains("faces"), "{error}");
    }

    #[test]
    fn missing_materials_and_textures_are_warnings() {
        let mesh = loaded(&OBJ.replace("my things", "lost")).unwrap();
        assert!(mesh.vertices.len() == 12 && mesh.warnings[0].contains("lost.mtl"), "{:?}", mesh.warnings);
        let dir = tempfile::tempdir().unwrap();
        // A colour of one number: found by the fuzzer.
        write(dir.path().join("my things.mtl"), MTL.replace("1 0.25 0", "1").replace("newmtl", "Ns x\nnewmtl")).unwrap();
        write(dir.path().join("mesh.obj"), OBJ).unwrap();
        let mesh = load(&dir.path().join("mesh.obj")).unwrap();
        assert!(mesh.warnings[0].contains("my things.mtl: line 3: expected a colour: Kd 1"), "{:?}", mesh.warnings);
        assert!(mesh.textures.is_empty() && mesh.warnings[1].contains("old oak.png"), "{:?}", mesh.warnings);
        assert_eq!(mesh.vertices[6].colour, Vec3::splat(0.1), "without its texture a surface has its own colour");
    }
}
