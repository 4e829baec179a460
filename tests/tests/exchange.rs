//! Maps on their way between the processes of real runs, and what happens when shared memory fails: the
//! cloud stays the same bytes, and the report tells how the maps came.

use std::time::Duration;

use planesweep_tests::{
    Bench, Finished, Running, can_mount, children, courtyard, is_alive, send, wait_until,
};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);

/// Eight views on the plain network, slow enough for faults to meet it.
const ALONE: [&str; 6] = ["--workers", "1", "--depths", "64", "--device", "torch"];
/// The same by two workers that infer and one that fuses.
const APART: [&str; 7] = ["--fusion-worker", "--workers", "2", "--depths", "64", "--device", "torch"];
const WARNING: &str = "maps do not go through shared memory";

fn of_courtyard() -> Bench {
    Bench::new(|folder| courtyard(folder, 8, 320, 256))
}

#[track_caller]
fn maps(run: &Finished, way: &str) -> u64 {
    run.json()["report"]["maps_by_way"][way].as_u64().expect("a number of maps")
}

/// A `/dev` with nothing in it but what every program needs.
const BARE_DEV: &str = "dev=$(mktemp -d) && mount -t tmpfs tmpfs $dev && \
    for d in null zero full random urandom tty; do touch $dev/$d && mount --bind /dev/$d $dev/$d || exit 9; done; \
    mount --rbind $dev /dev && [ ! -e /dev/shm ]";

/// Runs with a shared memory of its own, which this command makes.
fn start_with_memory(bench: &Bench, mount: &str, out: &str, run: &str) -> Running {
    let script = format!("exec unshare -m sh -c '{mount} || exit 9; {run}' \"$0\" \"$@\"");
    bench.start_in_script(&script, out, &APART)
}

#[test]
fn maps_reach_the_fusion_worker_through_shared_memory() {
    let bench = of_courtyard();
    let alone = bench.reconstruct("alone", &ALONE).expect_code(0);
    assert!(maps(&alone, "in process") > 0, "{}", alone.stdout);
    assert_eq!(maps(&alone, "by shared memory") + maps(&alone, "by stream"), 0, "{}", alone.stdout);

    let apart = bench.reconstruct("apart", &APART).expect_code(0);
    // All but those that were made before the fusion worker had reported.
    assert!(maps(&apart, "by shared memory") >= 4, "{}", apart.stdout);
    assert!(!apart.stderr.contains(WARNING), "{}", apart.stderr);
    bench.same_cloud("alone", "apart");
}

#[test]
fn workers_that_share_no_memory_send_maps_as_streams() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("alone", &ALONE).expect_code(0);
    let pair = ["--workers", "2", "--depths", "64", "--device", "torch"];
    let pair = bench.reconstruct("pair", &pair).expect_code(0);
    assert!(maps(&pair, "by stream") > 0, "{}", pair.stdout);
    assert_eq!(maps(&pair, "by shared memory"), 0, "{}", pair.stdout);
    bench.same_cloud("alone", "pair");
}

#[test]
fn full_and_absent_shared_memory_is_done_without() {
    if !can_mount("full_and_absent_shared_memory_is_done_without") {
        return;
    }
    let bench = of_courtyard();
    let _ = bench.reconstruct("alone", &ALONE).expect_code(0);
    for (out, mount, said) in [
        ("full", "mount -t tmpfs -o size=2m tmpfs /dev/shm", "MiB left"),
        ("read-only", "mount -t tmpfs -o ro tmpfs /dev/shm", "there is no shared memory"),
        ("absent", BARE_DEV, "there is no shared memory"),
    ] {
        let run = start_with_memory(&bench, mount, out, "exec \"$0\" \"$@\"").wait().expect_code(0);
        assert_eq!(run.stderr.matches(WARNING).count(), 1, "{}", run.stderr);
        assert!(run.stderr.contains(said), "{}", run.stderr);
        assert!(!run.stderr.contains("ended before its time"), "{}", run.stderr);
        assert_eq!(maps(&run, "by shared memory"), 0, "{}", run.stdout);
        assert!(maps(&run, "by stream") > 0, "{}", run.stdout);
        bench.same_cloud("alone", out);
    }
}

#[test]
fn shared_memory_that_fills_up_in_the_middle_ends_no_worker() {
    if !can_mount("shared_memory_that_fills_up_in_the_middle_ends_no_worker") {
        return;
    }
    let bench = of_courtyard();
    let _ = bench.reconstruct("alone", &ALONE).expect_code(0);
    // When both senders have their segments, all the rest is taken again and again.
    let run = r#""$0" "$@" & run=$!
        until [ "$(du -sk /dev/shm | cut -f1)" -gt 5000 ]; do kill -0 $run || exit 8; sleep 0.1; done
        sleep 0.5
        while kill -0 $run 2>/dev/null; do
            dd if=/dev/zero of=/dev/shm/rest bs=64k 2>&1 | grep -q "No space left" && filled=yes
            sleep 0.1
        done
        wait $run; code=$?
        echo "filled: $filled" >&2
        exit $code"#;
    let run = start_with_memory(&bench, "mount -t tmpfs -o size=24m tmpfs /dev/shm", "filled", run)
        .wait()
        .expect_code(0);
    assert!(run.stderr.contains("filled: yes"), "{}", run.stderr);
    assert!(maps(&run, "by shared memory") > 0, "{}", run.stdout);
    assert!(!run.stderr.contains("ended before its time"), "{}", run.stderr);
    bench.same_cloud("alone", "filled");
}

#[test]
fn killed_ends_of_shared_memory_are_replaced_and_change_no_byte() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("alone", &ALONE).expect_code(0);
    let mut run = bench.start("struck", &APART);
    for role in ["fuse", "infer"] {
        let mut workers = Vec::new();
        let is_there = wait_until(DEADLINE, || {
            workers = children(run.pid(), role);
            !workers.is_empty()
        });
        assert!(is_there, "no worker of role {role}: {}", run.stderr());
        let done = |line: &str| line.split_once("/25 jobs").and_then(|(done, _)| done.parse().ok());
        let has_begun =
            wait_until(DEADLINE, || run.stderr().lines().filter_map(done).any(|jobs: usize| jobs > 0));
        assert!(has_begun, "{}", run.stderr());
        let struck = workers[0];
        assert!(is_alive(struck) && send("KILL", struck) && run.is_running(), "{}", run.stderr());
        let replaced = || children(run.pid(), role).iter().any(|pid| !workers.contains(pid));
        assert!(wait_until(DEADLINE, replaced), "{}", run.stderr());
    }
    let run = run.wait().expect_code(0);
    assert_eq!(run.stderr.matches("a worker ended before its time").count(), 2, "{}", run.stderr);
    assert!(maps(&run, "by shared memory") > 0, "{}", run.stdout);
    bench.same_cloud("alone", "struck");
}
