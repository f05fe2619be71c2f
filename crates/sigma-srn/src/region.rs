//! The region of interest of a hypothesis: where the image or the view from its pose shows the object, and a margin for its way. Elsewhere both are
//! white, and rays there would only take time: what they add to the loss and to its derivatives is nothing.

/// A channel below this is not white; a network's background is within a hundredth of it.
const WHITE: f32 = 0.98;

/// How far around what is shown rays are cast, as a part of the picture's width; two rays at least.
const MARGIN: f64 = 1.0 / 32.0;

/// The rays of a hypothesis that are worth their time, by number, of those of its grid. `target` and `render [rays, 3]`, `weights [rays]`, `width`
/// rays per row. What is no number counts as shown.
pub(crate) fn region(target: &[f32], render: &[f32], weights: &[f32], width: usize) -> Vec<usize> {
    let is_shown = |(target, render): (&[f32], &[f32])| !target.iter().chain(render).all(|&colour| colour >= WHITE);
    let mut near: Vec<bool> = target.chunks_exact(3).zip(render.chunks_exact(3)).map(is_shown).collect();
    let (margin, height) = ((MARGIN * width as f64).ceil().max(2.0) as usize, near.len() / width);
    let around = |near: &[bool], at: usize, step: usize, place: usize, length: usize| {
        let (first, last) = (place.saturating_sub(margin), (place + margin).min(length - 1));
        (first..=last).any(|other| near[at + other * step - place * step])
    };
    // Along rows, then along columns.
    near = (0..near.len()).map(|at| around(&near, at, 1, at % width, width)).collect();
    near = (0..near.len()).map(|at| around(&near, at, width, at / width, height)).collect();
    (0..near.len()).filter(|&at| near[at] && weights[at] > 0.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 20;

    /// White, with these pixels in blue.
    fn picture(shown: &[(usize, usize)]) -> Vec<f32> {
        let mut rgb = vec![1.0; 3 * WIDTH * 15];
        shown.iter().for_each(|(u, v)| rgb[3 * (v * WIDTH + u)..][..2].fill(0.3));
        rgb
    }

    #[test]
    fn a_region_is_what_either_shows_and_a_margin() {
        let weights = vec![1.0; WIDTH * 15];
        let of = |target: &[f32], render: &[f32]| region(target, render, &weights, WIDTH);
        let block = |us: std::ops::Range<usize>, vs: std::ops::Range<usize>| {
            vs.flat_map(|v| us.clone().map(move |u| v * WIDTH + u)).collect::<Vec<usize>>()
        };
        let (white, middle, corner) = (picture(&[]), picture(&[(9, 7), (10, 7)]), picture(&[(19, 0)]));
        assert_eq!(of(&white, &white), [0; 0]);
        assert_eq!(of(&middle, &white), block(7..13, 5..10));
        assert_eq!(of(&white, &middle), of(&middle, &white));
        // Not beyond an edge, nor around it.
        assert_eq!(of(&corner, &white), block(17..20, 0..3));
        let mut both = [of(&middle, &white), of(&corner, &white)].concat();
        both.sort_unstable();
        assert_eq!(of(&middle, &corner), both);
        assert_eq!(of(&vec![0.9; white.len()], &white), (0..weights.len()).collect::<Vec<_>>());
        // A network's white is not quite white, and what is no number must be seen.
        assert_eq!(of(&white, &vec![0.99; white.len()]), [0; 0]);
        let mut broken = white.clone();
        broken[3 * (7 * WIDTH + 9) + 1] = f32::NAN;
        assert_eq!(of(&white, &broken), block(7..12, 5..10));
    }

    #[test]
    fn what_does_not_count_is_in_no_region() {
        let mut weights = vec![1.0; WIDTH * 15];
        weights[7 * WIDTH..8 * WIDTH].fill(0.0);
        let found = region(&picture(&[(9, 7)]), &picture(&[]), &weights, WIDTH);
        assert_eq!((found.len(), found.iter().filter(|&&at| at / WIDTH == 7).count()), (20, 0));
    }
}
