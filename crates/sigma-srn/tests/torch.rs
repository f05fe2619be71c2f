//! Checkpoints of `torch.save`: everything a file may say is read as PyTorch means it, or refused with the tensor's name.

use std::fs;
use std::io::{Cursor, Read, Write};
use std::path::Path;

use half::f16;
use proptest::prelude::*;
use sigma_srn::{Error, Metadata, Model, ModelConfig};
use tempfile::TempDir;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

#[path = "../../data/tests/spoil/mod.rs"]
mod spoil;
use spoil::{fuzz, spoiled};

/// `{'model': …}` by PyTorch, in the format before 1.6.
const LEGACY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/golden/tiny.pth");
const CODES: &str = "latent_codes.weight";

fn model() -> Model {
    Model::init(&ModelConfig { hidden: 6, latent: 5, instances: 2, tracing_steps: 4, density: true }, 1).unwrap()
}

fn load(path: &Path) -> Result<Model, Error> {
    Model::load_torch(path, 4, Metadata::default()).map(|(model, _)| model)
}

/// A folder with `good.pth`, the model of [`model`], and its bytes.
fn home() -> (TempDir, Vec<u8>) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("good.pth");
    model().save_torch(&path).unwrap();
    let bytes = fs::read(path).unwrap();
    (dir, bytes)
}

/// The archive with each entry changed; its name comes without the folder.
fn repack(bytes: &[u8], change: impl Fn(&str, Vec<u8>) -> Vec<u8>) -> Vec<u8> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    let mut out = ZipWriter::new(Cursor::new(Vec::new()));
    for number in 0..archive.len() {
        let mut entry = archive.by_index(number).unwrap();
        let mut content = Vec::new();
        entry.read_to_end(&mut content).unwrap();
        let name = entry.name().unwrap().into_owned();
        out.start_file(&name, SimpleFileOptions::default().compression_method(CompressionMethod::Stored)).unwrap();
        out.write_all(&change(name.strip_prefix("archive/").unwrap(), content)).unwrap();
    }
    out.finish().unwrap().into_inner()
}

/// The first, or every, place of `from` replaced.
fn replace(bytes: &[u8], from: &[u8], to: &[u8], most: usize) -> Vec<u8> {
    let mut out = Vec::new();
    let (mut at, mut done) = (0, 0);
    while at < bytes.len() {
        if done < most && bytes[at..].starts_with(from) {
            out.extend(to);
            (at, done) = (at + from.len(), done + 1);
        } else {
            out.push(bytes[at]);
            at += 1;
        }
    }
    assert!(done > 0, "nothing to replace");
    out
}

/// The archive with one change in its pickle.
fn repickle(bytes: &[u8], from: &[u8], to: &[u8], most: usize) -> Vec<u8> {
    repack(bytes, |name, content| if name == "data.pkl" { replace(&content, from, to, most) } else { content })
}

/// The archive with another pickle.
fn with_pickle(bytes: &[u8], pickle: &[u8]) -> Vec<u8> {
    repack(bytes, |name, content| if name == "data.pkl" { pickle.to_vec() } else { content })
}

/// The archive with every storage as another type.
fn retype(bytes: &[u8], class: &str, convert: impl Fn(f32) -> Vec<u8>) -> Vec<u8> {
    let renamed = repickle(bytes, b"FloatStorage", class.as_bytes(), usize::MAX);
    let value = |word: &[u8]| f32::from_le_bytes(word.try_into().unwrap());
    repack(&renamed, |name, content| match name.strip_prefix("data/") {
        Some(_) => content.chunks_exact(4).flat_map(|word| convert(value(word))).collect(),
        None => content,
    })
}

#[test]
fn what_is_written_reads_back() {
    let (dir, bytes) = home();
    assert_eq!(load(&dir.path().join("good.pth")).unwrap(), model());
    // Values that a map of the file into memory can use as they lie there.
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    for number in 0..archive.len() {
        assert!(archive.by_index(number).unwrap().data_start().unwrap().is_multiple_of(64));
    }
}

#[test]
fn all_types_and_byte_orders_are_read() {
    let (dir, good) = home();
    let path = dir.path().join("other.pth");
    let read = |bytes: Vec<u8>| {
        fs::write(&path, bytes).unwrap();
        load(&path).unwrap()
    };
    assert_eq!(read(retype(&good, "DoubleStorage", |value| f64::from(value).to_le_bytes().into())), model());
    let mut halved = model();
    halved.parameters.iter_mut().flat_map(|p| &mut p.values).for_each(|value| *value = f16::from_f32(*value).to_f32());
    assert_eq!(read(retype(&good, "HalfStorage", |value| f16::from_f32(value).to_le_bytes().into())), halved);
    let big = repack(&good, |name, content| match name {
        "byteorder" => b"big".into(),
        _ if name.starts_with("data/") => content.chunks_exact(4).flat_map(|word| word.iter().rev()).copied().collect(),
        _ => content,
    });
    assert_eq!(read(big), model());
    // Before 2.1 nothing was said about it, and folders were called otherwise.
    let old = replace(&replace(&good, b"archive/byteorder", b"archive/elsewhere", 9), b"archive/", b"another/", usize::MAX);
    assert_eq!(read(old), model());
}

#[test]
fn the_weights_alone_and_strangers_beside_them() {
    let (dir, good) = home();
    let path = dir.path().join("other.pth");
    // No `{'model': …}` around.
    let bare = repack(&good, |name, content| match name {
        "data.pkl" => replace(&replace(&content, b"}X\x05\0\0\0model", b"", 1), b"us.", b"u.", 1),
        _ => content,
    });
    fs::write(&path, bare).unwrap();
    assert_eq!(load(&path).unwrap(), model());
    let stranger = repickle(&good, b"sigma.net.3.bias", b"delta.net.3.bias", 1);
    fs::write(&path, stranger).unwrap();
    assert!(load(&path).unwrap_err().to_string().contains("`sigma.net.3.bias` is missing"));
    // The density net under another name: plain SRN, and the caller is told.
    fs::write(&path, repickle(&good, b"sigma.net", b"delta.net", usize::MAX)).unwrap();
    let (plain, left_out) = Model::load_torch(&path, 4, Metadata::default()).unwrap();
    assert!(plain.layout.density.is_none() && left_out.len() == 14, "{left_out:?}");
    assert_eq!(left_out[0], "delta.net.0.net.0.bias");
}

#[test]
fn bad_files_are_refused_by_name() {
    let (dir, good) = home();
    let path = dir.path().join("bad.pth");
    let size = |size: u64| [&b"\x8a\x08"[..], &size.to_le_bytes()].concat();
    let tuple = |sizes: &[u64]| [b"(".to_vec(), sizes.iter().flat_map(|&s| size(s)).collect(), b"t".to_vec()].concat();
    let layout = |shape: &[u64], strides: &[u64]| [tuple(shape), tuple(strides)].concat();
    let codes = |shape: &[u64], strides: &[u64]| repickle(&good, &layout(&[2, 5], &[5, 1]), &layout(shape, strides), 1);
    let reference = |key: &[u8], len: u64| [b"X\x01\0\0\0", key, b"X\x03\0\0\0cpu", &size(len)].concat();
    let first = |value: f32| {
        repack(&good, |name, mut content| {
            if name == "data/0" {
                content[4..8].copy_from_slice(&value.to_le_bytes());
            }
            content
        })
    };
    // Entries that say they are compressed.
    let mut compressed = good.clone();
    for at in 0..compressed.len() - 12 {
        match &compressed[at..at + 4] {
            b"PK\x01\x02" => compressed[at + 10] = 8,
            b"PK\x03\x04" => compressed[at + 8] = 8,
            _ => {}
        }
    }
    let legacy = fs::read(LEGACY).unwrap();
    let cases: Vec<(Vec<u8>, &[&str])> = vec![
        (b"weights".into(), &["not a file of torch.save"]),
        (vec![], &["not a file of torch.save"]),
        (good[..good.len() / 2].into(), &["zip"]),
        (compressed, &["ompress"]),
        (replace(&good, b"data.pkl", b"data.pki", 9), &["data.pkl"]),
        (replace(&good, &1.0f32.to_le_bytes(), &2.0f32.to_le_bytes(), 1), &["hecksum"]),
        (replace(&good, b"latent_codes", b"latent_modes", 1), &["data.pkl", "hecksum"]),
        (repack(&good, |name, content| if name == "byteorder" { b"middle".into() } else { content }), &["byteorder", "middle"]),
        (repickle(&good, b"torch._utils\n_rebuild_tensor_v2", b"os\nsystem", 1), &["`os.system`", "checkpoint['model']"]),
        (repickle(&good, b"torch\nFloatStorage", b"numpy\nndarray", 1), &["`numpy.ndarray`"]),
        (repickle(&good, b"FloatStorage", b"LongStorage", 1), &[CODES, "LongStorage"]),
        (repickle(&good, b"FloatStorage", b"DoubleStorage", 1), &[CODES, "10 values", "40 bytes"]),
        (repickle(&good, b"\x80\x02", b"\x80\x04", 1), &["byte 0", "protocol 4"]),
        (repickle(&good, b"us.", b"us", 1), &["ends too early"]),
        (repickle(&good, b"}X", b"}\x8cX", 1), &["byte 3", "0x8c"]),
        (with_pickle(&good, b"\x80\x02]."), &["dictionary"]),
        (with_pickle(&good, b"\x80\x02}X\x05\0\0\0modelK\x01s."), &["`model`", "state_dict"]),
        (with_pickle(&good, b"\x80\x02}."), &[CODES, "missing"]),
        (with_pickle(&good, &[b'('].repeat(5 << 20)), &["longer than"]),
        (
            repack(&good, |name, content| if name == "data/0" { content[..36].into() } else { content }),
            &[CODES, "10 values", "36"],
        ),
        (repack(&good, |name, content| if name == "data/0" { [content, vec![0; 4]].concat() } else { content }), &[CODES, "41"]),
        (replace(&good, b"archive/data/0", b"archive/data/x", 9), &[CODES, "storage \"0\""]),
        (codes(&[5, 2], &[2, 1]), &["hyper_phi", "[5, 2]", "[5, 5]"]),
        (codes(&[10], &[1]), &[CODES, "2 dimensions"]),
        (codes(&[2, 5], &[6, 1]), &[CODES, "within its 10", "[6, 1]"]),
        (codes(&[2, 5], &[5, u64::MAX >> 1]), &[CODES, "within its 10"]),
        (codes(&[2, u64::MAX], &[5, 1]), &["-1 where a size"]),
        (codes(&[0, 5], &[5, 1]), &[CODES, "none of them 0"]),
        (codes(&[1 << 40, 5], &[0, 1]), &[CODES, "bytes of the file"]),
        // So many values that the number of their bytes begins again: 20, as many as the other tensor's storage has.
        (repickle(&good, &reference(b"1", 25), &reference(b"2", (1 << 62) + 5), 1), &["hyper_phi", "20 bytes of storage"]),
        (repickle(&good, &reference(b"1", 25), &reference(b"1", 1 << 62), 1), &["hyper_phi", "bytes of the file"]),
        (codes(&[2, 5, 1], &[5, 1]), &["3 sizes and 2 strides"]),
        (codes(&[1; 9], &[1; 9]), &["9 dimensions"]),
        (first(f32::NAN), &[CODES, "finite", "NaN at 1"]),
        (retype(&good, "DoubleStorage", |value| (f64::from(value) * 1e300).to_le_bytes().into()), &["finite", "inf"]),
        (legacy[..legacy.len() - 5].into(), &["`", "values in storage", "bytes"]),
        (legacy[..400].into(), &["ends too early"]),
        (replace(&legacy, b"FloatStorage", b"WideStorage", 1), &["unknown type"]),
    ];
    for (number, (bytes, words)) in cases.into_iter().enumerate() {
        fs::write(&path, bytes).unwrap();
        let error = load(&path).map(|_| ()).unwrap_err().to_string();
        assert!(words.iter().all(|word| error.contains(word)) && !error.contains('\n'), "{number} {words:?}: {error}");
    }
    assert!(load(&dir.path().join("nowhere.pth")).unwrap_err().to_string().contains("nowhere.pth"));
    let refused = Model::load_torch(&dir.path().join("good.pth"), 0, Metadata::default()).unwrap_err();
    assert!(refused.to_string().contains("tracing_steps"));
    let names = Metadata { instance_names: vec!["one".into()], ..Metadata::default() };
    let refused = Model::load_torch(&dir.path().join("good.pth"), 4, names).unwrap_err();
    assert!(refused.to_string().contains("1 for 2 instances"));
}

/// Whatever is done to a file or to the pickle in it: an error in one line, or a model that is in order.
#[test]
fn fuzz_torch() {
    let (dir, good) = home();
    let path = dir.path().join("spoiled.pth");
    let mut pickle = Vec::new();
    ZipArchive::new(Cursor::new(&good)).unwrap().by_name("archive/data.pkl").unwrap().read_to_end(&mut pickle).unwrap();
    let legacy = fs::read(LEGACY).unwrap();
    fuzz("torch", 300, &(spoiled(), 0..3), |(spoiled, kind)| {
        let bytes = match kind {
            0 => spoiled.of(&good),
            1 => with_pickle(&good, &spoiled.of(&pickle)),
            _ => spoiled.of(&legacy),
        };
        fs::write(&path, bytes).unwrap();
        match load(&path) {
            Ok(model) => prop_assert!(model.parameters.iter().flat_map(|p| &p.values).all(|value| value.is_finite())),
            Err(error) => prop_assert!(!error.to_string().contains('\n'), "{}", error),
        }
        Ok(())
    });
}
