//! Every scene of the data beside the checkout, from photographs to a cloud, in one table:
//! `cargo run --release -p planesweep-tests --example all_scenes -- OUT`.
//!
//! Each result stays in OUT/SCENE, with its previews, and running it again resumes. Scenes with true
//! depth are measured against it.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use planesweep_tests::{Finished, confident_share, reference_weights, run, shared_scenes};
use serde_json::Value;

const NAME: &str = "all_scenes";

/// The longest side that every scene is reduced to unless a second argument names another.
const MAX_SIZE: &str = "640";

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let Some(out) = arguments.next().map(PathBuf::from) else {
        eprintln!("usage: all_scenes OUT [MAX_SIZE]");
        return ExitCode::from(2);
    };
    let max_size = arguments.next().unwrap_or_else(|| MAX_SIZE.to_owned());
    std::fs::create_dir_all(&out).expect("the folder for results");
    let Some(weights) = reference_weights(NAME, &out) else { return ExitCode::FAILURE };
    println!(
        "{:20} {:>5} {:>7} {:>8} {:>7} {:>9} {:>9} {:>6} {:>6}",
        "scene", "views", "seconds", "points", "skipped", "conf>0.8", "median", "1 %", "5 %"
    );
    for (name, scene) in shared_scenes(NAME, &out) {
        let result = out.join(name);
        let arguments = ["reconstruct", text(&scene), "-o", text(&result), "--weights", text(&weights)];
        let reconstructed = run(arguments.into_iter().chain(["--json", "--max-size", &max_size]));
        let truth = scene.join("depth_gt");
        let measured =
            truth.exists().then(|| run(["evaluate", "depth", text(&result), text(&truth), "--json"]));
        println!("{}", row(name, &result, &reconstructed, measured.as_ref()));
    }
    ExitCode::SUCCESS
}

fn row(name: &str, out: &Path, run: &Finished, measured: Option<&Finished>) -> String {
    let value: Value = serde_json::from_str(&run.stdout).unwrap_or_default();
    if let Some(error) = value["error"].as_str() {
        return format!("{name:20} {error}");
    }
    let errors = measured.map(|run| serde_json::from_str(&run.stdout).unwrap_or(Value::Null));
    let errors = errors.map_or(Value::Null, |value| value["mean"]["confident"].clone());
    let shown = |field: &str| errors[field].as_f64().map_or("-".to_owned(), |value| format!("{value:.4}"));
    format!(
        "{name:20} {:>5} {:>7.0} {:>8} {:>7} {:>9.3} {:>9} {:>6} {:>6}",
        value["report"]["views"].as_array().map_or(0, Vec::len),
        value["report"]["totals"]["wall_seconds"].as_f64().unwrap_or(f64::NAN),
        value["points"],
        value["skipped"].as_array().map_or(0, Vec::len),
        confident_share(out, 0.8),
        shown("median_relative"),
        shown("within_1_percent"),
        shown("within_5_percent"),
    )
}

fn text(path: &Path) -> &str {
    path.to_str().expect("the paths are UTF-8")
}
