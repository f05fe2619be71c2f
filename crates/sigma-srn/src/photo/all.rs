//! All of a model's objects that are in a photograph: the likeliest first, and what is found covers some of what is left.

use srn_photo::{BoundingBox, Photo, Place};

use super::{FoundObject, Outcome, Sighting, Sightings};
use crate::{Engine, Error, Found, Model};

/// Two that have more than this part of what they cover in common are one.
const SAME: f64 = 0.4;
/// An instance is searched for at so many places, until something else is found near one of them.
const PLACES: usize = 3;

/// How a photograph is looked at of which nobody knows what is in it.
pub struct All<'a> {
    /// What renders views.
    pub engine: &'a Engine,
    /// The model that knows the objects.
    pub model: &'a Model,
    /// The photograph.
    pub photo: &'a Photo,
}

/// An instance that may be there.
struct Waiting {
    instance: u32,
    /// How much speaks for its likeliest place.
    evidence: f32,
    /// So many others were known when it was looked for.
    known: usize,
}

/// An instance that was searched for, and where.
struct Lost {
    instance: u32,
    place: Sighting,
}

impl All<'_> {
    /// Looks for these instances, and searches for the one for which the most speaks, where that is, and so on. Where its pose is to be trusted it is taken, and of the same instance another one is looked for. Where one
    /// was not found, what is taken later may have hidden it: then it is searched for once more. What is taken, in this order. `look` hears of each instance that is looked for, and `search` searches for one at a place
    /// ([`super::Anywhere::search_at`]), beside or behind those that were taken before it.
    pub fn search<L, E: From<Error>>(
        &self,
        instances: impl IntoIterator<Item = u32>,
        mut look: impl FnMut(u32),
        mut search: impl FnMut(u32, &Sightings, Sighting, Option<Place>) -> Result<Option<Outcome<L>>, E>,
    ) -> Result<Vec<Outcome<L>>, E> {
        let Self { engine, model, photo } = *self;
        let mut sighted = |instance: u32, others: &[FoundObject]| {
            look(instance);
            Sightings::of(engine, model, instance, photo, others)
        };
        let (mut waiting, mut lost, mut objects, mut taken) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for instance in instances {
            waiting.extend(Waiting::at(&places(&sighted(instance, &[])?, instance, &[]), instance, 0));
        }
        while let Some(Waiting { instance, known, .. }) = likeliest(&mut waiting) {
            let sightings = sighted(instance, &objects)?;
            let mut places = places(&sightings, instance, &lost);
            let Some(now) = Waiting::at(&places, instance, objects.len()) else { continue };
            // What spoke for it may have been one of those that were taken since.
            if known < objects.len() && waiting.iter().any(|other| other.evidence > now.evidence) {
                waiting.push(now);
                continue;
            }
            let place = places.remove(0);
            waiting.extend(Waiting::at(&places, instance, objects.len()));
            let is_other = |at| objects.iter().any(|other: &FoundObject| other.covers(at));
            let others: Option<Place> = if objects.is_empty() { None } else { Some(&is_other) };
            let found = search(instance, &sightings, place.clone(), others)?;
            let Some((outcome, object, bounds)) = self.to_be_told(found, &objects)? else {
                lost.push(Lost { instance, place });
                continue;
            };
            for Lost { instance, place } in lost.extract_if(.., |lost| lost.place.bounds.overlap(&bounds) > 0.0) {
                waiting.retain(|waiting| waiting.instance != instance);
                waiting.push(Waiting { instance, evidence: place.evidence(), known: objects.len() });
            }
            objects.push(object);
            taken.push(outcome);
        }
        Ok(taken)
    }

    /// What was found, what it covers, and a box around that; `None` where it is not to be trusted, or is one of these objects.
    fn to_be_told<L>(
        &self,
        found: Option<Outcome<L>>,
        objects: &[FoundObject],
    ) -> Result<Option<(Outcome<L>, FoundObject, BoundingBox)>, Error> {
        let Some(outcome) = found.filter(|outcome| outcome.found.is_trusted()) else { return Ok(None) };
        let Outcome { shot, found: Found { world_from_camera, .. }, .. } = &outcome;
        let object = FoundObject::of(shot, world_from_camera, self.engine, self.model, 1)?;
        let is_new = objects.iter().all(|other| other.overlap(&object) < SAME);
        Ok(object.bounds().filter(|_| is_new).map(|bounds| (outcome, object, bounds)))
    }
}

/// Where an instance is likely, the likeliest first, but where it was lost.
fn places(sightings: &Sightings, instance: u32, lost: &[Lost]) -> Vec<Sighting> {
    let mut places = sightings.likeliest(PLACES);
    let was_lost =
        |at: &Sighting| lost.iter().any(|lost| lost.instance == instance && lost.place.bounds.overlap(&at.bounds) >= SAME);
    places.retain(|place| place.is_likely() && !was_lost(place));
    places
}

impl Waiting {
    /// Where it may be; `None` where it may not be anywhere.
    fn at(places: &[Sighting], instance: u32, known: usize) -> Option<Self> {
        places.first().map(|place| Waiting { instance, evidence: place.evidence(), known })
    }
}

/// The one for which the most spoke, which is taken out.
fn likeliest(waiting: &mut Vec<Waiting>) -> Option<Waiting> {
    let number = (0..waiting.len()).max_by(|&a, &b| waiting[a].evidence.total_cmp(&waiting[b].evidence))?;
    Some(waiting.swap_remove(number))
}
