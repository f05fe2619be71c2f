//! `adapters`: the GPU adapters of this machine, the preferred one first; exit 1 where there is none.

use std::process::ExitCode;

fn main() -> ExitCode {
    let adapters = sigma_srn::adapters();
    for (number, adapter) in adapters.iter().enumerate() {
        println!("{} {adapter}", if number == 0 { "adapter:" } else { "     or:" });
    }
    if adapters.is_empty() {
        eprintln!("error: no GPU adapter; GPU tests need one, if only Mesa's software adapter: cargo xtask setup");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
