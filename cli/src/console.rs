//! What a command leaves on the terminal.

use std::fmt;
use std::io::{IsTerminal, stderr};
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use serde_json::Value;
use tracing_subscriber::EnvFilter;

/// The end of a command that did what was asked.
pub struct Outcome {
    /// For people.
    pub text: String,
    /// The same for programs (`--json`).
    pub value: Value,
    /// Whether views were left out, which makes the exit code 3.
    pub skipped_views: bool,
}

/// What was asked for makes no sense, or would destroy something; the exit code is 2, as for an unknown option.
#[derive(Debug)]
pub struct UsageError(pub String);

impl fmt::Display for UsageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for UsageError {}

/// As JSON; unlike `json!`, which makes them doubles, with floats as short as they tell themselves apart.
pub fn shortest<T: Serialize>(value: &T) -> Value {
    serde_json::to_string(value).and_then(|text| serde_json::from_str(&text)).unwrap_or_default()
}

/// Sends logs to stderr: warnings, with `-v` more; `PLANESWEEP_LOG` overrides both.
pub fn start_logging(verbose: u8) {
    let level = ["warn", "info", "debug", "trace"][usize::from(verbose.min(3))];
    let filter = EnvFilter::try_from_env("PLANESWEEP_LOG").unwrap_or_else(|_| EnvFilter::new(level));
    let layer = tracing_subscriber::fmt().with_env_filter(filter).with_writer(stderr);
    layer.with_ansi(stderr().is_terminal()).without_time().with_target(false).init();
}

/// Progress of a run: a bar on a terminal, plain lines elsewhere.
pub struct Progress {
    bar: ProgressBar,
    is_terminal: bool,
    /// Jobs done when the last plain line was printed.
    printed: u64,
    /// Work that was done when it was first shown, by an earlier run or in a step that reads more than others; and when
    /// that was, in seconds.
    first: Option<(f64, f64)>,
}

impl Progress {
    /// Of `total` jobs.
    pub fn new(total: u64) -> Self {
        let is_terminal = stderr().is_terminal();
        let target = if is_terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let bar = ProgressBar::with_draw_target(Some(total), target);
        let style = "{bar:30} {pos}/{len} jobs  {elapsed} elapsed  {msg}";
        if let Ok(style) = ProgressStyle::with_template(style) {
            bar.set_style(style);
        }
        bar.enable_steady_tick(Duration::from_millis(200));
        Self { bar, is_terminal, printed: 0, first: None }
    }

    /// Shows how far the run is: jobs done, and how much `work` is done of how much, for jobs are not alike.
    pub fn show(&mut self, jobs: u64, work: (f64, f64), message: &str) {
        let total = self.bar.length().unwrap_or(0);
        let elapsed = self.bar.elapsed().as_secs_f64();
        let first = *self.first.get_or_insert((work.0, elapsed));
        let left = seconds_left(first, (work.0, elapsed), work.1).map(|left| format!("{left:.0} s left"));
        let message = Some(message).filter(|text| !text.is_empty());
        let told: Vec<&str> = left.as_deref().into_iter().chain(message).collect();
        let told = told.join(", ");
        self.bar.set_position(jobs);
        let step = (total / 20).max(1);
        if !self.is_terminal && jobs >= self.printed + step {
            self.printed = jobs;
            let comma = if told.is_empty() { "" } else { ", " };
            eprintln!("{jobs}/{total} jobs, {elapsed:.0} s elapsed{comma}{told}");
        }
        self.bar.set_message(told);
    }

    /// Says something that stays.
    pub fn say(&self, line: &str) {
        if self.is_terminal {
            self.bar.println(line);
        } else {
            eprintln!("{line}");
        }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// How long it takes on as fast as since the `first` moment, which like the one `now` is of work done and of seconds;
/// `None` as long as nothing was done since.
fn seconds_left(first: (f64, f64), now: (f64, f64), all: f64) -> Option<f64> {
    (now.0 > first.0).then(|| (now.1 - first.1) * (all - now.0) / (now.0 - first.0))
}

/// How many of something there are: "1 worker", "2 workers".
pub fn counted(count: u32, what: &str) -> String {
    format!("{count} {what}{}", if count == 1 { "" } else { "s" })
}

/// Aligns the cells of rows in columns; the first row is the heading.
pub fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (cell, width) in row.iter().zip(&widths) {
            let padding = " ".repeat(width - cell.chars().count() + 2);
            line.push_str(cell);
            line.push_str(&padding);
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_an_earlier_run_did_does_not_make_this_one_faster() {
        assert_eq!(seconds_left((0.0, 0.0), (0.0, 3.0), 10.0), None);
        assert_eq!(seconds_left((0.0, 0.0), (2.0, 3.0), 10.0), Some(12.0));
        assert_eq!(seconds_left((6.0, 1.0), (8.0, 4.0), 10.0), Some(3.0));
        assert_eq!(seconds_left((6.0, 1.0), (10.0, 4.0), 10.0), Some(0.0));
    }

    #[test]
    fn one_is_no_plural() {
        assert_eq!([counted(1, "worker"), counted(2, "worker")], ["1 worker", "2 workers"]);
    }

    #[test]
    fn floats_are_written_as_they_were_given() {
        assert_eq!(shortest(&[0.8_f32, 0.01]).to_string(), "[0.8,0.01]");
    }

    #[test]
    fn columns_line_up() {
        let rows = [["view", "size"], ["a", "1152x866"], ["öß", "1"]];
        let rows: Vec<Vec<String>> =
            rows.iter().map(|r| r.iter().map(ToString::to_string).collect()).collect();
        assert_eq!(table(&rows), "view  size\na     1152x866\nöß    1\n");
    }
}
