//! What is said of pictures that are searched for: by flags, or line by line on stdin.

use std::path::{Path, PathBuf};

use glam::DMat4;
use serde::Deserialize;
use sigma_srn::Model;
use sigma_srn::photo::{BoundingBox, Known};
use srn_data::srn::rigid;
use srn_data::target::Cutout;

use super::files::{Bounds, CameraArgs, Masks, Picture, path_of};
use super::notation::Notation;
use crate::common::Result;

/// A picture and what is said of it.
#[derive(Clone, Debug, Default)]
pub struct Given {
    /// Its file.
    pub image: PathBuf,
    /// The object in it.
    pub instance: Option<String>,
    /// What of it is the object: a file, or a folder with one that is called like the picture.
    pub cutout: Option<PathBuf>,
    /// A box around the object instead, or that there is none.
    pub bounds: Option<Bounds>,
    /// What counts; like `cutout`.
    pub mask: Option<PathBuf>,
    /// Roughly known pose, and the true one, `world_from_camera`.
    pub rough: Option<DMat4>,
    pub truth: Option<DMat4>,
}

/// A line of JSON on stdin.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    image: PathBuf,
    instance: Option<String>,
    cutout: Option<PathBuf>,
    #[serde(rename = "box")]
    bounds: Option<BoxLine>,
    mask: Option<PathBuf>,
    /// Rows.
    rough: Option<[[f64; 4]; 4]>,
}

/// A box in such a line: four numbers, or `auto`.
#[derive(Deserialize)]
#[serde(untagged, expecting = "box: expected four numbers, or \"auto\"")]
enum BoxLine {
    Box([f64; 4]),
    Word(Auto),
}

#[derive(Deserialize)]
enum Auto {
    #[serde(rename = "auto")]
    Auto,
}

impl Given {
    /// A line of stdin: JSON, or the path of a picture alone.
    pub fn parse(line: &[u8], notation: &Notation) -> Result<Self> {
        if !line.starts_with(b"{") {
            return Ok(Given { image: path_of(line), ..Given::default() });
        }
        let Line { image, instance, cutout, bounds, mask, rough } = serde_json::from_slice(line)?;
        if bounds.is_some() && cutout.is_some() {
            return Err("of `box` and `cutout` a picture has one".into());
        }
        let bounds = match bounds {
            Some(BoxLine::Box([_, _, width, height])) if width <= 0.0 || height <= 0.0 => {
                return Err(format!("box: expected a width and a height above 0, found {width}, {height}").into());
            }
            Some(BoxLine::Box([x, y, width, height])) => Some(Bounds::Box(BoundingBox { corner: [x, y], size: [width, height] })),
            Some(BoxLine::Word(Auto::Auto)) => Some(Bounds::Anywhere),
            None => None,
        };
        let pose = |rows: [[f64; 4]; 4]| rigid(Path::new("stdin"), "rough", DMat4::from_cols_array_2d(&rows).transpose());
        let rough = rough.map(pose).transpose()?.map(|pose| notation.ours(pose));
        Ok(Given { image, instance, cutout, bounds, mask, rough, truth: None })
    }

    /// Opens the picture; if it has a box, with what is `known` of the object in it; whole, where nobody knows where in it the object is. `instance`: the object where it names none.
    pub fn open(&self, model: &Model, side: u32, instance: Option<&str>, camera: &CameraArgs, known: Known) -> Result<Picture> {
        let bounds = self.bounds.and_then(|bounds| if let Bounds::Box(bounds) = bounds { Some(bounds) } else { None });
        let cutout = self.cutout.as_deref().map(Cutout::Mask).or(bounds.map(|bounds| Cutout::Box(bounds, known)));
        let masks = Masks { cutout, mask: self.mask.as_deref() };
        let picture = Picture::open(&self.image, masks, model, side, self.instance.as_deref().or(instance), camera)?;
        Ok(Picture { truth: self.truth, ..picture })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_paths_or_json() {
        let parse = |line: &str| Given::parse(line.as_bytes(), &Notation::default()).map_err(|error| error.to_string());
        assert_eq!(parse("a b.png").unwrap().image, PathBuf::from("a b.png"));
        let rough = "[[0,-1,0,1],[1,0,0,2],[0,0,1,3],[0,0,0,1]]";
        let line = format!(r#"{{"image": "a.png", "instance": "seat", "box": [1, 2.5, 3, 4], "mask": "m", "rough": {rough}}}"#);
        let given = parse(&line).unwrap();
        assert_eq!((given.instance.as_deref(), given.mask), (Some("seat"), Some("m".into())));
        assert_eq!(given.bounds, Some(Bounds::Box(BoundingBox { corner: [1.0, 2.5], size: [3.0, 4.0] })));
        assert_eq!(parse(r#"{"image": "a.png", "box": "auto"}"#).unwrap().bounds, Some(Bounds::Anywhere));
        assert_eq!(given.rough.unwrap().w_axis.truncate().to_array(), [1.0, 2.0, 3.0]);
        assert_eq!(given.rough.unwrap().x_axis.truncate().to_array(), [0.0, 1.0, 0.0]);
        for (line, said) in [
            (r#"{"image": "a.png", "bbox": [1, 2, 3, 4]}"#, "bbox"),
            (r#"{"box": [1, 2, 3, 4]}"#, "image"),
            (r#"{"image": "a.png", "box": [1, 2, 3]}"#, "four"),
            (r#"{"image": "a.png", "box": "there"}"#, "auto"),
            (r#"{"image": "a.png", "box": [1, 2, 3, 0]}"#, "above 0"),
            (r#"{"image": "a.png", "box": [1, 2, 3, 4], "cutout": "c.png"}"#, "`cutout`"),
            (r#"{"image": "a.png", "rough": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#, "rough"),
            (r#"{"image": "a.png""#, "EOF"),
        ] {
            let error = parse(line).unwrap_err();
            assert!(error.contains(said), "{line}: {error}");
        }
    }
}
