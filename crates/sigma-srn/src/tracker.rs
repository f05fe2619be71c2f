//! An object's pose from frame to frame: the next one is near the last.

use std::iter;

use glam::DMat4;

use crate::confidence::Doubt;
use crate::estimator::{Options, Phase, Progress, Query};
use crate::mask::{MISSING, Outline, WIDEST_CUT};
use crate::search::{Found, Search};
use crate::{Engine, Error, Model};

/// Pixels that a mask may be too large or too small, as the model sees it: as far as a search tries, as with [`WIDEST_CUT`]. An object that comes from near to
/// far has fewer pixels to lose.
const WIDEST_RIM: f64 = 2.0;

/// Follows an object through the frames of a video. A frame that the last pose does not lead to is searched all around.
#[derive(Clone, Debug)]
pub struct Tracker {
    engine: Engine,
    /// For work on the object.
    model: Model,
    /// Its number in the caller's model, and in this one.
    instance: u32,
    number: u32,
    search: Search,
    /// The last two poses, the later one first.
    before: Vec<DMat4>,
    rim: Option<Outline>,
}

/// What was found for a frame.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// The pose and what there is to say about it.
    pub found: Found,
    /// It is not from the pose in the frame before, but was searched for from [`Query::starts`].
    pub is_searched: bool,
}

impl Tracker {
    /// For frames of an instance of `model`, whose weights are made here, once. `search` is for the first frame, unless the object's pose there is known,
    /// `rough`ly, and for frames in which it was lost. A try that takes seconds more is seldom worth it there: the next frame is the second search.
    pub fn new(engine: &Engine, model: &Model, instance: u32, search: Search, rough: Option<DMat4>) -> Result<Self, Error> {
        let (at_work, numbers) = model.for_work_on(&[instance])?;
        let (model, number) = (at_work.into_owned(), numbers[0]);
        Ok(Tracker { engine: engine.clone(), model, instance, number, search, before: rough.into_iter().collect(), rim: None })
    }

    /// The pose in the next frame, if the object goes on as it did; `None` as long as it is lost.
    pub fn expected(&self) -> Option<DMat4> {
        match self.before[..] {
            [] => None,
            [last] => Some(last),
            [last, earlier, ..] => Some(last * earlier.inverse() * last),
        }
    }

    /// Finds the pose in the next frame. [`Query::starts`] are where to search if it does not lie near the last pose, all around the object say.
    /// [`Query::outline`] is not looked at: who cuts frames out does it alike from one to the next, so how wrong masks are is found out once.
    pub fn next(&mut self, frame: Query, mut observe: impl FnMut(Progress) -> Result<(), Error>) -> Result<Tracked, Error> {
        let frame = self.prepared(frame)?;
        let followed = self.followed(&frame, &mut observe)?;
        // An object that comes too near or goes too far away is followed all the same.
        let followed = followed.filter(|found| matches!(found.doubt, None | Some(Doubt::Distance | Doubt::Small)));
        let is_searched = followed.is_none();
        let found = match followed {
            Some(found) => found,
            None => self.search.run(&self.engine, &self.model, std::slice::from_ref(&frame), &mut observe)?.remove(0),
        };
        // Else what is not to be trusted is no place to go on from.
        if is_searched {
            self.before.clear();
        }
        if found.is_trusted() || !is_searched {
            self.keep(&found, &frame, is_searched);
        }
        Ok(Tracked { found, is_searched })
    }

    /// The same from the last pose alone, however much is unexplained: for a caller who searches all around himself. `None` where the object is lost.
    pub fn follow(&mut self, frame: Query, observe: impl FnMut(Progress) -> Result<(), Error>) -> Result<Option<Found>, Error> {
        let frame = self.prepared(frame)?;
        let found = self.followed(&frame, observe)?;
        found.iter().for_each(|found| self.keep(found, &frame, false));
        Ok(found)
    }

    /// The same from this pose, whatever the last frames led to; they still do.
    pub fn from(
        &self,
        world_from_camera: DMat4,
        frame: Query,
        observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<Found, Error> {
        let frame = Query { starts: vec![world_from_camera], ..self.prepared(frame)? };
        Ok(self.near(1)?.run(&self.engine, &self.model, &[frame], observe)?.remove(0))
    }

    /// Finds the pose in the last frame once more, from where it was found: cut out in a better way, say.
    pub fn again(&mut self, frame: Query, observe: impl FnMut(Progress) -> Result<(), Error>) -> Result<Option<Found>, Error> {
        let earlier = self.before.split_off(self.before.len().min(1));
        let found = self.follow(frame, observe)?;
        self.before.truncate(1);
        self.before.extend(earlier);
        Ok(found)
    }

    /// The object is known to have had this pose in the last frame.
    pub fn restart(&mut self, world_from_camera: DMat4) {
        self.before = vec![world_from_camera];
    }

    /// For this object, with what is known of masks.
    fn prepared(&self, frame: Query) -> Result<Query, Error> {
        if frame.instance != self.instance {
            let what = format!("shows instance {}, but {} is followed", frame.instance, self.instance);
            return Err(Error::Input { input: "frame".into(), what });
        }
        let rim = self.rim.unwrap_or_default() * frame.intrinsics.fx;
        let outline = Outline {
            dilation: rim.dilation.clamp(-WIDEST_RIM, WIDEST_RIM),
            cut: rim.cut.clamp_length_max(WIDEST_CUT),
            missing: rim.missing.clamp_length_max(MISSING),
            undecided: rim.undecided.min(WIDEST_CUT),
        };
        Ok(Query { instance: self.number, outline, ..frame })
    }

    /// What the last poses lead to.
    fn followed(&self, frame: &Query, observe: impl FnMut(Progress) -> Result<(), Error>) -> Result<Option<Found>, Error> {
        let starts: Vec<_> = match self.before[..] {
            [] => return Ok(None),
            [last] => vec![last],
            // It stands still, or goes on as it did.
            [last, ..] => iter::once(last).chain(self.expected()).collect(),
        };
        let frame = Query { starts, ..frame.clone() };
        Ok(Some(self.near(self.before.len())?.run(&self.engine, &self.model, &[frame], observe)?.remove(0)))
    }

    fn keep(&mut self, found: &Found, frame: &Query, is_searched: bool) {
        // Else it was not tried.
        if found.is_trusted() && (is_searched || self.rim.is_none()) {
            self.rim = found.estimate.outline.map(|by| by * (1.0 / frame.intrinsics.fx)).or(self.rim);
        }
        self.before.truncate(1);
        self.before.insert(0, found.world_from_camera);
    }

    /// How the outlines of the frames' masks are moved, as far as that was tried, in pixels over the focal length.
    pub fn rim(&self) -> Option<Outline> {
        self.rim
    }

    /// The next pose is near the last `known` ones; what would have to be found from afar is searched for all around instead.
    fn near(&self, known: usize) -> Result<Search, Error> {
        let phase = |steps, stride, keep| Phase { steps, stride, keep, light: true, closer_look: false, outlines: false };
        let phases = match (known, self.rim) {
            // A look says whether it stands still or goes on.
            (2.., _) => vec![phase(0, 4, 2), phase(3, 2, 1), phase(4, 1, 1)],
            (_, Some(_)) => vec![phase(5, 2, 1), phase(3, 1, 1)],
            (_, None) => vec![phase(5, 2, 1), Phase { outlines: true, ..phase(5, 2, 1) }, phase(3, 1, 1)],
        };
        let (first, _) = self.search.tries()?;
        // Steps so few are those of BFGS, also after a first search the paper's way.
        let Options { method, .. } = Options::default();
        let options = Options { method, phases, min_starts: 0, align: false, settle: 0, ..first.clone() };
        Ok(Search { tries: vec![options], accept: self.search.accept })
    }
}
