use std::io::Read;
use std::path::{Path, PathBuf};

/// What can go wrong with a file. Every message names the file and, where there is one, the field with what was found and
/// what was expected.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The operating system could not read or write the file.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// An image could not be decoded or encoded.
    #[error("{}: not a readable image: {source}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        source: image::ImageError,
    },
    /// A field of a file does not hold what it must.
    #[error("{}: {field}: expected {expected}, found {found}", path.display())]
    Field {
        /// The file.
        path: PathBuf,
        /// The field, with its line or row where there is one.
        field: String,
        /// What was expected.
        expected: String,
        /// What is there.
        found: String,
    },
    /// Of a picture in which no object is.
    #[error("{}: {field}: expected {expected}, found {found}", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
        /// What says where the object is.
        field: String,
        /// What was expected.
        expected: String,
        /// What is there.
        found: String,
    },
    /// A file that must exist does not.
    #[error("{}: missing: {why}", path.display())]
    Missing {
        /// The file.
        path: PathBuf,
        /// Who needs it.
        why: String,
    },
    /// An output exists already.
    #[error("{}: exists already; nothing was overwritten", path.display())]
    Exists {
        /// The file or folder.
        path: PathBuf,
    },
}

/// Results of this crate.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    pub(crate) fn field(path: &Path, field: impl Into<String>, expected: impl ToString, found: impl ToString) -> Self {
        Self::Field { path: path.into(), field: field.into(), expected: expected.to_string(), found: found.to_string() }
    }
}

/// Attaches a path to errors of the standard library and of the image crate.
pub(crate) trait At<T> {
    fn at(self, path: &Path) -> Result<T>;
}

impl<T> At<T> for std::io::Result<T> {
    fn at(self, path: &Path) -> Result<T> {
        self.map_err(|source| Error::Io { path: path.into(), source })
    }
}

impl<T> At<T> for image::ImageResult<T> {
    fn at(self, path: &Path) -> Result<T> {
        self.map_err(|source| match source {
            image::ImageError::IoError(source) if source.kind() != std::io::ErrorKind::UnexpectedEof => {
                Error::Io { path: path.into(), source }
            }
            source => Error::Image { path: path.into(), source },
        })
    }
}

/// Larger text files are refused: none of the formats comes near, and a wrong file should not fill the memory.
const LONGEST_TEXT: u64 = 1 << 30;

/// Reads a text file of bearable length.
pub(crate) fn read_text(path: &Path) -> Result<String> {
    let mut bytes = read_bytes(path)?;
    // Some editors begin a text with this mark.
    if bytes.starts_with(BYTE_ORDER_MARK) {
        bytes.drain(..BYTE_ORDER_MARK.len());
    }
    String::from_utf8(bytes)
        .map_err(|error| Error::field(path, format!("byte {}", error.utf8_error().valid_up_to()), "UTF-8 text", "other bytes"))
}

const BYTE_ORDER_MARK: &[u8] = "\u{feff}".as_bytes();

/// Reads a file of bearable length.
pub(crate) fn read_bytes(path: &Path) -> Result<Vec<u8>> {
    let length = std::fs::metadata(path).at(path)?.len();
    if length > LONGEST_TEXT {
        return Err(Error::field(path, "length", format!("at most {LONGEST_TEXT} bytes"), length));
    }
    // What has no length, as a device, may have no end.
    let mut bytes = vec![];
    std::fs::File::open(path).and_then(|file| file.take(LONGEST_TEXT).read_to_end(&mut bytes)).at(path)?;
    Ok(bytes)
}
