//! One op, one name, five places: kernel, reference, step, test with a planted fault, label. No part is missing, none is left over.

use std::collections::BTreeSet;

use srn_shaders::{Kernel, TABLE};

use crate::{files, text};

const REFERENCES: &str = "crates/cpu/src/ops";
const STEPS: &str = "crates/plan/src/ops";
const TESTS: &str = "tests/kernels";

/// Every kernel with the text of its op's file in a folder.
fn kernels(folder: &str) -> impl Iterator<Item = (&'static Kernel, String, String)> {
    TABLE.iter().map(move |kernel| {
        let path = format!("{folder}/{}.rs", kernel.op);
        (*kernel, text(&path), path)
    })
}

/// The name of the kernel's static in `srn_shaders`: `linear/backward_input` is `LINEAR_BACKWARD_INPUT`.
fn constant(kernel: &Kernel) -> String {
    kernel.name.replace('/', "_").to_uppercase()
}

#[test]
fn every_kernel_has_a_reference() {
    for (kernel, text, path) in kernels(REFERENCES) {
        let Kernel { name, direction, .. } = kernel;
        assert!(text.contains(&format!("pub fn {direction}<T")), "{path}: no `pub fn {direction}`, the reference of {name}");
        assert!(srn_cpu::ops::implements(name), "crates/cpu/src/executor.rs: {name} is not among the references");
    }
}

#[test]
fn every_kernel_has_a_step() {
    for (kernel, text, path) in kernels(STEPS) {
        // Imports name the kernel without the ampersand.
        let is_there = text.contains(&format!("&{},", constant(kernel)));
        assert!(is_there, "{path}: no step runs {}", kernel.name);
    }
}

#[test]
fn every_kernel_has_a_test_with_a_planted_fault() {
    for (kernel, text, path) in kernels(TESTS) {
        let Kernel { name, direction, .. } = kernel;
        assert!(text.contains(&format!("fn {direction}_matches_reference()")), "{path}: no `{direction}_matches_reference`");
        assert!(text.contains(&format!("kernel: &{},", constant(kernel))), "{path}: no test of {name}");
        for variant in kernel.variants {
            assert!(text.contains(&format!("(\"{}\", ", variant.name)), "{path}: no fault is planted into {}", variant.name);
        }
    }
}

#[test]
fn labels_are_op_and_direction() {
    let mut names = BTreeSet::new();
    for kernel in TABLE {
        assert_eq!(kernel.name, format!("{}/{}", kernel.op, kernel.direction));
        assert!(names.insert(kernel.name), "{} is in the table twice", kernel.name);
    }
}

#[test]
fn no_file_is_left_over() {
    let ops: BTreeSet<&str> = TABLE.iter().map(|kernel| kernel.op).collect();
    for (folder, others) in [(REFERENCES, &["mod"][..]), (STEPS, &["mod"]), (TESTS, &["main", "executor", "lockstep"])] {
        for path in files(folder, ".rs") {
            let name = path.strip_prefix(folder).unwrap().trim_start_matches('/').trim_end_matches(".rs");
            assert!(ops.contains(name) || others.contains(&name), "{path} belongs to no op of the table");
        }
    }
}

#[test]
fn no_function_is_left_over() {
    for path in files(REFERENCES, ".rs").iter().filter(|path| !path.ends_with("/mod.rs")) {
        let op = path.rsplit('/').next().unwrap().trim_end_matches(".rs");
        for line in text(path).lines().filter_map(|line| line.strip_prefix("pub fn ")) {
            let name = line.split(['<', '(']).next().unwrap();
            assert!(srn_shaders::find(&format!("{op}/{name}")).is_some(), "{path}: `{name}` is no kernel of the table");
        }
    }
    for line in text("crates/cpu/src/executor.rs").lines().filter(|line| line.contains("\" => ")) {
        let name = line.trim().split('"').nth(1).unwrap();
        assert!(srn_shaders::find(name).is_some(), "crates/cpu/src/executor.rs: `{name}` is no kernel of the table");
    }
    for path in files(TESTS, ".rs") {
        let op = path.rsplit('/').next().unwrap().trim_end_matches(".rs").to_owned();
        for name in text(&path).lines().filter_map(|line| line.strip_prefix("fn ")?.strip_suffix("_matches_reference() {")) {
            assert!(srn_shaders::find(&format!("{op}/{name}")).is_some(), "{path}: `{name}` is no kernel of the table");
        }
    }
}
