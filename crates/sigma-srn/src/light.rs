//! The light of a picture. A model knows its objects in the light of its training pictures; a camera's exposure, its white balance, haze
//! or a lamp of another colour change all colours of an object alike, and say nothing of its pose.

use serde::Serialize;

/// Parts of a pixel that count, in sum, below which a picture says nothing of its light.
const FEWEST: f64 = 16.0;
/// How much of a pixel the object covers whose colour is the object's.
pub(crate) const COVERED: f32 = 0.9;
/// Where the model's view has a channel below this, it shows the object, not white background.
const SHOWN: f32 = 0.8;
/// Variance of a channel that is no contrast yet (colours span 2): a surface of one colour has nothing but noise.
pub(crate) const NOISE: f64 = 4e-4;
/// The least and the most contrast that is made up for.
const CONTRASTS: [f64; 2] = [0.4, 2.5];
/// From which correlation of picture and view on the contrast between them is believed, and from which altogether, where the picture does not show where the
/// object ends. Nothing keeps a search from going closer there, where it sees a flat part of one surface; with all contrast taken off the picture that would explain
/// it. At poses found right they agree to 0.6 to 0.95, at such ones to 0.2 to 0.58 (`docs/accuracy.md`).
const AGREE: [f64; 2] = [0.6, 0.85];

/// What takes the colours of an object in a picture to those that it has in the model's light: `contrast · colour + offset`, colours in
/// [-1, 1]. A longer exposure has a contrast below 1, and one offset for all channels; light of another colour has three.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Light {
    /// Factor of all channels.
    pub contrast: f32,
    /// What is added then, by channel: red, green, blue.
    pub offset: [f32; 3],
}

impl Light {
    /// The model's own.
    pub const SAME: Light = Light { contrast: 1.0, offset: [0.0; 3] };

    /// What gives the object as many means and as much variance as it has in the model's view from about the same pose: moments, not least
    /// squares, for where the pose is not right yet those would rather have no contrast at all. `rgb` and `render [pixels, 3]`, `coverage`
    /// and `weights [pixels]`: how much of each pixel the object covers, and how much the pixel counts. Without an outline in sight the contrast is no more than
    /// what the picture and the view agree on.
    pub(crate) fn between(rgb: &[f32], render: &[f32], coverage: &[f32], weights: &[f32], has_outline: bool) -> Self {
        let mut count = 0.0;
        // Of each channel in the picture and the render: the sum, and that of the squares; and that of their products.
        let mut sums = [[[0.0; 2]; 2]; 3];
        let mut products = [0.0; 3];
        for (((rgb, render), &cover), &weight) in rgb.chunks_exact(3).zip(render.chunks_exact(3)).zip(coverage).zip(weights) {
            if cover < COVERED || render.iter().all(|&colour| colour >= SHOWN) {
                continue;
            }
            count += f64::from(weight);
            let pairs = rgb.iter().map(|&colour| uncovered(colour, cover)).zip(render);
            for ((sums, product), pair) in sums.iter_mut().zip(&mut products).zip(pairs) {
                let pair = [pair.0, pair.1.clamp(-1.0, 1.0)].map(f64::from);
                for ([sum, squares], colour) in sums.iter_mut().zip(pair) {
                    *sum += f64::from(weight) * colour;
                    *squares += f64::from(weight) * colour * colour;
                }
                *product += f64::from(weight) * pair[0] * pair[1];
            }
        }
        // Also where a render is no number.
        if !(count >= FEWEST && sums.iter().flatten().flatten().all(|sum: &f64| sum.is_finite())) {
            return Light::SAME;
        }
        let mean = |channel: usize, which: usize| sums[channel][which][0] / count;
        let variance = |channel: usize, which: usize| sums[channel][which][1] / count - mean(channel, which).powi(2) + NOISE;
        let [picture, render] = [0, 1].map(|which| (0..3).map(|channel| variance(channel, which)).sum::<f64>());
        let covariance: f64 = (0..3).map(|channel| products[channel] / count - mean(channel, 0) * mean(channel, 1)).sum();
        let agreed = (covariance / (picture * render).sqrt() - AGREE[0]) / (AGREE[1] - AGREE[0]);
        let believed = if has_outline { 1.0 } else { agreed.clamp(0.0, 1.0) };
        let contrast = (render / picture).sqrt().clamp(CONTRASTS[0], CONTRASTS[1]).powf(believed);
        let offset = |channel| (mean(channel, 1) - contrast * mean(channel, 0)) as f32;
        Light { contrast: contrast as f32, offset: [0, 1, 2].map(offset) }
    }

    /// A picture `[pixels, 3]` on white as it would be in the model's light: the part of each pixel that the object covers
    /// (`coverage [pixels]`, 0 to 1).
    pub fn undo(&self, rgb: &mut [f32], coverage: &[f32]) {
        for (rgb, &cover) in rgb.chunks_exact_mut(3).zip(coverage) {
            for (colour, offset) in rgb.iter_mut().zip(self.offset) {
                let object = (self.contrast * uncovered(*colour, cover) + offset).clamp(-1.0, 1.0);
                *colour = cover * object + (1.0 - cover);
            }
        }
    }
}

/// The object's colour in a pixel, the rest of which is white.
fn uncovered(colour: f32, cover: f32) -> f32 {
    if cover > 0.0 { ((colour - (1.0 - cover)) / cover).clamp(-1.0, 1.0) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 40 pixels of an object, one in five at its edge; then ten of background.
    fn object() -> (Vec<f32>, Vec<f32>) {
        let coverage: Vec<f32> = (0..50).map(|k| if k >= 40 { 0.0 } else { [1.0, 1.0, 1.0, 1.0, 0.3][k % 5] }).collect();
        let colour = |k: usize| 0.25 * ((7 * k) % 5) as f32 - 0.6 + 0.1 * (k % 3) as f32;
        (on_white(&(0..150).map(colour).collect::<Vec<_>>(), &coverage), coverage)
    }

    fn on_white(colours: &[f32], coverage: &[f32]) -> Vec<f32> {
        colours.iter().enumerate().map(|(k, colour)| coverage[k / 3] * colour + (1.0 - coverage[k / 3])).collect()
    }

    /// The picture where the object's colours are these.
    fn with(rgb: &[f32], coverage: &[f32], colour: impl Fn(usize, f32) -> f32) -> Vec<f32> {
        let colours: Vec<f32> = rgb.iter().enumerate().map(|(k, &c)| colour(k % 3, uncovered(c, coverage[k / 3]))).collect();
        on_white(&colours, coverage)
    }

    #[test]
    fn light_of_another_colour_is_undone() {
        let (rgb, coverage) = object();
        let offset = [0.2, 0.1, -0.1];
        let seen = with(&rgb, &coverage, |channel, colour| 0.7 * colour + offset[channel]);
        let light = Light::between(&seen, &rgb, &coverage, &[1.0; 50], true);
        // What is no contrast yet draws it a little towards 1.
        assert!((light.contrast - 1.0 / 0.7).abs() < 0.03, "{light:?}");
        let mut undone = seen.clone();
        light.undo(&mut undone, &coverage);
        let apart = undone.iter().zip(&rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart < 0.02, "{apart}");
        assert_eq!(undone[120..], [1.0; 30], "the background is white in any light");
        let same = Light::between(&rgb, &rgb, &coverage, &[1.0; 50], true);
        assert!((same.contrast - 1.0).abs() < 1e-6 && same.offset.iter().all(|o| o.abs() < 1e-6), "{same:?}");
    }

    #[test]
    fn what_does_not_count_says_nothing_of_the_light() {
        let (rgb, coverage) = object();
        let mut hidden = rgb.clone();
        hidden[..30].fill(-1.0);
        let weights: Vec<f32> = (0..50).map(|k| if k < 10 { 0.0 } else { 1.25 }).collect();
        let of = |rgb: &[f32]| Light::between(rgb, &rgb_of_model(), &coverage, &weights, true);
        assert_eq!(of(&hidden), of(&rgb));
        // Too little of the object, a view of nothing, one that is no number.
        let view = rgb_of_model();
        assert_eq!(Light::between(&rgb, &view, &coverage, &[0.1; 50], true), Light::SAME);
        assert_eq!(Light::between(&rgb, &[1.0; 150], &coverage, &[1.0; 50], true), Light::SAME);
        assert_eq!(Light::between(&rgb, &[f32::NAN; 150], &coverage, &[1.0; 50], true), Light::SAME);
    }

    fn rgb_of_model() -> Vec<f32> {
        let (rgb, coverage) = object();
        with(&rgb, &coverage, |_, colour| 0.5 * colour - 0.2)
    }

    #[test]
    fn without_an_outline_contrast_is_what_picture_and_view_agree_on() {
        let (rgb, coverage) = object();
        let seen = with(&rgb, &coverage, |_, colour| 0.5 * colour);
        let contrast =
            |seen: &[f32], view: &[f32], has_outline| Light::between(seen, view, &coverage, &[1.0; 50], has_outline).contrast;
        assert_eq!(contrast(&seen, &rgb, false), contrast(&seen, &rgb, true), "they agree");
        // A view that has nothing to do with it, flatter than the picture.
        let other = with(&rgb, &coverage, |channel, colour| 0.2 * ((50.0 * colour).sin() - channel as f32 * 0.1));
        let (with_outline, without) = (contrast(&rgb, &other, true), contrast(&rgb, &other, false));
        assert!(with_outline < 0.7 && without == 1.0, "{with_outline} {without}");
    }

    #[test]
    fn one_colour_has_no_contrast_to_be_stretched() {
        let (view, coverage) = object();
        let grey = on_white(&[0.1; 150], &coverage);
        let light = Light::between(&grey, &view, &coverage, &[1.0; 50], true);
        assert!(light.contrast <= 2.5, "{light:?}");
        let mut undone = grey;
        light.undo(&mut undone, &coverage);
        assert!(undone.iter().all(|colour| (-1.0..=1.0).contains(colour)));
    }
}
