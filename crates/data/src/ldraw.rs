//! LDraw parts (`.dat`): bricks described as text, each built of sub-files.
//!
//! A line of type 1 places a sub-file, 3 is a triangle, 4 a quadrilateral; others carry no surface. Colour 16 inherits from
//! the file above, 24 is its edge colour. The y axis points down.

use crate::error::{At, Error, Result};
use crate::mesh::{Mesh, Part};
use glam::{Affine3A, Mat3, Vec3};
use std::collections::HashMap;
use std::path::{Path, PathBuf};

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
        let text = String::from_utf8_lossy(&std::fs::read(&path).at(&path)?).into_owned();
        Ok(Self { root: root.into(), colours: text.lines().filter_map(colour_definition).collect() })
    }

    /// Reads a part. `main_colour` is an LDraw colour code for the surfaces that inherit; by default one of
    /// [`MAIN_COLOURS`], by a hash of the part's name.
    pub fn load(&self, part: &Path, main_colour: Option<u32>) -> Result<Mesh> {
        let name = part.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let code = main_colour.unwrap_or(MAIN_COLOURS[name_hash(&name) as usize % MAIN_COLOURS.len()].0);
        let mut mesh = Mesh::default();
        let colour = self.colours.get(&code).copied();
        let colour =
            colour.ok_or_else(|| Error::field(&self.root.join("LDConfig.ldr"), "!COLOUR", format!("code {code}"), "none"))?;
        self.append(&mut mesh, part, Affine3A::IDENTITY, colour, 0)?;
        if mesh.vertices.is_empty() {
            return Err(Error::field(part, "surfaces", "at least one triangle", "none"));
        }
        mesh.parts = vec![Part { vertices: 0..mesh.vertices.len(), texture: None }];
        Ok(mesh)
    }

    fn append(&self, mesh: &mut Mesh, path: &Path, placed: Affine3A, colour: Pair, depth: usize) -> Result<()> {
        let text = String::from_utf8_lossy(&std::fs::read(path).at(path)?).into_owned();
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
            let own = self.resolve(words.get(1).copied().unwrap_or_default(), colour).ok_or_else(|| bad("a known colour"))?;
            if kind == "1" {
                let m = floats(12)?;
                let rows = Mat3::from_cols_slice(&m[3..]).transpose();
                let here = Affine3A::from_mat3_translation(rows, Vec3::from_slice(&m));
                let name = words.get(14..).ok_or_else(|| bad("a file name"))?.join(" ").to_lowercase().replace('\\', "/");
                let candidates = ["parts", "p"].map(|folder| self.root.join(folder).join(&name));
                let file = candidates.into_iter().find(|file| file.is_file());
                let file = file.ok_or_else(|| Error::Missing {
                    path: self.root.join("parts").join(&name),
                    why: format!("{} needs it", path.display()),
                })?;
                // No part nests deeper than about ten files; a file that contains itself would nest for ever.
                if depth > 50 {
                    return Err(bad("at most 50 nested files"));
                }
                self.append(mesh, &file, placed * here, own, depth + 1)?;
            } else {
                let n = if kind == "3" { 3 } else { 4 };
                let values = floats(3 * n)?;
                let corner = |i: usize| placed.transform_point3(Vec3::from_slice(&values[3 * i..]));
                mesh.push_flat([0, 1, 2].map(corner), own[0]);
                if n == 4 {
                    mesh.push_flat([0, 2, 3].map(corner), own[0]);
                }
            }
        }
        Ok(())
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
