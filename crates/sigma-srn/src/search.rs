//! What is wanted of a picture: a pose, the model's view from there, and whether it is to be trusted. Where it is not, another search follows.

use glam::DMat4;
use web_time::Instant;

use crate::confidence::{Confidence, Doubt, explains_colours, hidden_doubt, unexplained, unexplained_doubt};
use crate::estimator::{Effort, Estimate, Options, Progress, Query, at_work, check, estimate};
use crate::renderer::{View, render_views};
use crate::unseen::estimate_unseen;
use crate::{Engine, Error, Model};

/// Rays that are cast side by side, but for those of a single image: enough to fill a large GPU. Each few hundred have some hundred steps of the plan, and
/// those of a thousand images would not fit into the memory of a machine.
const AT_ONCE: usize = 1 << 20;

/// Searches that follow one another until there is a pose to be trusted. By default those of [`Effort::Normal`].
#[derive(Clone, Debug, PartialEq)]
pub struct Search {
    /// The settings of each; all but the first are for images whose pose is not to be trusted yet.
    pub tries: Vec<Options>,
    /// Trusts a pose whose view leaves at most this part of the image unexplained, whatever else there is to doubt. `None`: what
    /// [`Estimate::doubt`] says.
    pub accept: Option<f64>,
}

/// What was found for an image.
#[derive(Clone, Debug)]
pub struct Found {
    /// The estimate with all starts ranked.
    pub estimate: Estimate,
    /// Its pose.
    pub world_from_camera: DMat4,
    /// The model's view from there `[height, width, 3]`.
    pub view: Vec<f32>,
    /// The part of [`Estimate::target`] that the view leaves [`unexplained`]: 0 if they are equal, 1 if it is no better than nothing.
    pub unexplained: f64,
    /// Why it is not to be trusted, if it is not.
    pub doubt: Option<Doubt>,
    /// How far off the pose may be, if the model is calibrated.
    pub confidence: Option<Confidence>,
    /// How many searches there were until this one had found it.
    pub searches: usize,
    /// Seconds of all searches, an image's share of their batch.
    pub seconds: f64,
}

impl Default for Search {
    fn default() -> Self {
        Search::of(Effort::Normal)
    }
}

impl From<Options> for Search {
    /// A single one.
    fn from(options: Options) -> Self {
        Search { tries: vec![options], accept: None }
    }
}

impl Search {
    /// One search of this effort; where [`Effort::Normal`] has found nothing to be trusted, one of [`Effort::Exhaustive`] too.
    pub fn of(effort: Effort) -> Self {
        let then = (effort == Effort::Normal).then_some(Effort::Exhaustive);
        Search { tries: [effort].into_iter().chain(then).map(Options::of).collect(), accept: None }
    }

    /// Searches for the poses of all queries, as many side by side as pays, then for each again that is not to be trusted. `observe` sees what that of
    /// [`estimate`] does, [`Progress::search`] says in which search.
    pub fn run(
        &self,
        engine: &Engine,
        model: &Model,
        queries: &[Query],
        mut observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<Vec<Found>, Error> {
        let (first, others) = self.tries()?;
        // Later ones see a query alone, and would call it the first.
        self.tries.iter().try_for_each(|options| check(model, queries, options))?;
        let began = Instant::now();
        let (model, queries) = &at_work(model, queries)?;
        let before = began.elapsed().as_secs_f64() / queries.len() as f64;
        let mut all = self.once(engine, model, queries, first, AT_ONCE, &mut observe)?;
        all.iter_mut().for_each(|found| found.seconds += before);
        for (search, options) in (1..).zip(others) {
            for (i, found) in all.iter_mut().enumerate().filter(|(_, found)| !found.is_trusted()) {
                let mut again = self.once(engine, model, &queries[i..=i], options, AT_ONCE, |progress| {
                    let hypotheses: Vec<_> = progress.hypotheses.iter().map(|(_, start)| (i, *start)).collect();
                    observe(Progress { search, hypotheses: &hypotheses, ..progress })
                })?;
                let again = again.remove(0);
                let seconds = found.seconds + again.seconds;
                // The first search's pose stays where the second has found no better one. In the image's own colours: with little contrast
                // there is little loss, too.
                let loss =
                    |found: &Found| found.estimate.loss / found.estimate.light.map_or(1.0, |light| f64::from(light.contrast));
                if loss(&again) < loss(found) {
                    *found = Found { searches: search + 1, ..again };
                }
                found.seconds = seconds;
            }
        }
        Ok(all)
    }

    /// The same for one image of an object that `model` was not trained on, by [`estimate_unseen`], of whose settings only the seed is taken. The
    /// model with the object as its only instance is returned too.
    pub fn run_unseen(
        &self,
        engine: &Engine,
        model: &Model,
        query: &Query,
        observe: impl FnMut(usize, usize) -> Result<(), Error>,
    ) -> Result<(Found, Model), Error> {
        let (Options { seed, .. }, _) = self.tries()?;
        let began = Instant::now();
        // It has no calibration: the deviations that it knows are those of known objects.
        let unseen = estimate_unseen(engine, model, query, *seed, observe)?;
        let seconds = began.elapsed().as_secs_f64();
        let query = Query { instance: 0, ..query.clone() };
        let view = view(&query, &unseen.estimate);
        let view = render_views(engine, &unseen.model, [query.width, query.height], &[view])?.remove(0).rgb;
        let doubt = |_: &Estimate, unexplained| unseen.doubt(model, unexplained);
        let found = self.judged(&unseen.model, &query, unseen.estimate.clone(), view, seconds, doubt);
        Ok((found, unseen.model))
    }

    pub(crate) fn tries(&self) -> Result<(&Options, &[Options]), Error> {
        self.tries.split_first().ok_or_else(|| Error::Setting { field: "tries", what: "there are none".into() })
    }

    /// One search for all queries, at most `at_once` rays side by side.
    fn once(
        &self,
        engine: &Engine,
        model: &Model,
        queries: &[Query],
        options: &Options,
        at_once: usize,
        mut observe: impl FnMut(Progress) -> Result<(), Error>,
    ) -> Result<Vec<Found>, Error> {
        let mut all = Vec::new();
        let portions = portions(queries, options, at_once);
        let (mut left, mut before) = (portions.len() as u32, 0);
        for portion in portions {
            let began = Instant::now();
            let (first, mut done) = (all.len(), 0);
            let estimates = estimate(engine, model, portion, options, |progress| {
                done = progress.step;
                let hypotheses: Vec<_> = progress.hypotheses.iter().map(|(query, start)| (first + query, *start)).collect();
                let (step, steps) = (before + progress.step, before + left * progress.steps);
                observe(Progress { step, steps, hypotheses: &hypotheses, ..progress })
            })?;
            (left, before) = (left - 1, before + done);
            let seconds = began.elapsed().as_secs_f64() / portion.len() as f64;
            let views: Vec<View> = portion.iter().zip(&estimates).map(|(query, estimate)| view(query, estimate)).collect();
            let views = render_views(engine, model, [portion[0].width, portion[0].height], &views)?;
            all.extend(portion.iter().zip(estimates).zip(views).map(|((query, estimate), view)| {
                let doubt = |estimate: &Estimate, unexplained| estimate.doubt(model, query.instance, unexplained);
                self.judged(model, query, estimate, view.rgb, seconds, doubt)
            }));
        }
        Ok(all)
    }

    /// `doubt`: why it is not to be trusted with so much of the image unexplained, unless [`Search::accept`] decides alone.
    fn judged(
        &self,
        model: &Model,
        query: &Query,
        estimate: Estimate,
        view: Vec<f32>,
        seconds: f64,
        doubt: impl FnOnce(&Estimate, f64) -> Option<Doubt>,
    ) -> Found {
        let unexplained = unexplained(&estimate.target, estimate.weights.as_deref(), &view);
        let doubt = match self.accept {
            Some(_) if !estimate.loss.is_finite() => Some(Doubt::Loss),
            Some(most) => unexplained_doubt(unexplained, most),
            None => doubt(&estimate, unexplained).or_else(|| {
                let weights = estimate.weights.as_deref()?;
                let coverage = query.seen(estimate.outline.unwrap_or_default()).coverage;
                let explains_colours = explains_colours(&estimate.target, &coverage, weights, &view);
                hidden_doubt(weights, &view, query.width as usize, explains_colours, estimate.rival().map(|(_, higher)| higher))
            }),
        };
        let confidence = Confidence::of(model, query.instance, &estimate);
        let world_from_camera = estimate.pose.to_matrix();
        Found { estimate, world_from_camera, view, unexplained, doubt, confidence, searches: 1, seconds }
    }
}

impl Found {
    /// Whether there is no doubt.
    pub fn is_trusted(&self) -> bool {
        self.doubt.is_none()
    }
}

/// The queries cut into portions of at most so many rays, but of one query at least.
fn portions<'a>(queries: &'a [Query], options: &Options, most: usize) -> Vec<&'a [Query]> {
    let (mut portions, mut from, mut rays) = (Vec::new(), 0, 0);
    for (number, query) in queries.iter().enumerate() {
        let own = query.most_rays(options);
        if number > from && rays + own > most {
            portions.push(&queries[from..number]);
            (from, rays) = (number, 0);
        }
        rays += own;
    }
    portions.push(&queries[from..]);
    portions
}

/// The view from an estimated pose.
fn view(query: &Query, estimate: &Estimate) -> View {
    (query.instance, estimate.pose.to_matrix(), query.intrinsics)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::camera::fixed24;
    use crate::{Intrinsics, ModelConfig, Outline};

    fn model() -> Model {
        Model::init(&ModelConfig { hidden: 8, latent: 4, instances: 1, tracing_steps: 2, density: true }, 3).unwrap()
    }

    fn of(shade: f32) -> Query {
        Query {
            instance: 0,
            rgb: (0..192).map(|k| shade - (k % 7) as f32 / 9.0).collect(),
            weights: None,
            coverage: None,
            outline: Outline::AS_GIVEN,
            width: 8,
            height: 8,
            intrinsics: Intrinsics { fx: 9.0, fy: 9.0, cx: 4.0, cy: 4.0, pixel_center: 0.0 },
            starts: vec![fixed24(1.3)[5]],
        }
    }

    #[test]
    fn many_images_are_searched_for_in_portions() {
        let (engine, model, search) = (Engine::cpu(), model(), Search::of(Effort::Fast));
        let queries = [0.9, 0.7, 0.4].map(of);
        let options = &search.tries[0];
        let lengths = |most| portions(&queries, options, most).iter().map(|portion| portion.len()).collect::<Vec<_>>();
        let one = queries[0].most_rays(options);
        assert_eq!([0, one, 2 * one, 3 * one].map(lengths), [vec![1, 1, 1], vec![1, 1, 1], vec![2, 1], vec![3]]);

        let searched = |at_once| {
            let mut seen = Vec::new();
            let observe = |progress: Progress| {
                seen.push((progress.step, progress.steps, progress.hypotheses.iter().map(|(query, _)| *query).max()));
                Ok(())
            };
            let found = search.once(&engine, &model, &queries, options, at_once, observe).unwrap();
            (found.iter().map(|found| found.estimate.pose).collect::<Vec<_>>(), seen)
        };
        let ((together, _), (apart, seen)) = (searched(usize::MAX), searched(one));
        let off = |(a, b): (&crate::Pose6, &crate::Pose6)| a.degrees_from(*b);
        assert!(together.iter().zip(&apart).map(off).all(|degrees| degrees < 1e-3), "{together:?} {apart:?}");
        assert!(seen.is_sorted_by_key(|(step, ..)| *step) && seen.is_sorted_by_key(|(.., query)| *query), "{seen:?}");
        let (step, steps, query) = seen[seen.len() - 1];
        assert_eq!((step, query), (steps, Some(2)));

        let wrong = [of(0.9), Query { starts: vec![], ..of(0.9) }];
        let error = search.run(&engine, &model, &wrong, |_| Ok(())).unwrap_err();
        assert!(matches!(error, Error::Query { number: 1, .. }), "{error}");
        // A later try, whose rays see nothing that counts, says it of the right image before the first begins.
        let mut weights = vec![0.0; 64];
        weights[0] = 1.0;
        let dark = [of(0.9), Query { weights: Some(weights), ..of(0.9) }];
        let with_stride = |stride| options.clone().with_stride(stride);
        let search = Search { tries: vec![with_stride(1), with_stride(2)], accept: None };
        let error = search.run(&engine, &model, &dark, |_| panic!("it has begun")).unwrap_err();
        assert!(matches!(error, Error::Query { number: 1, .. }), "{error}");
    }

    #[test]
    fn what_is_not_trusted_is_searched_for_once_more() {
        let model = model();
        let engine = Engine::cpu();
        // The searches, the images, and the losses that a call comes across.
        let searched = |search: &Search| {
            let (mut seen, mut lowest) = (BTreeSet::new(), [f64::INFINITY; 2]);
            let observe = |progress: Progress| {
                for ((query, _), (loss, _)) in progress.hypotheses.iter().zip(progress.descent.standing()?) {
                    seen.insert((progress.search, *query));
                    if progress.step == progress.steps {
                        lowest[*query] = lowest[*query].min(loss);
                    }
                }
                Ok(())
            };
            let found = search.run(&engine, &model, &[of(0.9), of(0.4)], observe).unwrap();
            assert_eq!([found[0].estimate.loss, found[1].estimate.loss], lowest);
            seen.into_iter().collect::<Vec<_>>()
        };
        let accepting = |accept, search| Search { accept: Some(accept), ..search };
        assert_eq!(searched(&accepting(1e9, Search::default())), [(0, 0), (0, 1)]);
        assert_eq!(searched(&accepting(1e-9, Search::default())), [(0, 0), (0, 1), (1, 0), (1, 1)]);
        assert_eq!(searched(&accepting(1e-9, Search::of(Effort::Fast))), [(0, 0), (0, 1)]);
        let error = Search { tries: vec![], accept: None }.run(&engine, &model, &[of(0.9)], |_| Ok(())).unwrap_err();
        assert_eq!(error.to_string(), "tries: there are none");
    }
}
