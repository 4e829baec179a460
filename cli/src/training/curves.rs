//! The curves of a run: lines for people, CSV files, TensorBoard's event files, pictures.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, Result};
use planesweep_mvsnet::train::{IntervalErrors, StepReport, TrainConfig, Validation};
use planesweep_report::{Line, LinePlot, draw_lines, encode_png, event_file_start, scalar_event};
use planesweep_scene::write_atomically;

const STEPS: &str = "curve.csv";
const STEPS_HEADING: &str = "step,loss,error,below_1,below_3,gradient_norm,learning_rate,seconds_per_step";
const VALIDATIONS: &str = "validation.csv";
const VALIDATIONS_HEADING: &str =
    "step,group,error,below_1,below_3,confident,confident_below_1,absent_confident";

/// Everything that is written about a run, in its folder.
pub struct Curves {
    folder: PathBuf,
    events: File,
    /// Lines without their headings.
    steps: Vec<String>,
    validations: Vec<String>,
    since: Sums,
    begun: Instant,
}

/// What happened since the last line.
struct Sums {
    steps: u64,
    loss: f64,
    norm: f64,
    errors: IntervalErrors,
    starved: u64,
    from: Instant,
}

impl Sums {
    fn new() -> Self {
        let errors = IntervalErrors::default();
        Self { steps: 0, loss: 0.0, norm: 0.0, errors, starved: 0, from: Instant::now() }
    }
}

impl Curves {
    /// Goes on with the curves of a run that has done `step` steps; what was written of later steps, which are done
    /// again, is dropped.
    pub fn open(folder: &Path, step: u64) -> Result<Self> {
        let events = folder.join("events");
        fs::create_dir_all(&events)
            .with_context(|| format!("cannot make the folder {}", events.display()))?;
        let name = format!("events.out.tfevents.{:010}.planesweep.{}", now() as u64, std::process::id());
        let path = events.join(name);
        let mut events = OpenOptions::new()
            .append(true)
            .create(true)
            .open(&path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        events.write_all(&event_file_start(now())).context("cannot write the event file")?;
        Ok(Self {
            folder: folder.to_owned(),
            events,
            steps: lines_until(&folder.join(STEPS), step),
            validations: lines_until(&folder.join(VALIDATIONS), step),
            since: Sums::new(),
            begun: Instant::now(),
        })
    }

    /// Adds a step; gives a line for people when it is time for one.
    pub fn add(&mut self, report: &StepReport, config: &TrainConfig) -> Result<Option<String>> {
        let since = &mut self.since;
        let errors = report.refined.unwrap_or(report.initial);
        since.steps += 1;
        since.loss += report.loss;
        since.norm += report.gradient_norm;
        since.errors = since.errors.plus(errors);
        since.starved += u64::from(report.examples_ready == 0);
        let step = report.step;
        if !step.is_multiple_of(config.progress.log_every) && step != config.steps {
            return Ok(None);
        }
        let since = std::mem::replace(&mut self.since, Sums::new());
        let count = since.steps as f64;
        let (loss, norm, error) = (since.loss / count, since.norm / count, since.errors.mean());
        let [one, three] = since.errors.shares();
        let seconds = since.from.elapsed().as_secs_f64() / count;
        let rate = report.learning_rate;
        let starved = since.starved as f64 / count;
        self.steps.push(format!(
            "{step},{loss:.6},{error:.6},{one:.6},{three:.6},{norm:.6},{rate:.3e},{seconds:.4}"
        ));
        let scalars = [
            ("train/loss", loss),
            ("train/error_intervals", error),
            ("train/below_1", one),
            ("train/below_3", three),
            ("train/gradient_norm", norm),
            ("train/learning_rate", rate),
            ("train/seconds_per_step", seconds),
            ("train/steps_without_sample_ready", starved),
        ];
        self.write_event(step, &scalars)?;
        self.write_lines()?;
        let left = (config.steps - step) as f64 * seconds;
        Ok(Some(format!(
            "step {step}/{}: loss {loss:.3}, error {error:.3} intervals, {:.1} % below 1, {:.1} % below 3, \
             {seconds:.2} s a step, {:.0} min, {:.0} min left{}",
            config.steps,
            100.0 * one,
            100.0 * three,
            self.begun.elapsed().as_secs_f64() / 60.0,
            left / 60.0,
            if starved > 0.2 {
                format!(", {:.0} % of steps waited for samples", 100.0 * starved)
            } else {
                String::new()
            },
        )))
    }

    /// Adds a validation.
    pub fn add_validation(&mut self, step: u64, validation: &Validation) -> Result<()> {
        for group in &validation.groups {
            let error = group.all.mean();
            let [one, three] = group.all.shares();
            let [sure_one, _] = group.confident.shares();
            let sure = group.confident.pixels as f64 / group.all.pixels.max(1) as f64;
            let absent = group.absent_share();
            let name = group.name.replace([' ', ',', '/'], "_");
            self.validations.push(format!(
                "{step},{name},{error:.6},{one:.6},{three:.6},{sure:.6},{sure_one:.6},{absent:.6}"
            ));
            let tags = [
                "error_intervals",
                "below_1",
                "below_3",
                "confident",
                "confident_below_1",
                "absent_confident",
            ];
            let tags = tags.map(|tag| format!("{name}/{tag}"));
            let values = [error, one, three, sure, sure_one, absent];
            let scalars: Vec<_> = tags.iter().map(String::as_str).zip(values).collect();
            self.write_event(step, &scalars)?;
        }
        // Validating is no part of a step's time.
        self.since.from = Instant::now();
        self.write_lines()
    }

    /// Draws loss and errors.
    pub fn draw(&self) -> Result<()> {
        let training = |column: usize| points(&self.steps, column, None);
        self.write_plot("loss.png", "loss", "intervals", &[("loss".to_owned(), training(1))])?;
        let mut curves = vec![("< 1".to_owned(), training(3)), ("< 3".to_owned(), training(4))];
        let groups: std::collections::BTreeSet<&str> =
            self.validations.iter().filter_map(|line| line.split(',').nth(1)).collect();
        for group in groups {
            let points = points(&self.validations, 3, Some(group));
            curves.push((format!("{} < 1", group.replace('_', " ")), points));
        }
        self.write_plot("errors.png", "errors in intervals", "share", &curves)
    }

    /// Draws curves, each with its name, over the steps.
    fn write_plot(&self, file: &str, title: &str, y_label: &str, curves: &[NamedCurve]) -> Result<()> {
        let lines: Vec<Line> = curves.iter().map(|(name, points)| Line { name, points }).collect();
        let plot = LinePlot { title, x_label: "step", y_label, lines: &lines, mark: None };
        write(&self.folder.join(file), &encode_png(&draw_lines(&plot))?)
    }

    fn write_event(&mut self, step: u64, scalars: &[(&str, f64)]) -> Result<()> {
        self.events.write_all(&scalar_event(now(), step, scalars)).context("cannot write the event file")
    }

    fn write_lines(&self) -> Result<()> {
        for (name, heading, lines) in
            [(STEPS, STEPS_HEADING, &self.steps), (VALIDATIONS, VALIDATIONS_HEADING, &self.validations)]
        {
            let text = format!("{heading}\n{}\n", lines.join("\n"));
            write(&self.folder.join(name), text.trim_end_matches('\n').as_bytes())?;
        }
        Ok(())
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomically(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// The lines of a CSV file up to a step, without its heading; none when there is no file.
fn lines_until(path: &Path, step: u64) -> Vec<String> {
    let text = fs::read_to_string(path).unwrap_or_default();
    let of = |line: &str| line.split(',').next().and_then(|step| step.parse::<u64>().ok());
    text.lines().filter(|line| of(line).is_some_and(|at| at <= step)).map(str::to_owned).collect()
}

/// A curve's name, and its points: (step, value).
type NamedCurve = (String, Vec<(f64, f64)>);

/// (step, value) of a column, of the lines of one group; values that are no numbers are left out.
fn points(lines: &[String], column: usize, group: Option<&str>) -> Vec<(f64, f64)> {
    let point = |line: &String| {
        let cells: Vec<&str> = line.split(',').collect();
        let number = |cell: Option<&&str>| cell?.parse().ok().filter(|value: &f64| value.is_finite());
        let mine = group.is_none_or(|group| cells.get(1) == Some(&group));
        if mine { Some((number(cells.first())?, number(cells.get(column))?)) } else { None }
    };
    lines.iter().filter_map(point).collect()
}
