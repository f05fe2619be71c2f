//! VRML 97 scenes (`.wrl`), of which the surfaces are read: `IndexedFaceSet` with colours, in their places.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part, triangles_of};
use glam::{Affine3A, Quat, Vec3};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// Nodes are not written deeper inside each other than this.
const DEEPEST: usize = 256;

/// A node may be used in many places, and so may be what it holds: a small file can describe more than fits anywhere.
const MOST_PLACES: usize = 1 << 20;

/// VRML's own colour of surfaces.
const PLAIN: [f32; 3] = [0.8; 3];

/// Reads a VRML 97 file. Other shapes than `IndexedFaceSet`, textures, files that are referred to, and faces whose indices are out
/// of range are left out and counted in [`Mesh::warnings`]; prototypes are an error, and so is a file without any face. Normals
/// are flat.
pub fn load(path: &Path) -> Result<Mesh> {
    let text = String::from_utf8_lossy(&read_bytes(path)?).into_owned();
    let text = text.trim_start_matches('\u{feff}');
    if !text.starts_with("#VRML V2.0") {
        let found = text.lines().next().unwrap_or_default().chars().take(40).collect::<String>();
        return Err(Error::field(path, "line 1", "#VRML V2.0 utf8", format!("\"{found}\"")));
    }
    let mut parser = Parser { path, words: Words { rest: text, line: 1 }, nodes: vec![], names: HashMap::new() };
    let mut roots = Value::default();
    while let Some(word) = parser.words.next() {
        parser.item(word, 0, &mut roots)?;
    }
    let mut drawn = Drawn::default();
    Scene { path, nodes: parser.nodes }.place(&roots.nodes, &mut drawn)?;
    let Drawn { mut mesh, left_out } = drawn;
    mesh.warnings.extend(left_out.iter().map(|(what, count)| format!("{count} {what} left out")));
    mesh.parts.push(Part { vertices: 0..mesh.vertices.len(), texture: None });
    mesh.with_faces(path)
}

/// The words of a file: numbers, names, strings with their quotes, brackets. Commas are spaces, comments nothing.
#[derive(Clone)]
struct Words<'a> {
    rest: &'a str,
    /// Where the last word ended, from 1.
    line: usize,
}

impl<'a> Words<'a> {
    fn take(&mut self, length: usize) -> &'a str {
        let (taken, rest) = self.rest.split_at(length);
        self.line += taken.bytes().filter(|&byte| byte == b'\n').count();
        self.rest = rest;
        taken
    }
}

impl<'a> Iterator for Words<'a> {
    type Item = &'a str;

    fn next(&mut self) -> Option<&'a str> {
        let is_space = |c: char| c.is_whitespace() || c == ',';
        loop {
            self.take(self.rest.find(|c| !is_space(c)).unwrap_or(self.rest.len()));
            if !self.rest.starts_with('#') {
                break;
            }
            self.take(self.rest.find('\n').unwrap_or(self.rest.len()));
        }
        let ends = |c: char| is_space(c) || "{}[]\"#".contains(c);
        let length = match self.rest.chars().next()? {
            '{' | '}' | '[' | ']' => 1,
            '"' => {
                let mut escaped = false;
                let closes = |c: char| {
                    let is_end = c == '"' && !escaped;
                    escaped = c == '\\' && !escaped;
                    is_end
                };
                self.rest[1..].find(closes).map_or(self.rest.len(), |at| at + 2)
            }
            _ => self.rest.find(ends).unwrap_or(self.rest.len()),
        };
        Some(self.take(length))
    }
}

/// What a field holds, whichever type it has: the format can be read without a table of types.
#[derive(Default)]
struct Value<'a> {
    numbers: Vec<f64>,
    /// Indices into the nodes.
    nodes: Vec<usize>,
    /// All else: strings, truth values, names.
    words: Vec<&'a str>,
}

struct Node<'a> {
    kind: &'a str,
    line: usize,
    fields: Vec<(&'a str, Value<'a>)>,
}

impl<'a> Node<'a> {
    fn field(&self, name: &str) -> Option<&Value<'a>> {
        self.fields.iter().find(|(field, _)| *field == name).map(|(_, value)| value)
    }
}

struct Parser<'a> {
    path: &'a Path,
    words: Words<'a>,
    nodes: Vec<Node<'a>>,
    /// The node that a name stands for: known when it has ended, so that none can hold itself.
    names: HashMap<&'a str, usize>,
}

impl<'a> Parser<'a> {
    fn bad(&self, expected: &str, found: &str) -> Error {
        let found = found.chars().take(40).collect::<String>().replace('\n', " ");
        Error::field(self.path, format!("line {}", self.words.line), expected, format!("\"{found}\""))
    }

    fn next(&mut self, expected: &str) -> Result<&'a str> {
        self.words.next().ok_or_else(|| self.bad(expected, "the end of the file"))
    }

    fn peek(&self) -> Option<&'a str> {
        self.words.clone().next()
    }

    /// A number, a word or a node that begins with this word.
    fn item(&mut self, word: &'a str, depth: usize, value: &mut Value<'a>) -> Result<()> {
        match word {
            "{" | "}" | "[" | "]" => return Err(self.bad("a value", word)),
            "PROTO" | "EXTERNPROTO" => return Err(self.bad("no prototypes", word)),
            "DEF" => {
                let name = self.next("a name")?;
                let kind = self.next("a node")?;
                let node = self.node(kind, depth)?;
                self.names.insert(name, node);
                value.nodes.push(node);
            }
            "USE" => {
                let name = self.next("a name")?;
                let node = self.names.get(name).ok_or_else(|| self.bad("the name of a node above", name))?;
                value.nodes.push(*node);
            }
            "NULL" => {}
            _ => match word.parse::<f64>() {
                Ok(number) if number.is_finite() => value.numbers.push(number),
                Ok(_) => return Err(self.bad("finite numbers", word)),
                Err(_) if self.peek() == Some("{") => value.nodes.push(self.node(word, depth)?),
                Err(_) => value.words.push(word),
            },
        }
        Ok(())
    }

    fn node(&mut self, kind: &'a str, depth: usize) -> Result<usize> {
        if depth > DEEPEST {
            return Err(self.bad(&format!("at most {DEEPEST} nodes inside each other"), kind));
        }
        let line = self.words.line;
        let open = self.next("{")?;
        if open != "{" {
            return Err(self.bad("{", open));
        }
        let mut fields = vec![];
        loop {
            let name = self.next("}")?;
            match name {
                "}" => break,
                "{" | "[" | "]" | "PROTO" | "EXTERNPROTO" => return Err(self.bad("a field", name)),
                _ => fields.push((name, self.value(depth + 1)?)),
            }
        }
        self.nodes.push(Node { kind, line, fields });
        Ok(self.nodes.len() - 1)
    }

    /// What follows the name of a field. Where nothing does, as for the fields of scripts, the value is empty.
    fn value(&mut self, depth: usize) -> Result<Value<'a>> {
        let mut value = Value::default();
        let is_plain = |word: &str| word.starts_with(['"', '+', '-', '.']) || word.starts_with(|c: char| c.is_ascii_digit());
        let is_plain = |word: &str| is_plain(word) || ["TRUE", "FALSE", "NULL"].contains(&word);
        let mut ahead = self.words.clone();
        match ahead.next() {
            Some("[") => {
                self.words = ahead;
                loop {
                    match self.next("]")? {
                        "]" => break,
                        word => self.item(word, depth, &mut value)?,
                    }
                }
            }
            Some(word) if ["DEF", "USE"].contains(&word) || ahead.next() == Some("{") => {
                let word = self.next("a node")?;
                self.item(word, depth, &mut value)?;
            }
            _ => {
                while let Some(word) = self.peek().filter(|word| is_plain(word)) {
                    self.words.next();
                    self.item(word, depth, &mut value)?;
                }
            }
        }
        Ok(value)
    }
}

struct Scene<'a> {
    path: &'a Path,
    nodes: Vec<Node<'a>>,
}

#[derive(Default)]
struct Drawn {
    mesh: Mesh,
    /// What, and how many.
    left_out: BTreeMap<String, usize>,
}

impl Drawn {
    fn leave_out(&mut self, what: impl Into<String>, count: usize) {
        *self.left_out.entry(what.into()).or_default() += count;
    }
}

impl Scene<'_> {
    /// Draws these nodes and what they hold.
    fn place(&self, roots: &[usize], drawn: &mut Drawn) -> Result<()> {
        let mut visited = 0;
        let mut places: Vec<_> = roots.iter().rev().map(|&node| (node, Affine3A::IDENTITY)).collect();
        while let Some((id, placed)) = places.pop() {
            visited += 1;
            let node = &self.nodes[id];
            let inside = match node.kind {
                "Shape" => {
                    self.shape(node, placed, drawn)?;
                    drawn.mesh.check_size(self.path)?;
                    continue;
                }
                "Switch" => {
                    let choice = self.numbers::<1>(node, "whichChoice")?.first().map_or(-1.0, |choice| choice[0]);
                    let choices = node.field("choice").map_or(&[][..], |value| &value.nodes);
                    if choice < 0.0 { &[] } else { choices.get(choice as usize).map_or(&[][..], std::slice::from_ref) }
                }
                "LOD" => node.field("level").and_then(|value| value.nodes.get(..1)).unwrap_or_default(),
                _ => node.field("children").map_or(&[][..], |value| &value.nodes),
            };
            if visited + places.len() + inside.len() > MOST_PLACES {
                let found = format!("more, from line {} on", node.line);
                return Err(Error::field(self.path, "nodes", format!("at most {MOST_PLACES} with those used again"), found));
            }
            let placed = if node.kind == "Transform" { placed * self.transform(node)? } else { placed };
            places.extend(inside.iter().rev().map(|&node| (node, placed)));
            if node.kind == "Inline" {
                drawn.leave_out("Inline (scenes in other files)", 1);
            }
        }
        Ok(())
    }

    /// The vectors of a field; none where there is no such field.
    fn numbers<const N: usize>(&self, node: &Node, name: &str) -> Result<Vec<[f32; N]>> {
        let Some(value) = node.field(name) else { return Ok(vec![]) };
        let rows = value.numbers.chunks_exact(N);
        if let ([], [], []) = (&value.words[..], &value.nodes[..], rows.remainder()) {
            return Ok(rows.map(|row| std::array::from_fn(|k| row[k] as f32)).collect());
        }
        let (place, count) = (format!("line {}: {}: {name}", node.line, node.kind), value.numbers.len());
        let found = value.words.first().map_or(format!("{count} numbers"), |word| word.replace('\n', " "));
        Err(Error::field(self.path, place, format!("numbers, {N} at a time"), found))
    }

    fn transform(&self, node: &Node) -> Result<Affine3A> {
        let vector = |name: &str, usual: Vec3| -> Result<Vec3> {
            Ok(self.numbers(node, name)?.first().map_or(usual, |&vector| Vec3::from_array(vector)))
        };
        let turn = |name: &str| -> Result<Affine3A> {
            let [x, y, z, angle] = self.numbers(node, name)?.first().copied().unwrap_or([0.0, 0.0, 1.0, 0.0]);
            let axis = Vec3::new(x, y, z).try_normalize();
            Ok(axis.map_or(Affine3A::IDENTITY, |axis| Affine3A::from_quat(Quat::from_axis_angle(axis, angle))))
        };
        let shift = Affine3A::from_translation;
        let (centre, scaled_along) = (vector("center", Vec3::ZERO)?, turn("scaleOrientation")?);
        let scale = scaled_along * Affine3A::from_scale(vector("scale", Vec3::ONE)?) * scaled_along.inverse();
        Ok(shift(vector("translation", Vec3::ZERO)? + centre) * turn("rotation")? * scale * shift(-centre))
    }

    fn shape(&self, shape: &Node, placed: Affine3A, drawn: &mut Drawn) -> Result<()> {
        let held = |node: &Node, name: &str| node.field(name).and_then(|value| value.nodes.first()).map(|&id| &self.nodes[id]);
        let Some(faces) = held(shape, "geometry") else { return Ok(()) };
        if faces.kind != "IndexedFaceSet" {
            drawn.leave_out(format!("{} (only IndexedFaceSet is drawn)", faces.kind.escape_debug()), 1);
            return Ok(());
        }
        let appearance = held(shape, "appearance");
        if appearance.is_some_and(|appearance| held(appearance, "texture").is_some()) {
            drawn.leave_out("textures", 1);
        }
        let material = appearance.and_then(|appearance| held(appearance, "material"));
        let material = material.map(|material| self.numbers(material, "diffuseColor")).transpose()?.unwrap_or_default();
        let plain = material.first().copied().unwrap_or(PLAIN);
        let points: Vec<[f32; 3]> =
            held(faces, "coord").map(|coord| self.numbers(coord, "point")).transpose()?.unwrap_or_default();
        let colours: Vec<[f32; 3]> =
            held(faces, "color").map(|color| self.numbers(color, "color")).transpose()?.unwrap_or_default();
        let indices = self.numbers::<1>(faces, "coordIndex")?;
        let colour_indices = self.numbers::<1>(faces, "colorIndex")?;
        let by_face = faces.field("colorPerVertex").is_some_and(|value| value.words == ["FALSE"]);
        let mut start = 0;
        let mut out_of_range = 0;
        for (number, polygon) in indices.split(|[i]| *i < 0.0).enumerate().filter(|(_, polygon)| !polygon.is_empty()) {
            let corners: Option<Vec<_>> = polygon.iter().map(|[i]| points.get(*i as usize)).collect();
            let Some(corners) = corners else {
                out_of_range += 1;
                start += polygon.len() + 1;
                continue;
            };
            let corners: Vec<_> = corners.into_iter().map(|&p| placed.transform_point3(Vec3::from_array(p))).collect();
            let colour = |k: usize| {
                let [at, itself] = if by_face { [number, number] } else { [start + k, polygon[k][0] as usize] };
                let index = colour_indices.get(at).map_or(itself, |[i]| *i as usize);
                Vec3::from_array(colours.get(index).copied().unwrap_or(plain)).clamp(Vec3::ZERO, Vec3::ONE)
            };
            for triangle in triangles_of(&corners) {
                let before = drawn.mesh.vertices.len();
                drawn.mesh.push_flat(triangle.map(|i| corners[i]), Vec3::ONE);
                drawn.mesh.vertices[before..].iter_mut().zip(triangle).for_each(|(vertex, i)| vertex.colour = colour(i));
            }
            start += polygon.len() + 1;
        }
        if out_of_range > 0 {
            drawn.leave_out("faces (indices out of range)", out_of_range);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A red square, moved, and a green one that uses its corners.
    const SQUARES: &str = "#VRML V2.0 utf8\nWorldInfo { title \"two {\\\"squares\\\" # not a comment\" info [\"a\", \"b\"] }\n\
        DEF PLACED Transform { translation 0 0 5 rotation 0 0 1 1.5707963 scale 2 2 2 # moved\n\
        children [\nShape { appearance Appearance { material DEF RED Material { diffuseColor 1 0 0 transparency 0 } }\n\
        geometry IndexedFaceSet\n{ coord DEF POINTS Coordinate { point [0 0 0,1 0 0,1 1 0,0 1 0] } coordIndex [0,1,2,3,-1] solid FALSE }\n\
        } ] }\n\
        Shape{geometry IndexedFaceSet{coordIndex[0 1 2 3]coord USE POINTS color Color{color[0 1 0]}colorPerVertex FALSE}}\n";

    fn loaded(text: &str) -> Result<Mesh> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("mesh.wrl"), text).unwrap();
        load(&dir.path().join("mesh.wrl"))
    }

    #[test]
    fn places_colours_and_nodes_used_again() {
        let mesh = loaded(SQUARES).unwrap();
        assert!(mesh.warnings.is_empty(), "{:?}", mesh.warnings);
        let near = |i: usize, x: f32, y: f32, z: f32| mesh.vertices[i].position.abs_diff_eq(Vec3::new(x, y, z), 1e-5);
        // A quarter turn about z takes x to y.
        assert!(near(0, 0.0, 0.0, 5.0) && near(1, 0.0, 2.0, 5.0) && near(2, -2.0, 2.0, 5.0), "{:?}", mesh.vertices);
        assert!(mesh.vertices[..6].iter().all(|v| v.colour == Vec3::X && v.normal.abs_diff_eq(Vec3::Z, 1e-6)));
        assert!(near(7, 1.0, 0.0, 0.0) && mesh.vertices[6..].iter().all(|v| v.colour == Vec3::Y));
        // A whole group used again; colours at corners, by indices of their own and without.
        let again = format!("{SQUARES}Group {{ children [ USE PLACED, USE PLACED ] }}\nROUTE A.b TO C.d\n");
        assert_eq!(loaded(&again).unwrap().vertices.len(), 24);
        let corners = SQUARES.replace("color[0 1 0]}colorPerVertex FALSE", "color[0 0 0 0 0 1 0 1 1 1 1 1]}");
        assert_eq!(loaded(&corners).unwrap().vertices[7].colour, Vec3::Z);
        let indexed = corners.replace("1 1 1 1 1]}", "1 1 1 1 1]} colorIndex [3 2 1 0]");
        assert_eq!(loaded(&indexed).unwrap().vertices[7].colour, Vec3::new(0.0, 1.0, 1.0));
        // About another centre, along other axes.
        let scaled = SQUARES
            .replace("rotation 0 0 1 1.5707963", "center 1 1 0 scaleOrientation 0 0 1 0.7853982")
            .replace("2 2 2", "3 1 1");
        let mesh = loaded(&scaled).unwrap();
        assert!(mesh.vertices[0].position.abs_diff_eq(Vec3::new(-2.0, -2.0, 5.0), 1e-5), "{}", mesh.vertices[0].position);
        assert!(mesh.vertices[1].position.abs_diff_eq(Vec3::new(0.0, -1.0, 5.0), 1e-5), "{}", mesh.vertices[1].position);
    }

    #[test]
    fn choices_and_levels() {
        let inner = SQUARES.split_once("DEF PLACED").unwrap().1;
        let (first, second) = inner.split_once("Shape{").unwrap();
        let text = |head: &str| format!("#VRML V2.0 utf8\n{head} [ DEF PLACED {first} Shape{{{second} ] }}\n");
        for (head, triangles) in [
            ("Switch { whichChoice 1 choice", 2),
            ("Switch { whichChoice 0 choice", 2),
            ("LOD { level", 2),
            ("Anchor { url \"x\" children", 4),
        ] {
            assert_eq!(loaded(&text(head)).unwrap().vertices.len(), 3 * triangles, "{head}");
        }
        assert!(loaded(&text("Switch { choice")).is_err(), "nothing is chosen");
    }

    #[test]
    fn what_is_left_out_is_counted() {
        let more = "Shape { geometry Box { size 1 1 1 } }\nShape { geometry Box {} }\nInline { url \"other.wrl\" }\n\
            Shape { appearance Appearance { texture ImageTexture { url \"a.png\" } } geometry IndexedFaceSet { \
            coord Coordinate { point [ 0 0 0 1 0 0 0 1 0 ] } coordIndex [ 0 1 2 -1 0 1 3 -1 ] } }\n\
            Script { eventIn SFTime now field SFColor c 0 0 1 url \"javascript: { }\" }";
        let mesh = loaded(&format!("{SQUARES}{more}")).unwrap();
        assert_eq!(mesh.vertices.len(), 15);
        let expected = [
            "2 Box (only IndexedFaceSet is drawn) left out",
            "1 Inline (scenes in other files) left out",
            "1 faces (indices out of range) left out",
            "1 textures left out",
        ];
        assert_eq!(mesh.warnings, expected);
    }

    #[test]
    fn bad_files_are_named_with_the_line() {
        let cases = [
            ("#VRML V2.0 utf8", "#VRML V1.0 ascii", "line 1: expected #VRML V2.0"),
            ("USE POINTS", "USE NOTHING", "line 9: expected the name of a node above, found \"NOTHING\""),
            ("1 0 0,1 1 0", "1 0 0,1 1", "line 7: Coordinate: point: expected numbers, 3 at a time"),
            ("1 0 0,1 1 0", "1 0 0,nan 1 0", "line 7: expected finite numbers"),
            ("1 0 0,1 1 0", "1 0 0,1..5 1 0", "1..5"),
            ("} ] }", "} ", "the end of the file"),
            ("] solid", "solid", "line 7"),
            ("WorldInfo", "PROTO WorldInfo", "no prototypes"),
            ("WorldInfo {", "}", "line 2: expected a value"),
            ("children", "PROTO", "line 4: expected a field"),
            ("coordIndex [0,1,2,3,-1]", "coordIndex [0,1,2,4000000000,-1]", ""),
        ];
        for (from, to, words) in cases {
            let text = SQUARES.replacen(from, to, 1);
            assert_ne!(text, SQUARES);
            match loaded(&text) {
                Ok(mesh) => assert_eq!((words, mesh.vertices.len(), mesh.warnings.len()), ("", 6, 1), "{to}"),
                Err(error) => {
                    let error = error.to_string();
                    let good = !words.is_empty() && error.contains("mesh.wrl") && error.contains(words) && !error.contains('\n');
                    assert!(good, "{to}: {error}");
                }
            }
        }
        assert!(loaded("").unwrap_err().to_string().contains("line 1"));
        assert!(loaded("#VRML V2.0 utf8\n").unwrap_err().to_string().contains("faces"));
    }

    #[test]
    fn deep_and_self_multiplying_files_are_refused() {
        let deep = format!("#VRML V2.0 utf8\n{}", "Group { children [ ".repeat(100_000));
        assert!(loaded(&deep).unwrap_err().to_string().contains("inside each other"));
        // Each holds the one before twice: 2^60 squares. Without any, it would only take for ever.
        for first in ["DEF A0 Group {}\n", "DEF A0 Transform { children [ USE PLACED ] }\n"] {
            let doubled = |i: usize| format!("DEF A{} Group {{ children [ USE A{i} USE A{i} ] }}\n", i + 1);
            let text = SQUARES.to_owned() + first + &(0..60).map(doubled).collect::<String>();
            let error = loaded(&text).unwrap_err().to_string();
            assert!(error.contains("at most"), "{error}");
        }
        // As deep as this, but not written so.
        let deep = |i: usize| format!("DEF A{} Group {{ children USE A{i} }}\n", i + 1);
        let text = format!("#VRML V2.0 utf8\nDEF A0 Group {{}}\n{}", (0..20_000).map(deep).collect::<String>());
        assert!(loaded(&text).unwrap_err().to_string().contains("at most"), "20000 nodes that hold each other are 2e8 places");
        assert_eq!(
            loaded(&SQUARES.replace("[0 1 2 3]", &format!("[0 1 2 3 -1 {}]", "0 ".repeat(100_000)))).unwrap().vertices.len(),
            12
        );
    }
}
