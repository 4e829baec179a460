//! Processes that die and results that spoil, in the middle of real runs: the cloud stays the same bytes.
//!
//! Each test also sees that its fault took place while there was still work to do.

use std::fs;
use std::path::Path;
use std::time::Duration;

use planesweep_tests::{
    Bench, Finished, Running, blobs, children, courtyard, is_alive, plane, send, wait_until,
};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);

/// Eight views, of which each takes long enough for a fault to meet it: the plain network is slow.
const COURTYARD: [&str; 6] = ["--workers", "2", "--depths", "128", "--device", "torch"];

fn of_courtyard() -> Bench {
    Bench::new(|folder| courtyard(folder, 8, 320, 256))
}

/// Waits until the ledger knows of the first results of a run, as its progress tells.
#[track_caller]
fn wait_for_results(run: &Running, count: usize) {
    let done = |line: &str| line.split_once("/25 jobs").and_then(|(done, _)| done.parse().ok());
    let is_there = || run.stderr().lines().filter_map(done).any(|jobs: usize| jobs >= count);
    assert!(wait_until(DEADLINE, is_there), "no result: {}", run.stderr());
}

/// The run's workers, once both are there.
#[track_caller]
fn two_workers(run: &Running) -> [u32; 2] {
    let mut found = Vec::new();
    let is_there = wait_until(DEADLINE, || {
        found = children(run.pid(), "worker");
        found.len() == 2
    });
    assert!(is_there, "the workers are {found:?}: {}", run.stderr());
    [found[0], found[1]]
}

/// Whether an interrupted run was taken up where it was.
fn was_resumed(run: &Finished) -> bool {
    run.stderr.contains("25 jobs are done already") && !run.stderr.contains("25 of 25 jobs")
}

#[test]
fn a_killed_worker_is_replaced_and_its_job_done_again() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("calm", &COURTYARD).expect_code(0);

    let mut run = bench.start("struck", &COURTYARD);
    wait_for_results(&run, 1);
    let [worker, other] = two_workers(&run);
    assert!(is_alive(worker) && send("KILL", worker) && run.is_running(), "{}", run.stderr());
    assert!(wait_until(DEADLINE, || !is_alive(worker)));
    let replaced = || children(run.pid(), "worker").iter().any(|pid| ![worker, other].contains(pid));
    assert!(wait_until(DEADLINE, replaced), "{}", run.stderr());
    let run = run.wait().expect_code(0);
    assert!(run.stderr.contains("a worker ended before its time"), "{}", run.stderr);
    assert!(run.stderr.contains("died or froze while it ran this job"), "{}", run.stderr);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_frozen_worker_is_done_without_and_changes_no_byte() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("calm", &COURTYARD).expect_code(0);

    let more: Vec<&str> = COURTYARD.into_iter().chain(["-v"]).collect();
    let run = bench.start("struck", &more);
    wait_for_results(&run, 1);
    let [worker, _] = two_workers(&run);
    assert!(send("STOP", worker));
    let noticed = wait_until(DEADLINE, || run.stderr().contains("worker stopped reporting"));
    assert!(noticed, "{}", run.stderr());
    assert!(send("CONT", worker));
    let run = run.wait().expect_code(0);
    assert!(run.stderr.contains("died or froze while it ran this job"), "{}", run.stderr);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_worker_frozen_for_good_does_not_keep_the_run_from_its_end() {
    let bench = of_courtyard();
    let run = bench.start("struck", &COURTYARD);
    wait_for_results(&run, 1);
    let [worker, _] = two_workers(&run);
    assert!(send("STOP", worker));
    let _ = run.wait().expect_code(0);
    assert!(wait_until(DEADLINE, || !is_alive(worker)), "the frozen worker outlives the run");
    let _ = bench.reconstruct("calm", &COURTYARD).expect_code(0);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_killed_run_leaves_no_worker_and_is_resumed() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("calm", &COURTYARD).expect_code(0);

    let run = bench.start("struck", &COURTYARD);
    wait_for_results(&run, 2);
    let workers = two_workers(&run);
    assert!(workers.into_iter().all(is_alive) && send("KILL", run.pid()));
    assert_eq!(run.wait().code, None, "it was not the signal that ended the run");
    for worker in workers {
        assert!(wait_until(DEADLINE, || !is_alive(worker)), "worker {worker} outlives the run");
    }
    assert!(!Path::new(&bench.path("struck/cloud.ply")).exists());
    let again = bench.reconstruct("struck", &COURTYARD).expect_code(0);
    assert!(was_resumed(&again), "{}", again.stderr);
    let says = |out: &str| String::from_utf8_lossy(&bench.read(&format!("{out}/report.html"))).into_owned();
    assert!(says("struck").contains("of 25 jobs were done before"));
    assert!(says("calm").contains("from start to end") && !says("calm").contains("were done before"));
    bench.same_cloud("calm", "struck");
}

#[test]
fn ctrl_c_stops_a_run_that_can_go_on() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("calm", &COURTYARD).expect_code(0);

    let answers = ["Ctrl-C again stops at once", "stopping at once"];
    for (out, answers) in [("once", &answers[..1]), ("twice", &answers[..])] {
        let mut run = bench.start(out, &COURTYARD);
        wait_for_results(&run, 2);
        let workers = two_workers(&run);
        for answer in answers {
            assert!(run.is_running() && send("INT", run.pid()), "{}", run.stderr());
            assert!(wait_until(DEADLINE, || run.stderr().contains(answer)), "{}", run.stderr());
        }
        let run = run.wait().expect_code(1);
        assert!(run.stderr.contains("run the same command again"), "{}", run.stderr);
        assert!(run.json()["error"].is_string());
        assert!(workers.into_iter().all(|worker| !is_alive(worker)));
        let again = bench.reconstruct(out, &COURTYARD).expect_code(0);
        assert!(was_resumed(&again), "{}", again.stderr);
        bench.same_cloud("calm", out);
    }
}

#[test]
fn spoilt_and_missing_blobs_are_found_and_made_again() {
    let bench = Bench::new(|folder| drop(plane(folder, 4)));
    let analytic = ["--device", "analytic", "--workers", "2"];
    let _ = bench.reconstruct("calm", &analytic).expect_code(0);
    let _ = bench.reconstruct("struck", &analytic).expect_code(0);
    let stored = blobs(Path::new(&bench.path("struck")));
    // The weights, three results for each of four views, and the cloud.
    assert_eq!(stored.len(), 14);

    for blob in &stored {
        let mut bytes = fs::read(blob).expect("a blob");
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x10;
        fs::write(blob, bytes).expect("spoilt");
    }
    let again = bench.reconstruct("struck", &analytic).expect_code(0);
    assert!(again.stderr.contains("are lost or damaged and are made again"), "{}", again.stderr);
    bench.same_cloud("calm", "struck");

    for lost in stored.chunks(2) {
        fs::remove_file(&lost[0]).expect("lost");
    }
    let again = bench.reconstruct("struck", &analytic).expect_code(0);
    assert!(again.stderr.contains("are lost or damaged and are made again"), "{}", again.stderr);
    bench.same_cloud("calm", "struck");
}
