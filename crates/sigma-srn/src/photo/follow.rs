//! Frames of a video that are not cut out: where the object is in one says what of the next is the object.

use glam::DMat4;
use srn_photo::{BoundingBox, Known};

use super::{Anywhere, Boxed, FoundObject, Outcome, Shot, Sightings};
use crate::{Engine, Error, Found, Model, Progress, Search, Tracked, Tracker};

/// A frame is cut out anew by the pose that was found in it where what this covers and what was expected have no more than so much of both in common.
const AS_EXPECTED: f64 = 0.9;
/// As long as poses are not to be trusted, the object is searched for in every so many frames: all around where it was last seen, and from the second time on, anywhere.
const SEARCHED: usize = 10;
/// What is found elsewhere leaves at most so many times unexplained what the object did where it was last seen: other things look like it, too.
const ABOVE_SURE: f64 = 1.5;

/// A frame, cut out by a box and what is known of the object in it.
pub type Open<'a, E> = &'a dyn Fn(BoundingBox, Known) -> Result<Shot, E>;
/// Watches a search.
pub type Observe<'a> = &'a mut dyn FnMut(Progress) -> Result<(), Error>;

/// Follows an object of which nothing but a box around it in the first frame is known.
pub struct Follower {
    /// A box around the object, where it was last seen for sure.
    bounds: BoundingBox,
    /// How it was seen there.
    sure: Option<Sure>,
    /// What it is expected to cover in the next frame, and a box around that.
    expected: Option<(FoundObject, BoundingBox)>,
    /// Frames in a row whose poses were not to be trusted.
    doubted: usize,
}

/// An object seen for sure.
struct Sure {
    /// What it covered.
    object: FoundObject,
    pose: DMat4,
    unexplained: f64,
}

/// How frames are looked at.
pub struct Looking<'a, E> {
    /// What renders views.
    pub engine: &'a Engine,
    /// The model that knows the object.
    pub model: &'a Model,
    /// All around.
    pub search: &'a Search,
    /// Where it starts.
    pub starts: &'a dyn Fn(&Shot) -> Result<Vec<DMat4>, E>,
    /// The frame at hand.
    pub open: Open<'a, E>,
    /// Where in it the object may be.
    pub sightings: &'a dyn Fn() -> Result<Sightings<'a>, E>,
}

impl Follower {
    /// For a first frame in which the object is in this box.
    pub fn new(bounds: BoundingBox) -> Self {
        Follower { bounds, sure: None, expected: None, doubted: 0 }
    }

    /// A frame, cut out by where the object is expected in it; if nothing is there, by the box alone.
    pub fn open<E>(&self, open: Open<E>) -> Result<Shot, E> {
        let expected = self.expected.as_ref().and_then(|(object, bounds)| cut_out(*bounds, object, open).ok());
        expected.map_or_else(|| open(self.bounds, Known::default()), Ok)
    }

    /// Finds the pose in a frame that [`Follower::open`] has cut out; where it could not, the object may be elsewhere. The frame comes back as it was cut out in the end; `None` where that was nowhere.
    pub fn next<E: From<Error>>(
        &mut self,
        shot: Option<Shot>,
        tracker: &mut Tracker,
        looking: &Looking<E>,
        observe: Observe,
    ) -> Result<Option<(Shot, Tracked)>, E> {
        let mut near = match &shot {
            Some(shot) => self.near(shot, tracker, looking, observe)?,
            None => None,
        };
        let is_sure = |found: &Option<(Shot, Found)>| found.as_ref().is_some_and(|(_, found)| found.is_trusted());
        // What hid it may be gone.
        if self.doubted > 0
            && near.is_some()
            && !is_sure(&near)
            && let Some(back) = self.back(tracker, looking, observe)?
        {
            tracker.restart(back.1.world_from_camera);
            near = Some(back);
        }
        let is_due = !is_sure(&near) && self.doubted.is_multiple_of(SEARCHED);
        let is_gone = self.sure.is_some() && (self.doubted > 0 || shot.is_none());
        let around = match shot {
            Some(_) if is_due && !is_gone && near.is_some() => (looking.open)(self.bounds, Known::default()).ok(),
            Some(_) if near.is_some() => None,
            shot => shot,
        };
        let around = around.map(|shot| self.around(shot, looking, observe)).transpose()?;
        let is_better = |(_, other): &(Shot, Found)| {
            other.is_trusted() || near.as_ref().is_none_or(|(_, found)| other.unexplained < found.unexplained)
        };
        let mut searched = around.filter(is_better);
        if is_due && is_gone {
            searched = searched.or(self.elsewhere(looking, observe)?);
        }
        let is_searched = searched.is_some();
        self.doubted += 1;
        let Some((shot, found)) = searched.or(near) else { return Ok(None) };
        if is_searched {
            tracker.restart(found.world_from_camera);
        }
        let next = tracker.expected().unwrap_or(found.world_from_camera);
        let object = FoundObject::of(&shot, &next, looking.engine, looking.model, 1)?;
        if found.is_trusted() {
            self.doubted = 0;
        }
        if let Some(bounds) = object.bounds() {
            // What is followed in doubt may be something else, which leads away.
            if found.is_trusted() {
                self.bounds = bounds;
                let there = FoundObject::of(&shot, &found.world_from_camera, looking.engine, looking.model, 1)?;
                self.sure = Some(Sure { object: there, pose: found.world_from_camera, unexplained: found.unexplained });
            }
            self.expected = Some((object, bounds));
        }
        Ok(Some((shot, Tracked { found, is_searched })))
    }

    /// From where it is expected.
    fn near<E: From<Error>>(
        &self,
        shot: &Shot,
        tracker: &mut Tracker,
        looking: &Looking<E>,
        observe: Observe,
    ) -> Result<Option<(Shot, Found)>, E> {
        let Some((expected, _)) = &self.expected else { return Ok(None) };
        let Some(found) = tracker.follow(shot.query(vec![]), &mut *observe)? else { return Ok(None) };
        let object = FoundObject::of(shot, &found.world_from_camera, looking.engine, looking.model, 1)?;
        let anew = object.bounds().filter(|_| object.overlap(expected) < AS_EXPECTED);
        let anew = anew.and_then(|bounds| cut_out(bounds, &object, looking.open).ok());
        if let Some(shot) = anew
            && let Some(found) = tracker.again(shot.query(vec![]), observe)?
        {
            return Ok(Some((shot, found)));
        }
        Ok(Some((shot.clone(), found)))
    }

    /// From where it was last seen for sure, if it is seen for sure there.
    fn back<E: From<Error>>(
        &self,
        tracker: &Tracker,
        looking: &Looking<E>,
        observe: Observe,
    ) -> Result<Option<(Shot, Found)>, E> {
        let Some(Sure { object, pose, .. }) = &self.sure else { return Ok(None) };
        let Ok(shot) = cut_out(self.bounds, object, looking.open) else { return Ok(None) };
        let found = tracker.from(*pose, shot.query(vec![]), observe)?;
        Ok(found.is_trusted().then_some((shot, found)))
    }

    /// From anywhere in the frame, if it is seen there as surely as where it was last seen for sure.
    fn elsewhere<E: From<Error>>(&self, looking: &Looking<E>, observe: Observe) -> Result<Option<(Shot, Found)>, E> {
        let Some(Sure { unexplained, .. }) = self.sure else { return Ok(None) };
        let Looking { engine, model, search, starts, open, sightings } = *looking;
        let is_it = |found: &Found| found.is_trusted() && found.unexplained <= ABOVE_SURE * unexplained;
        let mut pass = |_: &[usize], shots, starts: &[_]| Ok(search.shots(engine, model, shots, starts, &mut *observe)?);
        let found = Anywhere { engine, model, open, starts, others: None }.search(&sightings()?, &mut pass)?;
        Ok(found.map(|Outcome { shot, found, .. }| (shot, found)).filter(|(_, found)| is_it(found)))
    }

    /// From all around, of a frame that was cut out by the box alone.
    fn around<E: From<Error>>(&self, shot: Shot, looking: &Looking<E>, observe: Observe) -> Result<(Shot, Found), E> {
        let Looking { engine, model, search, starts, open, .. } = *looking;
        let (open, starts) = (|_, known: Known| open(self.bounds, known), |_, shot: &Shot| starts(shot));
        let given = |_| self.expected.is_none().then_some(self.bounds);
        let boxed = Boxed { engine, model, open: &open, starts: &starts, given: &given, sightings: &|_, _| Ok(None) };
        let mut pass = |_: &[usize], shots, starts: &[_]| Ok(search.shots(engine, model, shots, starts, &mut *observe)?);
        let Outcome { shot, found, .. } = boxed.search(&[0], vec![shot], &mut pass)?.remove(0);
        Ok((shot, found))
    }
}

/// What an object covers, in a box.
pub(super) fn cut_out<E>(bounds: BoundingBox, object: &FoundObject, open: Open<E>) -> Result<Shot, E> {
    open(bounds, Known { place: Some(&|at| object.shows(at)), ..Known::default() })
}
