//! Parameter structs. Each mirrors the `Params` of the kernels that name it; a test compares names, offsets and sizes through naga.

use bytemuck::{Pod, Zeroable};

/// Scalar type of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scalar {
    /// 32-bit unsigned integer.
    U32,
    /// 32-bit float.
    F32,
}

/// Names, types and offsets of a parameter struct.
#[derive(Debug)]
pub struct ParamsLayout {
    /// Name of the Rust struct.
    pub name: &'static str,
    /// Size in bytes.
    pub size: usize,
    /// `(name, scalar, byte offset)` of each field, in order.
    pub fields: &'static [(&'static str, Scalar, usize)],
}

/// A parameter struct with its layout.
pub trait Params: Pod {
    /// The layout that the WGSL struct must have.
    const LAYOUT: ParamsLayout;
}

macro_rules! scalar {
    (u32) => {
        Scalar::U32
    };
    (f32) => {
        Scalar::F32
    };
}

macro_rules! params {
    ($($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $ty:ident),* $(,)? })*) => {$(
        $(#[$doc])*
        #[repr(C)]
        #[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $ty,)*
        }
        impl Params for $name {
            const LAYOUT: ParamsLayout = ParamsLayout {
                name: stringify!($name),
                size: size_of::<$name>(),
                fields: &[$((stringify!($field), scalar!($ty), std::mem::offset_of!($name, $field))),*],
            };
        }
    )*};
}

params! {
    /// `pose/*`, `bfgs/*` but for `equations` and `solve`: number of poses.
    PoseParams {
        /// Number of poses.
        poses: u32,
    }
    /// `bfgs/solve`.
    SolveParams {
        /// Number of poses.
        poses: u32,
        /// Of which steps are multiples; 0: they have any length.
        grain: f32,
    }
    /// `rays/*`: rows of a tile and the images they belong to.
    RaysParams {
        /// Images in this tile.
        groups: u32,
        /// Rows of each image in this tile.
        rows_per_group: u32,
        /// Number of the tile's first image.
        first_group: u32,
        /// Rows per partial sum (`backward`).
        chunk_rows: u32,
        /// Partial sums per image (`backward`): `ceil(rows_per_group / chunk_rows)`.
        chunks: u32,
        /// Radius of the sphere on which rays begin; 0: they begin at the camera.
        sphere: f32,
    }
    /// `depth/*`: rows of a tile and the images they belong to.
    DepthParams {
        /// Images in this tile.
        groups: u32,
        /// Rows of each image in this tile.
        rows_per_group: u32,
        /// Number of the tile's first image.
        first_group: u32,
        /// Factor on the gradient (`backward`).
        scale: f32,
    }
    /// `tile/*`: which rows of the whole batch a tile holds.
    TileParams {
        /// Images in this tile.
        groups: u32,
        /// Rows of each image in this tile.
        rows_per_group: u32,
        /// Number of the tile's first image.
        first_group: u32,
        /// Number of the tile's first row within each image.
        first_row: u32,
        /// Rows of each image in the whole batch.
        rows_per_image: u32,
        /// Values per row.
        columns: u32,
    }
    /// `embedding/*`.
    EmbeddingParams {
        /// Rows of `index`.
        batch: u32,
        /// Rows of the table of codes.
        instances: u32,
        /// Length of a code.
        latent: u32,
    }
    /// `linear/*`.
    LinearParams {
        /// Groups of rows; each has one set of weights.
        groups: u32,
        /// Rows of each group.
        rows_per_group: u32,
        /// Number of the first group: group `g` uses the weights `slots[first_group + g]`.
        first_group: u32,
        /// Values per input row.
        in_features: u32,
        /// Values per output row.
        out_features: u32,
        /// Distance between two sets of weights, in elements; 0 where all groups share one.
        weight_stride: u32,
        /// 1: add to the output, 0: overwrite it.
        accumulate: u32,
        /// Output features per partial sum (`backward_input`).
        chunk_outs: u32,
        /// Rows per partial sum (`backward_weight`).
        chunk_rows: u32,
        /// Partial sums per group: `ceil(out_features / chunk_outs)` (`backward_input`), `ceil(rows_per_group / chunk_rows)` (`backward_weight`).
        chunks: u32,
    }
    /// `point_layer/*`.
    PointLayerParams {
        /// Groups of rows; each has one set of weights.
        groups: u32,
        /// Rows of each group.
        rows_per_group: u32,
        /// Number of the first group: group `g` uses the weights `slots[first_group + g]`.
        first_group: u32,
        /// Values per output row.
        features: u32,
        /// Distance between two sets of weights, in elements; 0 where all groups share one.
        weight_stride: u32,
        /// 1: add to the output, 0: overwrite it (`backward_input`).
        accumulate: u32,
    }
    /// `hidden_layer/*`.
    HiddenLayerParams {
        /// Groups of rows; each has one set of weights.
        groups: u32,
        /// Rows of each group.
        rows_per_group: u32,
        /// Number of the first group: group `g` uses the weights `slots[first_group + g]`.
        first_group: u32,
        /// Values per input row.
        in_features: u32,
        /// Values per output row.
        out_features: u32,
        /// Distance between two sets of weights, in elements; 0 where all groups share one.
        weight_stride: u32,
        /// 1: the rows that the norm reads have no mean, as in `LayerNormParams`.
        centred: u32,
    }
    /// `layer_norm_relu/*`.
    LayerNormParams {
        /// Rows.
        rows: u32,
        /// Rows of each group (`backward_affine`).
        rows_per_group: u32,
        /// Values per row.
        features: u32,
        /// 1: add to the output, 0: overwrite it (`backward_affine`).
        accumulate: u32,
        /// Rows per partial sum (`backward_affine`).
        chunk_rows: u32,
        /// Partial sums per group (`backward_affine`): `ceil(rows_per_group / chunk_rows)`.
        chunks: u32,
        /// 1: the rows have no mean, and none is looked for, neither of them nor, on the way back, of `e`.
        centred: u32,
    }
    /// `lstm_cell/*`.
    LstmParams {
        /// Rows.
        rows: u32,
        /// Size of the hidden state.
        hidden: u32,
    }
    /// `advance/*`.
    AdvanceParams {
        /// Rows.
        rows: u32,
        /// Size of the hidden state.
        hidden: u32,
        /// 1: add to the outputs, 0: overwrite them.
        accumulate: u32,
    }
    /// `density_sum/*`.
    DensitySumParams {
        /// Rays.
        rows: u32,
        /// Values per row before the head of g.
        in_features: u32,
        /// Features of f.
        features: u32,
        /// 1: add to phi, 0: overwrite it.
        accumulate: u32,
    }
    /// `depth_loss/*`, `latent_loss/*`: a weighted sum over all values.
    TermParams {
        /// Number of values.
        count: u32,
        /// Values per partial sum.
        chunk: u32,
        /// Partial sums: `ceil(count / chunk)`.
        chunks: u32,
        /// Factor on the sum, or on the gradient.
        scale: f32,
    }
    /// `image_loss/*`.
    ImageLossParams {
        /// 0 MAE, 1 MSE, 2 norm_l1, 3 norm_l2, 4 Charbonnier.
        kind: u32,
        /// Images.
        groups: u32,
        /// Rows (pixels) of each image.
        rows_per_group: u32,
        /// Number of the first image.
        first_group: u32,
        /// Values of a whole image (3 × pixels), the divisor of MAE, MSE and Charbonnier.
        values_per_image: u32,
        /// Rows per partial sum.
        chunk_rows: u32,
        /// Partial sums per image: `ceil(rows_per_group / chunk_rows)`.
        chunks: u32,
        /// Factor on the gradient.
        scale: f32,
        /// Residual at which Charbonnier turns from squares to absolute values.
        soft: f32,
    }
    /// `gmsd/*`.
    GmsdParams {
        /// Images.
        images: u32,
        /// Pixels per image row, before pooling.
        width: u32,
        /// Pixel rows per image, before pooling.
        height: u32,
        /// Pooled pixels per partial sum (`moments`).
        chunk: u32,
        /// Partial sums per image (`moments`).
        chunks: u32,
        /// Factor on the gradient (`backward_similarity`).
        scale: f32,
    }
    /// `adam/step`.
    AdamParams {
        /// Number of values.
        count: u32,
        /// Decay of the first moment.
        beta1: f32,
        /// Decay of the second moment.
        beta2: f32,
        /// `1 - beta1`, rounded once: the difference of the rounded numbers is off by 1e-5 of itself.
        one_minus_beta1: f32,
        /// `1 - beta2`.
        one_minus_beta2: f32,
        /// Added to the denominator.
        epsilon: f32,
    }
    /// `sum/forward`.
    SumParams {
        /// Groups, summed separately.
        groups: u32,
        /// Number of the first group in the output.
        first_group: u32,
        /// Terms per group.
        terms: u32,
        /// Values per term.
        count: u32,
        /// 1: add to the output, 0: overwrite it.
        accumulate: u32,
    }
    /// `bfgs/equations`: rows of a tile, and the residual of one channel.
    EquationsParams {
        /// Images in this tile.
        groups: u32,
        /// Rows of each image in this tile.
        rows_per_group: u32,
        /// Number of the tile's first image.
        first_group: u32,
        /// Rows per partial sum.
        chunk_rows: u32,
        /// Partial sums per image: `ceil(rows_per_group / chunk_rows)`.
        chunks: u32,
        /// 0 red, 1 green, 2 blue.
        channel: u32,
        /// What the backward pass began with: gradients are those of `seed · rgb[channel]`.
        seed: f32,
        /// Factor on the weights.
        scale: f32,
        /// Residual at which the loss turns from squares to absolute values.
        soft: f32,
        /// Radius of the sphere on which rays begin; 0: they begin at the camera.
        sphere: f32,
    }
    /// `pack_rgba8/forward`.
    PackParams {
        /// Pixels per row.
        width: u32,
        /// Rows.
        height: u32,
        /// Distance between two output rows, in pixels (texture copies want 64).
        stride: u32,
        /// First pixel of the image in `rgb`.
        first_pixel: u32,
    }
}
