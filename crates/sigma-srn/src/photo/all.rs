//! All of a model's objects that are in a photograph: the likeliest first, and what is found covers some of what is left.

use srn_photo::{Photo, Place};

use super::sightings::LIKELY;
use super::{FoundObject, Outcome, Sighting, Sightings};
use crate::{Engine, Error, Model};

/// Two that have more than this part of what they cover in common are one.
const SAME: f64 = 0.4;
/// With so much in common one may have hidden the other, which is worth another search.
const HIDES: f64 = 0.03;

/// How a photograph is looked at of which nobody knows what is in it.
pub struct All<'a> {
    /// What renders views.
    pub engine: &'a Engine,
    /// The model that knows the objects.
    pub model: &'a Model,
    /// The photograph.
    pub photo: &'a Photo,
}

/// An object that may be there.
struct Waiting {
    instance: u32,
    place: Sighting,
    /// So many others were known when it was looked for.
    known: usize,
}

impl All<'_> {
    /// Looks for these instances, and searches for the one for which the most speaks, and so on. Where its pose is to be trusted it is taken, and of the same instance another one is looked for; what was not found may have been hidden by it, and is searched for once more.
    /// What is taken, in this order. `look` hears of each instance that is looked for, and `search` searches for one ([`super::Anywhere`]), beside or behind those that were taken before it.
    pub fn search<L, E: From<Error>>(
        &self,
        instances: impl IntoIterator<Item = u32>,
        mut look: impl FnMut(u32),
        mut search: impl FnMut(u32, &Sightings, Option<Place>) -> Result<Option<Outcome<L>>, E>,
    ) -> Result<Vec<Outcome<L>>, E> {
        let Self { engine, model, photo } = *self;
        let mut sighted = |instance: u32, others: &[FoundObject]| {
            look(instance);
            Sightings::of(engine, model, instance, photo, others)
        };
        let (mut waiting, mut lost, mut objects, mut taken) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for instance in instances {
            waiting.extend(Waiting::at(sighted(instance, &[])?.likeliest(1), instance, 0));
        }
        while let Some(Waiting { instance, known, .. }) = likeliest(&mut waiting) {
            let sightings = sighted(instance, &objects)?;
            let mut places = sightings.likeliest(2);
            let next = places.split_off(places.len().min(1));
            let Some(now) = Waiting::at(places, instance, objects.len()) else { continue };
            // What spoke for it may have been one of those that were taken since.
            if known < objects.len() && waiting.iter().any(|other| other.evidence() > now.evidence()) {
                waiting.push(now);
                continue;
            }
            let is_other = |at| objects.iter().any(|other: &FoundObject| other.covers(at));
            let others: Option<Place> = if objects.is_empty() { None } else { Some(&is_other) };
            let found = search(instance, &sightings, others)?.filter(|outcome| outcome.found.is_trusted());
            let Some(outcome) = found else {
                lost.push(now);
                continue;
            };
            let Outcome { shot, found, .. } = &outcome;
            let object = FoundObject::of(shot, &found.world_from_camera, engine, model, 1)?;
            let is_likely = sightings.evidence(shot, &found.world_from_camera)? >= LIKELY;
            if is_likely && objects.iter().all(|other| other.overlap(&object) < SAME) {
                waiting.extend(Waiting::at(next, instance, objects.len()));
                waiting.extend(lost.extract_if(.., |lost: &mut Waiting| lost.place.object.overlap(&object) > HIDES));
                objects.push(object);
                taken.push(outcome);
            }
        }
        Ok(taken)
    }
}

impl Waiting {
    /// The first of these places, if it is likely.
    fn at(places: Vec<Sighting>, instance: u32, known: usize) -> Option<Self> {
        let place = places.into_iter().next().filter(Sighting::is_likely)?;
        Some(Waiting { instance, place, known })
    }

    fn evidence(&self) -> f32 {
        self.place.evidence()
    }
}

/// The one for which the most spoke, which is taken out.
fn likeliest(waiting: &mut Vec<Waiting>) -> Option<Waiting> {
    let number = (0..waiting.len()).max_by(|&a, &b| waiting[a].evidence().total_cmp(&waiting[b].evidence()))?;
    Some(waiting.swap_remove(number))
}
