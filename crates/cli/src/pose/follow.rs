//! Frames of a video that are not cut out: where the object is in one says what of the next is the object.

use glam::DMat4;
use sigma_srn::{Error, Found, Progress, Search, Tracked, Tracker};
use srn_data::segment::{BoundingBox, Known};

use super::boxed::{Boxed, Outcome};
use super::files::Picture;
use super::outline::FoundObject;
use super::search::{On, query, run};
use crate::common::Result;

/// A frame is cut out anew by the pose that was found in it where what this covers and what was expected have no more than so much of both in common.
const AS_EXPECTED: f64 = 0.9;
/// As long as poses are not to be trusted, the object is searched for all around in every so many frames.
const SEARCHED: usize = 10;

/// A frame, cut out by a box and what is known of the object in it.
pub type Open<'a> = &'a dyn Fn(BoundingBox, Known) -> Result<Picture>;
/// Watches a search.
type Observe<'a> = &'a mut dyn FnMut(Progress) -> std::result::Result<(), Error>;

/// Follows an object of which nothing but a box around it in the first frame is known.
pub struct Follower {
    /// A box around the object, where it was last seen for sure.
    bounds: BoundingBox,
    /// What it is expected to cover in the next frame, and a box around that.
    expected: Option<(FoundObject, BoundingBox)>,
    /// Frames in a row whose poses were not to be trusted.
    doubted: usize,
}

/// How frames are looked at.
pub struct Looking<'a> {
    pub on: On<'a>,
    /// All around.
    pub search: &'a Search,
    /// Where it starts.
    pub starts: &'a dyn Fn(&Picture) -> Result<Vec<DMat4>>,
    pub open: Open<'a>,
}

impl Follower {
    /// For a first frame in which the object is in this box.
    pub fn new(bounds: BoundingBox) -> Self {
        Follower { bounds, expected: None, doubted: 0 }
    }

    /// A frame, cut out by where the object is expected in it; if nothing is there, by the box alone.
    pub fn open(&self, open: Open) -> Result<Picture> {
        let expected = self.expected.as_ref().and_then(|(object, bounds)| cut_out(*bounds, object, open).ok());
        expected.map_or_else(|| open(self.bounds, Known::default()), Ok)
    }

    /// Finds the pose in a frame that [`Follower::open`] has cut out; the frame comes back as it was cut out in the end.
    pub fn next(
        &mut self,
        picture: Picture,
        tracker: &mut Tracker,
        looking: &Looking,
        observe: Observe,
    ) -> Result<(Picture, Tracked)> {
        let near = self.near(&picture, tracker, looking, observe)?;
        let is_due = |found: &Found| !found.is_trusted() && self.doubted.is_multiple_of(SEARCHED);
        let around = match &near {
            Some((_, found)) if is_due(found) => (looking.open)(self.bounds, Known::default()).ok(),
            Some(_) => None,
            None => Some(picture),
        };
        let around = around.map(|picture| self.around(picture, looking, observe)).transpose()?;
        let is_better = |(_, other): &(Picture, Found)| {
            other.is_trusted() || near.as_ref().is_none_or(|(_, found)| other.unexplained < found.unexplained)
        };
        let around = around.filter(is_better);
        let is_searched = around.is_some();
        let (picture, found) = around.or(near).ok_or("no pose was looked for")?;
        if is_searched {
            tracker.restart(found.world_from_camera);
        }
        self.doubted = if found.is_trusted() { 0 } else { self.doubted + 1 };
        let next = tracker.expected().unwrap_or(found.world_from_camera);
        let object = FoundObject::of(&picture, &next, looking.on, 1)?;
        if let Some(bounds) = object.bounds() {
            // What is followed in doubt may be something else, which leads away.
            if found.is_trusted() {
                self.bounds = bounds;
            }
            self.expected = Some((object, bounds));
        }
        Ok((picture, Tracked { found, is_searched }))
    }

    /// From where it is expected.
    fn near(
        &self,
        picture: &Picture,
        tracker: &mut Tracker,
        looking: &Looking,
        observe: Observe,
    ) -> Result<Option<(Picture, Found)>> {
        let (Some((expected, _)), side) = (&self.expected, looking.on.side) else { return Ok(None) };
        let Some(found) = tracker.follow(query(picture, side, &[]), &mut *observe)? else { return Ok(None) };
        let object = FoundObject::of(picture, &found.world_from_camera, looking.on, 1)?;
        let anew = object.bounds().filter(|_| object.overlap(expected) < AS_EXPECTED);
        let anew = anew.and_then(|bounds| cut_out(bounds, &object, looking.open).ok());
        if let Some(picture) = anew
            && let Some(found) = tracker.again(query(&picture, side, &[]), observe)?
        {
            return Ok(Some((picture, found)));
        }
        Ok(Some((picture.clone(), found)))
    }

    /// From all around, of a frame that was cut out by the box alone.
    fn around(&self, picture: Picture, looking: &Looking, observe: Observe) -> Result<(Picture, Found)> {
        let Looking { on, search, starts, open } = *looking;
        let boxed = Boxed { on, open: &|_, known| open(self.bounds, known), starts: &|_, picture| starts(picture) };
        let mut pass = |pictures: Vec<Picture>, starts: &[Vec<DMat4>]| {
            let found = run(search, on, &pictures, starts, &mut *observe)?;
            let outcome = |(picture, found)| Outcome { picture, found, log: Default::default() };
            Ok(pictures.into_iter().zip(found).map(outcome).collect())
        };
        let Outcome { picture, found, .. } = boxed.search(&[0], vec![picture], &mut pass)?.remove(0);
        Ok((picture, found))
    }
}

fn cut_out(bounds: BoundingBox, object: &FoundObject, open: Open) -> Result<Picture> {
    open(bounds, Known { colours: &[], place: Some(&|at| object.shows(at)) })
}
