//! Photographs with boxes around their objects: what in a box is the object and where the object is are found in turns.

use std::borrow::Borrow;
use std::cmp::Ordering;

use glam::{DMat4, DVec2};
use srn_photo::{BoundingBox, Known, Place};

use super::follow::cut_out;
use super::sightings::{LIKELY, TOLD};
use super::{FoundObject, Open, Shot, Sighting, Sightings};
use crate::camera::{fixed24, neighbor4};
use crate::renderer::render_views;
use crate::{Doubt, Engine, Error, Found, Intrinsics, Model, Outline, View};

/// The model's object is looked at in pictures of so many pixels, for its colours.
const SIDE: u32 = 32;
/// Where all channels are at least this (of [-1, 1]) a view shows background, or its edge.
const WHITE: f32 = 0.9;

/// Room around what seems to be the object, as a share of the longer side of its box: what sticks out of it may be missing there.
const ROOM: f64 = 0.15;
/// More around that where the object's own colours say what is the object: what seemed to be it may be a part of it.
const ROOM_BY_COLOURS: f64 = 0.4;
/// At so many places where it seems to be an object is searched for: of 432 pictures of rooms it is at the first in 423, at the second in 6 (`docs/tried.md`).
const PLACES: usize = 2;

/// A pose is not to be trusted whose outline ends so far inside the box that was given, as a part of its width or height: boxes may be off by a twentieth, right poses mostly end less than 3 % inside (`docs/tried.md`).
const INSIDE: f64 = 0.08;

/// What came of a search.
pub struct Outcome<L> {
    /// What was searched for.
    pub shot: Shot,
    /// What was found of it.
    pub found: Found,
    /// What whoever searches remembers of it.
    pub log: L,
}

/// How photographs are looked at and searched for. What goes wrong in what is called is handed on as it is.
pub struct Boxed<'a, E> {
    /// What renders views.
    pub engine: &'a Engine,
    /// The model that knows the objects.
    pub model: &'a Model,
    /// The object in the photograph with this number, cut out by its box and what is known of it.
    pub open: &'a dyn Fn(usize, Known) -> Result<Shot, E>,
    /// Where searches start.
    pub starts: StartsOf<'a, E>,
    /// The box around what is in sight of the object in the photograph with this number; `None` where nobody has given one.
    pub given: &'a dyn Fn(usize) -> Option<BoundingBox>,
    /// Where the object may be in its box if a part of it is hidden.
    pub sightings: SightingsOf<'a, E>,
}

/// Where a search for the object in the photograph with this number starts.
pub type StartsOf<'a, E> = &'a dyn Fn(usize, &Shot) -> Result<Vec<DMat4>, E>;

/// Where in its box ([`Sightings::in_box`]) this instance may be, in the photograph with this number; `None` where nobody wants to know.
pub type SightingsOf<'a, E> = &'a dyn Fn(usize, u32) -> Result<Option<Sightings<'a>>, E>;

/// Searches for objects in the photographs with these numbers, each from its own starts.
pub type Pass<'a, L, E> = &'a mut dyn FnMut(&[usize], Vec<Shot>, &[Vec<DMat4>]) -> Result<Vec<Outcome<L>>, E>;

impl<E: From<Error>> Boxed<'_, E> {
    /// Searches for objects in the photographs with these numbers, that were cut out by their boxes alone, then from where these end, cut out anew by the model's view from there. Where that is not to be
    /// trusted something may hide a part of the object; where that leads to none to be trusted it begins once more with the colours of the model's object, and what leaves less unexplained counts.
    pub fn search<L>(&self, numbers: &[usize], shots: Vec<Shot>, pass: Pass<L, E>) -> Result<Vec<Outcome<L>>, E> {
        let outcomes = self.in_turns(numbers, shots, pass)?;
        let behind = |(&number, outcome): (&usize, Outcome<L>)| {
            if outcome.found.is_trusted() { Ok(outcome) } else { self.behind(number, outcome, &mut *pass) }
        };
        let outcomes = numbers.iter().zip(outcomes).map(behind).collect::<Result<_, E>>()?;
        self.by_colours(numbers, outcomes, pass)
    }

    /// What is not to be trusted once more, by the colours of the model's object.
    fn by_colours<L>(&self, numbers: &[usize], mut outcomes: Vec<Outcome<L>>, pass: Pass<L, E>) -> Result<Vec<Outcome<L>>, E> {
        let (mut lost, mut anew) = (Vec::new(), Vec::new());
        for (i, Outcome { shot, .. }) in outcomes.iter().enumerate().filter(|(_, outcome)| !outcome.found.is_trusted()) {
            let colours = self.colours(shot.instance)?;
            // Nothing in the box may have those colours.
            if let Ok(shot) = (self.open)(numbers[i], Known { colours: &colours, ..Known::default() }) {
                lost.push(i);
                anew.push(shot);
            }
        }
        if lost.is_empty() {
            return Ok(outcomes);
        }
        let again = self.in_turns(&lost.iter().map(|&i| numbers[i]).collect::<Vec<_>>(), anew, pass)?;
        for (i, mut other) in lost.into_iter().zip(again) {
            let seconds = outcomes[i].found.seconds + other.found.seconds;
            if other.found.is_trusted() || likelier(&other.found, &outcomes[i].found).is_lt() {
                std::mem::swap(&mut outcomes[i], &mut other);
            }
            outcomes[i].found.seconds = seconds;
        }
        Ok(outcomes)
    }

    /// A search, one from where it ends, and, where that says that its mask lacks something on a side, or has too much there, one more.
    fn in_turns<L>(&self, numbers: &[usize], shots: Vec<Shot>, pass: Pass<L, E>) -> Result<Vec<Outcome<L>>, E> {
        let starts = numbers.iter().zip(&shots).map(|(&number, shot)| (self.starts)(number, shot));
        let starts = starts.collect::<Result<Vec<_>, E>>()?;
        let first = pass(numbers, shots, &starts)?;
        let mut second = self.cut_anew(numbers, &first, &mut *pass)?;
        let is_one_sided = |Outline { cut, missing, .. }: Outline| (cut, missing) != (DVec2::ZERO, DVec2::ZERO);
        let is_off = |outcome: &Outcome<L>| outcome.found.estimate.outline.is_some_and(is_one_sided);
        let off: Vec<usize> = (0..second.len()).filter(|&i| is_off(&second[i])).collect();
        if !off.is_empty() {
            let (numbers, wrong): (Vec<_>, Vec<_>) = off.iter().map(|&i| (numbers[i], &second[i])).unzip();
            let third = self.cut_anew(&numbers, &wrong, pass)?;
            off.into_iter().zip(third).for_each(|(i, third)| second[i] = third);
        }
        let judged = |(&number, outcome): (&usize, Outcome<L>)| {
            let is_trusted = outcome.found.is_trusted();
            let sightings = if is_trusted { (self.sightings)(number, outcome.shot.instance)? } else { None };
            self.judged(number, outcome, sightings.as_ref())
        };
        numbers.iter().zip(second).map(judged).collect()
    }

    /// In doubt where it does not reach the edges of the box that was given, or where more in it speaks for another side.
    pub(super) fn judged<L>(
        &self,
        number: usize,
        mut outcome: Outcome<L>,
        sightings: Option<&Sightings>,
    ) -> Result<Outcome<L>, E> {
        let Outcome { shot, found, .. } = &outcome;
        let mut doubt = None;
        if let Some(sightings) = sightings.filter(|_| found.is_trusted())
            && sightings.is_outdone(shot, &found.world_from_camera)?
        {
            doubt = Some(Doubt::Unlikely);
        }
        if let Some(given) = (self.given)(number) {
            let object = FoundObject::of(shot, &found.world_from_camera, self.engine, self.model, 1)?;
            if object.bounds().is_none_or(|bounds| bounds.ends_inside(&given) > INSIDE) {
                doubt = Some(Doubt::Inside);
            }
        }
        outcome.found.doubt = doubt.or(outcome.found.doubt);
        Ok(outcome)
    }

    /// Cut out anew by the model's view from where searches ended, and searched for from there.
    fn cut_anew<L, O: Borrow<Outcome<L>>>(
        &self,
        numbers: &[usize],
        before: &[O],
        pass: Pass<L, E>,
    ) -> Result<Vec<Outcome<L>>, E> {
        let mut shots = Vec::new();
        for (&number, before) in numbers.iter().zip(before) {
            let Outcome { shot, found, .. } = before.borrow();
            let object = FoundObject::of(shot, &found.world_from_camera, self.engine, self.model, 1)?;
            let cut = (self.open)(number, Known { place: Some(&|at| object.shows(at)), ..Known::default() });
            // Or nothing, where the pose is far off.
            shots.push(cut.unwrap_or_else(|_| shot.clone()));
        }
        let found = || before.iter().map(|before| &before.borrow().found);
        let near: Vec<_> = found().map(|found| neighbor4(&found.world_from_camera)).collect();
        let mut outcomes = pass(numbers, shots, &near)?;
        outcomes.iter_mut().zip(found()).for_each(|(outcome, before)| outcome.found.seconds += before.seconds);
        Ok(outcomes)
    }

    /// Those of the model's object, from all around.
    fn colours(&self, instance: u32) -> Result<Vec<[f32; 3]>, E> {
        let radius = self.model.metadata.orbit_radius.unwrap_or(1.3);
        // So that the object fills the picture.
        let focal = f64::from(SIDE) * radius;
        let middle = 0.5 * f64::from(SIDE);
        let camera = Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle, pixel_center: 0.5 };
        let views: Vec<View> = fixed24(radius).into_iter().map(|pose| (instance, pose, camera)).collect();
        let renders = render_views(self.engine, self.model, [SIDE; 2], &views)?;
        let pixels = renders.iter().flat_map(|render| render.rgb.chunks_exact(3)).map(|c| [c[0], c[1], c[2]]);
        Ok(pixels.filter(|colour| colour.iter().any(|&c| c < WHITE)).collect())
    }
}

/// In which order: what reaches the edges of its box before what does not, then by what is left unexplained.
pub(super) fn likelier(found: &Found, other: &Found) -> Ordering {
    is_inside(found).cmp(&is_inside(other)).then(found.unexplained.total_cmp(&other.unexplained))
}

pub(super) fn is_inside(found: &Found) -> bool {
    found.doubt == Some(Doubt::Inside)
}

/// How a photograph is looked at in which nobody knows where the object is; see [`Boxed`].
pub struct Anywhere<'a, E> {
    /// What renders views.
    pub engine: &'a Engine,
    /// The model that knows the object.
    pub model: &'a Model,
    /// The photograph, cut out by a box and what is known of the object in it.
    pub open: Open<'a, E>,
    /// Where searches start.
    pub starts: &'a dyn Fn(&Shot) -> Result<Vec<DMat4>, E>,
    /// Where something else is seen, before the object or beside it.
    pub others: Option<Place<'a>>,
}

/// So many sides from which it looks more like the object than it does as it was found are tried at a place.
const RIVALS: usize = 3;
/// Room around what seems to be the object, likewise, beyond which nothing counts where others of its kind may be.
const ROOM_ALONE: f64 = 0.05;
/// So many times as much must speak for a rival that is not to be trusted where the pose is: for a right one it was 1.03 times, for wrong ones it is 1.08 or more (`docs/tried.md`).
const SURER: f32 = 1.05;

impl<E: From<Error>> Anywhere<'_, E> {
    /// Searches at the places where the object seems to be, the likeliest first, from the likeliest of the [`Sightings::sides`] there, until a pose is to be trusted, and nothing that looks more like the
    /// object ([`Sightings::rivals`]) leads to a better one; if none is, once more by the colours of the model's object, and alone, first where the least is left unexplained; then the least counts. Where it hardly is
    /// ([`Sighting::is_likely`]) it is searched for once, at the likeliest place. `None` where no place differs from what is around it.
    pub fn search<L>(&self, sightings: &Sightings, pass: Pass<L, E>) -> Result<Option<Outcome<L>>, E> {
        let mut outcomes = Vec::new();
        let places = sightings.likeliest(PLACES);
        let likely = places.iter().filter(|place| place.is_likely()).count();
        for sighting in places.into_iter().take(likely.max(1)) {
            // A mask that has something else in it may lead anywhere, but where it is the likeliest the object mostly is.
            let is_likeliest = outcomes.is_empty() && likely > 0;
            let sides = sightings.sides(sighting.clone())?;
            let found = self.or_rival_at(sightings, &sides, is_likeliest, &mut *pass)?;
            outcomes.extend(found.map(|(bounds, outcome)| (bounds, sighting.object, sides, outcome)));
            if outcomes.last().is_some_and(|(.., outcome)| outcome.found.is_trusted()) {
                break;
            }
        }
        let mut seconds: f64 = outcomes.iter().map(|(.., outcome)| outcome.found.seconds).sum();
        let is_all = |(.., outcome): &mut (_, _, _, Outcome<L>)| outcome.found.is_trusted() || likely == 0;
        if let Some((.., Outcome { shot, found, log })) = outcomes.pop_if(is_all) {
            return Ok(Some(Outcome { shot, found: Found { seconds, ..found }, log }));
        }
        outcomes.sort_by(|(.., a), (.., b)| a.found.unexplained.total_cmp(&b.found.unexplained));
        let mut best = None::<Outcome<L>>;
        for (bounds, sighted, sides, outcome) in outcomes {
            seconds -= outcome.found.seconds;
            let wider = bounds.with_room(ROOM_BY_COLOURS);
            for outcome in self.at(wider, |boxed| boxed.by_colours(&[0], vec![outcome], &mut *pass))? {
                let outcome = if outcome.found.is_trusted() {
                    doubted(sightings, self.or_rival(sightings, &sides, outcome, &mut *pass)?)?
                } else {
                    self.or_alone(sightings, &sighted, &sides, outcome, &mut *pass)?
                };
                let Outcome { found, .. } = &outcome;
                seconds += found.seconds;
                if found.is_trusted() || best.as_ref().is_none_or(|best| found.unexplained < best.found.unexplained) {
                    best = Some(outcome);
                }
            }
            if best.as_ref().is_some_and(|best| best.found.is_trusted()) {
                break;
            }
        }
        best.iter_mut().for_each(|best| best.found.seconds = seconds);
        Ok(best)
    }

    /// Searches at one place where the object seems to be, and where its pose is not to be trusted alone. `None` where nothing at the place differs from what is around it.
    pub fn search_at<L>(&self, sightings: &Sightings, place: Sighting, pass: Pass<L, E>) -> Result<Option<Outcome<L>>, E> {
        let sides = sightings.sides(place.clone())?;
        let Some((_, outcome)) = self.or_rival_at(sightings, &sides, false, &mut *pass)? else { return Ok(None) };
        let is_found = outcome.found.is_trusted();
        let outcome = if is_found { outcome } else { self.or_alone(sightings, &place.object, &sides, outcome, pass)? };
        Ok(Some(outcome))
    }

    /// Where a pose is not to be trusted, but likely, what is beside the object may be of its kind: then once more at the place, where nothing beyond what was sighted counts, and once more from there; what is to be
    /// trusted then counts.
    fn or_alone<L>(
        &self,
        sightings: &Sightings,
        sighted: &FoundObject,
        sides: &[Sighting],
        mut outcome: Outcome<L>,
        pass: Pass<L, E>,
    ) -> Result<Outcome<L>, E> {
        if sightings.evidence(&outcome.shot, &outcome.found.world_from_camera)? < LIKELY {
            return Ok(outcome);
        }
        let alone = self.alone(sighted, |there| there.or_rival_at(sightings, sides, false, &mut *pass))?;
        let Some((bounds, mut other)) = alone else { return Ok(outcome) };
        if other.found.is_trusted() {
            // What seemed to be the object is not quite what is.
            let object = FoundObject::of(&other.shot, &other.found.world_from_camera, self.engine, self.model, 1)?;
            let anew = self.alone(&object, |there| there.at(bounds, |boxed| boxed.cut_anew(&[0], &[&other], pass)))?;
            let anew = anew.into_iter().map(|anew| doubted(sightings, anew)).collect::<Result<Vec<_>, E>>()?;
            other = anew.into_iter().find(|anew| anew.found.is_trusted()).unwrap_or(other);
            std::mem::swap(&mut outcome, &mut other);
        }
        outcome.found.seconds += other.found.seconds;
        Ok(outcome)
    }

    /// Where nothing beyond an object, and some room around it, counts.
    fn alone<T>(&self, object: &FoundObject, search: impl FnOnce(&Anywhere<E>) -> T) -> T {
        let room = object.bounds().map_or(0.0, |bounds| ROOM_ALONE * bounds.size[0].max(bounds.size[1]));
        let others = |at| self.others.is_some_and(|is_other| is_other(at)) || !object.covers_near(at, room);
        search(&Anywhere { others: Some(&others), ..*self })
    }

    /// What is found at a place, in a box there, which comes too, from the likeliest of its sides, or from a rival of what is found so; rivals are tried where that is to be trusted, else if `anyway`. `None` where
    /// nothing in the box differs from what is around it.
    fn or_rival_at<L>(
        &self,
        sightings: &Sightings,
        sides: &[Sighting],
        anyway: bool,
        pass: Pass<L, E>,
    ) -> Result<Option<(BoundingBox, Outcome<L>)>, E> {
        let Some((bounds, outcome)) = self.around(&sides[0], self.starts, &mut *pass)? else { return Ok(None) };
        let is_worth_it = anyway || outcome.found.is_trusted();
        let outcome = if is_worth_it { self.or_rival(sightings, sides, outcome, pass)? } else { outcome };
        Ok(Some((bounds, doubted(sightings, outcome)?)))
    }

    /// What looks more like the object from other sides is searched for from there, until one has more in the photograph that speaks for it, by [`SURER`] where it is to be trusted less; it counts.
    fn or_rival<L>(
        &self,
        sightings: &Sightings,
        sides: &[Sighting],
        outcome: Outcome<L>,
        pass: Pass<L, E>,
    ) -> Result<Outcome<L>, E> {
        let evidence = |Outcome { shot, found, .. }: &Outcome<L>| sightings.evidence(shot, &found.world_from_camera);
        let (own, mut seconds) = (evidence(&outcome)?, outcome.found.seconds);
        for rival in sightings.rivals(&outcome.shot, &outcome.found.world_from_camera, sides)?.into_iter().take(RIVALS) {
            let near = |shot: &Shot| Ok(neighbor4(&shot.facing(self.model, &rival.side)?));
            let Some((_, mut other)) = self.around(&rival, &near, &mut *pass)? else { continue };
            seconds += other.found.seconds;
            let least = if outcome.found.is_trusted() && !other.found.is_trusted() { SURER * own } else { own };
            if evidence(&other)? > least {
                other.found.seconds = seconds;
                return Ok(other);
            }
        }
        Ok(Outcome { found: Found { seconds, ..outcome.found }, ..outcome })
    }

    /// What is found at a place, in a box there, which comes too; `None` where nothing in it differs from what is around it.
    fn around<L>(
        &self,
        Sighting { object, bounds, .. }: &Sighting,
        starts: &dyn Fn(&Shot) -> Result<Vec<DMat4>, E>,
        pass: Pass<L, E>,
    ) -> Result<Option<(BoundingBox, Outcome<L>)>, E> {
        let bounds = bounds.with_room(ROOM);
        let Ok(shot) = cut_out(bounds, object, &|bounds, known| self.cut_out(bounds, known)) else { return Ok(None) };
        let there = Anywhere { starts, ..*self };
        let found = there.at(bounds, |boxed| boxed.in_turns(&[0], vec![shot], pass))?;
        Ok(found.into_iter().next().map(|outcome| (bounds, outcome)))
    }

    /// At one of them.
    fn at<T>(&self, bounds: BoundingBox, search: impl FnOnce(&Boxed<E>) -> T) -> T {
        let &Anywhere { engine, model, starts, .. } = self;
        let open = |_, known: Known| self.cut_out(bounds, known);
        search(&Boxed {
            engine,
            model,
            open: &open,
            starts: &|_, shot| starts(shot),
            given: &|_| None,
            sightings: &|_, _| Ok(None),
        })
    }

    /// The object in a box.
    fn cut_out(&self, bounds: BoundingBox, known: Known) -> Result<Shot, E> {
        (self.open)(bounds, Known { others: self.others, ..known })
    }
}

/// Not to be trusted where too little in the photograph speaks for it.
fn doubted<L, E: From<Error>>(sightings: &Sightings, mut outcome: Outcome<L>) -> Result<Outcome<L>, E> {
    let Outcome { shot, found, .. } = &outcome;
    if found.is_trusted() && sightings.evidence(shot, &found.world_from_camera)? < TOLD {
        outcome.found.doubt = Some(Doubt::Unlikely);
    }
    Ok(outcome)
}
