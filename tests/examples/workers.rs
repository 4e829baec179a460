//! How much faster two worker processes are than one, each with half of the processors, and what a worker
//! for fusion alone changes: runs of `planesweep reconstruct` that alternate, and the seconds from the first job to the last.
//!
//! ```sh
//! cargo run --release -p planesweep-tests --example workers -- SCENE --rounds 3 -- --max-size 640
//! ```
//!
//! What stands behind the second `--` is given to every run. Without SCENE a courtyard of 12 views is made.

use std::path::PathBuf;

use planesweep_tests::{courtyard, run, seeded_weights};

/// Name and options of each team.
const TEAMS: [(&str, &[&str]); 3] = [
    ("1 worker", &["--workers", "1"]),
    ("2 workers", &["--workers", "2"]),
    ("2 workers and one for fusion", &["--workers", "2", "--fusion-worker"]),
];

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let (own, more) = match arguments.iter().position(|argument| argument == "--") {
        Some(at) => (&arguments[..at], &arguments[at + 1..]),
        None => (&arguments[..], &[][..]),
    };
    let rounds = own.iter().position(|argument| argument == "--rounds");
    let rounds: usize = rounds.map_or(3, |at| own[at + 1].parse().expect("a number of rounds"));
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = own.first().filter(|argument| *argument != "--rounds").map(PathBuf::from);
    let scene = scene.unwrap_or_else(|| {
        let made = folder.path().join("scene");
        courtyard(&made, 12, 640, 512);
        made
    });
    let weights = seeded_weights(folder.path());
    let threads =
        std::thread::available_parallelism().map_or(1, |threads| threads.get().div_ceil(2)).to_string();

    let mut seconds = vec![Vec::new(); TEAMS.len()];
    for round in 0..rounds {
        for (team, (name, options)) in TEAMS.iter().enumerate() {
            let out = folder.path().join(format!("out{team}"));
            let mut command = vec!["reconstruct".to_owned(), scene.display().to_string()];
            command.extend([
                "-o".to_owned(),
                out.display().to_string(),
                "--fresh".to_owned(),
                "--json".to_owned(),
            ]);
            let easy = ["--min-confidence", "0", "--min-views", "1", "--threads", &threads];
            command.extend(easy.iter().chain(*options).map(|option| (*option).to_owned()));
            if !more.iter().any(|option| option == "--weights") {
                command.extend(["--weights".to_owned(), weights.display().to_string()]);
            }
            command.extend(more.iter().cloned());
            let value = run(command).expect_code(0).json();
            let stages = value["stages"].as_array().expect("stages");
            let compute =
                stages.iter().find(|stage| stage[0] == "compute").and_then(|stage| stage[1].as_f64());
            let compute = compute.expect("the seconds of the jobs");
            println!("round {}: {compute:8.1} s  {name}; maps {}", round + 1, value["report"]["maps_by_way"]);
            seconds[team].push(compute);
        }
    }
    let one = median(&mut seconds[0]);
    for ((name, _), seconds) in TEAMS.iter().zip(&mut seconds) {
        let middle = median(seconds);
        let (least, most) = (seconds[0], seconds[seconds.len() - 1]);
        println!(
            "{name}: median {middle:.1} s ({least:.1} to {most:.1}), {:.2} times 1 worker's speed",
            one / middle
        );
    }
    println!("efficiency of 2 workers: {:.0} %", 50.0 * one / median(&mut seconds[1]));
}

fn median(seconds: &mut [f64]) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}
