//! The memory that is predicted for an inference against the memory that a process takes for it.

use planesweep_mvsnet::Refinement;
use planesweep_tests::{run, seeded_weights_with};
use serde_json::Value;

/// Three sizes, with and without refinement, each in a process of its own.
#[test]
fn predicted_memory_is_that_of_a_process() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for refinement in [Refinement::None, Refinement::Paper] {
        let weights = seeded_weights_with(folder.path(), refinement);
        let weights = weights.to_str().expect("a temporary folder is UTF-8");
        let sizes = ["320x256x96x3", "640x256x64x2", "480x384x128x4"];
        let arguments =
            ["bench", "--json", "--sides", "alone", "--runs", "1", "--threads", "2", "--weights", weights];
        let sizes = sizes.iter().flat_map(|size| ["--size", *size]);
        let done = run(arguments.into_iter().chain(sizes)).expect_code(0);
        let value: Value = serde_json::from_str(&done.stdout).expect("JSON");
        let measured = value["sizes"].as_array().expect("three sizes");
        assert_eq!(measured.len(), 3);
        for size in measured {
            let side = &size["sides"][0];
            let number = |name: &str| side[name].as_f64().expect("a number of bytes");
            let (taken, predicted) = (number("first_run_bytes"), number("predicted_bytes"));
            let ratio = predicted / taken;
            eprintln!("{} {refinement:?}: {taken} bytes, predicted {predicted}", size["size"]);
            assert!(
                (0.85..=1.15).contains(&ratio),
                "{} {refinement:?}: predicted {ratio:.2} of it",
                size["size"]
            );
        }
    }
}
