use std::io::Write;
use std::sync::OnceLock;

use srn_gpu::{Gpu, OpenError};

/// The device of this test process: the preferred adapter, or the one that the variable `SIGMA_SRN_ADAPTER` names.
///
/// Prints the adapter's name first. No adapter is a failure, not a reason to skip.
pub fn gpu() -> &'static Gpu {
    static GPU: OnceLock<Gpu> = OnceLock::new();
    GPU.get_or_init(|| {
        let gpu = Gpu::open(wanted().as_deref()).unwrap_or_else(|error| panic!("GPU tests need an adapter: {error}"));
        // Not `eprintln`, which the test harness swallows where the test passes.
        let _ = writeln!(std::io::stderr(), "adapter: {}", gpu.adapter());
        gpu
    })
}

/// The same adapter with cooperative matrices; `None` where it says that it has none.
pub fn cooperative_gpu() -> Option<&'static Gpu> {
    static GPU: OnceLock<Option<Gpu>> = OnceLock::new();
    let open = || match Gpu::open_cooperative(wanted().as_deref()) {
        Err(OpenError::NoCooperativeMatrices { .. }) => None,
        opened => Some(opened.unwrap_or_else(|error| panic!("GPU tests need an adapter: {error}"))),
    };
    GPU.get_or_init(open).as_ref()
}

fn wanted() -> Option<String> {
    std::env::var("SIGMA_SRN_ADAPTER").ok()
}
