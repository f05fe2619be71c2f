//! The mask of a picture that is cut out. Who cuts leaves a rim of what is behind the object, or takes a little of the object away; it
//! then seems larger, or smaller, than it is.

use std::f64::consts::{FRAC_1_SQRT_2, TAU};
use std::iter::zip;
use std::ops::{Add, Mul};

use glam::DVec2;

/// How the outline of a mask is moved before a picture is compared, in pixels; by default not at all.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outline {
    /// How far out all around, or in where this is below zero.
    pub dilation: f64,
    /// What is cut away on one side, a shadow that was taken for the object: where it is (columns, rows), and how wide.
    pub cut: DVec2,
    /// Where a part of the object is missing, and how far from the mask on that side nothing is known (columns, rows).
    pub missing: DVec2,
    /// How wide a cut is that explains a picture better, but not by so much that it is believed: it is not made, and what it would have changed is uncertain.
    pub undecided: f64,
}

impl Outline {
    /// As the mask is.
    pub const AS_GIVEN: Outline = Outline { dilation: 0.0, cut: DVec2::ZERO, missing: DVec2::ZERO, undecided: 0.0 };

    /// How far it is moved.
    pub(crate) fn moved(&self) -> f64 {
        self.dilation.hypot(self.cut.length())
    }

    /// How far it is from as given.
    pub(crate) fn length(&self) -> f64 {
        self.moved().hypot(self.missing.length())
    }
}

impl Add for Outline {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Outline {
            dilation: self.dilation + other.dilation,
            cut: self.cut + other.cut,
            missing: self.missing + other.missing,
            undecided: self.undecided + other.undecided,
        }
    }
}

impl Mul<f64> for Outline {
    type Output = Self;

    /// In pixels that are so many times smaller.
    fn mul(self, times: f64) -> Self {
        let Outline { dilation, cut, missing, undecided } = self;
        Outline { dilation: times * dilation, cut: times * cut, missing: times * missing, undecided: times * undecided }
    }
}

/// How far masks are tried dilated, in pixels; the first is as given.
const DILATIONS: [f64; 5] = [0.0, -1.0, 1.0, -2.0, 2.0];

/// How much is tried to be cut away on a side, in pixels, and on which; and what else where that is worth a closer look.
const CUT: f64 = 3.0;
const NARROW: f64 = 1.5;
pub(crate) const WIDEST_CUT: f64 = 4.5;
const SIDES: [DVec2; 8] = [
    DVec2::X,
    DVec2::splat(FRAC_1_SQRT_2),
    DVec2::Y,
    DVec2::new(-FRAC_1_SQRT_2, FRAC_1_SQRT_2),
    DVec2::NEG_X,
    DVec2::splat(-FRAC_1_SQRT_2),
    DVec2::NEG_Y,
    DVec2::new(FRAC_1_SQRT_2, -FRAC_1_SQRT_2),
];

/// How far from a mask nothing may be known, a fourth of the object: no farther than that is never better (`docs/accuracy.md`). Above it, below it, or to one
/// side, which is enough of what lies between them, too.
pub(crate) const MISSING: f64 = 12.0;

/// What is tried of a mask: the first is as given.
pub(crate) fn outlines() -> impl Iterator<Item = Outline> {
    let dilations = DILATIONS.into_iter().map(|dilation| Outline { dilation, ..Outline::AS_GIVEN });
    let cuts = SIDES.into_iter().map(|side| Outline { cut: CUT * side, ..Outline::AS_GIVEN });
    let missing = SIDES.into_iter().step_by(2).map(|side| Outline { missing: MISSING * side, ..Outline::AS_GIVEN });
    dilations.chain(cuts).chain(missing)
}

/// Losses in the order of [`outlines`]: of dilations, of cuts, and of masks with something missing.
fn by_kind(losses: &[f64]) -> [&[f64]; 3] {
    let (dilated, others) = losses.split_at(DILATIONS.len());
    let (cut, missing) = others.split_at(SIDES.len());
    [dilated, cut, missing]
}

/// By which part of the loss a dilation must be better than the mask as given, for each pixel. At a pose that is wrong a mask that is wrong explains a
/// little more, too; and of exact masks the best are some tenths of a pixel off, by the shape that a network has learnt.
const BETTER: f64 = 0.15;

/// Which part of the least loss that dilations leave, for each pixel, a cut must leave at most to be believed, and to be worth a closer look (`docs/accuracy.md`).
const CUT_LEAVES: f64 = 0.72;
const CUT_IS_WORTH: f64 = 1.4;
/// The same of it, for something that is missing to be believed.
const MISSING_LEAVES: f64 = 0.6;

/// Directions in which a pixel looks around.
const DIRECTIONS: usize = 16;

/// Whether a mask has an outline where pixels count: else nothing says where the object ends. `coverage` and `weights [pixels]`.
pub(crate) fn has_outline(coverage: &[f32], weights: Option<&[f32]>) -> bool {
    let counts = |pixel: usize| weights.is_none_or(|weights| weights[pixel] > 0.0);
    let has = |is: fn(f32) -> bool| coverage.iter().enumerate().any(|(pixel, &cover)| is(cover) && counts(pixel));
    has(|cover| cover < 0.5) && has(|cover| cover >= 0.5)
}

/// Colours and coverage of a picture on white, as if the outline of its mask were moved: what is cut away first, then all around. `rgb [pixels, 3]`,
/// `coverage` and `weights [pixels]`, `width` pixels per row.
pub(crate) fn with_outline(
    rgb: &[f32],
    coverage: &[f32],
    weights: Option<&[f32]>,
    width: usize,
    outline: Outline,
) -> (Vec<f32>, Vec<f32>) {
    let Outline { dilation, cut, .. } = outline;
    let parts = |length: f64| 1..=length.abs().ceil() as usize;
    // Twice as many as pixels, so that nothing narrow is passed over.
    let along = parts(2.0 * cut.length());
    let last = *along.end() as f64;
    let side: Vec<DVec2> = along.map(|part| part as f64 / last * cut).collect();
    let (rgb, coverage) = moved(rgb, coverage, weights, width, &side, false);
    let rings = parts(dilation);
    let last = *rings.end() as f64;
    let ring = |ring: usize| {
        (0..DIRECTIONS).map(move |k| dilation.abs() * ring as f64 / last * DVec2::from_angle(TAU * k as f64 / DIRECTIONS as f64))
    };
    moved(&rgb, &coverage, weights, width, &rings.flat_map(ring).collect::<Vec<_>>(), dilation > 0.0)
}

/// How much is known of each pixel where a part of the object is missing on one side of its mask: there it may be the object's or not. `coverage` and `weights
/// [pixels]`, `width` pixels per row.
pub(crate) fn known(coverage: &[f32], weights: Option<&[f32]>, width: usize, missing: DVec2) -> Vec<f32> {
    let parts = (2.0 * missing.length()).ceil();
    let back: Vec<DVec2> = (1..=parts as usize).map(|part| -(part as f64 / parts) * missing).collect();
    // Whatever colour it has.
    let (_, reached) = moved(&vec![1.0; 3 * coverage.len()], coverage, weights, width, &back, true);
    zip(reached, coverage).map(|(reached, cover)| 1.0 - (reached - cover)).collect()
}

/// Each pixel takes the most, or the least, coverage of what lies at these offsets. Where the object grows, it has the colour of the place that it grows
/// from. Where pixels do not count, nothing is known of the outline.
fn moved(
    rgb: &[f32],
    coverage: &[f32],
    weights: Option<&[f32]>,
    width: usize,
    offsets: &[DVec2],
    grows: bool,
) -> (Vec<f32>, Vec<f32>) {
    let (mut colours, mut covers) = (rgb.to_vec(), coverage.to_vec());
    for (pixel, (colours, cover)) in colours.chunks_exact_mut(3).zip(&mut covers).enumerate() {
        let place = |offset: &DVec2| [(pixel % width) as f64 + offset.x, (pixel / width) as f64 + offset.y];
        let around = offsets.iter().filter_map(|offset| between(rgb, coverage, weights, width, place(offset)));
        let before = *cover;
        if !grows {
            *cover = around.map(|(cover, _)| cover).fold(before, f32::min);
            let left = if before > 0.0 { *cover / before } else { 1.0 };
            colours.iter_mut().for_each(|colour| *colour = 1.0 + left * (*colour - 1.0));
        } else if let Some((most, darker)) = around.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(most, _)| *most > before) {
            *cover = most;
            for (colour, darker) in colours.iter_mut().zip(darker) {
                *colour += (most - before) / most * darker;
            }
        }
    }
    (colours, covers)
}

/// Coverage between pixels, and how much darker than white the object makes each channel there; nothing outside of the picture or beside pixels
/// that do not count.
fn between(rgb: &[f32], coverage: &[f32], weights: Option<&[f32]>, width: usize, [u, v]: [f64; 2]) -> Option<(f32, [f32; 3])> {
    let height = coverage.len() / width;
    if u < 0.0 || v < 0.0 || u > (width - 1) as f64 || v > (height - 1) as f64 {
        return None;
    }
    let ([left, top], [right, below]) = ([u, v].map(f64::floor), [u, v].map(f64::fract));
    let (mut cover, mut darker) = (0.0, [0.0; 3]);
    for (x, y, share) in [
        (0, 0, (1.0 - right) * (1.0 - below)),
        (1, 0, right * (1.0 - below)),
        (0, 1, (1.0 - right) * below),
        (1, 1, right * below),
    ] {
        if share == 0.0 {
            continue;
        }
        let pixel = (top as usize + y) * width + left as usize + x;
        if weights.is_some_and(|weights| weights[pixel] == 0.0) {
            return None;
        }
        cover += share as f32 * coverage[pixel];
        for (sum, colour) in darker.iter_mut().zip(&rgb[3 * pixel..][..3]) {
            *sum += share as f32 * (colour - 1.0);
        }
    }
    Some((cover, darker))
}

/// How many of [`closer_outlines`] are tried from where the others began; the rest go on from where those ended.
pub(crate) const NARROW_CUTS: usize = 3;

/// What is worth a closer look: where a cut leaves little more than the least that dilations do, narrower ones on its side and to either side of it; then the
/// same cut again, a wider one, and the best dilation again beside which those are judged. `losses` are in the order of [`outlines`].
pub(crate) fn closer_outlines(losses: &[f64]) -> Vec<Outline> {
    let [dilated, cuts, _] = by_kind(losses);
    let least = |losses: &[f64]| (0..losses.len()).min_by(|&a, &b| losses[a].total_cmp(&losses[b])).unwrap_or_default();
    let (side, dilation) = (least(cuts), DILATIONS[least(dilated)]);
    if cuts[side].is_nan() || cuts[side] >= CUT_IS_WORTH * best_dilation(dilated).1 {
        return vec![];
    }
    let cut = |width: f64, by: usize| Outline { cut: width * SIDES[(side + by) % SIDES.len()], ..Outline::AS_GIVEN };
    let narrow: [Outline; NARROW_CUTS] = [0, 1, SIDES.len() - 1].map(|by| cut(NARROW, by));
    narrow.into_iter().chain([cut(CUT, 0), cut(WIDEST_CUT, 0), Outline { dilation, ..Outline::AS_GIVEN }]).collect()
}

/// What leaves the least loss: a cut, or something missing, if that is much less than what dilations leave, else a dilation; none, if the mask is not that
/// much worse as given.
/// `losses` are in the order of [`outlines`], `closer` in that of [`closer_outlines`].
pub(crate) fn best_outline(losses: &[f64], closer: &[f64]) -> Outline {
    let [dilated, cut, missing] = by_kind(losses);
    let (dilation, least) = best_dilation(dilated);
    let is_better = least < (1.0 - BETTER * dilation.abs()) * losses[0];
    let dilation = Outline { dilation: if is_better { dilation } else { 0.0 }, ..Outline::AS_GIVEN };
    // More steps leave less: what has gone on is beside what dilations leave then.
    let again = closer.last().map_or(1.0, |again| again / dilated.iter().copied().fold(f64::INFINITY, f64::min));
    let tried = zip(outlines().skip(DILATIONS.len()), cut).map(|(cut, loss)| (cut, loss / least));
    let of_closer = |(number, (cut, loss))| (cut, loss / if number < NARROW_CUTS { least } else { again * least });
    let cuts =
        tried.chain(zip(closer_outlines(losses), closer).enumerate().map(of_closer)).filter(|(cut, _)| cut.cut != DVec2::ZERO);
    let cut = cuts.min_by(|a, b| a.1.total_cmp(&b.1));
    let missing = zip(outlines().skip(DILATIONS.len() + SIDES.len()), missing).map(|(missing, loss)| (missing, loss / least));
    let missing = missing.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, leaves)| *leaves < MISSING_LEAVES);
    match (cut, missing) {
        (cut, Some((missing, leaves))) if cut.is_none_or(|(_, left)| leaves / MISSING_LEAVES < left / CUT_LEAVES) => missing,
        (Some((cut, leaves)), _) if leaves < CUT_LEAVES => cut,
        (Some((cut, leaves)), _) if leaves < 1.0 => Outline { undecided: cut.cut.length(), ..dilation },
        _ => dilation,
    }
}

/// The dilation with the least loss, and that: where a parabola through the losses at the best that was tried and to either side of it ends. `losses` are in
/// the order of [`DILATIONS`].
fn best_dilation(losses: &[f64]) -> (f64, f64) {
    let mut tried: Vec<(f64, f64)> = zip(DILATIONS, losses.iter().copied()).collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    let Some(best) = (0..tried.len()).min_by(|&a, &b| tried[a].1.total_cmp(&tried[b].1)) else { return (0.0, f64::NAN) };
    let ((at, least), beside) =
        (tried[best], best.checked_sub(1).and_then(|before| Some((tried[before].1, tried.get(best + 1)?.1))));
    match beside {
        Some((left, right)) if left + right - 2.0 * least > 0.0 && (left + right).is_finite() => {
            let (slope, curvature) = ((right - left) / 2.0, left + right - 2.0 * least);
            // Where losses rise like a V the parabola ends below nothing.
            (at - slope / curvature, (least - slope * slope / (2.0 * curvature)).max(0.0))
        }
        _ => (at, least),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dilated(rgb: &[f32], coverage: &[f32], weights: Option<&[f32]>, width: usize, by: f64) -> (Vec<f32>, Vec<f32>) {
        with_outline(rgb, coverage, weights, width, Outline { dilation: by, ..Outline::AS_GIVEN })
    }

    const WIDTH: usize = 12;

    /// A disc of radius 3.2 about the middle, dark blue, each pixel covered as much as it lies within.
    fn disc(radius: f64) -> (Vec<f32>, Vec<f32>) {
        let cover = |pixel: usize| {
            let within = |k: usize| {
                let [u, v] = [pixel % WIDTH, pixel / WIDTH].map(|at| at as f64 - 5.5);
                let [x, y] = [u + (k % 16) as f64 / 16.0 - 15.0 / 32.0, v + (k / 16) as f64 / 16.0 - 15.0 / 32.0];
                x.hypot(y) < radius
            };
            (0..256).filter(|&k| within(k)).count() as f32 / 256.0
        };
        let coverage: Vec<f32> = (0..WIDTH * WIDTH).map(cover).collect();
        (coverage.iter().flat_map(|cover| [-0.8, -0.6, 0.4].map(|colour| cover * colour + 1.0 - cover)).collect(), coverage)
    }

    #[test]
    fn an_outline_moves_by_as_many_pixels() {
        let (rgb, coverage) = disc(3.2);
        for by in [-2.0, -1.0, -0.4, 0.4, 1.0, 1.7] {
            let (rgb, coverage) = dilated(&rgb, &coverage, None, WIDTH, by);
            let (wanted_rgb, wanted) = disc(3.2 + by);
            let radius = |coverage: &[f32]| (coverage.iter().sum::<f32>() / std::f32::consts::PI).sqrt();
            let [is, should_be] = [&coverage, &wanted].map(|coverage| radius(coverage));
            assert!((is - should_be).abs() < 0.12, "{by}: {is} instead of {should_be}");
            // Its colour stays, also where there was none before.
            let apart = rgb.iter().zip(&wanted_rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(apart < 0.7, "{by}: {apart}");
            for (rgb, cover) in rgb.chunks(3).zip(&coverage) {
                let on_white = [-0.8, -0.6, 0.4].map(|colour| cover * colour + 1.0 - cover);
                assert!(rgb.iter().zip(on_white).all(|(a, b)| (a - b).abs() < 1e-5), "{by}: {rgb:?} {on_white:?}");
            }
        }
    }

    #[test]
    fn a_shadow_is_cut_away() {
        // Below a disc as much of it again.
        let (rgb, coverage) = disc(3.2);
        let below = |pixel: usize| if pixel < 2 * WIDTH { 0.0 } else { coverage[pixel - 2 * WIDTH] };
        let shadow: Vec<f32> = coverage.iter().enumerate().map(|(pixel, cover)| cover.max(below(pixel))).collect();
        let rgb: Vec<f32> = (0..rgb.len()).map(|value| rgb[value].min(1.0 - shadow[value / 3])).collect();
        let outline = |u: f64, v: f64| Outline { cut: DVec2::new(u, v), ..Outline::AS_GIVEN };
        let apart = |outline: Outline| {
            let (_, cut) = with_outline(&rgb, &shadow, None, WIDTH, outline);
            cut.iter().zip(&coverage).map(|(a, b)| (a - b).abs()).sum::<f32>()
        };
        assert!(apart(outline(0.0, 2.0)) < 0.1 * apart(Outline::AS_GIVEN), "{}", apart(outline(0.0, 2.0)));
        assert!(
            apart(outline(0.0, -2.0)) > 0.9 * apart(Outline::AS_GIVEN)
                && apart(outline(2.0, 0.0)) > 0.9 * apart(Outline::AS_GIVEN)
        );
        // After that it is dilated all around.
        let both = Outline { dilation: 1.0, ..outline(0.0, 2.0) };
        let ((rgb_cut, cut), (_, dilated)) =
            (with_outline(&rgb, &shadow, None, WIDTH, outline(0.0, 2.0)), with_outline(&rgb, &shadow, None, WIDTH, both));
        assert_eq!(dilated, self::dilated(&rgb_cut, &cut, None, WIDTH, 1.0).1);
    }

    #[test]
    fn what_may_be_missing_is_not_known() {
        // The lower part of a disc is missing, from the middle of a row on.
        let (rgb, whole) = disc(3.2);
        let left = |pixel: usize| [1.0, 0.5, 0.0][(pixel / WIDTH).saturating_sub(6).min(2)];
        let coverage: Vec<f32> = whole.iter().enumerate().map(|(pixel, cover)| cover * left(pixel)).collect();
        let known = |weights: Option<&[f32]>, by: f64| known(&coverage, weights, WIDTH, DVec2::new(0.0, by));
        // All that it lacks, and nothing of itself.
        for (k, (known, (cover, whole))) in zip(known(None, 3.0), zip(&coverage, &whole)).enumerate() {
            assert!(known <= 1.0 - (whole - cover) + 1e-5 && known >= *cover - 1e-5, "{k}: {known} of {cover}, {whole}");
        }
        // No farther than that, and nothing on other sides.
        let unknown = |by: f64| known(None, by).iter().map(|known| 1.0 - known).sum::<f32>();
        assert!(
            (unknown(3.0) / 6.4 - 3.0).abs() < 0.4 && (unknown(1.0) / 6.4 - 1.0).abs() < 0.2,
            "{} {}",
            unknown(3.0),
            unknown(1.0)
        );
        assert!(known(None, 3.0)[..4 * WIDTH].iter().all(|known| *known == 1.0));
        // What does not count says nothing of where the object ends.
        let weights: Vec<f32> = (0..WIDTH * WIDTH).map(|pixel| if pixel < 8 * WIDTH { 0.0 } else { 1.0 }).collect();
        assert!(super::known(&coverage, Some(&weights), WIDTH, DVec2::new(0.0, 3.0)).iter().all(|known| *known == 1.0));
        assert_eq!(rgb.len(), 3 * coverage.len());
    }

    #[test]
    fn what_is_missing_must_leave_much_less_than_dilations() {
        let number = DILATIONS.len() + SIDES.len() + 1;
        let below = outlines().nth(number).unwrap();
        assert_eq!((below.missing, outlines().count()), (DVec2::new(0.0, MISSING), number + 3));
        let losses = |dilated: f64, cut: f64, missing: f64| {
            let of = |outline: Outline| match outline {
                Outline { dilation: -2.0, .. } => dilated,
                outline if outline == below => missing,
                outline if outline.cut == DVec2::new(0.0, -CUT) => cut,
                outline => 1.0 + outline.length(),
            };
            best_outline(&outlines().map(of).collect::<Vec<_>>(), &[])
        };
        let dilated = Outline { dilation: -2.0, ..Outline::AS_GIVEN };
        assert_eq!([losses(1.0, 1.1, 0.61), losses(1.0, 1.1, 0.59)], [Outline::AS_GIVEN, below]);
        assert_eq!([losses(0.5, 1.1, 0.31), losses(0.5, 1.1, 0.29)], [dilated, below]);
        // Beside a cut the one that is beyond what it must be by more.
        let cut = Outline { cut: DVec2::new(0.0, -CUT), ..Outline::AS_GIVEN };
        assert_eq!([losses(1.0, 0.5, 0.43), losses(1.0, 0.5, 0.41)], [cut, below]);
    }

    #[test]
    fn a_cut_must_leave_much_less_than_dilations() {
        // A quarter of the way around.
        let below = outlines().nth(DILATIONS.len() + 2).unwrap();
        assert_eq!(below.cut, DVec2::new(0.0, 3.0));
        let losses = |dilated: f64, cut: f64| {
            let of = |outline: Outline| match outline {
                Outline { dilation: -2.0, .. } => dilated,
                outline if outline == below => cut,
                outline => 1.0 + outline.cut.length() + outline.missing.length(),
            };
            outlines().map(of).collect::<Vec<_>>()
        };
        let best = |dilated: f64, cut: f64| best_outline(&losses(dilated, cut), &[]);
        let dilated = Outline { dilation: -2.0, ..Outline::AS_GIVEN };
        let undecided = |outline: Outline, undecided: f64| Outline { undecided, ..outline };
        assert_eq!([best(1.0, 1.1), best(1.0, 0.9)], [Outline::AS_GIVEN, undecided(Outline::AS_GIVEN, 3.0)]);
        assert_eq!([best(1.0, 0.73), best(1.0, 0.71)], [undecided(Outline::AS_GIVEN, 3.0), below]);
        assert_eq!([best(0.5, 0.37), best(0.5, 0.35)], [undecided(dilated, 3.0), below]);
        assert_eq!([f64::INFINITY, f64::NAN].map(|loss| best_outline(&[loss; 17], &[])), [Outline::AS_GIVEN; 2]);

        // A closer look finds a narrower one on the same side, or beside it.
        let closer = closer_outlines(&losses(1.0, 1.3));
        let [x, y] = [1.5 * FRAC_1_SQRT_2, 1.5];
        let cuts = [(0.0, y), (-x, x), (x, x), (0.0, 3.0), (0.0, 4.5), (0.0, 0.0)].map(|(x, y)| DVec2::new(x, y));
        assert!(closer.len() == 6 && zip(&closer, cuts).all(|(outline, cut)| outline.cut.abs_diff_eq(cut, 1e-12)), "{closer:?}");
        assert_eq!(closer_outlines(&losses(0.5, 0.6))[5], dilated);
        assert_eq!((closer_outlines(&losses(0.9, 1.3)), closer_outlines(&[f64::NAN; 17])), (vec![], vec![]));
        let best = |closer: [f64; 6]| best_outline(&losses(1.0, 1.3), &closer);
        assert_eq!(best([1.0, 0.7, 0.8, 1.0, 1.0, 1.0]), closer[1]);
        assert_eq!(best([1.0, 0.8, 1.2, 1.0, 1.0, 1.0]), undecided(Outline::AS_GIVEN, closer[1].cut.length()));
        // What dilations leave after more steps, too, is what wide cuts are measured by.
        assert_eq!(best([1.0, 1.0, 1.0, 1.0, 0.7, 1.0]), closer[4]);
        assert_eq!(best([1.0, 1.0, 1.0, 1.0, 0.7, 0.9]), undecided(Outline::AS_GIVEN, 4.5));
    }

    #[test]
    fn what_does_not_count_has_no_outline() {
        let (rgb, mut coverage) = disc(3.2);
        assert!(has_outline(&coverage, None));
        // The upper half is hidden: what it is said to cover does not matter.
        let weights: Vec<f32> = (0..WIDTH * WIDTH).map(|pixel| if pixel < 6 * WIDTH { 0.0 } else { 1.0 }).collect();
        let of = |coverage: &[f32], by| dilated(&rgb, coverage, Some(&weights), WIDTH, by).1.split_off(6 * WIDTH);
        let before = [-1.0, 1.0].map(|by| of(&coverage, by));
        coverage[..6 * WIDTH].fill(1.0);
        assert_eq!(before, [-1.0, 1.0].map(|by| of(&coverage, by)));
        assert!(has_outline(&coverage, Some(&weights)));
        coverage[6 * WIDTH..].fill(1.0);
        assert!(!has_outline(&coverage, Some(&weights)) && !has_outline(&coverage, None) && !has_outline(&[0.0; 9], None));
        coverage[..6 * WIDTH].fill(0.0);
        assert!(has_outline(&coverage, None) && !has_outline(&coverage, Some(&weights)));
    }

    #[test]
    fn the_edge_of_a_picture_is_no_outline() {
        let coverage = vec![1.0; WIDTH * WIDTH];
        let rgb = vec![0.0; 3 * WIDTH * WIDTH];
        for by in [-2.0, 0.7] {
            let (colours, covers) = dilated(&rgb, &coverage, None, WIDTH, by);
            assert!(colours.iter().all(|colour| colour.abs() < 1e-5) && covers.iter().all(|cover| *cover > 0.9999), "{by}");
        }
    }

    #[test]
    fn the_best_dilation_lies_between_those_tried() {
        let losses = |least: f64, depth: f64| DILATIONS.map(|by| 1.0 + depth * (by - least) * (by - least));
        // With cuts that are worth nothing.
        let best = |dilated: [f64; 5]| best_outline(&[&dilated[..], &[f64::INFINITY; 12]].concat(), &[]).dilation;
        for least in [-1.4, -0.7, 0.8, 1.3] {
            assert!((best(losses(least, 0.5)) - least).abs() < 1e-9, "{least}");
        }
        // Beyond them there is nothing to go by.
        assert_eq!([-3.0, 2.6].map(|least| best(losses(least, 0.5))), [-2.0, 2.0]);
        // Nearly exact masks stay as they are, and those of searches that went wrong.
        assert_eq!([best(losses(0.2, 0.5)), best(losses(1.3, 0.1))], [0.0; 2]);
        assert_eq!(best([f64::INFINITY; 5]), 0.0);
        // An exact mask, beside which no other leaves anything like as little.
        let exact = [[1e-3, 1.0, 0.6, 2.0, 1.5].as_slice(), &[0.9; 12]].concat();
        assert_eq!((best_outline(&exact, &[]).cut, closer_outlines(&exact)), (DVec2::ZERO, vec![]));
        assert_eq!(best([1.0, 0.5, f64::INFINITY, f64::INFINITY, 2.0]), -1.0);
        assert_eq!(best([f64::NAN, 0.5, 1.0, 1.0, 2.0]), 0.0);
    }
}
