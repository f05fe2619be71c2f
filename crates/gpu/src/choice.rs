//! Which variant of its kernel a step runs: measured once for a device, a text and a shape, then kept in a file.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::SystemTime;
use std::{env, fs, io};

use srn_plan::{ExecutorError, Step};
use srn_shaders::{Requirement, Variant};

use crate::Gpu;
use crate::executor::{Bound, Launch, Scratch};
use crate::gpu::lock;
use crate::launch::MOST_FLOPS;

/// Where choices are kept: a line for each, a hash and `op/variant`, or what else was found of a device.
const FILE: &str = "variants.txt";
/// Who writes it holds this one, which is empty.
const LOCK: &str = "variants.lock";

/// How the variants of kernels are chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Choice {
    /// The fastest one: measured when a plan first needs it, on buffers of the measurement's own, and kept. In a browser whose devices have no
    /// timestamps, the plain form.
    ///
    /// Variants add in different orders, so results repeat bit for bit as long as the choice does. The file sees to that
    /// from one process to the next; without one, each device that is opened measures anew.
    Measured {
        /// The folder of the file `variants.txt`. One that cannot be read or written is as good as none.
        cache: Option<PathBuf>,
    },
    /// The variant of this name, or with this ending, where a kernel has it and size and device allow it, else the plain form: for tests. Or an op
    /// that does two steps in one, `hidden_layer`: wherever it can.
    Named(String),
}

impl Default for Choice {
    /// Measured, and kept in the user's cache directory, see [`cache_folder`].
    fn default() -> Self {
        Choice::Measured { cache: cache_folder() }
    }
}

/// `sigma-srn` in the user's cache directory, `$XDG_CACHE_HOME`, `%LOCALAPPDATA%` or `~/.cache`; it need not exist.
pub fn cache_folder() -> Option<PathBuf> {
    let set = |name| env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = set("XDG_CACHE_HOME").or_else(|| set("LOCALAPPDATA")).or_else(|| Some(set("HOME")?.join(".cache")));
    base.map(|base| base.join("sigma-srn"))
}

/// The choice, and what it has been so far.
#[derive(Debug, Default)]
pub(crate) struct Chooser {
    choice: Choice,
    chosen: Mutex<HashMap<Shape, &'static Variant>>,
    /// Of ops that do two steps in one; `None` where these are faster one after the other.
    joined: Mutex<HashMap<Shape, Option<&'static Variant>>>,
}

/// What is kept where two steps are faster one after the other.
const APART: &str = "apart";

/// A kernel, whether it may use cooperative matrices, the widths of a step, and its extent up to the next power of two.
type Shape = (&'static str, bool, Vec<u32>);

impl Chooser {
    pub fn new(choice: Choice) -> Self {
        Chooser { choice, ..Chooser::default() }
    }

    pub fn choice(&self) -> &Choice {
        &self.choice
    }

    /// What is kept under a key.
    pub fn remembered(&self, key: &str) -> Option<String> {
        read(self.folder()?).ok()?.remove(key)
    }

    /// Keeps a word, if there is a folder.
    pub fn remember(&self, key: &str, word: &str) {
        let Some(folder) = self.folder() else { return };
        if let Err(error) = keep(folder, key, word) {
            tracing::debug!(%error, ?folder, "the choice cannot be kept");
        }
    }

    fn folder(&self) -> Option<&Path> {
        match &self.choice {
            Choice::Measured { cache } => cache.as_deref(),
            Choice::Named(_) => None,
        }
    }

    /// The same choice with nothing chosen yet: for other texts.
    pub fn afresh(&self) -> Self {
        Chooser::new(self.choice.clone())
    }

    /// The variant for a step.
    pub fn choose(&self, bound: &Bound<'_>) -> Result<&'static Variant, ExecutorError> {
        let (gpu, step) = (bound.gpu, bound.step);
        let shape = shape(gpu, step);
        // Held while measuring: two plans that are built at once would spoil each other's times.
        let mut chosen = lock(&self.chosen);
        if let Some(variant) = chosen.get(&shape) {
            return Ok(variant);
        }
        let usable = usable(gpu, step);
        let variant = match &self.choice {
            _ if usable.len() == 1 => usable[0],
            Choice::Measured { .. } if !gpu.can_time() => usable[0],
            Choice::Named(name) => usable.iter().find(|variant| variant.name.ends_with(name)).unwrap_or(&usable[0]),
            Choice::Measured { .. } => {
                let label = self.kept_or(gpu, step, &shape, &usable, || {
                    let fastest = measure(bound, &usable)?;
                    Ok(step.kernel.label(fastest))
                })?;
                usable.iter().copied().find(|variant| step.kernel.label(variant) == label).unwrap_or(usable[0])
            }
        };
        chosen.insert(shape, variant);
        Ok(variant)
    }

    /// The variant of a step that does the work of two, where that is faster than these by the variants chosen for them.
    pub fn choose_joined(
        &self,
        joined: &Bound<'_>,
        apart: [(&Bound<'_>, &Variant); 2],
    ) -> Result<Option<&'static Variant>, ExecutorError> {
        let (gpu, step) = (joined.gpu, joined.step);
        let shape = shape(gpu, step);
        let mut chosen = lock(&self.joined);
        if let Some(&variant) = chosen.get(&shape) {
            return Ok(variant);
        }
        // The plain form is for nothing but to be compared with.
        let usable = usable(gpu, step);
        let fast = usable.get(1).copied().filter(|_| gpu.may_join());
        let variant = match (&self.choice, fast) {
            (Choice::Named(name), _) => usable.last().copied().filter(|_| name == step.kernel.op),
            (Choice::Measured { .. }, None) => None,
            (Choice::Measured { .. }, Some(fast)) => {
                let label = self.kept_or(gpu, step, &shape, &usable, || {
                    let is_faster = is_faster(joined, fast, apart)?;
                    Ok(if is_faster { step.kernel.label(fast) } else { APART.into() })
                })?;
                (label != APART).then_some(fast)
            }
        };
        chosen.insert(shape, variant);
        Ok(variant)
    }

    /// What was kept for a shape, else what `find` finds, which is kept then. Words that are of no use any more are found anew.
    fn kept_or(
        &self,
        gpu: &Gpu,
        step: &Step,
        shape: &Shape,
        usable: &[&'static Variant],
        find: impl FnOnce() -> Result<String, ExecutorError>,
    ) -> Result<String, ExecutorError> {
        let texts: Vec<String> = usable.iter().map(|variant| gpu.source(step.kernel, variant)).collect();
        let key = key(&format!("{} {shape:?} {texts:?}", gpu.identity()));
        let is_known = |word: &String| word == APART || usable.iter().any(|variant| &step.kernel.label(variant) == word);
        let kept = || self.remembered(&key).filter(is_known);
        if let Some(word) = kept() {
            return Ok(word);
        }
        let found = find()?;
        // What another process has chosen meanwhile holds for both.
        Ok(kept().unwrap_or_else(|| {
            self.remember(&key, &found);
            found
        }))
    }
}

fn shape(gpu: &Gpu, step: &Step) -> Shape {
    let cooperative = gpu.cooperative().is_some();
    (step.kernel.name, cooperative, widths(step).chain(step.extent.map(u32::next_power_of_two)).collect())
}

/// The variants that a step can run, the plain one first.
fn usable(gpu: &Gpu, step: &Step) -> Vec<&'static Variant> {
    step.kernel.variants.iter().filter(|variant| is_usable(variant, step, gpu)).collect()
}

fn is_usable(variant: &Variant, step: &Step, gpu: &Gpu) -> bool {
    variant.requires.iter().all(|requirement| match requirement {
        Requirement::FeaturesMultipleOf4 => widths(step).all(|width| width % 4 == 0),
        Requirement::FeaturesAtMost64 => widths(step).all(|width| width <= 64),
        Requirement::FeaturesAtMost256 => widths(step).all(|width| width <= 256),
        Requirement::FeaturesAtMost1024 => widths(step).all(|width| width <= 1024),
        Requirement::Subgroups => gpu.has_subgroups(),
        Requirement::CooperativeMatrices => gpu.cooperative().is_some(),
    })
}

/// The parameters of a step that are numbers of features.
fn widths(step: &Step) -> impl Iterator<Item = u32> {
    let names = ["features", "in_features", "out_features", "chunk_outs", "hidden"];
    let fields = step.kernel.params.fields.iter().filter(move |field| names.contains(&field.0));
    fields.map(|&(_, _, offset)| bytemuck::pod_read_unaligned(&step.params[offset..offset + 4]))
}

/// What a line of the file holds for, device and texts among it: Fowler, Noll and Vo's hash 1a, since the standard library's may change with its version.
pub(crate) fn key(of: &str) -> String {
    let hash = of.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3));
    format!("{hash:016x}")
}

/// Work that a software adapter is timed on, in floating-point operations: a millisecond or a few, which other programs
/// leave alone more often than not. A real GPU, which needs many rows to show what it can, is timed on as much as one submission may have.
const SAMPLE: u64 = 100_000_000;
/// Most times that a variant is timed.
const MOST_ROUNDS: usize = 20;
/// Times that differ by less are the same.
const SAME: f64 = 1.1;

/// One way to do the work, by one launch or several, with its times so far, the two shortest of them.
struct Candidate {
    name: &'static str,
    launches: Vec<Launch>,
    best: f64,
    second: f64,
}

impl Candidate {
    fn new(name: &'static str, launches: Vec<Launch>) -> Self {
        Candidate { name, launches, best: f64::INFINITY, second: f64::INFINITY }
    }

    fn add(&mut self, seconds: f64) {
        self.second = self.second.min(seconds.max(self.best));
        self.best = self.best.min(seconds);
    }

    /// Other programs only ever make a time longer, and hardly ever twice by the same.
    fn is_settled(&self) -> bool {
        self.second <= SAME * self.best
    }
}

fn measure(bound: &Bound<'_>, usable: &[&'static Variant]) -> Result<&'static Variant, ExecutorError> {
    let step = bound.step;
    let (mut extent, mut flops) = (step.extent, step.flops);
    let most = if bound.gpu.adapter().is_software { SAMPLE } else { MOST_FLOPS };
    while flops > most {
        // The rows of a group, or the groups; both for sums over rows.
        let longest = if extent[0] >= extent[2] { 0 } else { 2 };
        extent[longest] = extent[longest].div_ceil(2);
        flops /= 2;
    }
    let scratch = Scratch::of(&[bound])?;
    let mut candidates = Vec::new();
    for &variant in usable {
        match bound.trial(variant, extent, &scratch) {
            Ok(launch) => candidates.push(Candidate::new(variant.name, vec![launch])),
            Err(error) => tracing::debug!(%error, "not a candidate"),
        }
    }
    if candidates.len() > 1 {
        // As many side by side as a submission may have.
        candidates = timed(bound.gpu, candidates, (MOST_FLOPS / flops.max(1)).max(1) as usize)?;
    }
    let Some(fastest) = candidates.iter().min_by(|a, b| a.best.total_cmp(&b.best)) else { return Ok(usable[0]) };
    tell(step, fastest.name, &candidates);
    Ok(usable.iter().copied().find(|variant| variant.name == fastest.name).unwrap_or(usable[0]))
}

/// Whether a step does clearly better by this variant than the two whose work it does.
pub(crate) fn is_faster(
    joined: &Bound<'_>,
    fast: &'static Variant,
    apart: [(&Bound<'_>, &Variant); 2],
) -> Result<bool, ExecutorError> {
    let scratch = Scratch::of(&[joined, apart[0].0, apart[1].0])?;
    let [first, second] = apart.map(|(bound, variant)| bound.trial(variant, bound.step.extent, &scratch));
    let apart = Candidate::new(APART, vec![first?, second?]);
    let both = Candidate::new(fast.name, vec![joined.trial(fast, joined.step.extent, &scratch)?]);
    let candidates = timed(joined.gpu, vec![apart, both], 1)?;
    // Less by so much: the second of two steps finds more in the caches when nothing is timed between them.
    let is_faster = SAME * candidates[1].best < candidates[0].best;
    let chosen = &candidates[usize::from(is_faster)];
    tell(joined.step, chosen.name, &candidates);
    Ok(is_faster)
}

fn tell(step: &Step, chosen: &str, candidates: &[Candidate]) {
    let times = candidates.iter().map(|candidate| format!("{} {:.3} ms", candidate.name, 1e3 * candidate.best));
    let (times, widths) = (times.collect::<Vec<_>>().join(", "), widths(step).collect::<Vec<_>>());
    tracing::debug!(kernel = step.kernel.name, ?widths, extent = ?step.extent, "chose {chosen}: {times}");
}

/// The candidates with their times, in submissions of `at_once` of them; of those that are slow they may be rough.
fn timed(gpu: &Gpu, mut candidates: Vec<Candidate>, at_once: usize) -> Result<Vec<Candidate>, ExecutorError> {
    let time = |candidates: &[&mut Candidate]| -> Result<Vec<f64>, ExecutorError> {
        let mut times = Vec::new();
        for part in candidates.chunks(at_once) {
            let mut seconds = gpu.time(&part.iter().flat_map(|candidate| &candidate.launches).collect::<Vec<_>>())?.into_iter();
            times.extend(part.iter().map(|candidate| seconds.by_ref().take(candidate.launches.len()).sum::<f64>()));
        }
        Ok(times)
    };
    // The first time is that of compiling.
    time(&candidates.iter_mut().collect::<Vec<_>>())?;
    for _ in 0..MOST_ROUNDS {
        let best = candidates.iter().map(|candidate| candidate.best).fold(f64::INFINITY, f64::min);
        let is_open = |candidate: &&mut Candidate| !(candidate.is_settled() && candidate.best > SAME * best);
        let mut open: Vec<&mut Candidate> = candidates.iter_mut().filter(is_open).collect();
        if open.len() <= 1 || (best.is_finite() && open.iter().all(|candidate| candidate.is_settled())) {
            break;
        }
        let seconds = time(&open)?;
        open.iter_mut().zip(seconds).for_each(|(candidate, seconds)| candidate.add(seconds));
    }
    Ok(candidates)
}

/// The words, `op/variant` and others, by their keys; lines that are none are left out.
fn read(folder: &Path) -> io::Result<BTreeMap<String, String>> {
    let text = fs::read_to_string(folder.join(FILE))?;
    let lines = text.lines().filter_map(|line| line.split_once(' '));
    Ok(lines.map(|(key, label)| (key.to_owned(), label.to_owned())).collect())
}

/// Adds a line to the file, which is written whole or not at all: another process may be reading, or adding one of its own.
fn keep(folder: &Path, key: &str, word: &str) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let lock = fs::File::create(folder.join(LOCK))?;
    // Where there are no locks, a line of another's may get lost, and is measured again.
    let _ = lock.lock();
    let mut known = read(folder).unwrap_or_default();
    known.insert(key.to_owned(), word.to_owned());
    let lines: String = known.iter().map(|(key, label)| format!("{key} {label}\n")).collect();
    let nanoseconds = SystemTime::UNIX_EPOCH.elapsed().map_or(0, |time| time.as_nanos());
    let new = folder.join(format!("{FILE}.{}.{nanoseconds}", std::process::id()));
    let written = fs::write(&new, lines).and_then(|()| fs::rename(&new, folder.join(FILE)));
    written.inspect_err(|_| drop(fs::remove_file(&new)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writers_at_once_lose_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let write = |writer: usize| (0..20).for_each(|line| keep(folder.path(), &format!("{writer}-{line}"), "word").unwrap());
        std::thread::scope(|scope| (0..4).for_each(|writer| drop(scope.spawn(move || write(writer)))));
        assert_eq!(read(folder.path()).unwrap().len(), 80);
    }
}
