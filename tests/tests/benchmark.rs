//! Benchmarks run and judged by the program, on small scenes in the benchmarks' own folders.

use std::fs;
use std::path::{Path, PathBuf};

use planesweep_tests::{Bench, Cluster, benchmarks, run, seeded_weights};
use serde_json::Value;

/// Runs a benchmark on the device that knows the surface.
fn benchmark(folder: &Path, settings: &str) -> Value {
    let weights = seeded_weights(folder);
    let config = folder.join("benchmark.toml");
    let text = format!(
        "scenes = \"scenes\"\ntruth = \"truth\"\nout = \"out\"\nweights = \"{}\"\n{settings}",
        weights.display()
    );
    fs::write(&config, text).expect("written");
    run(["benchmark", config.to_str().expect("UTF-8"), "--json"]).expect_code(0).json()
}

const OPTIONS: &str = "options = [\"--device\", \"analytic\", \"--max-size\", \"160\", \"--depths\", \"16\", \
    \"--depth-range\", \"4,6\", \"--min-confidence\", \"0\", \"--workers\", \"1\"]\n";

#[test]
fn tanks_and_temples() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    benchmarks::tanks_and_temples(folder, "Barn");
    let settings = format!(
        "preset = \"tanks-and-temples-training\"\nnames = [\"Barn\"]\nthresholds = {{ Barn = 0.1 }}\n{OPTIONS}"
    );
    let value = benchmark(folder, &settings);
    let scores = &value["measured"]["scenes"][0]["scores"];
    let number = |field: &str| scores[field].as_f64().expect("a number");
    assert!(
        number("precision") > 0.99 && number("recall") > 0.95,
        "{} {}",
        number("precision"),
        number("recall")
    );
    let table = fs::read_to_string(folder.join("out/benchmark.md")).expect("a table");
    assert!(
        table.starts_with("|  | mean | Barn |") && table.contains("planesweep, 1 of 1 scenes"),
        "{table}"
    );
    for name in ["tnt.json", "precision.ply", "recall.ply", "precision_recall.png", "error_histogram.png"] {
        assert!(folder.join("out/evaluation/Barn").join(name).is_file(), "{name}");
    }

    // The cloud stands elsewhere than the scan, so without alignment nothing is near.
    let paths = ["out/Barn", "truth/Barn"].map(|name| folder.join(name));
    let [result, truth] = paths.each_ref().map(|path| path.to_str().expect("UTF-8"));
    let aligned = run(["evaluate", "tnt", result, truth, "--threshold", "0.1", "--aligned", "--json"]);
    let f_score = aligned.expect_code(0).json()["scores"]["f_score"].as_f64().expect("a number");
    assert!(f_score < 0.5, "{f_score}");
}

#[test]
fn dtu() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    benchmarks::dtu(folder, 1);
    benchmarks::dtu(folder, 4);
    let value = benchmark(folder, &format!("preset = \"dtu\"\nnames = [\"scan1\", \"scan4\"]\n{OPTIONS}"));
    let mean = &value["measured"]["mean"];
    eprintln!("{mean}");
    assert_eq!(mean["scans"], 2);
    let number = |field: &str| mean[field].as_f64().expect("a number");
    // Half the diagonal of the truth's grid is 0.14; the cloud covers more than the mask.
    assert!(number("accuracy") < 0.1 && number("completeness") < 0.5, "{mean}");
    let table = fs::read_to_string(folder.join("out/benchmark.md")).expect("a table");
    assert!(
        table.contains("MVSNet (paper) | 0.396") && table.contains("planesweep, 2 of 2 scans"),
        "{table}"
    );
    assert!(folder.join("out/evaluation/scan4/error_histogram.png").is_file());
}

#[test]
fn on_a_coordinator_elsewhere_the_clouds_are_the_same() {
    let bench = Bench::new(|_| ());
    let root = PathBuf::from(bench.path("."));
    benchmarks::dtu(&root, 1);
    let benchmark = |out: &str, more: &[&str]| {
        let config = root.join(format!("{out}.toml"));
        let weights = bench.weights();
        let options = OPTIONS.replace(", \"--workers\", \"1\"", "");
        let text = format!(
            "preset = \"dtu\"\nnames = [\"scan1\"]\nscenes = \"scenes\"\ntruth = \"truth\"\nout = \"{out}\"\n\
             weights = \"{weights}\"\n{options}"
        );
        fs::write(&config, text).expect("written");
        let given = ["benchmark", config.to_str().expect("UTF-8"), "--json"];
        run(given.iter().chain(more)).expect_code(0).json()
    };
    let here = benchmark("here", &[]);
    let cluster = Cluster::start(&bench, &[]);
    let _worker = cluster.worker(&["--device", "analytic"]);
    let there = benchmark("there", &["--coordinator", cluster.url()]);
    assert_eq!(here["measured"], there["measured"]);
    assert_eq!(bench.read("here/scan1/cloud.ply"), bench.read("there/scan1/cloud.ply"));
}

#[test]
fn scenes_that_fail_are_named_and_the_rest_goes_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    benchmarks::dtu(folder, 1);
    let weights = seeded_weights(folder);
    let config = folder.join("benchmark.toml");
    let text = format!(
        "preset = \"dtu\"\nscenes = \"scenes\"\nout = \"out\"\nweights = \"{}\"\nnames = [\"scan9\", \"scan1\"]\n{OPTIONS}",
        weights.display()
    );
    fs::write(&config, text).expect("written");
    let done = run(["benchmark", config.to_str().expect("UTF-8"), "--json"]).expect_code(3);
    let scenes = &done.json()["scenes"];
    assert!(scenes[0]["error"].as_str().expect("an error").contains("scan9"), "{scenes}");
    assert!(scenes[1]["points"].as_u64() > Some(100), "{scenes}");
}
