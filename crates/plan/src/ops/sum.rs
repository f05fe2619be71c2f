//! Sums of partial sums: the second stage of every reduction.

use srn_shaders::{SUM_FORWARD, SumParams};

use super::{output, read, size};
use crate::{BufferId, Builder, PlanError};

/// Groups that are summed separately, and the place of the first one in the output.
#[derive(Clone, Copy, Debug)]
pub struct Groups {
    /// How many.
    pub count: u32,
    /// Number of the first.
    pub first: u32,
}

impl Groups {
    /// Everything into one sum.
    pub const ONE: Groups = Groups { count: 1, first: 0 };

    /// `count` groups from 0.
    pub fn all(count: u32) -> Self {
        Groups { count, first: 0 }
    }
}

/// `y [groups, count] (+)= Σ_terms x [groups, terms, count]`.
pub fn forward(
    b: &mut Builder,
    groups: Groups,
    terms: u32,
    count: u32,
    x: BufferId,
    y: BufferId,
    accumulate: bool,
) -> Result<(), PlanError> {
    let args = [read(x, size([groups.count, terms, count])), output(y, size([groups.first + groups.count, count]), accumulate)];
    let params = SumParams { groups: groups.count, first_group: groups.first, terms, count, accumulate: accumulate.into() };
    b.step(&SUM_FORWARD, params, &args, [groups.count * count, 1, 1], terms.into(), 0)
}
