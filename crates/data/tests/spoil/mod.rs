//! Files as they should not be: changes of good ones, and anything.

use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::time::{Duration, Instant};

/// Beyond this an input counts as found to hang a reader. Far more than any takes, since machines may be busy.
const LONGEST: Duration = Duration::from_secs(20);

/// No reader may ask for more bytes at once: somewhat more than the decoders of pictures allow themselves, half a GiB.
const MOST_BYTES: usize = 600 << 20;

/// Tries a check on so many inputs, or on new ones for SRN_FUZZ_SECONDS, and prints how many there were. A check must not panic,
/// nor take too long, nor ask for too much memory. What is found becomes a test of its own.
pub fn fuzz<S: Strategy>(target: &str, inputs: u32, strategy: &S, check: impl Fn(S::Value) -> Result<(), TestCaseError>) {
    let seconds = std::env::var("SRN_FUZZ_SECONDS").map_or(0, |text| text.parse().expect("SRN_FUZZ_SECONDS: a whole number"));
    let begin = Instant::now();
    let tried = Cell::new(0u64);
    let checked = |input| {
        tried.set(tried.get() + 1);
        LARGEST.set(0);
        let begin = Instant::now();
        check(input)?;
        prop_assert!(begin.elapsed() < LONGEST, "took {:.0} s", begin.elapsed().as_secs_f64());
        prop_assert!(LARGEST.get() < MOST_BYTES, "asked for {} bytes at once", LARGEST.get());
        Ok(())
    };
    loop {
        // Each runner has a seed of its own.
        let config = ProptestConfig { cases: inputs, failure_persistence: None, ..ProptestConfig::default() };
        let found = TestRunner::new(config).run(strategy, checked);
        let is_last = found.is_err() || begin.elapsed() >= Duration::from_secs(seconds);
        if is_last {
            let [findings, seconds] = [u64::from(found.is_err()), begin.elapsed().as_secs()];
            println!("fuzzed {target}: {} inputs, {findings} findings, {seconds} s", tried.get());
        }
        match found {
            Err(found) => panic!("{target}: {found}"),
            Ok(()) if is_last => return,
            Ok(()) => {}
        }
    }
}

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

/// The system's allocator, which notes the largest request of each thread.
struct Watch;

#[global_allocator]
static WATCH: Watch = Watch;

// SAFETY: all is done by the system's allocator.
unsafe impl GlobalAlloc for Watch {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(layout.size()));
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(layout.size()));
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, old: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.set(LARGEST.get().max(size));
        unsafe { System.realloc(old, layout, size) }
    }

    unsafe fn dealloc(&self, old: *mut u8, layout: Layout) {
        unsafe { System.dealloc(old, layout) }
    }
}

/// One change of a file.
#[derive(Debug, Clone)]
pub enum Change {
    /// Ends here.
    Cut(usize),
    /// Other bits in one byte.
    Flip(usize, u8),
    /// More bytes.
    Insert(usize, Vec<u8>),
    /// A stretch of it twice: fields that should be there once, nesting, more than was declared.
    Repeat(usize, usize),
    /// A word that looks like a number becomes another.
    Number(usize, &'static str),
}

const NUMBERS: [&str; 14] = [
    "NaN",
    "inf",
    "-1e308",
    "1e999",
    "0",
    "-0.0",
    "1e-320",
    "-1",
    "4000000000",
    "4294967296",
    "18446744073709551615",
    "\"x\"",
    "[]",
    "null",
];

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        any::<usize>().prop_map(Change::Cut),
        (any::<usize>(), any::<u8>()).prop_map(|(at, byte)| Change::Flip(at, byte)),
        (any::<usize>(), proptest::collection::vec(any::<u8>(), 1..40)).prop_map(|(at, bytes)| Change::Insert(at, bytes)),
        (any::<usize>(), 1usize..200).prop_map(|(at, length)| Change::Repeat(at, length)),
        (any::<usize>(), proptest::sample::select(&NUMBERS[..])).prop_map(|(at, number)| Change::Number(at, number)),
    ]
}

impl Change {
    /// Changes a file.
    fn apply(&self, bytes: &mut Vec<u8>) {
        let length = bytes.len().max(1);
        match self {
            Change::Cut(at) => bytes.truncate(at % length),
            Change::Flip(at, byte) => bytes.iter_mut().skip(at % length).take(1).for_each(|b| *b ^= byte),
            Change::Insert(at, new) => drop(bytes.splice(at % length..at % length, new.iter().copied())),
            Change::Repeat(at, stretch) => {
                let start = at % length;
                let again = bytes[start.min(bytes.len())..].iter().copied().take(*stretch).collect::<Vec<_>>();
                bytes.splice(start..start, again);
            }
            Change::Number(at, number) => {
                let is_digit = |b: &u8| b"0123456789.-e".contains(b);
                let start = (at % length..bytes.len()).find(|&i| is_digit(&bytes[i])).unwrap_or(bytes.len());
                let end = (start..bytes.len()).find(|&i| !is_digit(&bytes[i])).unwrap_or(bytes.len());
                bytes.splice(start..end, number.bytes());
            }
        }
    }
}

/// What a file is replaced by.
#[derive(Debug, Clone)]
pub enum Spoiled {
    /// The file with changes.
    Changed(Vec<Change>),
    /// Anything.
    Bytes(Vec<u8>),
}

/// Any of it.
pub fn spoiled() -> impl Strategy<Value = Spoiled> {
    prop_oneof![
        6 => proptest::collection::vec(change(), 1..4).prop_map(Spoiled::Changed),
        1 => proptest::collection::vec(any::<u8>(), 0..300).prop_map(Spoiled::Bytes),
        1 => "[0-9eE.,:\\-\\[\\]{}\" \n]{0,200}".prop_map(|text| Spoiled::Bytes(text.into_bytes())),
    ]
}

impl Spoiled {
    /// The bad file of a good one.
    pub fn of(&self, good: &[u8]) -> Vec<u8> {
        let mut bytes = good.to_vec();
        match self {
            Spoiled::Changed(changes) => changes.iter().for_each(|change| change.apply(&mut bytes)),
            Spoiled::Bytes(other) => bytes.clone_from(other),
        }
        bytes
    }
}
