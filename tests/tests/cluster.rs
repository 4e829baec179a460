//! A coordinator, workers and clients as processes of their own: the cloud is that of one process, whatever
//! happens to them.

use std::path::Path;
use std::time::Duration;

use planesweep_tests::{
    Bench, Cluster, Postgres, Running, S3Server, courtyard, is_alive, plane_of_size, run, send, wait_until,
};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);

/// Eight views, each slow enough for a fault to meet it.
const SLOW: [&str; 2] = ["--depths", "128"];
/// Slow enough for two, although workers go on with what they hold meanwhile.
const SLOWER: [&str; 2] = ["--depths", "512"];
const TORCH: [&str; 2] = ["--device", "torch"];
/// The exit code of a worker that another one may replace.
const TERMINATED: i32 = 75;

fn of_courtyard() -> Bench {
    Bench::new(|folder| courtyard(folder, 8, 320, 256))
}

/// The undisturbed cloud, by one process of its own.
fn calm(bench: &Bench, depths: &[&str]) {
    let _ = bench.reconstruct("calm", &[depths, &TORCH, &["--workers", "2"]].concat()).expect_code(0);
}

#[track_caller]
fn wait_for_results(run: &Running, count: usize) {
    let done = |line: &str| line.split_once("/25 jobs").and_then(|(done, _)| done.parse().ok());
    let is_there = || run.stderr().lines().filter_map(done).any(|jobs: usize| jobs >= count);
    assert!(wait_until(DEADLINE, is_there), "no result: {}", run.stderr());
}

#[test]
fn a_cluster_gives_the_cloud_of_one_process_and_is_told_to_go() {
    let bench = Bench::new(|folder| courtyard(folder, 4, 160, 128));
    let alone = bench.reconstruct("alone", &["--workers", "1"]).expect_code(0).json();
    let mut cluster = Cluster::start(&bench, &[]);
    let url = cluster.url().to_owned();
    let nothing = run(["status", "--coordinator", &url, "--json"]).expect_code(0).json();
    assert_eq!(nothing["runs"].as_array().map(Vec::len), Some(0));

    let detached = run([
        "submit",
        &bench.scene(),
        "--detach",
        "--coordinator",
        &url,
        "--weights",
        &bench.weights(),
        "--json",
        "--depths",
        "40",
    ]);
    let id = detached.expect_code(0).json()["run"].as_str().expect("an id").to_owned();
    assert_eq!(id, "scene-1");
    let waiting = run(["status", &id, "--coordinator", &url, "--json"]).expect_code(0).json();
    assert_eq!((&waiting["state"], &waiting["jobs"]["infer"]["open"]), (&"running".into(), &4.into()));
    let _ = run(["cancel", &id, "--coordinator", &url]).expect_code(0);
    let watched = run(["status", &id, "--watch", "--coordinator", &url]).expect_code(1);
    assert!(watched.stderr.contains("scene-1 was cancelled"), "{}", watched.stderr);
    let unknown = run(["cancel", "no-such-run", "--coordinator", &url]).expect_code(1);
    assert!(unknown.stderr.contains("no-such-run"), "{}", unknown.stderr);

    let (staying, leaving) = (cluster.worker(&[]), cluster.worker(&[]));
    let together = bench.submit("together", &cluster, &[]).wait().expect_code(0).json();
    assert!(together["points"].as_u64() > Some(500), "{}", together["points"]);
    assert_eq!(alone["cloud_blake3"], together["cloud_blake3"]);
    for name in ["cloud.ply", "pair.txt", "depth/00000000.pfm", "confidence/00000003.pfm"] {
        let read = |out: &str| bench.read(&format!("{out}/{name}"));
        assert!(read("alone") == read("together"), "{name} differs");
    }

    let runs = run(["status", "--coordinator", &url, "--json"]).expect_code(0).json();
    let states = ["finished", "cancelled"].map(serde_json::Value::from);
    assert_eq!([&runs["runs"][0]["state"], &runs["runs"][1]["state"]], [&states[0], &states[1]], "{runs}");
    let watched = run(["status", "--watch", "--coordinator", &url, "--json"]).expect_code(0).json();
    assert_eq!(watched["workers"].as_array().map(Vec::len), Some(2));
    let again = bench.submit("again", &cluster, &[]).wait().expect_code(0);
    assert!(again.stderr.contains("13 of 13 jobs are done already"), "{}", again.stderr);

    assert!(send("TERM", leaving.pid()));
    let left = leaving.wait().expect_code(TERMINATED);
    let connected =
        format!("working for {url} as both; slots: 2 for inference, 2 for fusion; maps are served at ");
    assert!(left.stderr.contains(&connected), "{}", left.stderr);
    assert!(left.stderr.contains("another worker may take its place"), "{}", left.stderr);
    assert!(cluster.coordinator().is_running());
    let ended = cluster.drain().wait().expect_code(0);
    assert!(ended.stderr.contains("stopping when the running jobs are done"), "{}", ended.stderr);
    let _ = staying.wait().expect_code(0);
}

#[test]
fn a_run_waits_when_all_workers_are_gone_and_says_so_and_new_ones_carry_on() {
    let bench = of_courtyard();
    calm(&bench, &SLOW);
    let cluster = Cluster::start(&bench, &[]);
    let mut workers = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    let struck = bench.submit("struck", &cluster, &SLOW);
    wait_for_results(&struck, 1);
    for worker in &mut workers {
        assert!(worker.is_running() && send("KILL", worker.pid()));
    }
    assert!(wait_until(DEADLINE, || workers.iter().all(|worker| !is_alive(worker.pid()))));
    let says = |what: &str| wait_until(DEADLINE, || struck.stderr().contains(what));
    assert!(says("no worker is alive; waiting for one"), "{}", struck.stderr());
    let waiting = cluster.status("scene-1", &[])["waiting_seconds"].as_f64();
    assert!(waiting > Some(0.0), "{waiting:?}");
    let _successors = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    assert!(says("workers are back"), "{}", struck.stderr());
    let _ = struck.wait().expect_code(0);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_killed_coordinator_is_restarted_and_loses_nothing() {
    let bench = of_courtyard();
    calm(&bench, &SLOWER);
    let mut cluster = Cluster::start(&bench, &[]);
    let _workers = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    let mut struck = bench.submit("struck", &cluster, &SLOWER);
    for results in [1, 4] {
        wait_for_results(&struck, results);
        assert!(struck.is_running(), "{}", struck.stderr());
        cluster.kill_and_restart(&struck);
    }
    let struck = struck.wait().expect_code(0);
    assert!(struck.stderr.contains("the coordinator is back"), "{}", struck.stderr);
    let status = run(["status", "scene-1", "--coordinator", cluster.url(), "--json"]).expect_code(0).json();
    let done: u64 = ["infer", "filter", "emit", "assemble"]
        .iter()
        .map(|kind| status["jobs"][kind]["done"].as_u64().unwrap_or(0))
        .sum();
    assert_eq!(done, 25, "{status}");
    bench.same_cloud("calm", "struck");
}

#[test]
fn of_two_coordinators_one_goes_and_the_workers_stay() {
    let Some(postgres) = Postgres::start("of_two_coordinators_one_goes_and_the_workers_stay") else { return };
    let bench = of_courtyard();
    calm(&bench, &SLOW);
    let start = || Cluster::start_on(&postgres.url(), &bench.path("store"), Vec::new(), &[]);
    let (going, staying) = (start(), start());
    let both = format!("{},{}", going.url(), staying.url());
    let worker = ["worker", "--coordinator", &both, "--threads", "1", TORCH[0], TORCH[1]];
    let mut workers = [Running::start(worker), Running::start(worker)];
    let alive_at = |cluster: &Cluster| {
        let status =
            run(["status", "scene-1", "--coordinator", cluster.url(), "--json"]).expect_code(0).json();
        let workers = status["workers"].as_array().expect("workers").clone();
        workers.iter().filter(|worker| worker["alive"] == true).count()
    };
    let mut struck = bench.submit_to("struck", &both, &SLOW);
    wait_for_results(&struck, 1);
    assert_eq!((alive_at(&going), alive_at(&staying)), (2, 0));

    let gone = going.drain().wait().expect_code(0);
    assert!(!gone.stderr.contains("stopping at once"), "{}", gone.stderr);
    assert!(struck.is_running() && workers.iter_mut().all(Running::is_running), "{}", struck.stderr());
    assert!(wait_until(DEADLINE, || alive_at(&staying) == 2), "{}", workers[0].stderr());
    let _ = struck.wait().expect_code(0);
    bench.same_cloud("calm", "struck");

    // Both have said that they go, as far as the workers know.
    let _ = staying.drain().wait().expect_code(0);
    for worker in workers {
        let _ = worker.wait().expect_code(0);
    }
}

#[test]
fn a_worker_that_is_sent_away_goes_when_no_other_coordinator_can_be_reached() {
    let bench = Bench::new(|folder| drop(plane_of_size(folder, 4, 160, 128)));
    let cluster = Cluster::start(&bench, &["--lease", "2"]);
    let both = format!("http://127.0.0.1:9,{}", cluster.url());
    let mut worker = Running::start(["worker", "--coordinator", &both, "--device", "analytic"]);
    let _ = bench.submit("done", &cluster, &["--device", "analytic"]).wait().expect_code(0);
    let _ = cluster.drain().wait().expect_code(0);
    assert!(worker.is_running(), "it looks for the other first: {}", worker.stderr());
    let gone = worker.wait().expect_code(0);
    assert!(gone.stderr.contains("no other can be reached"), "{}", gone.stderr);
}

#[test]
fn an_s3_store_that_is_gone_for_a_while_loses_nothing() {
    let bench = of_courtyard();
    calm(&bench, &SLOW);
    let mut server = S3Server::start(Path::new(&bench.path("s3")));
    let ledger = bench.path("ledger.sqlite");
    let cluster = Cluster::start_on(&ledger, &server.store_url(), server.environment(), &[]);
    let workers = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    let mut struck = bench.submit("struck", &cluster, &SLOW);
    wait_for_results(&struck, 1);
    assert!(struck.is_running());
    server.go_away();
    let is_noticed = || workers.iter().any(|worker| worker.stderr().contains("the store does not answer"));
    assert!(wait_until(DEADLINE, is_noticed), "{}", workers[0].stderr());
    server.come_back();
    let _ = struck.wait().expect_code(0);
    let is_mended = || workers.iter().any(|worker| worker.stderr().contains("the store works again"));
    assert!(wait_until(DEADLINE, is_mended), "{}", workers[0].stderr());
    let status = run(["status", "scene-1", "--coordinator", cluster.url(), "--json"]).expect_code(0).json();
    assert_eq!(status["failures"], serde_json::json!([]));
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_postgres_that_restarts_in_the_middle_of_a_run_loses_nothing() {
    let test = "a_postgres_that_restarts_in_the_middle_of_a_run_loses_nothing";
    let Some(mut postgres) = Postgres::start(test) else { return };
    let bench = of_courtyard();
    calm(&bench, &SLOW);
    let cluster = Cluster::start_on(&postgres.url(), &bench.path("store"), Vec::new(), &["-v"]);
    let workers = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    let mut struck = bench.submit("struck", &cluster, &SLOW);
    wait_for_results(&struck, 1);
    postgres.go_away();
    let is_noticed = || cluster.coordinator_stderr().contains("the ledger does not answer");
    assert!(wait_until(DEADLINE, is_noticed), "{}", cluster.coordinator_stderr());
    let cannot = |worker: &Running| worker.stderr().contains("cannot report to the coordinator");
    assert!(wait_until(DEADLINE, || workers.iter().any(cannot)), "{}", workers[0].stderr());
    assert!(struck.is_running() && postgres.come_back(), "{}", struck.stderr());
    let _ = struck.wait().expect_code(0);
    let said = cluster.coordinator_stderr();
    for wrong in ["died or froze", "tried again", "failed for good"] {
        assert!(!said.contains(wrong), "{wrong}: {said}");
    }
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_coordinator_told_twice_to_stop_stops_at_once_and_goes_on_later() {
    let bench = of_courtyard();
    calm(&bench, &SLOW);
    let (ledger, store) = (bench.path("ledger.sqlite"), bench.path("store"));
    let mut cluster = Cluster::start(&bench, &[]);
    let workers = [cluster.worker(&TORCH), cluster.worker(&TORCH)];
    let struck = bench.submit("struck", &cluster, &SLOW);
    wait_for_results(&struck, 1);
    for answer in ["once more stops at once", "stopping at once"] {
        assert!(cluster.coordinator().is_running() && send("INT", cluster.coordinator().pid()));
        let is_answered = || cluster.coordinator_stderr().contains(answer);
        assert!(wait_until(DEADLINE, is_answered), "{}", cluster.coordinator_stderr());
    }
    assert!(wait_until(DEADLINE, || !cluster.coordinator().is_running()), "it does not stop");
    // Its workers are told, too, or find nobody to report to.
    drop(workers);
    drop(struck);
    let again = Cluster::start_on(&ledger, &store, Vec::new(), &[]);
    let unfinished = again.status("scene-1", &[]);
    assert_eq!(unfinished["state"], "running", "{unfinished}");
    let _workers = [again.worker(&TORCH), again.worker(&TORCH)];
    let resumed = bench.submit("struck", &again, &SLOW).wait().expect_code(0);
    assert!(resumed.stderr.contains("of 25 jobs are done already"), "{}", resumed.stderr);
    bench.same_cloud("calm", "struck");
}
