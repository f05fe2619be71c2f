//! Latent codes of the instances in a batch.

use srn_shaders::{EMBEDDING_BACKWARD, EMBEDDING_FORWARD, EmbeddingParams};

use super::{overwrite, read, size};
use crate::{BufferId, Builder, PlanError};

/// Sizes of the table of codes and of the batch.
#[derive(Clone, Copy, Debug)]
pub struct Embedding {
    /// Rows of the batch.
    pub batch: u32,
    /// Rows of the table.
    pub instances: u32,
    /// Length of a code.
    pub latent: u32,
}

/// `codes [instances, latent]`, `index [batch]` → `z [batch, latent]`.
pub fn forward(b: &mut Builder, e: Embedding, codes: BufferId, index: BufferId, z: BufferId) -> Result<(), PlanError> {
    let args =
        [read(codes, size([e.instances, e.latent])), read(index, size([e.batch])), overwrite(z, size([e.batch, e.latent]))];
    b.step(&EMBEDDING_FORWARD, params(e), &args, [e.batch * e.latent, 1, 1], 0, 0)
}

/// `d_z [batch, latent]` → `d_codes [instances, latent]`, zero for instances outside the batch.
pub fn backward(b: &mut Builder, e: Embedding, index: BufferId, d_z: BufferId, d_codes: BufferId) -> Result<(), PlanError> {
    let args =
        [read(index, size([e.batch])), read(d_z, size([e.batch, e.latent])), overwrite(d_codes, size([e.instances, e.latent]))];
    b.step(&EMBEDDING_BACKWARD, params(e), &args, [e.instances * e.latent, 1, 1], e.batch.into(), 0)
}

fn params(e: Embedding) -> EmbeddingParams {
    EmbeddingParams { batch: e.batch, instances: e.instances, latent: e.latent }
}
