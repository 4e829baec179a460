//! What the runs of one size come to.

use planesweep_mvsnet::InferRates;
use serde_json::{Value, json};

use super::side::{Run, Side, Size};

/// The runs of all sides at one size.
pub struct Figures {
    pub size: Size,
    pub threads: usize,
    /// Operations per second of matrix products between the rounds.
    pub peaks: Vec<f64>,
    pub sides: Vec<SideRuns>,
    /// The greatest relative difference between the first side's depth map and the others'.
    pub difference: Option<f64>,
    pub rates: InferRates,
}

/// The runs of one side.
pub struct SideRuns {
    pub side: Side,
    /// The first, in a process that has inferred nothing yet; its time does not count.
    pub warm_up: Run,
    /// One for each round.
    pub runs: Vec<Run>,
}

impl SideRuns {
    fn seconds(&self) -> Spread {
        Spread::of(self.runs.iter().map(|run| run.seconds))
    }

    fn all(&self) -> impl Iterator<Item = &Run> {
        std::iter::once(&self.warm_up).chain(&self.runs)
    }

    /// The most memory the process had.
    fn peak_bytes(&self) -> u64 {
        self.all().map(|run| run.peak_bytes).max().unwrap_or(0)
    }

    /// By how much its memory rose in the first inference.
    fn risen_bytes(&self) -> u64 {
        self.warm_up.peak_bytes.saturating_sub(self.warm_up.before_bytes)
    }

    /// The stages and, last, all of them together.
    fn parts(&self) -> Vec<Part> {
        let stages = &self.runs[0].stages;
        let mut parts: Vec<Part> = (0..stages.len())
            .map(|i| Part {
                name: stages[i].name.clone(),
                seconds: Spread::of(self.runs.iter().map(|run| run.stages[i].seconds)),
                operations: stages[i].operations,
            })
            .collect();
        let operations = parts.iter().map(|part| part.operations).sum();
        parts.push(Part { name: "all".to_owned(), seconds: self.seconds(), operations });
        parts
    }
}

/// A median and the extremes.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Spread {
    least: f64,
    median: f64,
    greatest: f64,
}

impl Spread {
    /// Of at least one value.
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        let median =
            if values.len() % 2 == 1 { values[middle] } else { 0.5 * (values[middle - 1] + values[middle]) };
        Self { least: values[0], median, greatest: values[values.len() - 1] }
    }

    fn value(self) -> Value {
        json!({ "least": self.least, "median": self.median, "greatest": self.greatest })
    }
}

/// A stage, or all of them, over the rounds.
struct Part {
    name: String,
    seconds: Spread,
    operations: f64,
}

impl Part {
    /// Operations per second.
    fn rate(&self) -> f64 {
        self.operations / self.seconds.median
    }
}

impl Figures {
    /// Operations per second of the matrix product: the best of them, for a product that was disturbed says
    /// nothing of the machine.
    fn peak(&self) -> f64 {
        self.peaks.iter().copied().fold(0.0, f64::max)
    }

    fn voxels(&self) -> f64 {
        let Size { width, height, depths, .. } = self.size;
        (width.next_multiple_of(32) * height.next_multiple_of(32) / 16 * depths) as f64
    }

    pub fn heading(&self) -> String {
        let Size { width, height, depths, views } = self.size;
        let peaks = Spread::of(self.peaks.iter().copied());
        format!(
            "{width}x{height}, {depths} depths, {views} views, {} threads; matrix product {:.0} GFLOP/s ({:.0} to {:.0})\n",
            self.threads,
            self.peak() / 1e9,
            peaks.least / 1e9,
            peaks.greatest / 1e9,
        )
    }

    /// The table, its heading first.
    pub fn rows(&self) -> Vec<Vec<String>> {
        let heading = ["side", "stage", "median s", "least", "greatest", "GFLOP", "GFLOP/s", "of peak"];
        let mut rows = vec![heading.map(str::to_owned).to_vec()];
        for side in &self.sides {
            for part in side.parts() {
                let Spread { least, median, greatest } = part.seconds;
                rows.push(vec![
                    side.side.name().to_owned(),
                    part.name.clone(),
                    format!("{median:.3}"),
                    format!("{least:.3}"),
                    format!("{greatest:.3}"),
                    format!("{:.1}", part.operations / 1e9),
                    format!("{:.0}", part.rate() / 1e9),
                    format!("{:.0} %", 100.0 * part.rate() / self.peak()),
                ]);
            }
        }
        rows
    }

    /// How much faster than the first side each of the others was: round by round, and by the medians.
    fn ratios<'a>(&'a self) -> Vec<(&'a SideRuns, Spread, f64)> {
        let Some((first, others)) = self.sides.split_first() else { return Vec::new() };
        let ratio = |other: &'a SideRuns| {
            let SideRuns { runs, .. } = other;
            let pairs = first.runs.iter().zip(runs).map(|(first, run)| first.seconds / run.seconds);
            (other, Spread::of(pairs), first.seconds().median / other.seconds().median)
        };
        others.iter().map(ratio).collect()
    }

    pub fn summary(&self) -> String {
        let mut text = String::new();
        for side in &self.sides {
            text.push_str(&format!(
                "{:6} {:6} MiB at most, {:.1} million voxels a second",
                side.side.name(),
                side.peak_bytes() >> 20,
                self.voxels() / side.seconds().median / 1e6
            ));
            if let Some(predicted) = side.warm_up.predicted_bytes {
                text.push_str(&format!(
                    "; the first run took {} MiB, predicted {} MiB; predicted {:.2} s",
                    side.risen_bytes() >> 20,
                    predicted >> 20,
                    self.predicted_seconds(side),
                ));
            }
            text.push('\n');
        }
        for (side, pairs, medians) in self.ratios() {
            let first = &self.sides[0];
            text.push_str(&format!(
                "{} is {medians:.1} times as fast as {} (pairs {:.1} to {:.1}) in 1/{:.1} of its memory\n",
                side.side.name(),
                first.side.name(),
                pairs.least,
                pairs.greatest,
                first.peak_bytes() as f64 / side.peak_bytes().max(1) as f64,
            ));
        }
        if let Some(difference) = self.difference {
            text.push_str(&format!("depths differ by at most {difference:.1e} of themselves\n"));
        }
        text
    }

    fn predicted_seconds(&self, side: &SideRuns) -> f64 {
        let new_images = if side.side == Side::Ours { 1 } else { self.size.views };
        self.rates.seconds(self.size.infer_size(side.warm_up.refined), new_images)
    }

    /// Everything, for programs.
    pub fn value(&self) -> Value {
        let sides = self.sides.iter().map(|side| {
            let stages: Vec<Value> = side
                .parts()
                .iter()
                .map(|part| {
                    json!({
                        "stage": part.name,
                        "seconds": part.seconds.value(),
                        "operations": part.operations,
                        "operations_per_second": part.rate(),
                        "share_of_peak": part.rate() / self.peak(),
                    })
                })
                .collect();
            json!({
                "side": side.side.name(),
                "stages": stages,
                "peak_bytes": side.peak_bytes(),
                "first_run_bytes": side.risen_bytes(),
                "predicted_bytes": side.warm_up.predicted_bytes,
                "predicted_seconds": side.warm_up.predicted_bytes.map(|_| self.predicted_seconds(side)),
                "runs": side.runs,
            })
        });
        let ratios = self.ratios().into_iter().map(|(side, pairs, medians)| {
            json!({ "side": side.side.name(), "ratio_of_medians": medians, "ratio_of_pairs": pairs.value() })
        });
        json!({
            "size": self.size,
            "matrix_operations_per_second": Spread::of(self.peaks.iter().copied()).value(),
            "sides": sides.collect::<Vec<_>>(),
            "faster_than_the_first": ratios.collect::<Vec<_>>(),
            "greatest_relative_difference": self.difference,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_is_the_middle() {
        let spread = |values: &[f64]| Spread::of(values.iter().copied());
        assert_eq!(spread(&[3.0, 1.0, 2.0]), Spread { least: 1.0, median: 2.0, greatest: 3.0 });
        assert_eq!(spread(&[4.0, 1.0, 2.0, 3.0]).median, 2.5);
        assert_eq!(spread(&[7.0]), Spread { least: 7.0, median: 7.0, greatest: 7.0 });
    }
}
