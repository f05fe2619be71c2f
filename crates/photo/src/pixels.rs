//! Images in memory: RGB in [-1, 1], area-resampled.

/// A float image: `data` is row-major `[height · width, 3]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Pixels {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// RGB triples in [-1, 1], row-major.
    pub data: Vec<f32>,
}

impl Pixels {
    /// The centred square.
    pub fn centre_square(&self) -> Self {
        let side = self.width.min(self.height);
        let corner = [(self.width - side) / 2, (self.height - side) / 2];
        self.square(corner.map(|x| x as i64), side, 1.0)
    }

    /// The square of `side` pixels from `corner` on, `outside` where it reaches out of the image.
    pub(crate) fn square(&self, corner: [i64; 2], side: usize, outside: f32) -> Self {
        let mut data = vec![outside; 3 * side * side];
        for (y, row) in (corner[1]..).zip(data.chunks_exact_mut(3 * side)) {
            let there = usize::try_from(y).ok().filter(|&y| y < self.height);
            for (x, pixel) in (corner[0]..).zip(row.chunks_exact_mut(3)) {
                if let (Some(y), Some(x)) = (there, usize::try_from(x).ok().filter(|&x| x < self.width)) {
                    pixel.copy_from_slice(&self.data[3 * (y * self.width + x)..][..3]);
                }
            }
        }
        Self { width: side, height: side, data }
    }

    /// A `width × height` image in which each pixel is the mean of the area that it covers here.
    pub fn area_resample(&self, width: usize, height: usize) -> Self {
        if [width, height] == [self.width, self.height] {
            return self.clone();
        }
        let across = resample_rows(&self.data, self.width, width);
        let turned = transpose(&across, width, self.height);
        let data = transpose(&resample_rows(&turned, self.height, height), height, width);
        Self { width, height, data }
    }
}

/// Each row of `from` pixels becomes `to` pixels; partly covered pixels count by their share.
fn resample_rows(data: &[f32], from: usize, to: usize) -> Vec<f32> {
    let step = from as f64 / to as f64;
    let mut out = Vec::with_capacity(data.len() / from.max(1) * to);
    for row in data.chunks_exact(3 * from) {
        for i in 0..to {
            let (start, end) = (i as f64 * step, (i + 1) as f64 * step);
            let mut sum = [0.0f64; 3];
            for k in start as usize..(end.ceil() as usize).min(from) {
                let share = end.min(k as f64 + 1.0) - start.max(k as f64);
                (0..3).for_each(|c| sum[c] += share * f64::from(row[3 * k + c]));
            }
            out.extend(sum.map(|s| (s / step) as f32));
        }
    }
    out
}

fn transpose(data: &[f32], width: usize, height: usize) -> Vec<f32> {
    let pixel = |i: usize| &data[3 * ((i % height) * width + i / height)..][..3];
    (0..width * height).flat_map(pixel).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: usize, height: usize, values: &[f32]) -> Pixels {
        Pixels { width, height, data: values.iter().flat_map(|&v| [v; 3]).collect() }
    }

    #[test]
    fn area_resample_takes_means() {
        let half = grey(4, 2, &[0.0, 1.0, 0.5, 0.5, 1.0, 0.0, -1.0, 0.0]).area_resample(2, 1);
        assert_eq!(half, grey(2, 1, &[0.5, 0.0]));
        // 3 → 2: each new pixel covers one and a half old ones.
        let thirds = grey(3, 1, &[0.0, 0.6, 0.9]).area_resample(2, 1);
        let expected = [0.3 / 1.5, (0.3 + 0.9) / 1.5];
        assert!(thirds.data.iter().step_by(3).zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{thirds:?}");
        let column = grey(1, 3, &[0.0, 0.6, 0.9]).area_resample(1, 2);
        assert_eq!(column.data, thirds.data);
        let same = grey(2, 2, &[0.1, 0.2, 0.3, 0.4]);
        assert_eq!(same.area_resample(2, 2), same);
    }

    #[test]
    fn channels_stay_apart() {
        let image = Pixels { width: 2, height: 1, data: vec![1.0, 0.0, -1.0, 0.0, 1.0, -1.0] };
        assert_eq!(image.area_resample(1, 1).data, [0.5, 0.5, -1.0]);
    }

    #[test]
    fn the_square_is_centred() {
        let square = grey(4, 2, &[0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7]).centre_square();
        assert_eq!(square, grey(2, 2, &[0.1, 0.2, 0.5, 0.6]));
    }
}
