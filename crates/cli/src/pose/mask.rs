//! How the mask of a picture was made right, for machines and for people.

use serde::Serialize;
use sigma_srn::Estimate;

/// In pixels of the picture on disk.
#[derive(Serialize)]
pub struct MadeRight {
    /// By how many it was dilated all around: below zero where it was too large.
    mask_dilation_px: Option<f64>,
    /// On which side how many were cut away, columns and rows: a shadow, say.
    mask_cut_px: Option<[f64; 2]>,
    /// On which side something is missing, and up to how many from the mask nothing there counts, columns and rows.
    mask_missing_px: Option<[f64; 2]>,
}

impl MadeRight {
    /// `pixels` on disk for each that was compared.
    pub fn of(estimate: &Estimate, pixels: f64) -> Self {
        let outline = estimate.outline.map(|outline| outline * pixels);
        MadeRight {
            mask_dilation_px: outline.map(|outline| outline.dilation),
            mask_cut_px: outline.map(|outline| outline.cut.to_array()),
            mask_missing_px: outline.map(|outline| outline.missing.to_array()),
        }
    }

    /// A line for each way in which it was wrong.
    pub fn captions(&self) -> impl Iterator<Item = String> {
        let outline = |by: f64| format!("mask {:.1} px too {}", by.abs(), if by < 0.0 { "large" } else { "small" });
        let side = |[u, v]: [f64; 2]| {
            let side = |by: f64, before: &'static str, beyond: &'static str| match by {
                0.0 => None,
                by => Some(if by < 0.0 { before } else { beyond }),
            };
            let sides = side(v, "top", "bottom").into_iter().chain(side(u, "left", "right"));
            sides.collect::<Vec<_>>().join(" ")
        };
        // Short, for a panel is narrow.
        let cut = |by: [f64; 2]| format!("{}: {:.1} px cut", side(by), by[0].hypot(by[1]));
        let missing = |by: [f64; 2]| format!("{}: mask too short", side(by));
        let dilated = self.mask_dilation_px.filter(|by| *by != 0.0).map(outline);
        let cut = self.mask_cut_px.filter(|by| *by != [0.0; 2]).map(cut);
        let missing = self.mask_missing_px.filter(|by| *by != [0.0; 2]).map(missing);
        cut.into_iter().chain(missing).chain(dilated)
    }
}
