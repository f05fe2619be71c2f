//! The table of kernels. A test without a GPU walks it and fails where a kernel, reference, step or test is missing.

use crate::params::*;
use crate::{Binding, Element, Kernel, Requirement, Variant};

macro_rules! element {
    (f32) => {
        Element::F32
    };
    (u32) => {
        Element::U32
    };
}

macro_rules! table {
    ($(
        $(#[$doc:meta])*
        $id:ident = $op:literal / $direction:literal, $params:ident, tile $tile:expr,
        ($($in:ident: $in_ty:ident),*) -> ($($out:ident: $out_ty:ident),*)
        $(, with [$($with:literal),*])?
        $(, or $variant:literal tile $variant_tile:expr, when [$($requires:ident),*] $(, with [$($variant_with:literal),*])?)*;
    )*) => {
        $(
            $(#[$doc])*
            pub static $id: Kernel = Kernel {
                op: $op,
                direction: $direction,
                name: concat!($op, "/", $direction),
                bindings: &[
                    $(Binding { name: stringify!($in), element: element!($in_ty), written: false },)*
                    $(Binding { name: stringify!($out), element: element!($out_ty), written: true },)*
                ],
                params: &$params::LAYOUT,
                variants: &[
                    Variant {
                        name: $direction,
                        text: include_str!(concat!("../", $op, "/", $direction, ".wgsl")),
                        with: &[$($(include_str!(concat!("../common/", $with, ".wgsl"))),*)?],
                        tile: $tile,
                        requires: &[],
                    },
                    $(Variant {
                        name: $variant,
                        text: include_str!(concat!("../", $op, "/", $variant, ".wgsl")),
                        with: &[$($(include_str!(concat!("../common/", $variant_with, ".wgsl"))),*)?],
                        tile: $variant_tile,
                        requires: &[$(Requirement::$requires),*],
                    },)*
                ],
            };
        )*
        /// Every kernel, in the order of the forward pass.
        pub static TABLE: &[&Kernel] = &[$(&$id),*];
    };
}

/// One invocation per element, 64 to a workgroup.
const FLAT: [u32; 3] = [64, 1, 1];

table! {
    /// `R = Rx(θ1)·Ry(θ2)·Rz(θ3)`, `world_from_camera = [R | t]` (spec 1). `pose6 [B,6]` → `world_from_camera [B,12]`, 3×4 row-major.
    POSE_FORWARD = "pose"/"forward", PoseParams, tile FLAT,
        (pose6: f32) -> (world_from_camera: f32);
    /// Chain rule from `d_world_from_camera [B,12]` to the six numbers `d_pose6 [B,6]`.
    POSE_BACKWARD = "pose"/"backward", PoseParams, tile FLAT,
        (pose6: f32, d_world_from_camera: f32) -> (d_pose6: f32);
    /// `q = ((u-cx)/fx, (v-cy)/fy, 1)`, `direction = normalize(R q)`, `origin = t + s direction + R (z0 q)`, where the line of the ray
    /// enters the sphere at `t + s direction`; without a sphere `s = 0`.
    /// `world_from_camera [images,12]`, `intrinsics [images,4]` (fx, fy, cx, cy), `uv [rows,2]`, `z0 [rows]` → `origin, direction [rows,3]`.
    RAYS_FORWARD = "rays"/"forward", RaysParams, tile FLAT,
        (world_from_camera: f32, intrinsics: f32, uv: f32, z0: f32) -> (origin: f32, direction: f32);
    /// Sums each image's rows into `partial [groups, chunks, 12]`, the gradient of `world_from_camera`; `d_origin, d_direction [rows,3]`.
    RAYS_BACKWARD = "rays"/"backward", RaysParams, tile FLAT,
        (world_from_camera: f32, intrinsics: f32, uv: f32, z0: f32, d_origin: f32, d_direction: f32) -> (partial: f32);
    /// Copies a tile's rows out of the whole batch: `whole [images · rows_per_image, columns]` → `part [rows, columns]`.
    TILE_GATHER = "tile"/"gather", TileParams, tile FLAT,
        (whole: f32) -> (part: f32);
    /// Copies a tile's rows into the whole batch; other rows stay.
    TILE_SCATTER = "tile"/"scatter", TileParams, tile FLAT,
        (part: f32) -> (whole: f32);
    /// `z[b] = codes[index[b]]`: `codes [instances, latent]`, `index [B]` → `z [B, latent]`.
    EMBEDDING_FORWARD = "embedding"/"forward", EmbeddingParams, tile FLAT,
        (codes: f32, index: u32) -> (z: f32);
    /// `d_codes[n] = Σ_{b: index[b]=n} d_z[b]`, zero for codes outside the batch.
    EMBEDDING_BACKWARD = "embedding"/"backward", EmbeddingParams, tile FLAT,
        (index: u32, d_z: f32) -> (d_codes: f32);
    /// `y[r,o] (+)= Σ_i W[o,i] x[r,i] + b[o]`, weights at `slots[first_group + r / rows_per_group] · weight_stride`.
    /// Extent: rows of a group × out_features × groups.
    LINEAR_FORWARD = "linear"/"forward", LinearParams, tile [64, 32, 1],
        (x: f32, weights: f32, slots: u32) -> (y: f32), with ["weights_of"],
        or "forward_vec4" tile [64, 64, 1], when [FeaturesMultipleOf4], with ["weights_of"],
        or "forward_workgroup" tile [64, 64, 1], when [FeaturesMultipleOf4], with ["weights_of"],
        or "forward_subgroup" tile [128, 64, 1], when [FeaturesMultipleOf4, Subgroups], with ["weights_of", "eight"],
        or "forward_cooperative" tile [64, 128, 1], when [FeaturesMultipleOf4, FeaturesAtMost1024, CooperativeMatrices], with ["weights_of", "halves"];
    /// `d_x[g,c,r,i] (+)= Σ_o W[o,i] d_y[g,r,o]` over the output features of chunk `c`, `d_x [groups, chunks, rows_per_group, in]`.
    /// Extent: rows of a group × in_features × (groups · chunks).
    LINEAR_BACKWARD_INPUT = "linear"/"backward_input", LinearParams, tile [64, 32, 1],
        (d_y: f32, weights: f32, slots: u32) -> (d_x: f32), with ["weights_of"],
        or "backward_input_vec4" tile [64, 64, 1], when [FeaturesMultipleOf4], with ["weights_of"],
        or "backward_input_workgroup" tile [64, 64, 1], when [FeaturesMultipleOf4], with ["weights_of"],
        or "backward_input_subgroup" tile [128, 64, 1], when [FeaturesMultipleOf4, Subgroups], with ["weights_of", "eight"],
        or "backward_input_cooperative" tile [64, 128, 1], when [FeaturesMultipleOf4, FeaturesAtMost1024, CooperativeMatrices], with ["weights_of", "halves"];
    /// `partial[g,c] (+)= (Σ_r d_y[r,o] x[r,i], Σ_r d_y[r,o])` over the rows of chunk `c`: weight, then bias; `[groups, chunks, out·in + out]`.
    /// Extent: out_features × in_features × (groups · chunks). (Independent of `slots`: group `g` writes set `g`.)
    LINEAR_BACKWARD_WEIGHT = "linear"/"backward_weight", LinearParams, tile [32, 32, 1],
        (x: f32, d_y: f32) -> (partial: f32),
        or "backward_weight_rows" tile [32, 4, 1], when [],
        or "backward_weight_vec4" tile [64, 64, 1], when [FeaturesMultipleOf4],
        or "backward_weight_workgroup" tile [64, 64, 1], when [FeaturesMultipleOf4],
        or "backward_weight_subgroup" tile [128, 128, 1], when [FeaturesMultipleOf4, Subgroups], with ["eight"];
    /// `y = relu(gamma (x - mean) rstd + beta)`, `rstd = 1/√(var + 1e-5)`, biased variance.
    /// `x [rows, features]`, `affine [2, features]` → `y`, `stats [rows,2]` = (mean, rstd). Extent: rows.
    LAYER_NORM_RELU_FORWARD = "layer_norm_relu"/"forward", LayerNormParams, tile FLAT,
        (x: f32, affine: f32) -> (y: f32, stats: f32),
        or "forward_vec4" tile FLAT, when [FeaturesMultipleOf4],
        or "forward_subgroup" tile [128, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["team"],
        or "forward_short" tile [16, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["teams"];
    /// Gradient to `x`: with `e = gamma · d_y` where `y > 0`, else 0: `d_x = rstd (e - mean(e) - x̂ mean(e x̂))`. Extent: rows.
    LAYER_NORM_RELU_BACKWARD_INPUT = "layer_norm_relu"/"backward_input", LayerNormParams, tile FLAT,
        (x: f32, stats: f32, affine: f32, d_y: f32) -> (d_x: f32),
        or "backward_input_vec4" tile FLAT, when [FeaturesMultipleOf4],
        or "backward_input_subgroup" tile [128, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["team"],
        or "backward_input_short" tile [16, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["teams"];
    /// Sums of `d_y x̂` and `d_y` (where `y > 0`) over the rows of each chunk: `partial [chunks, 2, features]`. Extent: features × chunks.
    LAYER_NORM_RELU_BACKWARD_AFFINE = "layer_norm_relu"/"backward_affine", LayerNormParams, tile [64, 1, 1],
        (x: f32, stats: f32, affine: f32, d_y: f32) -> (partial: f32),
        or "backward_affine_vec4" tile [256, 1, 1], when [FeaturesMultipleOf4],
        or "backward_affine_workgroup" tile [32, 1, 1], when [FeaturesMultipleOf4];
    /// `linear/forward` and then `layer_norm_relu/forward` of what it makes, `z`. No plan has this step: a device that is faster so joins the two.
    /// `x [rows, in]`, `affine [2, out]` → `z, y [rows, out]`, `stats [rows, 2]`. Extent: rows of a group × 1 × groups.
    HIDDEN_LAYER_FORWARD = "hidden_layer"/"forward", HiddenLayerParams, tile FLAT,
        (x: f32, weights: f32, slots: u32, affine: f32) -> (z: f32, y: f32, stats: f32), with ["weights_of"],
        or "forward_workgroup" tile [32, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost64], with ["weights_of"];
    /// `linear/backward_input` and then `layer_norm_relu/backward_input` of the layer before, likewise: from the gradient `d_z` of this layer to
    /// `d_y` and `d_z` of that one, which has as many features and takes the place of this one's. `x` is what the norm of that one read. Extent: rows of a group × 1 × groups.
    HIDDEN_LAYER_BACKWARD_INPUT = "hidden_layer"/"backward_input", HiddenLayerParams, tile FLAT,
        (weights: f32, slots: u32, x: f32, stats: f32, affine: f32) -> (d_y: f32, d_z: f32), with ["weights_of"],
        or "backward_input_workgroup" tile [32, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost64], with ["weights_of"];
    /// The first layer of a network of points, where no weight takes a gradient: linear map, layer norm and ReLU in one, and nothing kept.
    /// `z = W x + b`, `y = relu(gamma (z - mean) rstd + beta)`; `x [rows, 3]`, `affine [2, features]` → `y [rows, features]`.
    /// Extent: rows of a group × 1 × groups.
    POINT_LAYER_FORWARD = "point_layer"/"forward", PointLayerParams, tile FLAT,
        (x: f32, weights: f32, slots: u32, affine: f32) -> (y: f32), with ["weights_of"],
        or "forward_subgroup" tile [128, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["weights_of", "team", "point_weights"],
        or "forward_short" tile [16, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["weights_of", "teams", "point_weights"];
    /// `d_x (+)= Wᵀ d_z`, `d_z` as the gradient of `layer_norm_relu`. Extent: rows of a group × 1 × groups.
    POINT_LAYER_BACKWARD_INPUT = "point_layer"/"backward_input", PointLayerParams, tile FLAT,
        (x: f32, weights: f32, slots: u32, affine: f32, d_y: f32) -> (d_x: f32), with ["weights_of"],
        or "backward_input_subgroup" tile [128, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["weights_of", "team", "point_weights"],
        or "backward_input_short" tile [16, 1, 1], when [FeaturesMultipleOf4, FeaturesAtMost256, Subgroups], with ["weights_of", "teams", "point_weights"];
    /// Gates in the order i, f, g, o: `c = σ(f) c_prev + σ(i) tanh(g)`, `h = σ(o) tanh(c)`.
    /// `gates [rows, 4·hidden]` before activation, `c_prev [rows, hidden]` → `h, c [rows, hidden]`. Extent: rows · hidden.
    LSTM_CELL_FORWARD = "lstm_cell"/"forward", LstmParams, tile FLAT,
        (gates: f32, c_prev: f32) -> (h: f32, c: f32),
        or "forward_vec4" tile [256, 1, 1], when [FeaturesMultipleOf4];
    /// Clamps `d_h` to ±10, then back to the gates (before activation) and to `c_prev`; `d_c` arrives from the next step.
    LSTM_CELL_BACKWARD = "lstm_cell"/"backward", LstmParams, tile FLAT,
        (gates: f32, c_prev: f32, c: f32, d_h: f32, d_c: f32) -> (d_gates: f32, d_c_prev: f32),
        or "backward_vec4" tile [256, 1, 1], when [FeaturesMultipleOf4];
    /// `step = ⟨head, h⟩ + bias`, `x_next = x + direction · step`; `x, direction, x_next [rows,3]`, `h [rows, hidden]`, `head [hidden + 1]`,
    /// `step [rows]`. Extent: rows.
    ADVANCE_FORWARD = "advance"/"forward", AdvanceParams, tile FLAT,
        (x: f32, direction: f32, h: f32, head: f32) -> (step: f32, x_next: f32);
    /// `d_step = d_x_next · direction` (overwrites), `d_direction (+)= d_x_next step`, `d_h (+)= d_step head`. (`d_x = d_x_next`: the caller keeps
    /// the buffer.)
    ADVANCE_BACKWARD = "advance"/"backward", AdvanceParams, tile FLAT,
        (direction: f32, step: f32, d_x_next: f32, head: f32) -> (d_step: f32, d_direction: f32, d_h: f32);
    /// The last layer of g, and the sum: `density[r] = ⟨head, hidden[r]⟩ + bias`, `phi[r] (+)= density[r] feature[r]`;
    /// `hidden [rows, in]`, `head [in + 1]`, `feature, phi [rows, features]`, `density [rows]`. Extent: rows.
    DENSITY_SUM_FORWARD = "density_sum"/"forward", DensitySumParams, tile FLAT,
        (hidden: f32, head: f32, feature: f32) -> (density: f32, phi: f32),
        or "forward_vec4" tile FLAT, when [FeaturesMultipleOf4],
        or "forward_subgroup" tile [8, 1, 1], when [FeaturesMultipleOf4, Subgroups];
    /// `d_density[r] = ⟨d_phi[r], feature[r]⟩`, `d_feature[r] = density[r] d_phi[r]`, `d_hidden[r] = d_density[r] head`; all overwrite. Extent: rows.
    DENSITY_SUM_BACKWARD = "density_sum"/"backward", DensitySumParams, tile FLAT,
        (density: f32, feature: f32, d_phi: f32, head: f32) -> (d_density: f32, d_feature: f32, d_hidden: f32),
        or "backward_vec4" tile FLAT, when [FeaturesMultipleOf4],
        or "backward_subgroup" tile [8, 1, 1], when [FeaturesMultipleOf4, Subgroups];
    /// `depth = R[:,2] · (x - t)`, z in the camera frame: `x [rows,3]` → `depth [rows]`. Extent: rows.
    DEPTH_FORWARD = "depth"/"forward", DepthParams, tile FLAT,
        (world_from_camera: f32, x: f32) -> (depth: f32);
    /// Gradient of `scale · Σ min(depth, 0)²` to `d_x [rows,3]`, overwrites. Extent: rows.
    DEPTH_BACKWARD = "depth"/"backward", DepthParams, tile FLAT,
        (world_from_camera: f32, depth: f32) -> (d_x: f32);
    /// `partial[c] = scale · Σ min(depth, 0)²` over chunk `c`. Extent: chunks.
    DEPTH_LOSS_FORWARD = "depth_loss"/"forward", TermParams, tile FLAT,
        (depth: f32) -> (partial: f32);
    /// `partial[c] = scale · Σ z²` over chunk `c`. Extent: chunks.
    LATENT_LOSS_FORWARD = "latent_loss"/"forward", TermParams, tile FLAT,
        (z: f32) -> (partial: f32);
    /// `d_z += 2 scale z`: ACCUMULATES onto the gradient that came through the hypernetwork. Extent: count.
    LATENT_LOSS_BACKWARD = "latent_loss"/"backward", TermParams, tile FLAT,
        (z: f32) -> (d_z: f32);
    /// Weights of the wanted values that are not exactly 1, added up: `wanted [groups · rows_per_group, 4]` (colour, weight) → `partial [groups, chunks]`.
    /// Extent: groups · chunks.
    IMAGE_LOSS_COUNT = "image_loss"/"count", ImageLossParams, tile FLAT,
        (wanted: f32) -> (partial: f32);
    /// Sum of `w ρ(e)` over the rows of a chunk, times the normaliser: `1 / values_per_image` (MAE, MSE, Charbonnier) or
    /// `1 / (1 + count[image])` (norm_l1, norm_l2), `image = first_group + group`. `rgb [groups · rows_per_group, 3]`
    /// and `wanted [groups · rows_per_group, 4]` of the tile, `count [images]` of the whole batch (read for those two) → `partial [groups, chunks]`. Extent: groups · chunks.
    IMAGE_LOSS_FORWARD = "image_loss"/"forward", ImageLossParams, tile FLAT,
        (rgb: f32, wanted: f32, count: f32) -> (partial: f32);
    /// `d_rgb = scale · normaliser · w · ρ'(e)`; `sign(0) = 0`. Extent: values.
    IMAGE_LOSS_BACKWARD = "image_loss"/"backward", ImageLossParams, tile FLAT,
        (rgb: f32, wanted: f32, count: f32) -> (d_rgb: f32);
    /// To `[0,1]` (not clamped), YIQ luma `0.299 R + 0.587 G + 0.114 B`, 2×2 average: `rgb [images, height, width, 3]` → `luma [images, h2, w2]`,
    /// `h2 = height / 2`, `w2 = width / 2` rounded down. Extent: images · h2 · w2, as for the next ones.
    GMSD_POOL = "gmsd"/"pool", GmsdParams, tile FLAT,
        (rgb: f32) -> (luma: f32);
    /// Prewitt magnitudes `a, b` (3×3 / 3, zero padding; x = right - left, y = below - above) of both images, `quality = (2ab + c)/(a² + b² + c)`, `c = 170/255²`.
    GMSD_SIMILARITY = "gmsd"/"similarity", GmsdParams, tile FLAT,
        (luma: f32, target_luma: f32) -> (quality: f32);
    /// `Σ (q - 1)` and `Σ (q - 1)²` per chunk: `partial [images, chunks, 2]`. Extent: images · chunks.
    GMSD_MOMENTS = "gmsd"/"moments", GmsdParams, tile FLAT,
        (quality: f32) -> (partial: f32);
    /// Biased standard deviation `√(S2/n - (S1/n)²)`, `n = h2 · w2`, from `moments [images, 2] = (S1, S2)`: `loss [images]`. Extent: images.
    GMSD_DEVIATION = "gmsd"/"deviation", GmsdParams, tile FLAT,
        (moments: f32) -> (loss: f32);
    /// Gradient of `scale · loss` to the render's Prewitt responses: `∂loss/∂q = (q - 1 - S1/n) / (n loss)`,
    /// `∂q/∂a = 2 (b - a q) / (a² + b² + c)`, `∂a/∂response = response / a`; `d_response [images, 2, h2, w2]`, x then y;
    /// zero where the magnitude or the loss is zero.
    GMSD_BACKWARD_SIMILARITY = "gmsd"/"backward_similarity", GmsdParams, tile FLAT,
        (luma: f32, target_luma: f32, quality: f32, moments: f32, loss: f32) -> (d_response: f32);
    /// Transposed Prewitt, pooling and luma: `d_rgb [images, height, width, 3]`, overwrites. Extent: images · height · width.
    GMSD_BACKWARD_POOL = "gmsd"/"backward_pool", GmsdParams, tile FLAT,
        (d_response: f32) -> (d_rgb: f32);
    /// Adam: `m = β1 m + (1-β1) g`, `v = β2 v + (1-β2) g²`, `value -= lr (m · schedule[1]) / (√(v · schedule[2]) + ε)`,
    /// `schedule = [lr, 1/(1-β1ᵗ), 1/(1-β2ᵗ)]`. Extent: count.
    ADAM_STEP = "adam"/"step", AdamParams, tile FLAT,
        (gradient: f32, schedule: f32) -> (value: f32, m: f32, v: f32);
    /// `y[first_group + g, j] (+)= Σ_t x[g, t, j]`; `x [groups, terms, count]`. Extent: groups · count.
    SUM_FORWARD = "sum"/"forward", SumParams, tile FLAT,
        (x: f32) -> (y: f32);
    /// Normal equations of one channel's residuals over a motion `ξ` about the object, in the camera's axes: per chunk of an image's
    /// rows the upper triangle of `A = Σ ω J Jᵀ` (21 values) and `g = Σ ω e J` (6), `ω = scale w / √(e² + s²)`.
    /// `origin, direction, d_origin, d_direction, rgb [rows,3]`, `wanted [rows,4]` (colour, weight `w`) → `partial [groups, chunks, 27]`.
    BFGS_EQUATIONS = "bfgs"/"equations", EquationsParams, tile FLAT,
        (world_from_camera: f32, origin: f32, direction: f32, d_origin: f32, d_direction: f32, rgb: f32, wanted: f32) -> (partial: f32);
    /// The search's `state [poses,47]` at its first pose, its second derivatives from the normal equations `[poses,27]`. Extent: poses.
    BFGS_BEGIN = "bfgs"/"begin", PoseParams, tile FLAT,
        (equations: f32, loss: f32, world_from_camera: f32) -> (state: f32);
    /// Gradient over `ξ` `[poses,6]` from that over the pose's matrix. Extent: poses.
    BFGS_GRADIENT = "bfgs"/"gradient", PoseParams, tile FLAT,
        (world_from_camera: f32, d_world_from_camera: f32) -> (gradient: f32);
    /// What a trial says: second derivatives from the change of the gradient, the best pose, how long steps may be. Extent: poses.
    BFGS_UPDATE = "bfgs"/"update", PoseParams, tile FLAT,
        (gradient: f32, loss: f32, world_from_camera: f32) -> (state: f32);
    /// The next trial: `B ξ = -g`, shortened to the radius, to whole grains, the best pose moved by `ξ`. Extent: poses.
    BFGS_SOLVE = "bfgs"/"solve", SolveParams, tile FLAT,
        () -> (world_from_camera: f32, state: f32);
    /// RGB in `[-1,1]` to packed RGBA8 (r in the low byte, alpha 255), clamped and rounded: `rgb [.., 3]` → `packed [height, stride]`. Extent: width · height.
    PACK_RGBA8_FORWARD = "pack_rgba8"/"forward", PackParams, tile FLAT,
        (rgb: f32) -> (packed: u32);
}
