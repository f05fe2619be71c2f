//! What the errors of many searches come to.

use rand::RngExt;
use serde::Serialize;
use sigma_srn::stream;

use super::evaluate::ViewReport;

/// Draws of the bootstrap.
const DRAWS: usize = 4000;

/// Errors of several views.
#[derive(Serialize)]
pub struct Summary {
    pub name: String,
    pub views: usize,
    /// Estimates that were trusted.
    pub trusted: usize,
    /// Of the failures, the estimates more than 5° off, those that were not trusted.
    pub failures: usize,
    pub failures_told: usize,
    /// Views of a calibrated model, and those of them whose true pose lies within the stated 95 % ellipsoid.
    pub stated: usize,
    pub within_95: usize,
    pub rotation_deg: Statistics,
    pub translation: Statistics,
    pub translation_percent: Statistics,
    /// Translation in units of the source; where all instances were imported.
    pub translation_source: Option<Statistics>,
    /// Parts of the views with a rotation error of at most 5° and 10°.
    pub recall_5_deg: f64,
    pub recall_10_deg: f64,
    /// Rotation error of the start that came nearest to the truth, the winner or not: what a perfect choice would reach.
    pub oracle_deg: Statistics,
    pub seconds_per_view: f64,
}

/// Of some values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Statistics {
    pub mean: f64,
    pub median: f64,
    /// 95 % interval of the mean: the views drawn anew from themselves, 4000 times.
    pub mean_95: [f64; 2],
}

impl Statistics {
    /// Of at least one value.
    pub fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let n = values.len();
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / n as f64;
        let mut random = stream(0, 0);
        let mut draws: Vec<f64> = (0..DRAWS).map(|_| mean(&mut (0..n).map(|_| values[random.random_range(0..n)]))).collect();
        draws.sort_by(f64::total_cmp);
        Statistics {
            mean: mean(&mut values.iter().copied()),
            median: 0.5 * (values[(n - 1) / 2] + values[n / 2]),
            mean_95: [DRAWS / 40, DRAWS - 1 - DRAWS / 40].map(|k| draws[k]),
        }
    }
}

impl Summary {
    /// Of at least one view.
    pub fn of(name: &str, views: &[&ViewReport]) -> Self {
        let n = views.len() as f64;
        let in_source: Option<Vec<f64>> = views.iter().map(|view| view.translation_source).collect();
        let count = |is: &dyn Fn(&ViewReport) -> bool| views.iter().filter(|view| is(view)).count();
        let part = |limit: f64| views.iter().filter(|view| view.error.rotation_deg <= limit).count() as f64 / n;
        Summary {
            name: name.into(),
            views: views.len(),
            trusted: count(&|view| view.trusted),
            failures: count(&|view| view.is_failure()),
            failures_told: count(&|view| view.is_failure() && !view.trusted),
            stated: count(&|view| view.within_95.is_some()),
            within_95: count(&|view| view.within_95 == Some(true)),
            rotation_deg: Statistics::of(views.iter().map(|view| view.error.rotation_deg)),
            translation: Statistics::of(views.iter().map(|view| view.error.translation)),
            translation_percent: Statistics::of(views.iter().map(|view| view.error.translation_percent)),
            translation_source: in_source.map(|errors| Statistics::of(errors.into_iter())),
            recall_5_deg: part(5.0),
            recall_10_deg: part(10.0),
            oracle_deg: Statistics::of(views.iter().map(|view| view.oracle.rotation_deg)),
            seconds_per_view: views.iter().map(|view| view.seconds).sum::<f64>() / n,
        }
    }
}

/// A table in Markdown, its columns aligned; the first row is the head.
pub fn markdown(rows: &[Vec<String>]) -> String {
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..rows[0].len()).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells: Vec<_> = row.iter().zip(&widths).map(|(cell, width)| format!(" {cell:>width$} ")).collect();
        format!("|{}|", cells.join("|"))
    };
    let mut lines: Vec<_> = rows.iter().map(line).collect();
    let rule: Vec<_> = widths.iter().map(|width| "-".repeat(width + 1) + ":").collect();
    lines.insert(1, format!("|{}|", rule.join("|")));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_of_odd_and_even_counts() {
        let of = |values: &[f64]| Statistics::of(values.iter().copied());
        assert_eq!((of(&[3.0, 1.0, 8.0]).mean, of(&[3.0, 1.0, 8.0]).median), (4.0, 3.0));
        assert_eq!(of(&[4.0, 1.0, 2.0, 9.0]).median, 3.0);
        assert_eq!(of(&[2.5]).mean_95, [2.5, 2.5]);
    }

    #[test]
    fn the_interval_of_the_mean_is_that_of_a_normal_distribution() {
        // 400 values with mean 0 and standard deviation 1: the mean's is 1/20.
        let values: Vec<f64> = (0..400).map(|k| 12f64.sqrt() * ((f64::from(k) + 0.5) / 400.0 - 0.5)).collect();
        let [low, high] = Statistics::of(values.into_iter()).mean_95;
        assert!((low + 0.098).abs() < 0.01 && (high - 0.098).abs() < 0.01, "{low} {high}");
    }
}
