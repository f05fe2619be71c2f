//! Files as they should not be: changes of good ones, and anything.

use proptest::prelude::*;

/// So many cases, or SRN_FUZZ_CASES for a long search. What is found becomes a test of its own.
pub fn config(cases: u32) -> ProptestConfig {
    let cases = std::env::var("SRN_FUZZ_CASES").ok().and_then(|text| text.parse().ok()).unwrap_or(cases);
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
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
    /// A word that looks like a number becomes another.
    Number(usize, &'static str),
}

const NUMBERS: [&str; 12] =
    ["NaN", "inf", "-1e308", "1e999", "0", "-0.0", "1e-320", "4294967296", "18446744073709551615", "\"x\"", "[]", "null"];

fn change() -> impl Strategy<Value = Change> {
    prop_oneof![
        any::<usize>().prop_map(Change::Cut),
        (any::<usize>(), any::<u8>()).prop_map(|(at, byte)| Change::Flip(at, byte)),
        (any::<usize>(), proptest::collection::vec(any::<u8>(), 1..40)).prop_map(|(at, bytes)| Change::Insert(at, bytes)),
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
