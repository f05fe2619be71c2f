//! The whole model: against golden values, finite differences and itself (other tiles, other executors), and what it does.

mod golden;
