use srn_plan::ops::embedding::{self, Embedding};
use srn_shaders::{EMBEDDING_BACKWARD, EMBEDDING_FORWARD};
use srn_tests::{Case, Sketch};

use crate::KernelTest;

pub static FORWARD: KernelTest = KernelTest {
    kernel: &EMBEDDING_FORWARD,
    // A copy.
    tolerance: 0.0,
    cases: forward,
    faults: &[("forward", "index[i / params.latent]", "index[i % params.batch]")],
};

pub static BACKWARD: KernelTest = KernelTest {
    kernel: &EMBEDDING_BACKWARD,
    // Worst 0 on llvmpipe: few terms; other drivers may contract them.
    tolerance: 1e-6,
    cases: backward,
    faults: &[("backward", "index[b] == instance", "index[b] != instance"), ("backward", "total += ", "total = ")],
};

#[test]
fn forward_matches_reference() {
    FORWARD.matches_reference();
}

#[test]
fn backward_matches_reference() {
    BACKWARD.matches_reference();
}

const SIZES: [Embedding; 4] = [
    Embedding { batch: 1, instances: 1, latent: 3 },
    Embedding { batch: 7, instances: 3, latent: 17 },
    Embedding { batch: 5, instances: 40, latent: 30 },
    Embedding { batch: 129, instances: 2, latent: 1 },
];

fn forward() -> Vec<Case> {
    SIZES.map(forward_case).into()
}

fn forward_case(e: Embedding) -> Case {
    let mut s = Sketch::new(format!("{e:?}"));
    let codes = s.random("codes", (e.instances * e.latent) as usize);
    let index = s.indices("index", e.batch as usize, e.instances);
    let z = s.scratch("z", (e.batch * e.latent) as usize);
    s.step(|b| embedding::forward(b, e, codes, index, z));
    s.finish()
}

fn backward() -> Vec<Case> {
    SIZES.map(backward_case).into()
}

fn backward_case(e: Embedding) -> Case {
    let mut s = Sketch::new(format!("{e:?}"));
    let index = s.indices("index", e.batch as usize, e.instances);
    let d_z = s.random("d_z", (e.batch * e.latent) as usize);
    let d_codes = s.scratch("d_codes", (e.instances * e.latent) as usize);
    s.step(|b| embedding::backward(b, e, index, d_z, d_codes));
    s.finish()
}
