//! LDraw parts (`.dat`): bricks described as text, each built of sub-files.
//!
//! A line of type 1 places a sub-file, 3 is a triangle, 4 a quadrilateral; others carry no surface. Colour 16 inherits from
//! the file above, 24 is its edge colour. The y axis points down.

use crate::error::{Error, Result, read_bytes};
use crate::mesh::{Mesh, Part};
use glam::{Affine3A, Mat3, Vec3};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::rc::Rc;

/// LDraw colour codes for parts that leave their main colour open: strong opaque colours that stand out from a white
/// background and from one another. Names as in `LDConfig.ldr`.
pub const MAIN_COLOURS: [(u32, &str); 10] = [
    (1, "Blue"),
    (2, "Green"),
    (3, "Dark_Turquoise"),
    (4, "Red"),
    (14, "Yellow"),
    (22, "Purple"),
    (25, "Orange"),
    (26, "Magenta"),
    (27, "Lime"),
    (70, "Reddish_Brown"),
];

/// No part places more sub-files, those of its sub-files included; real ones place some thousand.
const MOST_FILES: usize = 1 << 17;

/// A surface colour and the colour of its edges, RGB in [0, 1].
type Pair = [Vec3; 2];

/// A folder of LDraw files: `parts/`, `p/` and `LDConfig.ldr`.
#[derive(Debug, Clone)]
pub struct Library {
    root: PathBuf,
    colours: HashMap<u32, Pair>,
}

impl Library {
    /// Opens the library that a part's path lies in: the folder above `parts/` or `p/`.
    pub fn of_part(part: &Path) -> Result<Self> {
        let root = part.ancestors().find(|folder| folder.join("LDConfig.ldr").is_file());
        let why = || "an LDraw part lies in parts/ of a library, beside p/ and LDConfig.ldr".into();
        let root = root.ok_or_else(|| Error::Missing { path: part.with_file_name("LDConfig.ldr"), why: why() })?;
        let path = root.join("LDConfig.ldr");
        let text = String::from_utf8_lossy(&read_bytes(&path)?).into_owned();
        Ok(Self { root: root.into(), colours: text.lines().filter_map(colour_definition).collect() })
    }

    /// Reads a part. `main_colour` is an LDraw colour code for the surfaces that inherit; by default one of
    /// [`MAIN_COLOURS`], by a hash of the part's name.
    pub fn load(&self, part: &Path, main_colour: Option<u32>) -> Result<Mesh> {
        let name = part.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let code = main_colour.unwrap_or(MAIN_COLOURS[name_hash(&name) as usize % MAIN_COLOURS.len()].0);
        let colour = self.colours.get(&code).copied();
        let colour =
            colour.ok_or_else(|| Error::field(&self.root.join("LDConfig.ldr"), "!COLOUR", format!("code {code}"), "none"))?;
        let mut reader = Reader { library: self, mesh: Mesh::default(), placed: 0, known: HashMap::new() };
        reader.append(&File::read(part.into())?, Affine3A::IDENTITY, colour, 0)?;
        let mut mesh = reader.mesh;
        mesh.parts = vec![Part { vertices: 0..mesh.vertices.len(), texture: None }];
        mesh.with_faces(part)
    }

    fn resolve(&self, code: &str, inherited: Pair) -> Option<Pair> {
        match code {
            "16" => Some(inherited),
            "24" => Some([inherited[1]; 2]),
            _ => match code.strip_prefix("0x2") {
                Some(hex) => hex_colour(hex).map(|rgb| [rgb; 2]),
                None => self.colours.get(&code.parse().ok()?).copied(),
            },
        }
    }
}

/// A file as it was read.
struct File {
    path: PathBuf,
    text: String,
}

impl File {
    fn read(path: PathBuf) -> Result<Self> {
        let text = String::from_utf8_lossy(&read_bytes(&path)?).into_owned();
        Ok(File { path, text })
    }
}

/// A part while it is read.
struct Reader<'a> {
    library: &'a Library,
    mesh: Mesh,
    /// Sub-files placed so far.
    placed: usize,
    /// Those read so far, by name: the same stud is placed a hundred times.
    known: HashMap<String, Rc<File>>,
}

impl Reader<'_> {
    fn append(&mut self, File { path, text }: &File, placed: Affine3A, colour: Pair, depth: usize) -> Result<()> {
        // Files that hold each other twice, and so on, would take for ever.
        self.placed += 1;
        if self.placed > MOST_FILES {
            return Err(Error::field(path, "sub-files", format!("at most {MOST_FILES}"), "more"));
        }
        self.mesh.check_size(path)?;
        for (number, line) in text.lines().enumerate() {
            let words: Vec<_> = line.split_whitespace().collect();
            let bad = |expected| Error::field(path, format!("line {}", number + 1), expected, format!("\"{line}\""));
            let floats = |n: usize| -> Result<Vec<f32>> {
                let numbers = words.get(2..2 + n).ok_or_else(|| bad("more numbers"))?;
                let number = |word: &&str| word.parse().ok().filter(|x: &f32| x.is_finite());
                numbers.iter().map(number).collect::<Option<_>>().ok_or_else(|| bad("numbers"))
            };
            let kind = words.first().copied().unwrap_or_default();
            if !["1", "3", "4"].contains(&kind) {
                continue;
            }
            let code = words.get(1).copied().unwrap_or_default();
            let own = self.library.resolve(code, colour).ok_or_else(|| bad("a known colour"))?;
            if kind == "1" {
                let m = floats(12)?;
                let rows = Mat3::from_cols_slice(&m[3..]).transpose();
                let here = Affine3A::from_mat3_translation(rows, Vec3::from_slice(&m));
                let name = words.get(14..).ok_or_else(|| bad("a file name"))?.join(" ").to_lowercase().replace('\\', "/");
                // No part nests deeper than about ten files; a file that contains itself would nest for ever.
                if depth > 50 {
                    return Err(bad("at most 50 nested files"));
                }
                let file = self.sub_file(name, path)?;
                self.append(&file, placed * here, own, depth + 1)?;
            } else {
                let n = if kind == "3" { 3 } else { 4 };
                let values = floats(3 * n)?;
                let corner = |i: usize| placed.transform_point3(Vec3::from_slice(&values[3 * i..]));
                self.mesh.push_flat([0, 1, 2].map(corner), own[0]);
                if n == 4 {
                    self.mesh.push_flat([0, 2, 3].map(corner), own[0]);
                }
            }
        }
        Ok(())
    }

    /// The sub-file of this name, which the file `above` places.
    fn sub_file(&mut self, name: String, above: &Path) -> Result<Rc<File>> {
        if let Some(file) = self.known.get(&name) {
            return Ok(file.clone());
        }
        let candidates = ["parts", "p"].map(|folder| self.library.root.join(folder).join(&name));
        let path = candidates.into_iter().find(|path| path.is_file()).ok_or_else(|| Error::Missing {
            path: self.library.root.join("parts").join(&name),
            why: format!("{} needs it", above.display()),
        })?;
        let file = Rc::new(File::read(path)?);
        self.known.insert(name, file.clone());
        Ok(file)
    }
}

/// `0 !COLOUR Blue CODE 1 VALUE #0055BF EDGE #333333 …`; the edge may be another colour's code, then it is left black.
fn colour_definition(line: &str) -> Option<(u32, Pair)> {
    let words: Vec<_> = line.split_whitespace().collect();
    let after = |key: &str| words.iter().position(|&word| word == key).and_then(|i| words.get(i + 1).copied());
    let colour = |key: &str| after(key)?.strip_prefix('#').and_then(hex_colour);
    (words.get(1) == Some(&"!COLOUR")).then_some(())?;
    Some((after("CODE")?.parse().ok()?, [colour("VALUE")?, colour("EDGE").unwrap_or_default()]))
}

fn hex_colour(hex: &str) -> Option<Vec3> {
    let rgb = u32::from_str_radix(hex, 16).ok().filter(|_| hex.len() == 6)?;
    Some(Vec3::from_array([16, 8, 0].map(|shift| (rgb >> shift & 255) as f32 / 255.0)))
}

/// FNV-1a: the same in every version of Rust and on every machine, unlike the standard hasher.
pub fn name_hash(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::write;

    const CONFIG: &str = "0 !COLOUR Red CODE 4 VALUE #FF0000 EDGE #330000\n0 !COLOUR Blue CODE 1 VALUE #0000FF EDGE #000033\n";
    const RED: Vec3 = Vec3::new(1., 0., 0.);
    const DARK_RED: Vec3 = Vec3::new(0.2, 0., 0.);
    const BLUE: Vec3 = Vec3::new(0., 0., 1.);
    const DARK_BLUE: Vec3 = Vec3::new(0., 0., 0.2);

    /// A library with the given part, and a sub-file with a surface that inherits, one of the edge colour and a red one.
    fn load(part: &str, main_colour: u32) -> Result<Mesh> {
        let dir = tempfile::tempdir().unwrap();
        for folder in ["parts/s", "p"] {
            std::fs::create_dir_all(dir.path().join(folder)).unwrap();
        }
        write(dir.path().join("LDConfig.ldr"), CONFIG).unwrap();
        write(dir.path().join("parts/s/sub.dat"), "3 16 0 0 0 1 0 0 0 1 0\n3 24 0 0 0 1 0 0 0 1 0\n3 4 0 0 0 1 0 0 0 1 0\n")
            .unwrap();
        write(dir.path().join("p/loop.dat"), "1 16 0 0 0 1 0 0 0 1 0 0 0 1 loop.dat\n").unwrap();
        let path = dir.path().join("parts/part.dat");
        write(&path, part).unwrap();
        Library::of_part(&path)?.load(&path, Some(main_colour))
    }

    fn colours(part: &str, main_colour: u32) -> Vec<Vec3> {
        load(part, main_colour).unwrap().vertices.chunks(3).map(|corners| corners[0].colour).collect()
    }

    #[test]
    fn colours_are_inherited_through_files() {
        let place = |colour: &str| format!("0 A part\n1 {colour} 0 0 0 1 0 0 0 1 0 0 0 1 S\\SUB.DAT\n");
        assert_eq!(colours(&place("16"), 1), [BLUE, DARK_BLUE, RED], "the main colour reaches the sub-file");
        assert_eq!(colours(&place("4"), 1), [RED, DARK_RED, RED], "the placing line's colour wins over the main one");
        assert_eq!(colours(&place("24"), 1), [DARK_BLUE, DARK_BLUE, RED], "the edge colour of the main one");
        assert_eq!(colours("3 0x20000FF 0 0 0 1 0 0 0 1 0", 4), [BLUE], "a direct colour");
        assert_eq!(colours("4 16 0 0 0 1 0 0 1 1 0 0 1 0\n2 24 0 0 0 1 1 1\n5 24 0 0 0 1 1 1 2 2 2 3 3 3", 4), [RED, RED]);
    }

    #[test]
    fn sub_files_are_placed_by_rows() {
        // x' = 10 + 2·y, y' = 20 + 3·z, z' = 30 + 4·x
        let mesh = load("1 16 10 20 30 0 2 0 0 0 3 4 0 0 s/sub.dat", 4).unwrap();
        let corners = [0, 1, 2].map(|i| mesh.vertices[i].position.to_array());
        assert_eq!(corners, [[10., 20., 30.], [10., 20., 34.], [12., 20., 30.]]);
    }

    #[test]
    fn bad_parts_are_named() {
        let cases = [
            ("1 16 0 0 0 1 0 0 0 1 0 0 0 1 none.dat", "none.dat"),
            ("1 16 0 0 0 1 0 0 0 1 0 0 0 1 loop.dat", "nested"),
            ("3 16 0 0 0 1 0 0 0 1", "line 1"),
            ("3 16 0 0 0 1 0 0 0 1 x", "line 1"),
            ("0 fine\n3 99 0 0 0 1 0 0 0 1 0", "line 2"),
            ("0 nothing here", "faces"),
        ];
        for (part, word) in cases {
            let error = load(part, 4).unwrap_err().to_string();
            assert!(error.contains(word), "{part}: {error}");
        }
        assert!(load("3 16 0 0 0 1 0 0 0 1 0", 77).unwrap_err().to_string().contains("77"));
        let error = Library::of_part(Path::new("/parts/3001.dat")).unwrap_err().to_string();
        assert!(error.contains("LDConfig.ldr"), "{error}");
    }

    #[test]
    fn files_that_multiply_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(dir.path().join("parts")).unwrap();
        write(dir.path().join("LDConfig.ldr"), CONFIG).unwrap();
        let path = |i: usize| dir.path().join(format!("parts/a{i}.dat"));
        for i in 0..40 {
            let line = format!("1 16 0 0 0 1 0 0 0 1 0 0 0 1 a{}.dat\n", i + 1);
            write(path(i), line.repeat(2)).unwrap();
        }
        write(path(40), "3 16 0 0 0 1 0 0 0 1 0\n").unwrap();
        let load = |i: usize| Library::of_part(&path(i)).unwrap().load(&path(i), Some(4));
        assert_eq!(load(36).unwrap().vertices.len(), 3 << 4);
        let error = load(0).unwrap_err().to_string();
        assert!(error.contains("sub-files: expected at most"), "{error}");
    }

    #[test]
    fn the_name_decides_the_colour_for_ever() {
        // Published values of FNV-1a, 64 bits.
        assert_eq!(name_hash(""), 0xcbf29ce484222325);
        assert_eq!(name_hash("foobar"), 0x85944171f73967e8);
    }
}
