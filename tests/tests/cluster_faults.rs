//! Workers that die, freeze or differ exactly where it hurts: the cloud stays the same bytes, or what is missing is
//! named.
//!
//! The faults meet their job at the points of `worker/src/fault_point.rs`.

use std::path::Path;
use std::time::Duration;

use planesweep_mvsnet::Refinement;
use planesweep_tests::{
    Bench, Cluster, Running, files_below, is_frozen, plane, run, seeded_weights_with, send, wait_until,
};
use serde_json::{Value, json};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
/// Computes at once, so that nothing but the faults takes its time.
const ANALYTIC: [&str; 2] = ["--device", "analytic"];
/// The exit code of a worker that should not be started again.
const REFUSED: i32 = 78;
const RUN: &str = "scene-1";

/// Six views, and the cloud that one undisturbed process makes of them.
fn of_plane() -> Bench {
    let bench = Bench::new(|folder| drop(plane(folder, 6)));
    let _ = bench.reconstruct("calm", &[&ANALYTIC[..], &["--workers", "1"]].concat()).expect_code(0);
    bench
}

fn jobs(status: &Value, state: &str) -> u64 {
    let kinds = status["jobs"].as_object().expect("jobs by kind");
    kinds.values().filter_map(|states| states[state].as_u64()).sum()
}

/// Waits for a worker to be killed by its own fault.
#[track_caller]
fn died(worker: Running) {
    let ended = worker.wait();
    assert_eq!(ended.code, None, "it was no signal that ended it: {}", ended.stderr);
}

#[test]
fn a_worker_killed_between_storing_and_reporting_a_result_loses_nothing() {
    let bench = of_plane();
    let cluster = Cluster::start(&bench, &[]);
    let struck = bench.submit("struck", &cluster, &ANALYTIC);
    died(cluster.faulty_worker("kill:stored:infer:3", &ANALYTIC));
    // The weights, what is done, and what nobody knows of.
    let stored = files_below(Path::new(&bench.path("store"))).len() as u64;
    let known = jobs(&cluster.status(RUN, &[]), "done");
    assert!(stored >= known + 2, "{stored} blobs for {known} jobs: nothing is unknown");
    let _healthy = cluster.worker(&ANALYTIC);
    let _ = struck.wait().expect_code(0);
    let said = cluster.coordinator_stderr();
    assert!(said.contains("died or froze while it ran this job"), "{said}");
    bench.same_cloud("calm", "struck");
}

#[test]
fn of_two_workers_that_finish_one_job_the_first_counts_and_a_difference_is_told() {
    let bench = of_plane();
    // The same result twice, and another one by another network.
    for (device, differs) in [("analytic", false), ("cpu", true)] {
        let (ledger, store) =
            (bench.path(&format!("{device}.sqlite")), bench.path(&format!("{device}-store")));
        let cluster = Cluster::start_on(&ledger, &store, Vec::new(), &[]);
        let struck = bench.submit(device, &cluster, &["--device", device]);
        let mut frozen = cluster.faulty_worker("stop:stored:infer", &["--device", device]);
        assert!(wait_until(DEADLINE, || is_frozen(frozen.pid())), "{}", frozen.stderr());
        assert_eq!(jobs(&cluster.status(RUN, &[]), "done"), 0, "it froze before it reported anything");
        let _other = cluster.worker(&ANALYTIC);
        let _ = struck.wait().expect_code(0);
        assert_eq!(cluster.status(RUN, &[])["late_results"], 0);
        assert!(is_frozen(frozen.pid()) && send("CONT", frozen.pid()));
        let late = || cluster.status(RUN, &[])["late_results"].as_u64() > Some(0);
        assert!(wait_until(DEADLINE, late), "{}", cluster.coordinator_stderr());

        let status = cluster.status(RUN, &[]);
        let divergent = status["divergent_results"].as_u64() > Some(0);
        assert_eq!(divergent, differs, "{device}: {status}");
        let said = cluster.coordinator_stderr();
        assert_eq!(said.contains("late result differs from the published one"), differs, "{said}");
        // It has registered anew.
        let alive = status["workers"].as_array().expect("workers").iter().filter(|w| w["alive"] == true);
        assert!(alive.count() == 2 && frozen.is_running(), "{status}");
        bench.same_cloud("calm", device);
    }
}

#[test]
fn a_job_that_kills_every_worker_is_quarantined_and_named_and_the_rest_is_finished() {
    let bench = of_plane();
    let cluster = Cluster::start(&bench, &[]);
    let mut struck = bench.submit("struck", &cluster, &ANALYTIC);
    let poisoned = || cluster.faulty_worker("kill:started:infer:2", &ANALYTIC);
    let mut workers = [poisoned(), poisoned()];
    let mut deaths = 0;
    let ended = wait_until(DEADLINE, || {
        for worker in &mut workers {
            if !worker.is_running() {
                deaths += 1;
                *worker = poisoned();
            }
        }
        !struck.is_running()
    });
    assert!(ended, "{}", struck.stderr());
    // One makes it suspect, three die alone with it.
    assert!(deaths >= 4, "only {deaths} died");
    let struck = struck.wait().expect_code(3);
    let why = "each worker that ran this job, and nothing else, died or stopped reporting";
    assert!(struck.stderr.contains(&format!("infer of 00000002.png: {why}")), "{}", struck.stderr);
    let skipped = struck.json()["skipped"].clone();
    assert_eq!(skipped.as_array().map(Vec::len), Some(1), "{skipped}");
    assert_eq!(skipped[0]["view"], "00000002.png");
    assert!(skipped[0]["reason"].as_str().is_some_and(|reason| reason.contains(why)), "{skipped}");
    let said = cluster.coordinator_stderr();
    for deaths_alone in 0..3 {
        assert!(said.contains(&format!("deaths_alone={deaths_alone}")), "{said}");
    }
    let status = cluster.status(RUN, &[]);
    assert_eq!(status["failures"][0]["code"], "quarantined", "{status}");
    for view in [0, 1, 3, 4, 5] {
        let read = |out: &str| bench.read(&format!("{out}/depth/{view:08}.pfm"));
        assert!(read("calm") == read("struck"), "view {view} differs");
    }
    // Its cloud is that of the undisturbed maps without the lost one.
    std::fs::remove_file(bench.path("calm/depth/00000002.pfm")).expect("it was there");
    let (calm, lacking) = (bench.path("calm"), bench.path("lacking.ply"));
    let _ = run(["fuse", &calm, "-o", &lacking, "--min-confidence", "0", "--min-views", "1"]).expect_code(3);
    let lacking = bench.read("lacking.ply");
    assert!(lacking.len() > 10_000 && lacking == bench.read("struck/cloud.ply"), "the clouds differ");
    assert!(lacking != bench.read("calm/cloud.ply"), "the view is not missed");

    // Submitted again, where nothing kills, it is done after all.
    drop(workers);
    let _healthy = cluster.worker(&ANALYTIC);
    let _ = bench.submit("again", &cluster, &ANALYTIC).wait().expect_code(0);
    bench.same_cloud("calm", "again");
}

#[test]
fn crashes_at_different_jobs_cost_no_view() {
    let bench = of_plane();
    let cluster = Cluster::start(&bench, &[]);
    let struck = bench.submit("struck", &cluster, &ANALYTIC);
    // More than the deaths that would quarantine one job.
    for job in ["infer:0", "infer:1", "filter:2", "emit:3", "assemble"] {
        died(cluster.faulty_worker(&format!("kill:started:{job}"), &ANALYTIC));
    }
    let _healthy = cluster.worker(&ANALYTIC);
    let _ = struck.wait().expect_code(0);
    let said = cluster.coordinator_stderr();
    assert!(said.matches("died or froze while it ran this job").count() >= 5, "{said}");
    assert!(!said.contains("failed for good"), "{said}");
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_worker_of_another_version_is_refused_with_both_versions() {
    let bench = of_plane();
    let cluster = Cluster::start(&bench, &[]);
    let struck = bench.submit("struck", &cluster, &ANALYTIC);
    let is_submitted = || struck.stderr().contains("run scene-1");
    assert!(wait_until(DEADLINE, is_submitted), "{}", struck.stderr());
    let refused = cluster.faulty_worker("version:0.0.9", &ANALYTIC).wait().expect_code(REFUSED);
    let ours = concat!("the coordinator ", env!("CARGO_PKG_VERSION"));
    for said in ["version mismatch", "is version 0.0.9", ours] {
        assert!(refused.stderr.contains(said), "{said}: {}", refused.stderr);
    }
    assert_eq!(jobs(&cluster.status(RUN, &[]), "done"), 0);
    let _worker = cluster.worker(&ANALYTIC);
    let _ = struck.wait().expect_code(0);
    bench.same_cloud("calm", "struck");
}

/// Workers have no weights of their own: they come with the job, by their hash.
#[test]
fn runs_of_different_weights_on_one_cluster_do_not_mix() {
    let bench = Bench::new(|folder| drop(plane(folder, 3)));
    std::fs::create_dir(bench.path("other")).expect("made");
    let other = seeded_weights_with(Path::new(&bench.path("other")), Refinement::Paper);
    let cluster = Cluster::start(&bench, &[]);
    let _worker = cluster.worker(&[]);
    for out in ["ours", "theirs"] {
        let done = bench.submit(out, &cluster, &[]).wait().expect_code(0);
        assert!(!done.stderr.contains("jobs are done already"), "{}", done.stderr);
        let _ = bench.reconstruct(&format!("{out}-alone"), &[]).expect_code(0);
        let read = |out: &str| bench.read(&format!("{out}/cloud.ply"));
        assert!(read(out) == read(&format!("{out}-alone")), "{out} differs from its own run");
        std::fs::copy(&other, bench.weights()).expect("replaced");
    }
    assert!(bench.read("ours/depth/00000000.pfm") != bench.read("theirs/depth/00000000.pfm"));
    assert_eq!(cluster.status("scene-2", &[])["failures"], json!([]));
}
