//! Files out of archives, which may be anybody's: none can lead out of the folder that it is unpacked into.

use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Component, Path, PathBuf};

use tar::EntryType;
use zip::ZipArchive;

use crate::common::Result;

/// What is done with a file of an archive: its path within, and its content.
pub type Keep<'a> = dyn FnMut(&Path, &mut dyn Read) -> Result<()> + 'a;

/// Hands the wanted files of a tar archive to `keep`. An entry whose name leads elsewhere is an error, wanted or not; so is a wanted
/// link. Folders are passed over: who writes a file makes its folder.
pub fn tar(from: impl Read, wanted: &dyn Fn(&Path) -> bool, keep: &mut Keep) -> Result<()> {
    for entry in tar::Archive::new(from).entries()? {
        let mut entry = entry?;
        let path = inside(&entry.path()?)?;
        match entry.header().entry_type() {
            EntryType::Regular | EntryType::Continuous | EntryType::GNUSparse if wanted(&path) => keep(&path, &mut entry)?,
            EntryType::Directory | EntryType::XGlobalHeader => {}
            _ if wanted(&path) => return Err(format!("{}: a link or device, not a file", path.display()).into()),
            _ => {}
        }
    }
    Ok(())
}

/// The same for a ZIP archive.
pub fn zip(from: impl Read + Seek, wanted: &dyn Fn(&Path) -> bool, keep: &mut Keep) -> Result<()> {
    let mut archive = ZipArchive::new(from)?;
    for i in 0..archive.len() {
        let mut file = archive.by_index(i)?;
        let path = inside(Path::new(&*file.name()?))?;
        if file.is_dir() || !wanted(&path) {
            continue;
        }
        if !file.is_file() {
            return Err(format!("{}: a link or device, not a file", path.display()).into());
        }
        keep(&path, &mut file)?;
    }
    Ok(())
}

/// Writes a file and the folders above it.
pub fn write(path: &Path, content: &mut dyn Read) -> Result<()> {
    let about = |error: io::Error| format!("{}: {error}", path.display());
    std::fs::create_dir_all(path.parent().unwrap_or(path)).map_err(about)?;
    let mut file = File::create(path).map_err(about)?;
    io::copy(content, &mut file).map_err(about)?;
    Ok(())
}

/// The name of an entry as a path below the folder that is unpacked into.
fn inside(name: &Path) -> Result<PathBuf> {
    let mut path = PathBuf::new();
    for component in name.components() {
        match component {
            Component::Normal(part) => path.push(part),
            Component::CurDir => {}
            _ => return Err(format!("{}: leads out of the folder", name.display()).into()),
        }
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::zip::ZipWriter;
    use ::zip::write::SimpleFileOptions;
    use std::io::{Cursor, Write};

    type Unpacked = Result<Vec<(PathBuf, String)>>;

    fn unpack(all: impl FnOnce(&mut Keep) -> Result<()>) -> Unpacked {
        let mut found = vec![];
        all(&mut |path, content| {
            let mut text = String::new();
            content.read_to_string(&mut text)?;
            found.push((path.to_owned(), text));
            Ok(())
        })?;
        Ok(found)
    }

    /// A tar archive of one file of each name, and of one entry of another type and name, which points to the last name.
    fn tarred(names: &[&str], other: Option<(EntryType, &str)>) -> Vec<u8> {
        let mut archive = tar::Builder::new(vec![]);
        let mut add = |name: &str, kind: EntryType, target: &str, content: &str| {
            let mut header = tar::Header::new_gnu();
            // The crate's own setters refuse bad names.
            header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
            header.as_old_mut().linkname[..target.len()].copy_from_slice(target.as_bytes());
            header.set_entry_type(kind);
            header.set_size(content.len() as u64);
            header.set_cksum();
            archive.append(&header, content.as_bytes()).unwrap();
        };
        other.iter().for_each(|(kind, name)| add(name, *kind, names[names.len() - 1], ""));
        names.iter().for_each(|name| add(name, EntryType::Regular, "", name));
        archive.into_inner().unwrap()
    }

    fn zipped(names: &[&str], link: Option<&str>) -> Cursor<Vec<u8>> {
        let mut archive = ZipWriter::new(Cursor::new(vec![]));
        link.iter().for_each(|name| archive.add_symlink(*name, "elsewhere", SimpleFileOptions::default()).unwrap());
        for name in names {
            archive.start_file(*name, SimpleFileOptions::default()).unwrap();
            archive.write_all(name.as_bytes()).unwrap();
        }
        archive.finish().unwrap()
    }

    #[test]
    fn wanted_files_come_out() {
        let wanted = |path: &Path| path.starts_with("a");
        let expected = [("a/b.txt", "./a/b.txt"), ("a/c d.txt", "a/c d.txt")].map(|(path, text)| (path.into(), text.into()));
        let archive = tarred(&["./a/b.txt", "b/a.txt", "a/c d.txt"], Some((EntryType::Directory, "a/")));
        assert_eq!(unpack(|keep| tar(&archive[..], &wanted, keep)).unwrap(), expected);
        let archive = zipped(&["./a/b.txt", "b/a.txt", "a/c d.txt"], None);
        assert_eq!(unpack(|keep| zip(archive, &wanted, keep)).unwrap(), expected);
    }

    #[test]
    fn names_that_lead_elsewhere_are_refused() {
        for name in ["../x", "a/../../x", "/x", "a/.."] {
            for wanted in [true, false] {
                let archive = tarred(&["a/good", name], None);
                let tarred = unpack(|keep| tar(&archive[..], &|_| wanted, keep));
                let zipped = unpack(|keep| zip(zipped(&["a/good", name], None), &|_| wanted, keep));
                for error in [tarred, zipped].map(|result| result.unwrap_err().to_string()) {
                    assert!(error.contains(name) && error.contains("leads out"), "{name}: {error}");
                }
            }
        }
    }

    #[test]
    fn links_are_refused_where_they_are_wanted() {
        let link = Path::new("a").join("link").display().to_string();
        for kind in [EntryType::Symlink, EntryType::Link, EntryType::Char] {
            let archive = tarred(&["a/good"], Some((kind, "a/link")));
            let error = unpack(|keep| tar(&archive[..], &|_| true, keep)).unwrap_err().to_string();
            assert!(error.contains(&link), "{error}");
            let found = unpack(|keep| tar(&archive[..], &|path| path == Path::new("a/good"), keep)).unwrap();
            assert_eq!(found.len(), 1, "{kind:?}");
        }
        let error = unpack(|keep| zip(zipped(&["a/good"], Some("a/link")), &|_| true, keep)).unwrap_err().to_string();
        assert!(error.contains(&link), "{error}");
    }

    #[test]
    fn cut_archives_are_errors() {
        let archive = tarred(&["a/one", "a/two"], None);
        assert!(unpack(|keep| tar(&archive[..514], &|_| true, keep)).is_err());
        let archive = zipped(&["a/one", "a/two"], None).into_inner();
        assert!(unpack(|keep| zip(Cursor::new(&archive[..archive.len() / 2]), &|_| true, keep)).is_err());
    }
}
