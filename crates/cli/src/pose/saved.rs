//! Pictures whose poses were found, as views of a data set: `sigma-train adapt --more` learns from them.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::Path;

use sigma_srn::{Found, Intrinsics, Model};
use srn_data::pixels::rgb8;
use srn_data::srn::{self, InstanceWriter};

use super::files::Picture;
use crate::common::{Result, create_dir};

/// A data set in the making. There is nothing of it until [`SavedViews::finish`].
pub struct SavedViews {
    /// By instance, with the number of its views so far.
    instances: BTreeMap<u32, (InstanceWriter, usize)>,
}

impl SavedViews {
    /// For these instances, each in its folder in `dir`. A folder that exists is refused, or, with `force`, replaced.
    pub fn create(dir: &Path, model: &Model, shown: impl Iterator<Item = u32>, force: bool) -> Result<Self> {
        create_dir(dir)?;
        let mut instances = BTreeMap::new();
        for instance in shown {
            if let Entry::Vacant(entry) = instances.entry(instance) {
                entry.insert((InstanceWriter::bare(dir.join(model.instance_name(instance)), force)?, 0));
            }
        }
        Ok(SavedViews { instances })
    }

    /// Takes a picture as it was compared in the end, `side` pixels square, if its pose is to be trusted. What did not count there is as
    /// the model shows it.
    pub fn add(&mut self, picture: &Picture, found: &Found, side: u32) -> Result<()> {
        let Some((writer, count)) = self.instances.get_mut(&picture.shot.instance).filter(|_| found.is_trusted()) else {
            return Ok(());
        };
        let mut rgb = found.estimate.target.clone();
        for (number, &weight) in found.estimate.weights.iter().flatten().enumerate() {
            let pixel = 3 * number..3 * number + 3;
            let counts = weight.min(1.0);
            rgb[pixel.clone()]
                .iter_mut()
                .zip(&found.view[pixel])
                .for_each(|(seen, shown)| *seen += (1.0 - counts) * (shown - *seen));
        }
        let side = side as usize;
        let Intrinsics { fx, fy, cx, cy, .. } = picture.shot.intrinsics;
        writer.add(&picture.name, &rgb8(&rgb, side, side), &found.world_from_camera)?;
        writer.view_intrinsics(&picture.name, &srn::Intrinsics { focal: [fx, fy], centre: [cx, cy], size: [side; 2] })?;
        *count += 1;
        Ok(())
    }

    /// Puts the views in their folders, and returns how many there are. An instance of none gets no folder.
    pub fn finish(self) -> Result<usize> {
        let mut all = 0;
        for (writer, count) in self.instances.into_values().filter(|(_, count)| *count > 0) {
            writer.finish()?;
            all += count;
        }
        Ok(all)
    }
}
