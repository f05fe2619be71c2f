//! Latent codes of the instances in a batch.

use srn_shaders::EmbeddingParams;

use crate::Real;

/// `z[b] = codes[index[b]]`.
pub fn forward<T: Real>(p: EmbeddingParams, codes: &[T], index: &[u32], z: &mut [T]) {
    let latent = p.latent as usize;
    for (z, &instance) in z.chunks_exact_mut(latent).zip(index).take(p.batch as usize) {
        z.copy_from_slice(&codes[instance as usize * latent..][..latent]);
    }
}

/// `d_codes[n] = Σ_{b: index[b]=n} d_z[b]`.
pub fn backward<T: Real>(p: EmbeddingParams, index: &[u32], d_z: &[T], d_codes: &mut [T]) {
    let latent = p.latent as usize;
    d_codes[..p.instances as usize * latent].fill(T::zero());
    for (d_z, &instance) in d_z.chunks_exact(latent).zip(index).take(p.batch as usize) {
        for (sum, &d) in d_codes[instance as usize * latent..].iter_mut().zip(d_z) {
            *sum += d;
        }
    }
}
