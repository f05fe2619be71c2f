//! Checkpoints of the authors' PyTorch code, `{'model': weights by name, …}`: both file kinds of `torch.save` are read, the newer is
//! written. Nothing in a file is run, and nothing in it can cost more memory than a few times its length.

mod pickle;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;

use half::f16;
use zip::result::ZipError;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::model::Tensors;
use crate::{Error, Metadata, Model, write_atomically};
use pickle::{Pickle, Storage, TensorAt, Value};

/// First bytes of a zip archive: `torch.save` since PyTorch 1.6.
const ZIP: &[u8] = b"PK\x03\x04";
/// First bytes of what it wrote before: a pickle of the number 0x1950a86a20f9469cfc6c.
const LEGACY: &[u8] = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";

/// The element types that weights are stored in.
#[derive(Clone, Copy)]
enum Element {
    F16,
    F32,
    F64,
}

impl Element {
    fn of(class: &str) -> Option<Self> {
        match class {
            "HalfStorage" => Some(Element::F16),
            "FloatStorage" => Some(Element::F32),
            "DoubleStorage" => Some(Element::F64),
            _ => None,
        }
    }

    fn bytes(self) -> usize {
        match self {
            Element::F16 => 2,
            Element::F32 => 4,
            Element::F64 => 8,
        }
    }

    /// The value in the first bytes, lowest first.
    fn value(self, bytes: &[u8]) -> f32 {
        fn first<const N: usize>(bytes: &[u8]) -> [u8; N] {
            std::array::from_fn(|k| bytes[k])
        }
        match self {
            Element::F16 => f16::from_le_bytes(first(bytes)).to_f32(),
            Element::F32 => f32::from_le_bytes(first(bytes)),
            Element::F64 => f64::from_le_bytes(first(bytes)) as f32,
        }
    }
}

/// An open file of one of the two kinds.
enum Archive {
    Zip {
        zip: ZipArchive<BufReader<File>>,
        /// Folder in the archive.
        folder: String,
        is_big_endian: bool,
    },
    Legacy {
        file: BufReader<File>,
        /// First byte and number of values of each storage.
        places: HashMap<String, (u64, u64)>,
    },
}

impl Archive {
    /// The bytes of a storage, each value's lowest first; `len` values, no more than the file could have.
    fn storage(&mut self, key: &str, len: usize, element: Element) -> Result<Vec<u8>, String> {
        let io = |error: std::io::Error| error.to_string();
        let wanted = len * element.bytes();
        let mut bytes = Vec::with_capacity(wanted);
        match self {
            Archive::Zip { zip, folder, is_big_endian } => {
                let entry = zip.by_name(&format!("{folder}data/{key}")).map_err(|error| error.to_string())?;
                // One byte more than wanted: beyond it the checksum is looked at.
                entry.take(wanted as u64 + 1).read_to_end(&mut bytes).map_err(io)?;
                if *is_big_endian {
                    bytes.chunks_exact_mut(element.bytes()).for_each(<[u8]>::reverse);
                }
            }
            Archive::Legacy { file, places } => {
                let &(start, count) = places.get(key).ok_or("no such storage")?;
                if count != len as u64 {
                    return Err(format!("{count} values"));
                }
                file.seek(SeekFrom::Start(start)).map_err(io)?;
                file.take(wanted as u64).read_to_end(&mut bytes).map_err(io)?;
            }
        }
        if bytes.len() == wanted { Ok(bytes) } else { Err(format!("{} bytes", bytes.len())) }
    }
}

impl Model {
    /// Reads a checkpoint of the authors' PyTorch code: the weights under the key `model` where there is one. Sizes follow from the
    /// tensors, what does not is given. Also returns the names of what is no part of the network and was left out, sorted.
    pub fn load_torch(path: &Path, tracing_steps: u32, metadata: Metadata) -> Result<(Self, Vec<String>), Error> {
        if tracing_steps == 0 {
            return Err(Error::Setting { field: "tracing_steps", what: "must be at least 1".into() });
        }
        let tensors = read(path)?;
        let model = Self::from_tensors(&tensors, tracing_steps, metadata)?;
        let taken: HashSet<String> = model.tensors().into_iter().map(|(name, ..)| name).collect();
        let mut left_out: Vec<String> = tensors.into_keys().filter(|name| !taken.contains(name)).collect();
        left_out.sort();
        Ok((model, left_out))
    }

    /// Writes a checkpoint that `torch.load` and the authors' code read: `{'model': weights by name}`. The format has no place for
    /// marching steps, names and the like.
    pub fn save_torch(&self, path: &Path) -> Result<(), Error> {
        self.hypernetwork()?;
        let bytes = archive(&self.tensors()).map_err(|error| Error::Io { path: path.into(), source: error.into() })?;
        write_atomically(path, &bytes)
    }
}

/// All tensors of a checkpoint's model.
fn read(path: &Path) -> Result<Tensors, Error> {
    let io = |source| Error::Io { path: path.into(), source };
    let format = |what: String| Error::Format { path: path.into(), what };
    let file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let (mut archive, pickle) = open(BufReader::new(file)).map_err(format)?;
    let entries = weights(&pickle).map_err(format)?;

    // Tensors may share storages, and storages bytes of the file: together they must not be more than the file has.
    let mut left = [length, length];
    let mut spend = |of: usize, values: usize, element: Element| {
        left[of] = left[of].checked_sub((values as u64).checked_mul(element.bytes() as u64)?)?;
        Some(())
    };
    let mut storages: HashMap<&str, Vec<u8>> = HashMap::new();
    let mut tensors = Tensors::new();
    for (&name, &tensor) in &entries {
        let about = |expected: String, got: String| Error::Tensor { name: name.escape_debug().to_string(), expected, got };
        let shown = || format!("shape {:?}, strides {:?}, offset {}", tensor.shape, tensor.strides, tensor.offset);
        let Storage { len, .. } = tensor.storage;
        let key = pickle.name(tensor.storage.key).unwrap_or_default();
        let class = pickle.class(&tensor.storage).unwrap_or_default();
        let types = || about("FloatStorage, DoubleStorage or HalfStorage".into(), class.into());
        let element = Element::of(class).ok_or_else(types)?;
        let values = values(tensor, len).ok_or_else(|| about(format!("a tensor within its {len} stored values"), shown()))?;
        let larger = || about(format!("no more than the {length} bytes of the file"), shown());
        spend(0, values, element).ok_or_else(larger)?;
        if !storages.contains_key(key) {
            spend(1, len, element).ok_or_else(larger)?;
            let expected = || format!("{len} values in storage {key:?}");
            storages.insert(key, archive.storage(key, len, element).map_err(|got| about(expected(), got))?);
        }
        let bytes = &storages[key];
        // Not multiplied: another tensor's number of values may be anything.
        if bytes.len() / element.bytes() != len || !bytes.len().is_multiple_of(element.bytes()) {
            return Err(about(format!("the {} bytes of storage {key:?}", bytes.len()), format!("{len} values of {class}")));
        }
        tensors.insert(name.into(), (tensor.shape.clone(), gather(tensor, element, bytes, values)));
    }
    Ok(tensors)
}

/// The tensors by name: those of the outermost dictionary's entry `model`, or its own.
fn weights(pickle: &Pickle) -> Result<BTreeMap<&str, &TensorAt>, String> {
    let outermost = pickle.entries(pickle.root).ok_or("a checkpoint is a dictionary, this is something else")?;
    let model = outermost.filter(|(key, _)| *key == "model").last().map(|(_, value)| value);
    let what = "`model` is no dictionary of tensors: save its state_dict()";
    let entries = pickle.entries(model.unwrap_or(pickle.root)).ok_or(what)?;
    let tensors = entries.filter_map(|(name, value)| match pickle.value(value) {
        Value::Tensor(tensor) => Some((name, tensor)),
        _ => None,
    });
    Ok(tensors.collect())
}

/// Number of values of a tensor, `None` where it reaches out of its storage of `len` values.
fn values(tensor: &TensorAt, len: usize) -> Option<usize> {
    let values = tensor.shape.iter().try_fold(1usize, |product, &size| product.checked_mul(size))?;
    let mut last = tensor.offset;
    for (&size, &stride) in tensor.shape.iter().zip(&tensor.strides) {
        last = last.checked_add(size.saturating_sub(1).checked_mul(stride)?)?;
    }
    (values == 0 || last < len).then_some(values)
}

/// The values of a tensor, row by row, whatever its strides.
fn gather(tensor: &TensorAt, element: Element, bytes: &[u8], values: usize) -> Vec<f32> {
    let mut index = vec![0; tensor.shape.len()];
    let mut at = tensor.offset;
    let mut gathered = Vec::with_capacity(values);
    for _ in 0..values {
        gathered.push(element.value(&bytes[at * element.bytes()..]));
        for (k, (&size, &stride)) in tensor.shape.iter().zip(&tensor.strides).enumerate().rev() {
            index[k] += 1;
            at += stride;
            if index[k] < size {
                break;
            }
            at -= size * stride;
            index[k] = 0;
        }
    }
    gathered
}

/// Opens a file and reads the pickle in it.
fn open(mut file: BufReader<File>) -> Result<(Archive, Pickle), String> {
    let io = |error: std::io::Error| error.to_string();
    let mut start = Vec::new();
    file.by_ref().take(LEGACY.len() as u64).read_to_end(&mut start).map_err(io)?;
    if start == LEGACY {
        return open_legacy(file);
    }
    if !start.starts_with(ZIP) {
        return Err("not a file of torch.save".into());
    }
    let broken = |error: ZipError| format!("a broken zip archive: {error}");
    let mut zip = ZipArchive::new(file).map_err(broken)?;
    let folder = |name: &str| Some(name.strip_suffix("data.pkl").filter(|folder| folder.ends_with('/'))?.to_owned());
    let folder = zip.file_names().flatten().find_map(|name| folder(&name));
    let folder = folder.ok_or("a zip archive without data.pkl: not of torch.save")?;
    // A small file could hold much.
    for number in 0..zip.len() {
        let entry = zip.by_index_raw(number).map_err(broken)?;
        if entry.compression() != CompressionMethod::Stored {
            return Err("a compressed zip archive: not of torch.save".into());
        }
    }
    let mut order = String::new();
    match zip.by_name(&format!("{folder}byteorder")) {
        Ok(entry) => _ = entry.take(10).read_to_string(&mut order).map_err(io)?,
        // PyTorch before 2.1 does not say it; it wrote the machine's.
        Err(ZipError::FileNotFound) => order.push_str("little"),
        Err(error) => return Err(broken(error)),
    }
    let is_big_endian = match order.as_str() {
        "little" => false,
        "big" => true,
        other => return Err(format!("byteorder is {other:?}, neither little nor big")),
    };
    let mut entry = zip.by_name(&format!("{folder}data.pkl")).map_err(broken)?;
    let pickle = Pickle::read(&mut entry)?;
    // The checksum is looked at behind the last byte.
    std::io::copy(&mut entry, &mut std::io::sink()).map_err(|error| format!("data.pkl: {error}"))?;
    drop(entry);
    Ok((Archive::Zip { zip, folder, is_big_endian }, pickle))
}

/// What was written before 1.6, from behind the first pickle: two more about the format, the object, the keys of the storages in order,
/// then each storage as its number of values (8 bytes) and the values, all lowest byte first.
fn open_legacy(mut file: BufReader<File>) -> Result<(Archive, Pickle), String> {
    for _ in ["version", "machine"] {
        Pickle::read(&mut file)?;
    }
    let pickle = Pickle::read(&mut file)?;
    let keys = Pickle::read(&mut file)?;
    let Value::List(keys_in_order) = keys.value(keys.root) else { return Err("no list of storages behind the pickle".into()) };
    let classes: HashMap<&str, &str> = pickle.storages().collect();
    let mut places = HashMap::new();
    for &key in keys_in_order {
        let key = keys.name(key).ok_or("a storage without a name")?;
        let mut count = [0; 8];
        file.read_exact(&mut count).map_err(|_| format!("ends before storage {key:?}"))?;
        let count = u64::from_le_bytes(count);
        let start = file.stream_position().map_err(|error| error.to_string())?;
        let bytes =
            classes.get(key).and_then(|class| bytes_of(class)).ok_or_else(|| format!("storage {key:?} of unknown type"))?;
        let bytes = count.checked_mul(bytes).and_then(|bytes| bytes.try_into().ok());
        let skipped = bytes.map(|bytes| file.seek_relative(bytes));
        skipped.and_then(Result::ok).ok_or_else(|| format!("storage {key:?} of {count} values"))?;
        places.insert(key.to_owned(), (start, count));
    }
    Ok((Archive::Legacy { file, places }, pickle))
}

/// Bytes of a value of any class of storages: those that are not wanted must be skipped.
fn bytes_of(class: &str) -> Option<u64> {
    match class {
        "BoolStorage" | "ByteStorage" | "CharStorage" => Some(1),
        "HalfStorage" | "BFloat16Storage" | "ShortStorage" => Some(2),
        "FloatStorage" | "IntStorage" => Some(4),
        "DoubleStorage" | "LongStorage" => Some(8),
        _ => None,
    }
}

/// The bytes of a zip archive with a state dictionary under the key `model`.
fn archive(tensors: &[(String, Vec<usize>, &[f32])]) -> Result<Vec<u8>, ZipError> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    // Not compressed, so that storages can be mapped into memory, for which they begin at multiples of 64.
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored).with_alignment(64);
    let mut add = |name: &str, bytes: &[u8]| {
        zip.start_file(format!("archive/{name}"), options.large_file(bytes.len() > u32::MAX as usize))?;
        zip.write_all(bytes).map_err(ZipError::from)
    };
    add("data.pkl", &pickle::write(tensors))?;
    add("byteorder", b"little")?;
    for (key, (_, _, values)) in tensors.iter().enumerate() {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        add(&format!("data/{key}"), &bytes)?;
    }
    add("version", b"3\n")?;
    Ok(zip.finish()?.into_inner())
}
