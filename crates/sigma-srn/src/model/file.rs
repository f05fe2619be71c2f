//! Models and their tensors as safetensors files.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use super::layout::{BAKED, CODES, HYPER};
use super::{Metadata, Model, Source};
use crate::Error;

/// Marching steps of a file, at most: what a renderer allocates grows with them.
const MOST_STEPS: f64 = 1000.0;

/// Side of the pictures that a model takes, at most.
const MOST_SIDE: f64 = 4096.0;

/// What files of models call themselves.
const FORMAT: &str = "sigma-srn 1";

/// Named tensors of a file, with shape and values; those of other types than `F32` are left out.
pub(crate) type Tensors = HashMap<String, (Vec<usize>, Vec<f32>)>;

impl Model {
    /// Reads a safetensors file. Sizes come from the tensors, M from the metadata key `tracing_steps`.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
        Self::from_bytes(&bytes, "", path)
    }

    /// Reads a model from the bytes of a safetensors file, from the tensors whose names begin with `prefix`.
    pub fn from_bytes(bytes: &[u8], prefix: &str, path: &Path) -> Result<Self, Error> {
        let format = |what: String| Error::Format { path: path.into(), what };
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| not_safetensors(path, error))?;
        let text = header.metadata().clone().unwrap_or_default();
        let file = SafeTensors::deserialize(bytes).map_err(|error| not_safetensors(path, error))?;
        let mut tensors = Tensors::new();
        for (name, view) in file.tensors() {
            if let Some(name) = name.strip_prefix(prefix) {
                if view.dtype() == Dtype::F32 {
                    tensors.insert(name.to_string(), (view.shape().to_vec(), floats(&view)));
                } else if [CODES, HYPER, BAKED].iter().any(|part| name.starts_with(part)) {
                    let got = format!("{:?}", view.dtype());
                    return Err(Error::Tensor { name: name.into(), expected: "F32".into(), got });
                }
            }
        }
        let number = |key: &str| text.get(key).map(|value| value.parse::<f64>());
        let tracing_steps = match number("tracing_steps") {
            Some(Ok(steps)) if (1.0..=MOST_STEPS).contains(&steps) && steps.fract() == 0.0 => steps as u32,
            Some(_) => return Err(format(format!("metadata `tracing_steps` must be a whole number from 1 to {MOST_STEPS}"))),
            None => return Err(format("it is no model of this program: it has no metadata `tracing_steps`".into())),
        };
        let json = |key: &str| text.get(key).map_or("null", String::as_str);
        let wrong = |key: &str, error: serde_json::Error| format(format!("metadata `{key}`: {error}"));
        let calibration = |key: &str| serde_json::from_str(json(key)).map_err(|error| wrong(key, error));
        let instance_names: Option<Vec<String>> =
            serde_json::from_str(json("instance_names")).map_err(|error| wrong("instance_names", error))?;
        let unexplained: Option<BTreeMap<String, f64>> =
            serde_json::from_str(json("unexplained")).map_err(|error| wrong("unexplained", error))?;
        let length = |key: &str| match number(key) {
            Some(Ok(length)) if length > 0.0 && length.is_finite() => Ok(Some(length)),
            None => Ok(None),
            Some(_) => Err(format(format!("metadata `{key}` must be a positive number"))),
        };
        let side = match number("side") {
            Some(Ok(side)) if (1.0..=MOST_SIDE).contains(&side) && side.fract() == 0.0 => Some(side as u32),
            None => None,
            Some(_) => return Err(format(format!("metadata `side` must be a whole number from 1 to {MOST_SIDE}"))),
        };
        if let Some(other) = text.get("format").filter(|name| name.starts_with("sigma-srn ") && *name != FORMAT) {
            return Err(format(format!("metadata `format` is `{other}`, and this program reads `{FORMAT}`")));
        }
        let mut names: Vec<&String> = instance_names.iter().flatten().collect();
        names.sort_unstable();
        if let Some(twice) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(format(format!("metadata `instance_names`: two are called `{}`", twice[0])));
        }
        let metadata = Metadata {
            instance_names: instance_names.unwrap_or_default(),
            side,
            orbit_radius: length("orbit_radius")?,
            ray_sphere: length("ray_sphere")?,
            distances: serde_json::from_str(json("distances")).map_err(|error| wrong("distances", error))?,
            unexplained: unexplained.unwrap_or_default(),
            calibration: calibration("calibration")?,
            calibration_of_new: calibration("calibration_of_new")?,
        };
        Self::from_tensors(&tensors, tracing_steps, metadata)
    }

    /// Writes a safetensors file, by way of a temporary file beside it: a crash leaves the old one whole.
    pub fn save(&self, path: &Path) -> Result<(), Error> {
        write_tensors(path, &self.tensors(), self.metadata_text())
    }

    pub(crate) fn metadata_text(&self) -> HashMap<String, String> {
        let mut text = HashMap::from([
            ("format".to_string(), FORMAT.to_string()),
            ("tracing_steps".into(), self.layout.tracing_steps.to_string()),
            ("density".into(), self.layout.density.is_some().to_string()),
            ("hidden".into(), self.layout.features().to_string()),
            ("instances".into(), self.layout.instances.to_string()),
        ]);
        if let Source::Hypernetwork(hypernetwork) = &self.layout.source {
            text.insert("latent".into(), hypernetwork.latent.to_string());
        }
        if !self.metadata.instance_names.is_empty() {
            text.insert("instance_names".into(), serde_json::json!(self.metadata.instance_names).to_string());
        }
        if let Some(side) = self.metadata.side {
            text.insert("side".into(), side.to_string());
        }
        if let Some(radius) = self.metadata.orbit_radius {
            text.insert("orbit_radius".into(), radius.to_string());
        }
        if let Some(radius) = self.metadata.ray_sphere {
            text.insert("ray_sphere".into(), radius.to_string());
        }
        if let Some(distances) = self.metadata.distances {
            text.insert("distances".into(), serde_json::json!(distances).to_string());
        }
        if !self.metadata.unexplained.is_empty() {
            text.insert("unexplained".into(), serde_json::json!(self.metadata.unexplained).to_string());
        }
        let Metadata { calibration, calibration_of_new, .. } = &self.metadata;
        for (key, calibration) in [("calibration", calibration), ("calibration_of_new", calibration_of_new)] {
            if let Some(calibration) = calibration {
                text.insert(key.into(), serde_json::json!(calibration).to_string());
            }
        }
        text
    }
}

fn floats(view: &TensorView) -> Vec<f32> {
    view.data().chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect()
}

fn not_safetensors(path: &Path, error: SafeTensorError) -> Error {
    Error::Format { path: path.into(), what: format!("not a safetensors file: {error}") }
}

/// Writes named tensors to `path` by way of a temporary file beside it.
pub(crate) fn write_tensors(
    path: &Path,
    tensors: &[(String, Vec<usize>, &[f32])],
    metadata: HashMap<String, String>,
) -> Result<(), Error> {
    let views: Vec<(&str, TensorView)> = tensors
        .iter()
        .map(|(name, shape, values)| {
            let bytes = bytemuck::cast_slice(values);
            (name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytes).expect("a parameter fills its shape"))
        })
        .collect();
    let bytes = safetensors::serialize(views, Some(metadata)).map_err(|error| not_safetensors(path, error))?;
    write_atomically(path, &bytes)
}

/// Writes a file so that at any moment either the old or the new content is there.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    let io = |source| Error::Io { path: path.into(), source };
    // A device or a pipe would be replaced, and a folder cannot be.
    if std::fs::metadata(path).is_ok_and(|there| !there.is_file()) {
        return Err(io(std::io::Error::other("there is something else than a file")));
    }
    let mut name = path.file_name().unwrap_or_default().to_os_string();
    name.push(".partial");
    let temporary = path.with_file_name(name);
    let written = std::fs::File::create(&temporary).and_then(|mut file| {
        std::io::Write::write_all(&mut file, bytes)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    });
    written.map_err(|source| {
        let _ = std::fs::remove_file(&temporary);
        io(source)
    })
}

/// Tensors and metadata of a file.
pub(crate) fn read_tensors(path: &Path) -> Result<(Tensors, HashMap<String, String>), Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.into(), source })?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| not_safetensors(path, error))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|error| not_safetensors(path, error))?;
    let floats = file.tensors().into_iter().filter(|(_, view)| view.dtype() == Dtype::F32);
    let tensors = floats.map(|(name, view)| (name, (view.shape().to_vec(), self::floats(&view)))).collect();
    Ok((tensors, header.metadata().clone().unwrap_or_default()))
}
