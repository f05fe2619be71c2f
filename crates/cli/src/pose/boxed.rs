//! Pictures with boxes around their objects: what in a box is the object and where the object is are found in turns.

use std::rc::Rc;

use glam::DMat4;
use sigma_srn::camera::{fixed24, neighbor4};
use sigma_srn::{Found, Intrinsics};
use srn_data::segment::{BoundingBox, Known};

use super::files::Picture;
use super::outline::FoundObject;
use super::record::Log;
use super::search::{On, render};
use crate::common::Result;

/// The model's object is looked at in pictures of so many pixels, for its colours.
const SIDE: u32 = 32;
/// Where all channels are at least this (of [-1, 1]) a view shows background, or its edge.
const WHITE: f32 = 0.9;

/// The value of --box.
pub fn bounding_box(text: &str) -> std::result::Result<BoundingBox, String> {
    let numbers: Vec<f64> =
        text.split(',').filter_map(|number| number.trim().parse().ok()).filter(|n: &f64| n.is_finite()).collect();
    match (&numbers[..], text.matches(',').count()) {
        (&[x, y, width, height], 3) if width > 0.0 && height > 0.0 => Ok(BoundingBox { corner: [x, y], size: [width, height] }),
        _ => Err("expected left edge, top edge, width and height in pixels: `120,80,200,160`".into()),
    }
}

/// What came of a search.
pub struct Outcome {
    pub picture: Picture,
    pub found: Found,
    /// Of the search that has found it, and its number in there.
    pub log: (Rc<Log>, usize),
}

/// How pictures are looked at and searched for.
pub struct Boxed<'a> {
    pub on: On<'a>,
    /// The picture with this number, cut out by what is known of its object.
    pub open: &'a dyn Fn(usize, Known) -> Result<Picture>,
    /// Where a search for the picture with this number starts.
    pub starts: &'a dyn Fn(usize, &Picture) -> Result<Vec<DMat4>>,
}

/// Searches for pictures, each from its own starts.
pub type Pass<'a> = &'a mut dyn FnMut(Vec<Picture>, &[Vec<DMat4>]) -> Result<Vec<Outcome>>;

impl Boxed<'_> {
    /// Searches for pictures that were cut out by their boxes alone, then from where these end, cut out anew by the model's view from there. Where that is not to be
    /// trusted it begins once more with the colours of the model's object; what leaves less unexplained counts.
    pub fn search(&self, numbers: &[usize], pictures: Vec<Picture>, pass: Pass) -> Result<Vec<Outcome>> {
        let mut outcomes = self.in_turns(numbers, pictures, pass)?;
        let (mut lost, mut anew) = (Vec::new(), Vec::new());
        for (i, Outcome { picture, .. }) in outcomes.iter().enumerate().filter(|(_, outcome)| !outcome.found.is_trusted()) {
            let colours = self.colours(picture.instance)?;
            // Nothing in the box may have those colours.
            if let Ok(picture) = (self.open)(numbers[i], Known { colours: &colours, place: None }) {
                lost.push(i);
                anew.push(picture);
            }
        }
        if lost.is_empty() {
            return Ok(outcomes);
        }
        let again = self.in_turns(&lost.iter().map(|&i| numbers[i]).collect::<Vec<_>>(), anew, pass)?;
        for (i, mut other) in lost.into_iter().zip(again) {
            let seconds = outcomes[i].found.seconds + other.found.seconds;
            if other.found.is_trusted() || other.found.unexplained < outcomes[i].found.unexplained {
                std::mem::swap(&mut outcomes[i], &mut other);
            }
            outcomes[i].found.seconds = seconds;
        }
        Ok(outcomes)
    }

    /// A search, and one from where it ends.
    fn in_turns(&self, numbers: &[usize], pictures: Vec<Picture>, pass: Pass) -> Result<Vec<Outcome>> {
        let starts = numbers.iter().zip(&pictures).map(|(&number, picture)| (self.starts)(number, picture));
        let first = pass(pictures.clone(), &starts.collect::<Result<Vec<_>>>()?)?;
        let mut anew = Vec::new();
        for (&number, Outcome { picture, found, .. }) in numbers.iter().zip(&first) {
            let object = FoundObject::of(picture, &found.world_from_camera, self.on, 1)?;
            let cut = (self.open)(number, Known { colours: &[], place: Some(&|at| object.shows(at)) });
            // Or nothing, where the pose is far off.
            anew.push(cut.unwrap_or_else(|_| picture.clone()));
        }
        let near: Vec<_> = first.iter().map(|outcome| neighbor4(&outcome.found.world_from_camera)).collect();
        let mut second = pass(anew, &near)?;
        second.iter_mut().zip(first).for_each(|(second, first)| second.found.seconds += first.found.seconds);
        Ok(second)
    }

    /// Those of the model's object, from all around.
    fn colours(&self, instance: u32) -> Result<Vec<[f32; 3]>> {
        let On { model, .. } = self.on;
        let radius = model.metadata.orbit_radius.unwrap_or(1.3);
        // So that the object fills the picture.
        let focal = f64::from(SIDE) * radius;
        let middle = 0.5 * f64::from(SIDE);
        let camera = Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, pixel_center: 0.5 };
        let views: Vec<_> = fixed24(radius).into_iter().map(|pose| (instance, pose, camera)).collect();
        let renders = render(On { side: SIDE, ..self.on }, &views)?;
        let pixels = renders.iter().flat_map(|render| render.rgb.chunks_exact(3)).map(|c| [c[0], c[1], c[2]]);
        Ok(pixels.filter(|colour| colour.iter().any(|&c| c < WHITE)).collect())
    }
}
