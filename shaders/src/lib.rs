//! This crate owns the WGSL text of every kernel, the table that lists them, and the parameter structs they read.
//! It does not know wgpu, plans or the model.
//!
//! One op has one name, used by the kernel file (`<op>/<direction>.wgsl`), the CPU reference, the plan step, the test
//! and the label in profiles and errors. Conventions that hold for every kernel:
//!
//! - Matrices are row-major. A *row* is one ray (or one point on a ray); `rows = groups · rows_per_group`, and the rows of a
//!   group belong to one image, number `first_group + row / rows_per_group`.
//! - A linear layer is **one** buffer: the weight `[out, in]` row-major, then the bias `[out]`. That is also what the
//!   hypernetwork emits, so plain and per-instance layers are the same op. An affine layer norm is `gamma` then `beta`.
//! - A kernel OVERWRITES its outputs, or ACCUMULATES where its parameter `accumulate` is 1.
//! - Sums over rows go to partial sums first and through `sum/forward` after: no atomics, so a run repeats bit for bit.

mod params;
mod table;

pub use params::*;
pub use table::*;

/// The scalar type of a buffer's elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Element {
    /// 32-bit float.
    F32,
    /// 32-bit unsigned integer.
    U32,
}

/// One storage buffer that a kernel reads or writes, identified by its name in the WGSL text.
#[derive(Clone, Copy, Debug)]
pub struct Binding {
    /// Name of the WGSL variable.
    pub name: &'static str,
    /// Element type of the array behind it.
    pub element: Element,
    /// True for `var<storage, read_write>`.
    pub written: bool,
}

/// What a faster form of a kernel needs before it may replace the plain one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Requirement {
    /// Every parameter named `features`, `in_features`, `out_features` or `chunk_outs` is a multiple of 4 (f32
    /// buffers may be read as `vec4<f32>`).
    FeaturesMultipleOf4,
    /// None of those parameters exceeds 64.
    FeaturesAtMost64,
    /// None of those parameters exceeds 256.
    FeaturesAtMost256,
    /// None of those parameters exceeds 1024.
    FeaturesAtMost1024,
    /// The device has subgroups, always of at least eight lanes.
    Subgroups,
    /// Subgroups of the device, all of one size, multiply matrices of `f16` with sums in `f32`. [`Cooperative::head`] stands before the text.
    CooperativeMatrices,
}

/// Matrices that a subgroup multiplies together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cooperative {
    /// Rows and columns: 8 or 16.
    pub side: u32,
    /// Invocations of a subgroup.
    pub lanes: u32,
}

impl Cooperative {
    /// Invocations of a workgroup, whose subgroups share 64 × 128 results, each with 2 × 4 matrices: the texts take 128.
    pub fn invocations(self) -> u32 {
        1024 / (self.side * self.side) * self.lanes
    }

    /// What stands before a text that uses them: `Sums += Left · Right`, the factors in `f16`, the sums in `f32`.
    pub fn head(self) -> String {
        let Cooperative { side, lanes } = self;
        let alias = |name, scalar, role| format!("alias {name} = coop_mat{side}x{side}<{scalar}, {role}>;\n");
        let aliases = [alias("Left", "f16", "A"), alias("Right", "f16", "B"), alias("Sums", "f32", "C")].concat();
        format!(
            "enable f16;\nenable wgpu_cooperative_matrix;\n{aliases}const SIDE: u32 = {side}u;\nconst LANES: u32 = {lanes}u;\n"
        )
    }
}

/// One WGSL text that computes a kernel; every kernel has at least one, and its plain form runs everywhere.
#[derive(Clone, Copy, Debug)]
pub struct Variant {
    /// Unique within the kernel.
    pub name: &'static str,
    /// The WGSL text of the file.
    pub text: &'static str,
    /// Texts of `common/` that it shares with some others: they use its parameters and buffers, so they cannot stand before every kernel.
    pub with: &'static [&'static str],
    /// Elements of the step's extent that one workgroup covers, per dimension.
    pub tile: [u32; 3],
    /// What must hold before it may be used; nothing for the plain form.
    pub requires: &'static [Requirement],
}

/// One kernel: an op in one direction.
#[derive(Debug)]
pub struct Kernel {
    /// Name of the op: the directory.
    pub op: &'static str,
    /// Direction: the file.
    pub direction: &'static str,
    /// `op/direction`, the label everywhere.
    pub name: &'static str,
    /// The storage buffers, inputs first.
    pub bindings: &'static [Binding],
    /// The Rust mirror of the WGSL `Params`.
    pub params: &'static ParamsLayout,
    /// Plain form first, then forms for some sizes or devices.
    pub variants: &'static [Variant],
}

impl Kernel {
    /// The WGSL source of one variant: shared functions, then the kernel; complete but for [`Cooperative::head`].
    pub fn source(&self, variant: &Variant) -> String {
        let parts = [&[COMMON], variant.with, &[variant.text]];
        parts.concat().join("\n")
    }

    /// `op/variant`, in profiles and errors.
    pub fn label(&self, variant: &Variant) -> String {
        format!("{}/{}", self.op, variant.name)
    }

    /// The binding called `name`.
    pub fn binding(&self, name: &str) -> Option<&'static Binding> {
        self.bindings.iter().find(|binding| binding.name == name)
    }
}

/// The kernel called `name`, as `op/direction`.
pub fn find(name: &str) -> Option<&'static Kernel> {
    TABLE.iter().copied().find(|kernel| kernel.name == name)
}

/// Functions that every kernel can call.
pub const COMMON: &str = concat!(
    include_str!("../common/index.wgsl"),
    "\n",
    include_str!("../common/ray_sphere.wgsl"),
    "\n",
    include_str!("../common/activation.wgsl"),
    "\n",
    include_str!("../common/image_loss.wgsl"),
    "\n",
    include_str!("../common/gmsd.wgsl"),
    "\n",
    include_str!("../common/bfgs.wgsl"),
);
