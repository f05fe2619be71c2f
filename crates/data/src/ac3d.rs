//! AC3D models (`.ac`) and those of TORCS (`.acc`): objects inside objects, polygons with colours and textures, as text.
//!
//! TORCS adds normals to the vertices, strips of triangles, and up to four textures, of which the first is the surface's own.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part, Textures, triangles_of};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use std::iter::{Enumerate, Peekable};
use std::path::Path;
use std::str::Split;

/// Kinds of surfaces, the last four bits of their flags; others are lines.
const POLYGON: u32 = 0;
const STRIP: u32 = 4;

/// Reads an AC3D file and its textures. Lines, surfaces that refer to what the file does not have, textures that cannot be read,
/// and surfaces whose texture is nowhere opaque (shadows on the ground) are left out and named in [`Mesh::warnings`]; a file
/// without any other surface is an error. Normals are kept where the file has them, else flat; a textured surface takes its
/// colour from the texture alone.
pub fn load(path: &Path) -> Result<Mesh> {
    let text = String::from_utf8_lossy(&read_bytes(path)?).into_owned();
    let lines = text.split('\n').enumerate().peekable();
    let mut reader = Reader { path, lines, at: 0, materials: vec![], textures: Textures::beside(path), mesh: Mesh::default() };
    let header = reader.line().unwrap_or_default();
    if !header.starts_with("AC3D") {
        return Err(reader.bad("AC3D", header));
    }
    reader.objects()?;
    reader.mesh.with_faces(path)
}

struct Reader<'a> {
    path: &'a Path,
    lines: Peekable<Enumerate<Split<'a, char>>>,
    /// The number of the line that was read last, from 1.
    at: usize,
    materials: Vec<Vec3>,
    textures: Textures<'a>,
    mesh: Mesh,
}

/// An object as it is read. Those inside of it have its place and, if no other, its texture.
#[derive(Clone, Default)]
struct Object<'a> {
    placed: Affine3A,
    texture: Option<&'a str>,
    repeat: Vec2,
    offset: Vec2,
    /// Positions and, in TORCS' files, normals.
    vertices: Vec<[Vec3; 2]>,
    /// Objects inside of it that are still to come.
    inside: u32,
}

impl<'a> Reader<'a> {
    fn bad(&self, expected: &str, found: &str) -> Error {
        Error::field(self.path, format!("line {}", self.at), expected, format!("\"{}\"", found.trim()))
    }

    /// The next line that is not empty.
    fn line(&mut self) -> Result<&'a str> {
        for (number, line) in self.lines.by_ref() {
            self.at = number + 1;
            if !line.trim().is_empty() {
                return Ok(line.trim());
            }
        }
        Err(Error::field(self.path, format!("line {}", self.at), "another line", "the end of the file"))
    }

    fn ended(&mut self) -> bool {
        while self.lines.next_if(|(_, line)| line.trim().is_empty()).is_some() {}
        self.lines.peek().is_none()
    }

    fn numbers<const N: usize>(&self, text: &str) -> Result<[f32; N]> {
        let mut numbers = text.split_whitespace().map_while(|word| word.parse().ok().filter(|x: &f32| x.is_finite()));
        let read = std::array::from_fn(|_| numbers.next());
        if read.contains(&None) { Err(self.bad(&format!("{N} numbers"), text)) } else { Ok(read.map(Option::unwrap_or_default)) }
    }

    fn count(&self, text: &str) -> Result<u32> {
        text.parse().map_err(|_| self.bad("a count", text))
    }

    /// A line of an object's parts, which must begin with this word; what follows it.
    fn after(&mut self, key: &str) -> Result<&'a str> {
        let line = self.line()?;
        line.strip_prefix(key)
            .filter(|rest| rest.starts_with(char::is_whitespace))
            .map(str::trim)
            .ok_or_else(|| self.bad(key, line))
    }

    fn objects(&mut self) -> Result<()> {
        // A stack of its own: files may nest as deep as they like.
        let mut around = vec![];
        while !self.ended() {
            let line = self.line()?;
            match line.split_whitespace().next() {
                Some("MATERIAL") => self.material(line)?,
                // From version 12 on, materials may have many lines.
                Some("MAT") => while !self.line().and_then(|line| self.part_of_material(line))? {},
                Some("OBJECT") => {
                    while around.pop_if(|object: &mut Object| object.inside == 0).is_some() {}
                    let outer = around.last_mut();
                    let outer = outer.map(|object| (object.placed, object.texture, object.inside -= 1));
                    let (placed, texture, ()) = outer.unwrap_or_default();
                    around.push(self.object(Object { placed, texture, repeat: Vec2::ONE, ..Object::default() })?);
                }
                _ => return Err(self.bad("MATERIAL or OBJECT", line)),
            }
        }
        // Some files are cut out of larger ones, with the count of the whole.
        let more: u64 = around.iter().map(|object| u64::from(object.inside)).sum();
        if more > 0 {
            self.mesh.warnings.push(format!("line {}: {more} more objects were promised", self.at));
        }
        Ok(())
    }

    fn material(&mut self, line: &str) -> Result<()> {
        // Names may hold anything but quotes.
        let rest = line.rsplit_once('"').map_or(line, |(_, rest)| rest);
        let (_, rgb) = rest.split_once("rgb").ok_or_else(|| self.bad("a colour, rgb", line))?;
        self.materials.push(Vec3::from_array(self.numbers(rgb)?).clamp(Vec3::ZERO, Vec3::ONE));
        Ok(())
    }

    /// Whether this was the last line of a material.
    fn part_of_material(&mut self, line: &str) -> Result<bool> {
        if let Some(rgb) = line.strip_prefix("rgb ") {
            self.materials.push(Vec3::from_array(self.numbers(rgb)?).clamp(Vec3::ZERO, Vec3::ONE));
        }
        Ok(line == "ENDMAT")
    }

    fn object(&mut self, mut object: Object<'a>) -> Result<Object<'a>> {
        let outer = object.placed;
        let (mut turn, mut shift) = (Mat3::IDENTITY, Vec3::ZERO);
        let mut own_texture = false;
        loop {
            let line = self.line()?;
            let (key, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
            let rest = rest.trim();
            match key {
                "loc" => shift = Vec3::from_array(self.numbers(rest)?),
                "rot" => turn = Mat3::from_cols_array(&self.numbers(rest)?).transpose(),
                "texture" if !own_texture => (own_texture, object.texture) = (true, Some(unquoted(rest))),
                "texrep" => object.repeat = Vec2::from_array(self.numbers(rest)?),
                "texoff" => object.offset = Vec2::from_array(self.numbers(rest)?),
                "data" => self.skip(rest)?,
                "numvert" => {
                    for _ in 0..self.count(rest)? {
                        let line = self.line()?;
                        let position = Vec3::from_array(self.numbers(line)?);
                        let normal = self.numbers::<6>(line).map(|[.., x, y, z]| Vec3::new(x, y, z)).unwrap_or_default();
                        object.vertices.push([position, normal]);
                    }
                }
                "numsurf" => self.surfaces(&object, self.count(rest)?)?,
                "kids" => {
                    object.inside = self.count(rest)?;
                    object.vertices = vec![];
                    return Ok(object);
                }
                // Names, links, and how the editor treats the object.
                _ => {}
            }
            object.placed = outer * Affine3A::from_mat3_translation(turn, shift);
        }
    }

    /// A text of so many bytes, in lines of its own.
    fn skip(&mut self, length: &str) -> Result<()> {
        let mut left = self.count(length)? as usize;
        while left > 0 {
            let Some((number, line)) = self.lines.next() else { return Ok(()) };
            self.at = number + 1;
            left = left.saturating_sub(line.len() + 1);
        }
        Ok(())
    }

    fn surfaces(&mut self, object: &Object, count: u32) -> Result<()> {
        let texture = object.texture.and_then(|name| self.textures.find(&mut self.mesh, name));
        let is_shadow = texture.is_some_and(|texture| self.mesh.textures[texture].pixels().all(|pixel| pixel.0[3] < 255));
        let start = self.mesh.vertices.len();
        let [mut lines, mut wrong] = [0; 2];
        for _ in 0..count {
            let flags = self.after("SURF")?;
            let hex = flags.strip_prefix("0x").or(flags.strip_prefix("0X"));
            let kind =
                hex.and_then(|hex| u32::from_str_radix(hex, 16).ok()).ok_or_else(|| self.bad("flags as 0x10", flags))? & 15;
            let material = self.after("mat")?;
            let material = self.materials.get(self.count(material)? as usize).copied();
            let corners = self.after("refs")?;
            let mut found = vec![];
            let mut complete = true;
            for _ in 0..self.count(corners)? {
                let line = self.line()?;
                let (index, uv) = line.split_once(char::is_whitespace).unwrap_or((line, "0 0"));
                let vertex = object.vertices.get(self.count(index)? as usize);
                let uv = object.offset + object.repeat * Vec2::from_array(self.numbers(uv)?);
                complete &= vertex.is_some();
                found.extend(vertex.map(|&[position, normal]| (object.placed.transform_point3(position), normal, uv)));
            }
            let (Some(colour), true) = (material, complete) else {
                wrong += 1;
                continue;
            };
            // Materials of textured surfaces are a grey that is made up for by ambient and emitted light.
            let colour = if texture.is_some() { Vec3::ONE } else { colour };
            let triangles = match kind {
                POLYGON => triangles_of(&found.iter().map(|corner| corner.0).collect::<Vec<_>>()),
                STRIP => (2..found.len()).map(|i| [i - 2, i - 1, i]).collect(),
                _ => {
                    lines += 1;
                    continue;
                }
            };
            for corners in triangles.into_iter().filter(|_| !is_shadow) {
                let before = self.mesh.vertices.len();
                self.mesh.push_flat(corners.map(|i| found[i].0), colour);
                for (vertex, i) in self.mesh.vertices[before..].iter_mut().zip(corners) {
                    let (_, normal, uv) = found[i];
                    vertex.normal = object.placed.transform_vector3(normal).try_normalize().unwrap_or(vertex.normal);
                    vertex.uv = Vec2::new(uv.x, 1.0 - uv.y); // AC3D has v upwards
                }
            }
        }
        let left_out = [
            (lines, "lines are not drawn"),
            (wrong, "they refer to vertices or materials that do not exist"),
            (if is_shadow { count } else { 0 }, "their texture is nowhere opaque"),
        ];
        let name = object.texture.unwrap_or("none");
        for (count, why) in left_out.into_iter().filter(|(count, _)| *count > 0) {
            self.mesh.warnings.push(format!("line {}: {count} surfaces left out, texture {name}: {why}", self.at));
        }
        self.mesh.parts.push(Part { vertices: start..self.mesh.vertices.len(), texture });
        Ok(())
    }
}

/// The first word of a line, or what stands in quotes there.
fn unquoted(text: &str) -> &str {
    match text.strip_prefix('"') {
        Some(quoted) => quoted.split('"').next().unwrap_or_default(),
        None => text.split_whitespace().next().unwrap_or_default(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{Rgba, RgbaImage};
    use std::fs::write;

    /// A unit square in the plane z = 0 with a red and a blue half.
    const SQUARE: &str = "AC3Db\nMATERIAL \"red rgb\" rgb 1 0 0  amb 1 1 1  emis 0 0 0  spec 0 0 0  shi 8  trans 0\n\
        MATERIAL blue rgb 0 0 1 amb 1 1 1 emis 0 0 0 spec 0 0 0 shi 8 trans 0\nOBJECT world\nkids 1\nOBJECT poly\n\
        name \"a square\"\ntexture \"my oak.png\"\nnumvert 4\n0 0 0\n1 0 0\n1 1 0\n0 1 0\nnumsurf 2\n\
        SURF 0x10\nmat 0\nrefs 3\n0 0 0\n1 1 0\n2 1 1\nSURF 0X30\nmat 1\nrefs 3\n0 0 0\n2 1 1\n3 0 1\nkids 0\n";
    /// Two triangles as a strip, with normals, two textures and their coordinates.
    const STRIP: &str = "AC3Db\nMATERIAL m rgb 1 1 1\nOBJECT world\nkids 1\nOBJECT poly\ntexture \"my oak.png\" base\n\
        texture shadow.png shad\nnumvert 4\n0 0 0 0 0 2\n1 0 0 0 0 2\n0 1 0 0 1 0\n1 1 0 0 1 0\nnumsurf 1\n\
        SURF 0x14\nmat 0\nrefs 4\n0 0.1 0.9 7 7\n1 0.2 0.8 7 7\n2 0.3 0.7 7 7\n3 0.4 0.5 7 7\nkids 0\n";

    fn loaded(text: &str) -> Result<Mesh> {
        let dir = tempfile::tempdir().unwrap();
        RgbaImage::from_pixel(2, 1, Rgba([7, 8, 9, 255])).save(dir.path().join("my oak.png")).unwrap();
        RgbaImage::from_pixel(2, 1, Rgba([0, 0, 0, 200])).save(dir.path().join("shadow.png")).unwrap();
        write(dir.path().join("mesh.ac"), text).unwrap();
        load(&dir.path().join("mesh.ac"))
    }

    fn positions(mesh: &Mesh) -> Vec<[f32; 3]> {
        mesh.vertices.iter().map(|v| v.position.to_array()).collect()
    }

    #[test]
    fn colours_textures_and_coordinates() {
        let mesh = loaded(SQUARE).unwrap();
        assert!(mesh.warnings.is_empty(), "{:?}", mesh.warnings);
        assert_eq!(mesh.parts, [Part { vertices: 0..6, texture: Some(0) }]);
        assert_eq!(mesh.textures[0].as_raw(), &[7, 8, 9, 255, 7, 8, 9, 255]);
        assert!(mesh.vertices.iter().all(|v| v.uv == Vec2::new(v.position.x, 1.0 - v.position.y)));
        assert!(mesh.vertices.iter().all(|v| v.normal == Vec3::Z && v.colour == Vec3::ONE));
        let newer = "MAT \"b\"\nrgb 0 0 1\nENDMAT"; // of version 12
        let other = SQUARE.replace("MATERIAL blue rgb 0 0 1 amb 1 1 1 emis 0 0 0 spec 0 0 0 shi 8 trans 0", newer);
        for text in [SQUARE, &other] {
            let mesh = loaded(&text.replace("texture", "url")).unwrap();
            assert_eq!([mesh.vertices[0].colour, mesh.vertices[5].colour], [Vec3::X, Vec3::Z]);
        }
        // Repeated twice and shifted; the name of another machine's file.
        let mesh = loaded(
            &SQUARE
                .replace("\nname", "\ntexrep 2 3\ntexoff 0.5 -1\ncrease 40\nname")
                .replace("my oak", "C:\\their textures\\my oak"),
        )
        .unwrap();
        assert!(mesh.textures.len() == 1 && mesh.warnings.is_empty(), "{:?}", mesh.warnings);
        assert_eq!(mesh.vertices[2].uv, Vec2::new(2.5, -1.0));
    }

    #[test]
    fn strips_with_normals_and_only_the_first_texture() {
        let mesh = loaded(STRIP).unwrap();
        assert!(mesh.warnings.is_empty() && mesh.textures.len() == 1, "{:?}", mesh.warnings);
        let corners = [[0., 0., 0.], [1., 0., 0.], [0., 1., 0.], [1., 0., 0.], [0., 1., 0.], [1., 1., 0.]];
        assert_eq!(positions(&mesh), corners);
        assert_eq!([mesh.vertices[1].normal, mesh.vertices[2].normal], [Vec3::Z, Vec3::Y]);
        assert_eq!(mesh.vertices[5].uv, Vec2::new(0.4, 0.5));
    }

    #[test]
    fn objects_inside_objects() {
        // A group turned by x → y → z → x and moved, with a texture that what is inside of it takes over, holds the square, which
        // is moved itself. Its data has a line that looks like another one. A light and a lone object follow.
        let (head, square) = SQUARE.split_once("OBJECT poly\n").unwrap();
        let group =
            "OBJECT group\ndata 14\nkids 5\nkids 6\n\nloc 10 20 30\nrot 0 0 1 1 0 0 0 1 0\ntexture \"my oak.png\"\nkids 1\n";
        let square = square.replace("texture \"my oak.png\"\n", "loc 0 0 5\n");
        let text = head.replace("kids 1", "kids 2") + group + "OBJECT poly\n" + &square + "OBJECT light\nkids 0\n";
        let mesh = loaded(&text).unwrap();
        assert_eq!(positions(&mesh)[..3], [[15., 20., 30.], [15., 21., 30.], [15., 21., 31.]]);
        assert!(mesh.vertices[0].normal == Vec3::X && mesh.parts[0].texture == Some(0));
        // Deeper than any stack.
        let deep = "OBJECT group\nkids 1\n".repeat(200_000);
        assert_eq!(loaded(&(head.to_owned() + &deep + "OBJECT poly\n" + &square)).unwrap().vertices.len(), 6);
    }

    #[test]
    fn shadows_lines_and_wrong_surfaces_are_left_out() {
        for (from, to, triangles, words) in [
            ("my oak", "shadow", 0, "nowhere opaque"),
            ("SURF 0X30", "SURF 0x22", 1, "1 surfaces left out, texture my oak.png: lines"),
            ("mat 1", "mat 2", 1, "do not exist"),
            ("3 0 1\nkids", "4 0 1\nkids", 1, "do not exist"),
            ("my oak", "lost", 2, "lost.png"),
            ("kids 2", "kids 4000000000", 2, "line 49: 3999999998 more objects were promised"),
        ] {
            // A second object, so that something is there.
            let other = SQUARE.split_once("OBJECT poly\n").unwrap().1;
            let good = SQUARE.replace("kids 1", "kids 2");
            assert!(good.contains(from));
            let text = good.replace(from, to) + "OBJECT poly\n" + other;
            let mesh = loaded(&text).unwrap();
            assert_eq!(mesh.vertices.len(), 3 * (triangles + 2), "{to}");
            assert!(mesh.warnings.len() == 1 && mesh.warnings[0].contains(words), "{to}: {:?}", mesh.warnings);
        }
    }

    #[test]
    fn bad_files_are_named_with_the_line() {
        let cases = [
            ("", "", "AC3D"),
            ("AC3Db", "AC4D", "line 1"),
            ("rgb 0 0 1", "rgb 0 0 x", "line 3: expected 3 numbers"),
            ("blue rgb", "blue", "line 3: expected a colour"),
            ("1 1 0\n0 1", "1 nan 0\n0 1", "line 12: expected 3 numbers"),
            ("numvert 4", "numvert 4000000000", "line 14"),
            ("numvert 4", "numvert -1", "line 9: expected a count"),
            ("numsurf 2", "numsurf 4000000000", "line 27: expected SURF"),
            ("refs 3", "refs 4000000000", "line 21: expected a count"),
            ("SURF 0x10", "SURF 10", "line 15"),
            ("mat 0", "mad 0", "line 16: expected mat"),
            ("kids 1", "kids 0\nkids 1", "line 6: expected MATERIAL or OBJECT"),
            ("kids 0\n", "data 9999\n", "the end of the file"),
        ];
        for (from, to, words) in cases {
            let text = if from.is_empty() { String::new() } else { SQUARE.replacen(from, to, 1) };
            assert_ne!(text, SQUARE);
            let error = loaded(&text).unwrap_err().to_string();
            assert!(error.contains("mesh.ac") && error.contains(words) && !error.contains('\n'), "{to}: {error}");
        }
        let error = loaded(&SQUARE.replace("my oak", "shadow")).unwrap_err().to_string();
        assert!(error.contains("faces: expected at least one"), "{error}");
    }
}
