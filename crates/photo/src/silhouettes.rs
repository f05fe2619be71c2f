//! What of photographs of one object, whose cameras are known, is the object, where nobody has cut it out. In each it is what has other colours than what is around it,
//! and than the plane that it stands on; all of them see it in the same place (silhouettes of one body: Campbell et al. 2010).

use glam::DVec3;
use rayon::prelude::*;

use self::ground::Ground;
use crate::colours::Mixture;
use crate::pixels::Pixels;
use crate::segment::{BoundingBox, COLOUR, Grid, SUREST, cut};

/// Where the object is, roughly: all of it lies in this ball.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ball {
    /// In the units of the cameras.
    pub centre: DVec3,
    /// Likewise.
    pub radius: f64,
}

/// What an object stands on: `normal · x = offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// Of length 1.
    pub normal: DVec3,
    /// In the units of the cameras.
    pub offset: f64,
}

/// Where a camera sees a point of space, across and down in pixels whose edges are whole numbers; `None` behind it.
pub type Projection<'a> = &'a (dyn Fn(DVec3) -> Option<[f64; 2]> + Sync);

/// What photographs say together.
pub struct Found {
    /// What just holds the object.
    pub ball: Ball,
    /// What it stands on, if that has a pattern.
    pub ground: Option<Plane>,
    own: Mixture,
}

/// Cells of space across the ball, and a cell of a photograph is at most so many away from one of space that it shows.
const ACROSS: usize = 64;
const SPREAD: usize = 2;
/// Not in this photograph.
const NOWHERE: u32 = u32::MAX;
/// Turns of colours, outlines and space, where nothing of the object is known but the ball, and where more is.
const FIRST_ROUNDS: usize = 3;
const ROUNDS: usize = 5;
/// Logarithm of the density of colours, if all are alike; but for the constant of a [`Mixture`].
const ANYTHING: f64 = 0.68;
/// By so much less likely the object has a colour that it is not known to have, its surroundings one that they are not known to have, before a known ground one of theirs or any
/// other, and any of these a colour that is one of its own in the shade.
const NEW: f64 = 3.0;
const STRANGE: f64 = 6.0;
const ELSEWHERE: f64 = 11.0;
const BEFORE: f64 = 12.0;
const SHADED: f64 = 3.0;
/// How bright such shades are.
const SHADES: [f64; 4] = [0.8, 0.65, 0.5, 0.4];
/// Logarithms of the odds that a place is the object where photographs agree, and is not where they do not; the share of them that says neither, and how far from it they are sure.
const AGREED: f64 = 2.0;
const ALONE: f64 = 8.0;
const UNDECIDED: f64 = 0.75;
const DOUBT: f64 = 0.15;
/// The object is where at least this share of photographs see it.
const SEEN: f64 = 0.8;
/// Colours are learnt from so many photographs, and where the ground is known from what so large a share of them see.
const LEARNT_FROM: usize = 16;
const LEARNT_WHERE: f64 = 0.5;
/// Where the ground is known, so much more do colours count; one that is so much less likely the object's says that it is not there, others say nothing, but as if at least so many said something.
const SURER: f64 = 4.0;
const AGAINST: f64 = 0.5;
const ANSWERS: f64 = 0.5;
/// A colour so far from the ground's, in variances, is none of it.
const UNLIKE: f64 = 12.0;
/// Logarithm of the odds that what is out of the ball is not the object.
const OUTSIDE: f64 = 1e9;

/// Mean of the ground's colours, and their variance.
type Shade = (DVec3, f64);

/// What a photograph shows of the ball.
pub struct Sight<'a> {
    project: Projection<'a>,
    grid: Grid,
    edges: Vec<f32>,
    /// Whether a cell shows some of the ball.
    may_be: Vec<bool>,
    /// For each cell of space, which cell shows it.
    cells: Vec<u32>,
    /// For each cell, the colour of the ground that is there or behind it; none at all where that is not known.
    ground: Vec<Option<Shade>>,
    /// Colours of what is around the object.
    others: Option<Mixture>,
    object: Vec<bool>,
    /// Whether a cell says that it is not the object.
    against: Vec<bool>,
}

impl<'a> Sight<'a> {
    /// `None` where the ball is not in the picture, or nothing else is.
    pub fn of(picture: &Pixels, project: Projection<'a>, ball: Ball) -> Option<Self> {
        let middle = project(ball.centre)?;
        let off = |[x, y]: [f64; 2]| (x - middle[0]).hypot(y - middle[1]);
        let reach = directions().filter_map(|way| project(ball.centre + ball.radius * way)).map(off).fold(0.0, f64::max);
        let bounds = BoundingBox { corner: middle.map(|x| x - reach), size: [2.0 * reach; 2] };
        let grid = Grid::around(picture, bounds)?;
        let may_be = grid.each(|at| off(at) <= reach);
        let cells = places(ball).map(|place| project(place).and_then(|at| grid.cell_of(at)).unwrap_or(NOWHERE)).collect();
        let (object, against) = (vec![false; may_be.len()], vec![false; may_be.len()]);
        Mixture::of(&grid.colours_where(&may_be, false)).map(|others| Self {
            project,
            edges: grid.edges(),
            grid,
            may_be,
            cells,
            ground: vec![],
            others: Some(others),
            object,
            against,
        })
    }

    /// How much of each pixel is the object, 0 to 1, `[height · width]`. All 0 where it is not seen.
    pub fn on(&self, width: usize, height: usize) -> Vec<f32> {
        self.grid.on(width, height, &self.object)
    }

    /// Whether it is seen.
    pub fn is_seen(&self) -> bool {
        self.object.contains(&true)
    }

    fn is_grounded(&self) -> bool {
        !self.ground.is_empty()
    }

    /// Parts it once more, by the object's own colours, if they are known, and by what all photographs think of each cell.
    fn part(&mut self, own: Option<&Mixture>, agreed: &[f64], is_first: bool) {
        let is_other = |i: usize| {
            let is_out = if is_first { !self.may_be[i] } else { !self.object[i] };
            // The ground has its own colours at each place, and what photographs agree on may still be found to be the object.
            is_out && (!self.is_grounded() || agreed[i] <= 0.0 && self.is_unlike_ground(i))
        };
        let others: Vec<bool> = (0..self.object.len()).map(is_other).collect();
        self.others = Mixture::of(&self.grid.colours_where(&others, true));
        let weight = f64::from(COLOUR) * if self.is_grounded() { SURER } else { 1.0 };
        let odds: Vec<f64> = self.odds(own).collect();
        self.against = odds.iter().map(|odds| *odds > AGAINST).collect();
        let costs: Vec<f32> = odds.iter().zip(agreed).map(|(odds, agreed)| (weight * (odds - agreed)) as f32).collect();
        self.object = cut(&costs, &self.edges, self.grid.size[0], &self.object);
    }

    /// Has cells say whether they are not the object, if it has these colours.
    fn answer(&mut self, own: Option<&Mixture>) {
        self.against = self.odds(own).map(|odds| odds > AGAINST).collect();
    }

    /// Logarithm of the odds that each cell is not the object, by its colour.
    fn odds(&self, own: Option<&Mixture>) -> impl Iterator<Item = f64> {
        let of_others = |i: usize| {
            let colour = self.grid.colours[i];
            let around = self.others.as_ref().map_or(f64::NEG_INFINITY, |others| {
                let shaded = SHADES.map(|shade| others.log_density((colour + 1.0) / shade - 1.0) - SHADED);
                shaded.into_iter().fold(others.log_density(colour), f64::max)
            });
            let of = |(mean, variance): Shade| -0.5 * mean.distance_squared(colour) / variance - 1.5 * variance.ln();
            match self.ground_at(i).map(of).reduce(f64::max) {
                Some(ground) => ground.max(around - ELSEWHERE).max(ANYTHING - BEFORE),
                None => around.max(ANYTHING - STRANGE),
            }
        };
        let odds = move |i: usize| {
            let mine = own.map_or(ANYTHING, |own| own.log_density(self.grid.colours[i]).max(ANYTHING - NEW));
            (of_others(i) - mine).clamp(-SUREST, SUREST)
        };
        (0..self.object.len()).map(move |i| if self.may_be[i] { odds(i) } else { OUTSIDE })
    }

    /// The ground where a cell shows it, and what between the cells to either side is most like the cell: edges of a pattern lie somewhere in their cells.
    fn ground_at(&self, i: usize) -> impl Iterator<Item = Shade> {
        let known = |at: usize| self.ground.get(at).copied().flatten();
        let between = move |step: usize| {
            let ((one, its), (other, others)) = (known(i.wrapping_sub(step))?, known(i + step)?);
            let way = other - one;
            let share = ((self.grid.colours[i] - one).dot(way) / (way.length_squared() + 1e-12)).clamp(0.0, 1.0);
            Some((one + share * way, its + share * (others - its)))
        };
        known(i).into_iter().flat_map(move |own| [Some(own), between(1), between(self.grid.size[0])]).flatten()
    }

    /// Whether a cell is not the ground, by its colour.
    fn is_unlike_ground(&self, i: usize) -> bool {
        self.ground_at(i).all(|(mean, variance)| mean.distance_squared(self.grid.colours[i]) > UNLIKE * variance)
    }

    /// In which share of the photographs at most some place that each cell shows is the object.
    fn most(&self, shares: &[f64]) -> Vec<f64> {
        let [width, height] = self.grid.size;
        let mut most = vec![0.0f64; width * height];
        for (&cell, &share) in self.cells.iter().zip(shares).filter(|(cell, _)| **cell != NOWHERE) {
            most[cell as usize] = most[cell as usize].max(share);
        }
        let spread = |values: &[f64], step: usize, length: usize| -> Vec<f64> {
            let near = |i: usize| {
                let at = i / step % length;
                let range = at.saturating_sub(SPREAD)..(at + SPREAD + 1).min(length);
                range.map(|other| values[i + other * step - at * step]).fold(0.0, f64::max)
            };
            (0..values.len()).map(near).collect()
        };
        spread(&spread(&most, 1, width), width, height)
    }
}

/// How often [`find`] tells that it goes on, at most, without and with what was found before.
pub const STEPS: [usize; 2] = [FIRST_ROUNDS + ROUNDS, 1 + ROUNDS];

/// Finds the object in photographs of a ball; `ups` are directions that may be up, and `before` is what was found with another ball. `None` where they agree on nothing.
pub fn find(sights: &mut [Sight], ball: Ball, ups: &[DVec3], before: Option<Found>, told: &mut dyn FnMut()) -> Option<Found> {
    let plane = match before {
        // Where the object hides the ground must be known before the ground is.
        Some(Found { ground: Some(plane), own, .. }) => rounds(sights, 1, Some(own), None, told).map(|_| Some(plane))?,
        Some(Found { ground: None, .. }) => None,
        None => rounds(sights, FIRST_ROUNDS, None, None, told).map(|_| ground::under(sights, ball, ups))?,
    };
    let mut ground = plane.map(|plane| Ground::new(plane, sights, ball));
    let own = rounds(sights, ROUNDS, None, ground.as_mut(), told)?;
    let shares = shares(sights, ground.as_ref());
    let inside: Vec<DVec3> = places(ball).zip(&shares).filter(|(_, share)| **share > SEEN).map(|(place, _)| place).collect();
    let [low, high] = [DVec3::min, DVec3::max].map(|of: fn(DVec3, DVec3) -> DVec3| inside.iter().copied().reduce(of));
    let centre = 0.5 * (low? + high?);
    let radius = inside.iter().map(|place| place.distance(centre)).fold(0.0, f64::max);
    Some(Found { ball: Ball { centre, radius }, ground: plane, own })
}

/// Parts all photographs so many times, and learns the object's colours.
fn rounds(
    sights: &mut [Sight],
    rounds: usize,
    mut own: Option<Mixture>,
    mut ground: Option<&mut Ground>,
    told: &mut dyn FnMut(),
) -> Option<Mixture> {
    let learnt_where = if ground.is_some() { LEARNT_WHERE } else { UNDECIDED };
    let mut agreed_on = Vec::new();
    for round in 0..rounds {
        match &mut ground {
            Some(ground) => ground.show(sights),
            None => sights.iter_mut().for_each(|sight| sight.ground.clear()),
        }
        if round == 0 {
            sights.iter_mut().for_each(|sight| sight.object.fill(false));
        }
        sights.par_iter_mut().for_each(|sight| {
            let sure = |share: f64| match ((share - UNDECIDED) / DOUBT).clamp(-1.0, 1.0) {
                agreed if agreed > 0.0 => AGREED * agreed,
                alone => ALONE * alone,
            };
            let agreed = match round {
                0 => vec![0.0; sight.object.len()],
                _ => sight.most(&agreed_on).into_iter().map(sure).collect(),
            };
            sight.part(own.as_ref(), &agreed, round == 0);
        });
        agreed_on = shares(sights, ground.as_deref());
        let few = sights.iter().step_by(sights.len().div_ceil(LEARNT_FROM).max(1));
        let colours = few.flat_map(|sight| {
            let is_own = |(i, share): (usize, f64)| sight.object[i] && share > learnt_where && sight.is_unlike_ground(i);
            sight.grid.colours_where(&sight.most(&agreed_on).into_iter().enumerate().map(is_own).collect::<Vec<_>>(), true)
        });
        own = Some(Mixture::of(&colours.collect::<Vec<_>>())?);
        if ground.is_some() {
            sights.par_iter_mut().for_each(|sight| sight.answer(own.as_ref()));
            agreed_on = shares(sights, ground.as_deref());
        }
        told();
    }
    own
}

/// For each cell of space, in which share of the photographs that show it the object is seen there; beside the largest share of all, for something may be before it in some. On a
/// known ground those do not count that say nothing, and nothing is below it.
fn shares(sights: &[Sight], ground: Option<&Ground>) -> Vec<f64> {
    let answers = if ground.is_some() { ANSWERS } else { 1.0 };
    let share = |i: usize| {
        if ground.is_some_and(|ground| ground.is_below[i]) {
            return 0.0;
        }
        let seen = || sights.iter().filter(|sight| sight.cells[i] != NOWHERE);
        let count = |is: fn(&Sight, usize) -> bool| seen().filter(|sight| is(sight, sight.cells[i] as usize)).count() as f64;
        let object = count(|sight, cell| sight.object[cell]);
        let against = count(|sight, cell| sight.against[cell] && !sight.object[cell]);
        object / (object + against).max(answers * seen().count() as f64).max(1.0)
    };
    let shares: Vec<f64> = (0..sights.first().map_or(0, |sight| sight.cells.len())).into_par_iter().map(share).collect();
    let most = shares.iter().copied().fold(0.5, f64::max);
    shares.into_iter().map(|share| share / most).collect()
}

/// The cells of space in a ball.
fn places(ball: Ball) -> impl Iterator<Item = DVec3> {
    let of = |i: usize| (i as f64 + 0.5) / ACROSS as f64 * 2.0 - 1.0;
    let all = (0..ACROSS.pow(3)).map(move |i| DVec3::new(of(i % ACROSS), of(i / ACROSS % ACROSS), of(i / ACROSS.pow(2))));
    all.filter(|place| place.length() <= 1.0).map(move |place| ball.centre + ball.radius * place)
}

/// To the corners, edges and faces of a cube.
fn directions() -> impl Iterator<Item = DVec3> {
    let steps = |i: i32| f64::from(i % 3 - 1);
    (0..27).filter_map(move |i| DVec3::new(steps(i), steps(i / 3), steps(i / 9)).try_normalize())
}

/// What an object stands on, found by that all photographs see the same pattern on it.
mod ground {
    use glam::DVec3;
    use rayon::prelude::*;

    use super::{Ball, NOWHERE, Plane, Shade, Sight, places};

    /// What is looked at, in radii around the foot of the ball's centre: not what is under the object, or near it.
    const NEAREST: f64 = 0.6;
    const FARTHEST: f64 = 1.6;
    /// At first less, where a wrong tilt does not tell yet.
    const FIRST_FARTHEST: f64 = 1.1;
    /// Places of the pattern that are compared, across, in so many photographs.
    const COMPARED: usize = 24;
    const COMPARED_IN: usize = 12;
    /// Tilts from what is thought to be up and heights, in radii, and how often and by what they get finer.
    const TILT: f64 = 0.07;
    const TILTS: i32 = 2;
    const HEIGHT: f64 = 0.035;
    const HEIGHTS: i32 = 34;
    const FINER: f64 = 0.65;
    const TIMES: usize = 7;
    /// The share of all variance that is between photographs of one place, beside that of planes so much higher and lower, in radii: else all planes are alike.
    const SHARPER: f64 = 0.25;
    const HIGHER: f64 = 0.1;
    /// Fewer photographs say nothing.
    const FEWEST: usize = 4;
    /// Places of the ground across, and how far they reach.
    const ACROSS: usize = 256;
    const REACH: f64 = 2.0;
    /// Cells so far from such places are filled.
    const FILLED: usize = 4;
    /// What is hidden now has the colours of before, if their variance was less.
    const CERTAIN: f64 = 0.02;
    /// Variance that its colours have beside what is seen.
    const NOISE: f64 = 4e-3;

    /// The place of the plane at some radii from the foot of the ball's centre, along two axes.
    fn place(plane: Plane, ball: Ball, [u, v]: [f64; 2]) -> DVec3 {
        let (a, b) = plane.normal.any_orthonormal_pair();
        let foot = ball.centre + (plane.offset - plane.normal.dot(ball.centre)) * plane.normal;
        foot + ball.radius * (u * a + v * b)
    }

    /// The middles of cells of a square, so many across.
    fn square(across: usize, reach: f64) -> impl IndexedParallelIterator<Item = [f64; 2]> {
        (0..across * across)
            .into_par_iter()
            .map(move |i| [i % across, i / across].map(|k| reach * ((k as f64 + 0.5) / across as f64 * 2.0 - 1.0)))
    }

    /// The plane on which photographs that are parted agree best, if it is one of these ways up; `None` where they do not.
    pub fn under(sights: &[Sight], ball: Ball, ups: &[DVec3]) -> Option<Plane> {
        let few: Vec<&Sight> = sights.iter().step_by(sights.len().div_ceil(COMPARED_IN).max(1)).collect();
        let planes = ups.iter().filter_map(|up| up.try_normalize()).filter_map(|up| best(&few, ball, up));
        planes.min_by(|a, b| a.1.total_cmp(&b.1)).map(|(plane, _)| plane)
    }

    /// The best of those that are nearly this way up, if it is better than others, and its discord.
    fn best(sights: &[&Sight], ball: Ball, up: DVec3) -> Option<(Plane, f64)> {
        let (a, b) = up.any_orthonormal_pair();
        let plane = |[x, y, height]: [f64; 3]| {
            let normal = (up + x * a + y * b).normalize();
            Plane { normal, offset: normal.dot(ball.centre) + height * ball.radius }
        };
        let around = |[x, y, height]: [f64; 3], tilts: i32, tilt: f64, heights: i32, step: f64| -> Vec<[f64; 3]> {
            let steps = |n: i32, step: f64| (-n..=n).map(move |i| f64::from(i) * step);
            let tilted = steps(tilts, tilt).flat_map(|dx| steps(tilts, tilt).map(move |dy| [x + dx, y + dy]));
            tilted.flat_map(|[x, y]| steps(heights, step).map(move |dh| [x, y, height + dh])).collect()
        };
        let least = |tries: Vec<[f64; 3]>, farthest: f64| {
            let told = tries.into_par_iter().map(|which| (discord(plane(which), sights, ball, farthest), which));
            told.min_by(|a, b| a.0.total_cmp(&b.0))
        };
        let (_, mut which) = least(around([0.0; 3], TILTS, TILT, HEIGHTS, HEIGHT), FIRST_FARTHEST)?;
        let (mut finer, mut is) = (FINER, f64::INFINITY);
        for turn in 1..=TIMES {
            let farthest = FIRST_FARTHEST + (FARTHEST - FIRST_FARTHEST) * turn as f64 / TIMES as f64;
            (is, which) = least(around(which, 1, finer * TILT, 2, finer * HEIGHT), farthest)?;
            finer *= FINER;
        }
        let [x, y, height] = which;
        let others = [-HIGHER, HIGHER].map(|by| discord(plane([x, y, height + by]), sights, ball, FARTHEST));
        (is < SHARPER * others[0].min(others[1])).then(|| (plane(which), is))
    }

    /// How much of the variance of colours on a plane is between photographs of the same place.
    fn discord(plane: Plane, sights: &[&Sight], ball: Ball, farthest: f64) -> f64 {
        let seen: Vec<(DVec3, f64)> = (0..COMPARED * COMPARED)
            .map(|i| [i % COMPARED, i / COMPARED].map(|k| farthest * ((k as f64 + 0.5) / COMPARED as f64 * 2.0 - 1.0)))
            .filter(|[u, v]| (NEAREST..farthest).contains(&u.hypot(*v)))
            .filter_map(|at| {
                let place = place(plane, ball, at);
                let colour = |sight: &&&Sight| {
                    let cell = sight.grid.cell_of((sight.project)(place)?)? as usize;
                    (!sight.object[cell]).then_some(sight.grid.colours[cell])
                };
                let mut colours: Vec<DVec3> = sights.iter().filter_map(|sight| colour(&sight)).collect();
                (colours.len() >= FEWEST).then(|| typical(&mut colours))
            })
            .collect();
        if seen.len() < COMPARED * COMPARED / 4 {
            return f64::INFINITY;
        }
        let mean = seen.iter().map(|(colour, _)| *colour).sum::<DVec3>() / seen.len() as f64;
        let within: f64 = seen.iter().map(|(_, variance)| variance).sum();
        let between: f64 = seen.iter().map(|(colour, _)| colour.distance_squared(mean) / 3.0).sum();
        // Where all has one colour nothing is told.
        within / (within + between + 1e-3 * seen.len() as f64)
    }

    /// Median of each channel, and the variance around it of the four fifths that are nearest: something may stand before the rest.
    fn typical(colours: &mut [DVec3]) -> (DVec3, f64) {
        let middle = colours.len() / 2;
        let median = [0, 1, 2].map(|k| colours.select_nth_unstable_by(middle, |a, b| a[k].total_cmp(&b[k])).1[k]);
        let median = DVec3::from_array(median);
        let mut squares: Vec<f64> = colours.iter().map(|colour| colour.distance_squared(median)).collect();
        squares.sort_by(f64::total_cmp);
        let most = (4 * squares.len()).div_ceil(5);
        (median, squares[..most].iter().sum::<f64>() / (3 * most) as f64)
    }

    /// A plane with its pattern.
    pub struct Ground {
        /// Which cells of each sight show its places.
        shown: Vec<Vec<u32>>,
        /// Their colours.
        colours: Vec<Option<Shade>>,
        /// Whether cells of space lie below it, or on it.
        pub is_below: Vec<bool>,
    }

    impl Ground {
        /// Of these sights.
        pub fn new(plane: Plane, sights: &[Sight], ball: Ball) -> Self {
            let cells = |sight: &Sight| -> Vec<u32> {
                let cell = |at| (sight.project)(place(plane, ball, at)).and_then(|at| sight.grid.cell_of(at)).unwrap_or(NOWHERE);
                square(ACROSS, REACH).map(cell).collect()
            };
            let lowest = plane.offset + 2.0 * ball.radius / super::ACROSS as f64;
            Ground {
                shown: sights.iter().map(cells).collect(),
                colours: vec![None; ACROSS * ACROSS],
                is_below: places(ball).map(|place| plane.normal.dot(place) < lowest).collect(),
            }
        }

        /// Tells every sight the colours of the ground, as those show it that have nothing before it.
        pub fn show(&mut self, sights: &mut [Sight]) {
            let colour = |i: usize| {
                let seen = sights.iter().zip(&self.shown).filter(|(_, shown)| shown[i] != NOWHERE);
                let bare = seen.filter(|(sight, shown)| !sight.object[shown[i] as usize]);
                let mut colours: Vec<DVec3> = bare.map(|(sight, shown)| sight.grid.colours[shown[i] as usize]).collect();
                let before = self.colours[i].filter(|(_, variance)| *variance < CERTAIN);
                if colours.len() >= FEWEST { Some(typical(&mut colours)) } else { before }
            };
            self.colours = (0..ACROSS * ACROSS).into_par_iter().map(colour).collect();
            sights.par_iter_mut().zip(&self.shown).for_each(|(sight, shown)| {
                let mut sums = vec![(0.0, DVec3::ZERO, 0.0); sight.object.len()];
                for (&cell, ground) in shown.iter().zip(&self.colours).filter(|(cell, _)| **cell != NOWHERE) {
                    if let Some((mean, variance)) = ground {
                        let (count, sum, squares) = &mut sums[cell as usize];
                        *count += 1.0;
                        *sum += *mean;
                        *squares += variance + mean.length_squared() / 3.0;
                    }
                }
                let of_cell = |(count, sum, squares): (f64, DVec3, f64)| {
                    let mean = sum / count;
                    (count > 0.0).then(|| (mean, NOISE + (squares / count - mean.length_squared() / 3.0).max(0.0)))
                };
                sight.ground = sums.into_iter().map(of_cell).collect();
                for _ in 0..FILLED {
                    sight.ground = filled(&sight.ground, sight.grid.size[0]);
                }
            });
        }
    }

    /// With the mean of those beside them for cells between places: near ones are smaller.
    fn filled(ground: &[Option<Shade>], width: usize) -> Vec<Option<Shade>> {
        let near = |i: usize| {
            let beside = [i.wrapping_sub(1), i + 1, i.wrapping_sub(width), i + width];
            let known = || beside.into_iter().filter_map(|at| ground.get(at).copied().flatten());
            let count = known().count() as f64;
            let mean = known().map(|(mean, _)| mean).sum::<DVec3>() / count;
            (count > 1.0).then(|| (mean, known().map(|(_, variance)| variance).sum::<f64>() / count))
        };
        ground.iter().enumerate().map(|(i, own)| own.or_else(|| near(i))).collect()
    }
}

#[cfg(test)]
mod tests {
    use glam::DMat3;

    use super::*;

    const SIDE: usize = 128;
    const FOCAL: f64 = 150.0;
    const BALL: Ball = Ball { centre: DVec3::new(0.1, -0.05, 0.02), radius: 0.6 };
    const RADIUS: f64 = 0.3;

    /// From where, and camera axes (x right, y down, z forward) to the world's.
    fn camera(view: usize) -> (DVec3, DMat3) {
        let angle = 0.5 * view as f64;
        let eye = 2.0 * DVec3::new(angle.cos(), angle.sin(), if view.is_multiple_of(2) { 0.4 } else { 0.9 }).normalize();
        let forward = -eye.normalize();
        let right = forward.cross(DVec3::Z).normalize();
        (eye, DMat3::from_cols(right, forward.cross(right), forward))
    }

    /// A ball that is `colour` on one half and green on the other, on a board of black and white squares. What is seen, and whether it is the ball.
    fn photograph(view: usize, colour: [f32; 3], squares: f64) -> (Pixels, Vec<bool>) {
        let (eye, axes) = camera(view);
        let seen = |i: usize| {
            let [x, y] = [i % SIDE, i / SIDE].map(|at| (at as f64 + 0.5 - 0.5 * SIDE as f64) / FOCAL);
            let ray = (axes * DVec3::new(x, y, 1.0)).normalize();
            let nearest = -eye.dot(ray);
            let inside = RADIUS * RADIUS - (eye + nearest * ray).length_squared();
            let noise = [0.03, -0.02, 0.05, 0.0, -0.04][(7 * i + i / SIDE) % 5];
            if inside > 0.0 {
                let at = eye + (nearest - inside.sqrt()) * ray;
                return (if at.x > 0.0 { colour } else { [-0.3, 0.5, -0.6] }, noise, true);
            }
            let at = eye + (-RADIUS - eye.z) / ray.z * ray;
            let is_light = ((at.x / squares).floor() + (at.y / squares).floor()).rem_euclid(2.0) < 1.0;
            let wall = [0.2, 0.1 + 0.1 * (9.0 * ray.x).sin() as f32, 0.4];
            (
                if ray.z > 0.0 || at.length() > 6.0 {
                    wall
                } else if is_light {
                    [0.9; 3]
                } else {
                    [-0.9; 3]
                },
                noise,
                false,
            )
        };
        let all: Vec<_> = (0..SIDE * SIDE).map(seen).collect();
        let data = all.iter().flat_map(|(colour, noise, _)| colour.map(|c| c + noise)).collect();
        (Pixels { width: SIDE, height: SIDE, data }, all.into_iter().map(|(.., is_ball)| is_ball).collect())
    }

    fn project(view: usize, place: DVec3) -> Option<[f64; 2]> {
        let (eye, axes) = camera(view);
        let at = axes.transpose() * (place - eye);
        (at.z > 0.0).then(|| [at.x, at.y].map(|x| FOCAL * x / at.z + 0.5 * SIDE as f64))
    }

    #[test]
    fn what_photographs_agree_on_is_found_and_what_it_stands_on() {
        let photographs: Vec<_> = (0..13).map(|view| photograph(view, [0.8, -0.5, -0.5], 0.35)).collect();
        let projections: Vec<_> = (0..13).map(|view| move |place: DVec3| project(view, place)).collect();
        let both = photographs.iter().zip(&projections);
        let mut sights: Vec<_> = both.map(|((picture, _), by)| Sight::of(picture, by, BALL).unwrap()).collect();
        let mut steps = 0;
        let found = find(&mut sights, BALL, &[DVec3::new(0.05, -0.1, 1.0)], None, &mut || steps += 1).unwrap();
        assert_eq!(steps, STEPS[0]);
        assert!(found.ball.centre.length() < 0.06 && (found.ball.radius / RADIUS - 1.0).abs() < 0.25, "{:?}", found.ball);
        let ground = found.ground.unwrap();
        assert!(ground.normal.distance(DVec3::Z) < 0.02 && (ground.offset + RADIUS).abs() < 0.02, "{ground:?}");
        let least = sights.iter().zip(&photographs).map(|(sight, (_, truth))| in_both(sight, truth)).reduce(f64::min).unwrap();
        assert!(least > 0.85, "{least}");
        let again = find(&mut sights, BALL, &[], Some(found), &mut || steps += 1).unwrap();
        assert_eq!((again.ground, steps), (Some(ground), STEPS[0] + STEPS[1]));
    }

    /// What of the mask or the truth is both.
    fn in_both(sight: &Sight, truth: &[bool]) -> f64 {
        let mask = sight.on(SIDE, SIDE);
        let count =
            |is: fn(bool, bool) -> bool| mask.iter().zip(truth).filter(|(share, truth)| is(**share > 0.5, **truth)).count();
        count(|a, b| a && b) as f64 / count(|a, b| a || b) as f64
    }

    #[test]
    fn small_squares_of_the_ground_are_not_taken_for_the_object() {
        let photographs: Vec<_> = (0..13).map(|view| photograph(view, [0.8, -0.5, -0.5], 0.2)).collect();
        let projections: Vec<_> = (0..13).map(|view| move |place: DVec3| project(view, place)).collect();
        let both = photographs.iter().zip(&projections);
        let mut sights: Vec<_> = both.map(|((picture, _), by)| Sight::of(picture, by, BALL).unwrap()).collect();
        find(&mut sights, BALL, &[DVec3::Z], None, &mut || ()).unwrap();
        let least = sights.iter().zip(&photographs).map(|(sight, (_, truth))| in_both(sight, truth)).reduce(f64::min).unwrap();
        assert!(least > 0.75, "{least}");
    }

    #[test]
    fn nothing_is_found_where_there_is_nothing() {
        // A ball like the wall, and no board.
        let photographs: Vec<_> = (0..9)
            .map(|view| photograph(view, [0.8, -0.5, -0.5], 0.35).0)
            .map(|p| Pixels { data: vec![0.3; p.data.len()], ..p })
            .collect();
        let projections: Vec<_> = (0..9).map(|view| move |place: DVec3| project(view, place)).collect();
        let mut sights: Vec<_> = photographs.iter().zip(&projections).filter_map(|(p, by)| Sight::of(p, by, BALL)).collect();
        assert_eq!(sights.len(), 9);
        assert!(find(&mut sights, BALL, &[DVec3::Z], None, &mut || ()).is_none());
        assert!(find(&mut [], BALL, &[DVec3::Z], None, &mut || ()).is_none());
        // Behind the camera, and all around the picture.
        let aside = Ball { centre: DVec3::new(9.0, 0.0, 0.0), radius: 0.5 };
        assert!(Sight::of(&photographs[0], &projections[0], aside).is_none());
        assert!(Sight::of(&photographs[0], &projections[0], Ball { radius: 1.9, ..BALL }).is_none());
    }
}
