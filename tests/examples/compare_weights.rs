//! Two weights files on generated scenes and on every scene of the data beside the checkout, in one table:
//! `cargo run --release -p planesweep-tests --example compare_weights -- OUT FIRST SECOND [MAX_SIZE]`.
//!
//! A weights file may be a PyTorch checkpoint; it is imported then. Each result stays in OUT/WEIGHTS/SCENE, and
//! running it again resumes. A network that is surer of itself than another must not win by that alone, so the
//! most confident shares of the pixels are compared, the same share of both: their error where there is true
//! depth, the share that three views agree on, and the difference to a photograph that was no source.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use planesweep_tests::{Finished, confident_share, run, shared_scenes};
use serde_json::Value;

const NAME: &str = "compare_weights";
const MAX_SIZE: &str = "640";
/// The share of the pixels that is compared, in tenths.
const KEPT_TENTHS: usize = 6;
/// Seeds of generated courtyards.
const COURTYARDS: [u64; 2] = [1, 2];
/// The first seed of the generated samples, and their number; training takes random seeds of 64 bits.
const SAMPLES: (u64, u64) = (1, 8);
/// Scenes whose true depth is itself some 2 % off: only the share within 5 % says something.
const COARSE_TRUTH: [&str; 2] = ["hololens_b", "hololens_c"];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [out, first, second, rest @ ..] = &arguments[..] else {
        eprintln!("usage: {NAME} OUT FIRST SECOND [MAX_SIZE]");
        return ExitCode::from(2);
    };
    let out = PathBuf::from(out);
    let max_size = rest.first().map_or(MAX_SIZE, String::as_str);
    std::fs::create_dir_all(&out).expect("the folder for results");
    let contestants = [first, second].map(|file| weights(&out, Path::new(file)));
    println!(
        "{:18} {:14} {:>9} {:>10} {:>8} {:>8} {:>8} {:>8} {:>8}",
        "scene", "weights", "conf>0.8", "consistent", "median", "1 %", "5 %", "grey all", "grey"
    );
    let mut wins = [0, 0];
    let shared = shared_scenes(NAME, &out).into_iter().map(|(name, path)| (name.to_owned(), path));
    for (scene, path) in generated_scenes(&out).into_iter().chain(shared) {
        let figures = contestants.each_ref().map(|(name, weights)| {
            let result = out.join(name).join(&scene);
            let figures = measure(&scene, &path, &result, weights, max_size);
            println!("{}", figures.row(&scene, name));
            figures
        });
        for (win, better) in wins.iter_mut().zip(compare(&figures)) {
            *win += usize::from(better);
        }
    }
    println!(
        "better at the most confident {} %: {} on {} scenes, {} on {}",
        10 * KEPT_TENTHS,
        contestants[0].0,
        wins[0],
        contestants[1].0,
        wins[1]
    );
    ExitCode::SUCCESS
}

/// Scenes of seeds that nothing is trained on: courtyards of ten views, which the training's generator does not
/// make, and samples of that generator, of which one view has its true depth.
fn generated_scenes(out: &Path) -> Vec<(String, PathBuf)> {
    let mut scenes = Vec::new();
    for seed in COURTYARDS {
        let folder = out.join(format!("scenes/courtyard_{seed}"));
        // That of an earlier run, which may have been interrupted.
        let _ = std::fs::remove_dir_all(&folder);
        let _ = run(["synth", text(&folder), "--seed", &seed.to_string()]).expect_code(0);
        scenes.push((format!("courtyard_{seed}"), folder));
    }
    let samples = out.join("scenes/samples");
    let _ = std::fs::remove_dir_all(&samples);
    let (first, count) = SAMPLES;
    let (seed, count_text) = (first.to_string(), count.to_string());
    let shape = ["--views", "5", "--width", "640", "--height", "480"];
    let made = ["synth", text(&samples), "--training", &count_text, "--seed", &seed];
    let _ = run(made.into_iter().chain(shape)).expect_code(0);
    scenes.extend(
        (first..first + count).map(|seed| (format!("sample_{seed}"), samples.join(format!("{seed:08}")))),
    );
    scenes
}

/// The name of a weights file, and the file itself, imported when it is a checkpoint.
fn weights(out: &Path, file: &Path) -> (String, PathBuf) {
    let name = file.file_stem().expect("a file name").to_string_lossy().into_owned();
    if file.extension().is_some_and(|extension| extension == "safetensors") {
        return (name, file.to_owned());
    }
    let imported = out.join(format!("{name}.safetensors"));
    let _ = run(["weights", "import", text(file), "-o", text(&imported)]).expect_code(0);
    (name, imported)
}

/// What is compared; `None` where it cannot be measured.
#[derive(Default)]
struct Figures {
    confident: f64,
    /// Share of the kept pixels that three views agree on.
    consistent: Option<f64>,
    /// Errors of the kept pixels.
    median_relative: Option<f64>,
    within_1_percent: Option<f64>,
    within_5_percent: Option<f64>,
    /// Difference to the held-out photograph in grey levels: all pixels, and those kept.
    grey_all: Option<f64>,
    grey: Option<f64>,
    problem: Option<String>,
}

fn measure(name: &str, scene: &Path, result: &Path, weights: &Path, max_size: &str) -> Figures {
    let arguments = ["reconstruct", text(scene), "-o", text(result), "--weights", text(weights), "--json"];
    let done = run(arguments.into_iter().chain(["--max-size", max_size]));
    if let Some(problem) = json(&done)["error"].as_str() {
        // An empty cloud still leaves depth maps, but nothing that says whose.
        return Figures { problem: Some(problem.to_owned()), ..Figures::default() };
    }
    let evaluate = |metric: &str| json(&run(["evaluate", metric, text(result), "--json"]));
    let at_kept = |curve: &Value, steps: usize| curve[steps * KEPT_TENTHS / 10 - 1].clone();
    let consistent = at_kept(&evaluate("consistency")["curve"], 10)["consistent"].as_f64();
    let photometric = evaluate("photometric")["mean"]["curve"].clone();
    let truths = ["depth_gt", "rendered_depth_maps"].map(|folder| scene.join(folder));
    let truth = truths.iter().find(|folder| folder.exists());
    let errors = if let Some(truth) = truth {
        at_kept(&json(&run(["evaluate", "depth", text(result), text(truth), "--json"]))["mean"]["curve"], 20)
    } else {
        Value::Null
    };
    let is_fine = !COARSE_TRUTH.contains(&name);
    Figures {
        confident: confident_share(result, 0.8),
        consistent,
        median_relative: errors["median_relative"].as_f64().filter(|_| is_fine),
        within_1_percent: errors["within_1_percent"].as_f64().filter(|_| is_fine),
        within_5_percent: errors["within_5_percent"].as_f64(),
        grey_all: photometric[19]["mean"].as_f64(),
        grey: at_kept(&photometric, 20)["mean"].as_f64(),
        problem: None,
    }
}

impl Figures {
    fn row(&self, scene: &str, weights: &str) -> String {
        if let Some(problem) = &self.problem {
            return format!("{scene:18} {weights:14} {problem}");
        }
        let shown =
            |value: Option<f64>, digits: usize| value.map_or("-".to_owned(), |v| format!("{v:.digits$}"));
        let weights: String = weights.chars().take(14).collect();
        format!(
            "{scene:18} {weights:14} {:>9.3} {:>10} {:>8} {:>8} {:>8} {:>8} {:>8}",
            self.confident,
            shown(self.consistent, 3),
            shown(self.median_relative, 4),
            shown(self.within_1_percent, 3),
            shown(self.within_5_percent, 3),
            shown(self.grey_all, 2),
            shown(self.grey, 2),
        )
    }

    /// The figure that decides: against true depth where there is one, else the views' agreement.
    fn merit(&self) -> Option<f64> {
        self.median_relative.map(|error| -error).or(self.within_5_percent).or(self.consistent)
    }
}

/// Which of two is better; neither where they are equal or cannot be compared.
fn compare(figures: &[Figures; 2]) -> [bool; 2] {
    match (figures[0].merit(), figures[1].merit()) {
        (Some(first), Some(second)) => [first > second, second > first],
        _ => [false, false],
    }
}

fn json(finished: &Finished) -> Value {
    serde_json::from_str(&finished.stdout).unwrap_or_default()
}

fn text(path: &Path) -> &str {
    path.to_str().expect("the paths are UTF-8")
}
