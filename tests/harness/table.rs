//! The table of kernels as Markdown.

use srn_shaders::{Kernel, TABLE};

use crate::between;

/// A line per kernel: label, formula, buffers, faster variants.
pub fn markdown() -> String {
    let mut text = String::from("| kernel | formula | reads | writes | variants |\n|---|---|---|---|---|\n");
    for kernel in TABLE {
        let [first, ..] = kernel.variants else { continue };
        let formula = first.text.lines().next().unwrap_or_default().trim_start_matches("// ").trim_end_matches('.');
        let cells = [
            format!("`{}`", kernel.name),
            formula.replace('|', "\\|").replace('*', "\\*"),
            buffers(kernel, false),
            buffers(kernel, true),
            kernel.variants[1..].iter().map(|variant| format!("`{}`", variant.name)).collect::<Vec<_>>().join(", "),
        ];
        text += &format!("| {} |\n", cells.join(" | "));
    }
    text
}

fn buffers(kernel: &Kernel, written: bool) -> String {
    let chosen = kernel.bindings.iter().filter(|binding| binding.written == written);
    chosen.map(|binding| format!("`{}`", binding.name)).collect::<Vec<_>>().join(", ")
}

/// `document` with the table between its marks replaced by the current one.
pub fn update(document: &str) -> Result<String, String> {
    between::replace(document, "table", &markdown())
}
