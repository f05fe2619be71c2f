//! The two-shot fit.
