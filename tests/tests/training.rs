//! Training through the program: a run that is killed goes on to the same bytes.

use std::fs;
use std::path::Path;
use std::time::Duration;

use planesweep_tests::{Running, wait_until};

const CONFIG: &str = r#"
seed = 5
steps = 8
threads = 2

[samples]
sizes = [[64, 64], [96, 64]]
views = [2, 3]
depths = [8, 16]

[network]
refinement = "paper"

[optimizer]
warmup = 2
samples_per_step = 2
average_decay = 0.9
freeze_statistics_at = 6

[progress]
log_every = 1
checkpoint_every = 2
validate_every = 4
validation_samples = 1
"#;

fn start(config: &Path, out: &Path) -> Running {
    Running::start(["train".as_ref(), config.as_os_str(), "-o".as_ref(), out.as_os_str(), "--json".as_ref()])
}

#[test]
fn a_killed_run_goes_on_to_the_same_weights() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = folder.path().join("train.toml");
    fs::write(&config, CONFIG).expect("written");
    let (whole, killed) = (folder.path().join("whole"), folder.path().join("killed"));
    // It ends early where it is told to, and goes on when it no longer is.
    fs::write(&config, format!("{CONFIG}stop_after = 5\n")).expect("written");
    assert_eq!(start(&config, &whole).wait().expect_code(0).json()["steps"], 5);
    fs::write(&config, CONFIG).expect("written");
    let finished = start(&config, &whole).wait().expect_code(0);
    assert_eq!(finished.json()["steps"], 8);

    let running = start(&config, &killed);
    // After a checkpoint, and with steps since then that are lost.
    let there = wait_until(Duration::from_mins(10), || running.stderr().contains("step 3/8"));
    assert!(there, "{}", running.stderr());
    drop(running);
    assert!(!fs::read_to_string(killed.join("curve.csv")).expect("a curve").contains("\n8,"));

    let finished = start(&config, &killed).wait().expect_code(0);
    assert!(finished.stderr.contains("going on after step"), "{}", finished.stderr);
    for file in ["weights.safetensors", "checkpoint.safetensors"] {
        let read = |run: &Path| fs::read(run.join(file)).expect("a file of the run");
        assert!(read(&whole) == read(&killed), "{file} differs");
    }
    let curve = |run: &Path| fs::read_to_string(run.join("curve.csv")).expect("a curve").lines().count();
    assert_eq!((curve(&whole), curve(&killed)), (9, 9));
    assert!(whole.join("loss.png").exists() && whole.join("errors.png").exists());
}

#[test]
fn data_sets_are_trained_on() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let stored = folder.path().join("stored");
    let stored_name = stored.to_str().expect("UTF-8");
    let _ = Running::start(["synth", stored_name, "--training", "2", "--seed", "9"]).wait().expect_code(0);
    let few = "steps = 2\n[samples]\nsizes = [[64, 64]]\ndepths = [8, 16]\n\
               [progress]\nlog_every = 1\nvalidation_samples = 1\n";
    let run = |name: &str, data: &str| {
        let config = folder.path().join(format!("{name}.toml"));
        fs::write(&config, format!("{few}{data}")).expect("written");
        let out = folder.path().join(name);
        (start(&config, &out).wait(), out.join("weights.safetensors"))
    };
    let weights = |name: &str, data: &str| {
        let (finished, weights) = run(name, data);
        let _ = finished.expect_code(0);
        fs::read(weights).expect("weights")
    };
    let folders = format!("[data]\nfolders = [{stored_name:?}]\n");
    assert_ne!(weights("stored", &format!("{folders}generated_share = 0.0\n")), weights("generated", ""));
    let refused = run("refused", &folders).0.expect_code(1);
    assert!(refused.stderr.contains("data.generated_share must be below 1"), "{}", refused.stderr);
}

#[test]
fn another_configuration_and_nonsense_are_refused() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = folder.path().join("train.toml");
    let out = folder.path().join("out");
    for (text, complaint) in [
        ("steps = 0", "steps must be at least 1"),
        ("stepz = 5", "unknown field `stepz`"),
        ("[samples]\nsizes = [[60, 64]]", "samples.sizes must be multiples of 32"),
        ("device = \"abacus\"", "\"abacus\" is none of"),
    ] {
        let few = format!("{text}\n");
        fs::write(&config, few).expect("written");
        let finished = start(&config, &out).wait().expect_code(1);
        assert!(finished.stderr.contains(complaint), "{text}: {}", finished.stderr);
    }
}
