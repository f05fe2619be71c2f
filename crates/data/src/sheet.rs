//! Plain drawings: contact sheets, curves, cameras around an object. Everything is an [`RgbImage`].

use font8x8::UnicodeFonts;
use glam::{DMat4, DVec2, DVec3};
use image::{Rgb, RgbImage};

/// A colour, RGB.
pub type Colour = [u8; 3];
/// Background of every drawing.
pub const WHITE: Colour = [255; 3];
/// Text and axes.
pub const BLACK: Colour = [0; 3];
/// Grid lines and outlines.
pub const GREY: Colour = [200; 3];
/// Colours of curves that are easy to tell apart, also for the colour-blind (Okabe and Ito).
pub const CURVES: [Colour; 7] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233], [90, 90, 90]];

/// Colours of x, y and z axes.
pub const AXES: [Colour; 3] = [[220, 40, 40], [30, 150, 30], [40, 60, 230]];

/// From nothing to much, light to dark: white, yellow, red, black.
pub const HEAT: [Colour; 4] = [WHITE, [255, 200, 70], [200, 30, 30], [40, 0, 10]];
/// From near to far, dark to light: the stops of viridis.
pub const VIRIDIS: [Colour; 5] = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/// Width and height of a character of [`text`], in pixels.
pub const GLYPH: u32 = 8;

/// An image of one colour.
pub fn blank(width: u32, height: u32) -> RgbImage {
    RgbImage::from_pixel(width, height, Rgb(WHITE))
}

/// Writes one line of text with its top left corner at `(x, y)`; what does not fit is cut off. Characters are 8×8 pixels;
/// those that the font lacks become `?`.
pub fn text(image: &mut RgbImage, x: i32, y: i32, text: &str, colour: Colour) {
    use font8x8::{BASIC_FONTS, GREEK_FONTS, LATIN_FONTS};
    for (i, c) in text.chars().enumerate() {
        let glyph = BASIC_FONTS.get(c).or_else(|| LATIN_FONTS.get(c)).or_else(|| GREEK_FONTS.get(c));
        for (dy, row) in glyph.or_else(|| BASIC_FONTS.get('?')).unwrap_or_default().into_iter().enumerate() {
            for dx in (0..8).filter(|bit| row >> bit & 1 == 1) {
                put(image, x + i as i32 * GLYPH as i32 + dx, y + dy as i32, colour);
            }
        }
    }
}

/// Like [`text`], each pixel of the font `scale` pixels wide and high.
pub fn title(image: &mut RgbImage, x: i32, y: i32, text: &str, scale: u32, colour: Colour) {
    let mut small = blank(text.chars().count() as u32 * GLYPH, GLYPH);
    self::text(&mut small, 0, 0, text, colour);
    for (dx, dy, _) in enlarge(&small, scale).enumerate_pixels().filter(|(.., pixel)| pixel.0 == colour) {
        put(image, x + dx as i32, y + dy as i32, colour);
    }
}

/// The colour at `t` of 0 (first) to 1 (last) between equally spaced colours; grey where `t` is not a number.
pub fn ramp(stops: &[Colour], t: f64) -> Colour {
    if t.is_nan() || stops.is_empty() {
        return GREY;
    }
    let at = t.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
    let (low, high) = (stops[at.floor() as usize], stops[at.ceil() as usize]);
    std::array::from_fn(|c| (f64::from(low[c]) + at.fract() * (f64::from(high[c]) - f64::from(low[c]))).round() as u8)
}

/// Draws a straight line, one pixel wide, cut at the image's edges.
pub fn line(image: &mut RgbImage, from: DVec2, to: DVec2, colour: Colour) {
    // At most a few thousand steps, also for points far outside.
    let steps = (to - from).abs().max_element().clamp(1.0, 10_000.0).ceil();
    for i in 0..=steps as i32 {
        let p = from.lerp(to, f64::from(i) / steps).round();
        put(image, p.x as i32, p.y as i32, colour);
    }
}

fn put(image: &mut RgbImage, x: i32, y: i32, colour: Colour) {
    if let (Ok(x), Ok(y)) = (u32::try_from(x), u32::try_from(y))
        && x < image.width()
        && y < image.height()
    {
        image.put_pixel(x, y, Rgb(colour));
    }
}

/// Enlarges an image by a whole factor without smoothing, so that single pixels stay visible.
pub fn enlarge(image: &RgbImage, factor: u32) -> RgbImage {
    RgbImage::from_fn(image.width() * factor, image.height() * factor, |x, y| *image.get_pixel(x / factor, y / factor))
}

/// A table of pictures, row by row, each under its label. All cells are as large as the largest picture; a label longer than
/// its cell is cut off. An empty label takes no less space.
pub fn grid(cells: &[(&RgbImage, &str)], columns: usize) -> RgbImage {
    const GAP: u32 = 4;
    let columns = columns.clamp(1, cells.len().max(1)) as u32;
    let size = |side: fn(&RgbImage) -> u32| cells.iter().map(|(picture, _)| side(picture)).max().unwrap_or(0);
    let [width, height] = [size(RgbImage::width) + GAP, size(RgbImage::height) + GLYPH + 2 + GAP];
    let mut sheet = blank(columns * width + GAP, (cells.len() as u32).div_ceil(columns) * height + GAP);
    for (i, (picture, label)) in cells.iter().enumerate() {
        let [x, y] = [GAP + i as u32 % columns * width, GAP + i as u32 / columns * height];
        let fitting: String = label.chars().take(((width - GAP) / GLYPH) as usize).collect();
        text(&mut sheet, x as i32, y as i32, &fitting, BLACK);
        image::imageops::replace(&mut sheet, *picture, x.into(), i64::from(y + GLYPH + 2));
    }
    sheet
}

/// A named line of a plot: points `(x, y)` in order. Values that are not finite (or, on a logarithmic axis, not positive) are
/// left out.
#[derive(Debug, Clone)]
pub struct Curve<'a> {
    /// The name in the legend; none if empty.
    pub label: &'a str,
    /// The points.
    pub points: &'a [(f64, f64)],
    /// The colour of the line, for example one of [`CURVES`].
    pub colour: Colour,
}

/// Labels on an axis, at most.
const MOST_TICKS: usize = 7;

/// A line plot with axes, a few labelled ticks and a legend; `log` tells which of the axes, x and y, are logarithmic.
pub fn plot_curve(title: &str, curves: &[Curve], [width, height]: [u32; 2], log: [bool; 2]) -> RgbImage {
    let scale = |value: f64, log: bool| if log { value.log10() } else { value };
    let place = |x: f64, y: f64| DVec2::new(scale(x, log[0]), scale(y, log[1]));
    let placed = |curve: &Curve| -> Vec<DVec2> {
        curve.points.iter().map(|&(x, y)| place(x, y)).filter(|point| point.is_finite()).collect()
    };
    let lines: Vec<_> = curves.iter().map(placed).collect();
    let all = || lines.iter().flatten().copied();
    let [mut low, mut high] = [all().fold(DVec2::MAX, DVec2::min), all().fold(DVec2::MIN, DVec2::max)];
    if all().next().is_none() {
        [low, high] = [DVec2::ZERO, DVec2::ONE];
    }
    // A constant curve still needs a range.
    high = DVec2::select(high.cmpgt(low), high, low + 1e-9 + low.abs() * 1e-3);

    let mut image = blank(width, height);
    let [left, top, right, bottom] = [72.0, 24.0, f64::from(width) - 16.0, f64::from(height) - 24.0];
    let to_pixel = |p: DVec2| {
        let t = (p - low) / (high - low);
        DVec2::new(left + t.x * (right - left), bottom - t.y * (bottom - top))
    };
    text(&mut image, 8, 8, title, BLACK);
    for value in ticks(low.y, high.y, log[1]) {
        let at = to_pixel(DVec2::new(low.x, scale(value, log[1])));
        line(&mut image, at, DVec2::new(right, at.y), GREY);
        let label = tick(value);
        text(&mut image, left as i32 - 4 - (label.len() as u32 * GLYPH) as i32, at.y as i32 - 4, &label, BLACK);
    }
    for value in ticks(low.x, high.x, log[0]) {
        let at = to_pixel(DVec2::new(scale(value, log[0]), low.y));
        line(&mut image, at, at + DVec2::new(0.0, 4.0), BLACK);
        let label = tick(value);
        let x = (at.x as i32 - (label.len() * 4) as i32).min(width as i32 - (label.len() * 8) as i32);
        text(&mut image, x, bottom as i32 + 8, &label, BLACK);
    }
    line(&mut image, DVec2::new(left, top), DVec2::new(left, bottom), BLACK);
    line(&mut image, DVec2::new(left, bottom), DVec2::new(right, bottom), BLACK);
    for (points, curve) in lines.iter().zip(curves) {
        for pair in points.windows(2) {
            line(&mut image, to_pixel(pair[0]), to_pixel(pair[1]), curve.colour);
        }
        if let [point] = points[..] {
            ring(&mut image, to_pixel(point), 2.0, curve.colour);
        }
    }
    for (i, curve) in curves.iter().filter(|curve| !curve.label.is_empty()).enumerate() {
        let x = right as i32 - (curve.label.chars().count() as u32 * GLYPH) as i32 - 4;
        text(&mut image, x, top as i32 + 4 + 10 * i as i32, curve.label, curve.colour);
    }
    image
}

/// Round values between two places on an axis; `log`: the places are decimal logarithms.
fn ticks(low: f64, high: f64, log: bool) -> Vec<f64> {
    let within = |value: &f64| (low..=high).contains(&if log { value.log10() } else { *value });
    if log {
        let decades = low.floor() as i32..=high.ceil() as i32;
        for digits in [&[1.0, 2.0, 5.0][..], &[1.0]] {
            let of_decade = |decade| digits.iter().map(move |digit| digit * 10f64.powi(decade));
            let values: Vec<f64> = decades.clone().flat_map(of_decade).filter(within).collect();
            if (2..=MOST_TICKS).contains(&values.len()) {
                return values;
            }
        }
        if high - low > 1.0 {
            return ticks(low, high, false).into_iter().map(|exponent| 10f64.powf(exponent)).collect();
        }
        return ticks(10f64.powf(low), 10f64.powf(high), false);
    }
    let decade = 10f64.powf(((high - low) / MOST_TICKS as f64).log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|digit| digit * decade);
    let step = steps.into_iter().find(|step| (high - low) / step < MOST_TICKS as f64).unwrap_or(high - low);
    (0..=MOST_TICKS).map(|k| ((low / step).ceil() + k as f64) * step).filter(within).collect()
}

/// A number in at most eight characters.
fn tick(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        0.01..1e5 => {
            let digits = (3 - value.abs().log10().floor() as i32).clamp(0, 4) as usize;
            let short = format!("{value:.digits$}");
            if short.contains('.') { short.trim_end_matches('0').trim_end_matches('.').into() } else { short }
        }
        _ => format!("{value:.1e}"),
    }
}

fn ring(image: &mut RgbImage, centre: DVec2, radius: f64, colour: Colour) {
    let point = |i: i32| centre + radius * DVec2::from_angle(f64::from(i) * std::f64::consts::TAU / 64.0);
    (0..64).for_each(|i| line(image, point(i), point(i + 1), colour));
}

/// Two drawings side by side, from above (x right, y up) and from the front (x right, z up): the sphere of radius 0.5 that holds
/// the object with the world's axes, and each camera as a dot with its own: x red, y green, z blue.
pub fn cameras(world_from_camera: &[DMat4], side: u32) -> RgbImage {
    let extent = world_from_camera.iter().map(|m| m.w_axis.truncate().abs().max_element()).fold(0.5, f64::max) * 1.2;
    let mut image = blank(2 * side, side);
    for (panel, (name, vertical)) in
        [("top: x right, y up", DVec3::Y), ("front: x right, z up", DVec3::Z)].into_iter().enumerate()
    {
        let middle = f64::from(side) / 2.0;
        let to_pixel = |p: DVec3| {
            let flat = DVec2::new(p.x, -p.dot(vertical)) / extent * middle;
            flat + DVec2::new(middle + panel as f64 * f64::from(side), middle)
        };
        ring(&mut image, to_pixel(DVec3::ZERO), 0.5 / extent * middle, GREY);
        for (axis, colour) in DVec3::AXES.into_iter().zip(AXES) {
            line(&mut image, to_pixel(DVec3::ZERO), to_pixel(0.5 * axis), colour);
        }
        for m in world_from_camera {
            let centre = m.w_axis.truncate();
            for (axis, colour) in [m.x_axis, m.y_axis, m.z_axis].into_iter().zip(AXES) {
                line(&mut image, to_pixel(centre), to_pixel(centre + 0.08 * extent * axis.truncate()), colour);
            }
            ring(&mut image, to_pixel(centre), 1.5, BLACK);
        }
        text(&mut image, (panel as u32 * side) as i32 + 6, 6, name, BLACK);
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(image: &RgbImage, colour: Colour) -> usize {
        image.pixels().filter(|p| p.0 == colour).count()
    }

    #[test]
    fn grid_keeps_every_picture_whole() {
        let [red, blue] = [[255, 0, 0], [0, 0, 255]].map(|c| RgbImage::from_pixel(10, 6, Rgb(c)));
        let sheet = grid(&[(&red, "a"), (&blue, ""), (&red, "much too long")], 2);
        assert_eq!([count(&sheet, [255, 0, 0]), count(&sheet, [0, 0, 255])], [120, 60]);
        assert_eq!(sheet.dimensions(), (2 * 14 + 4, 2 * 20 + 4));
        assert!(count(&sheet, BLACK) > 5);
        assert_eq!(grid(&[], 3).dimensions().0, 8);
    }

    #[test]
    fn text_is_clipped_and_legible() {
        let mut image = blank(16, 8);
        text(&mut image, 0, 0, "I", BLACK);
        assert!(count(&image, BLACK) > 10 && (8..16).all(|x| (0..8).all(|y| image.get_pixel(x, y).0 == WHITE)));
        text(&mut image, -3, -5, "outside", BLACK);
        text(&mut image, 14, 4, "outside σ ☃", BLACK);
    }

    #[test]
    fn titles_are_enlarged_text() {
        let [mut small, mut large] = [blank(20, 10), blank(60, 30)];
        text(&mut small, 1, 1, "Aσ", BLACK);
        title(&mut large, 3, 3, "Aσ", 3, BLACK);
        assert_eq!(large, enlarge(&small, 3));
    }

    #[test]
    fn ramps_go_through_their_stops() {
        assert_eq!([0.0, 0.5, 1.0, -3.0, 7.0].map(|t| ramp(&VIRIDIS, t)), [0, 2, 4, 0, 4].map(|i| VIRIDIS[i]));
        assert_eq!((ramp(&[BLACK, WHITE], 0.2), ramp(&HEAT, f64::NAN)), ([51; 3], GREY));
    }

    #[test]
    fn a_falling_curve_falls() {
        let points: Vec<_> = (0..100).map(|i| (f64::from(i), 10f64.powf(-f64::from(i) / 25.0))).collect();
        let colour = CURVES[0];
        let image = plot_curve("loss", &[Curve { label: "", points: &points, colour }], [400, 300], [false, true]);
        let row_of = |x: u32| (0..300).find(|&y| image.get_pixel(x, y).0 == colour);
        // Straight on the logarithmic axis: the middle lies half-way down.
        let [left, middle, right] = [74, 228, 382].map(|x| row_of(x).expect("the curve") as i32);
        assert!(left < 30 && right > 270 && ((left + right) / 2 - middle).abs() <= 2, "{left} {middle} {right}");
    }

    #[test]
    fn plots_survive_odd_values() {
        for points in
            [vec![], vec![(0.0, f64::NAN)], vec![(1.0, 2.0)], vec![(0.0, 0.0), (1.0, -1.0)], vec![(0.0, 3.0), (1.0, 3.0)]]
        {
            for log in [[false; 2], [true; 2]] {
                plot_curve("", &[Curve { label: "x", points: &points, colour: BLACK }], [200, 100], log);
            }
        }
    }

    #[test]
    fn ticks_are_round() {
        let nearly = |(low, high, log), expected: &[f64]| {
            let found = ticks(low, high, log);
            let same = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9 * b.abs().max(1.0));
            assert!(found.len() == expected.len() && same, "{found:?}");
        };
        nearly((0.0, 300.0, false), &[0.0, 50.0, 100.0, 150.0, 200.0, 250.0, 300.0]);
        nearly((-1.3, 1.1, false), &[-1.0, -0.5, 0.0, 0.5, 1.0]);
        nearly((0.75f64.log10(), 135f64.log10(), true), &[1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0]);
        nearly((-4.1, 0.3, true), &[1e-4, 1e-3, 1e-2, 1e-1, 1.0]);
        nearly((-20.0, 0.5, true), &[1e-20, 1e-15, 1e-10, 1e-5, 1.0]);
        nearly((6f64.log10(), 8.5f64.log10(), true), &[6.0, 6.5, 7.0, 7.5, 8.0, 8.5]);
    }

    #[test]
    fn ticks_are_short() {
        for (value, expected) in
            [(0.0, "0"), (0.25, "0.25"), (1500.0, "1500"), (-12.5, "-12.5"), (3.2e-5, "3.2e-5"), (2e6, "2.0e6")]
        {
            assert_eq!(tick(value), expected);
        }
    }
}
