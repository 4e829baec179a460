//! Disks without room, where maps, the ledger and the cloud are written: nothing is lost, and it goes on when there is
//! room.

use std::fs;
use std::path::Path;
use std::time::Duration;

use planesweep_tests::{
    Bench, Cluster, Running, SmallDisk, can_mount, files_below, hiding, plane_of_size, wait_until,
};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
/// Room for everything.
const LARGE: u64 = 256 << 20;
const ANALYTIC: [&str; 2] = ["--device", "analytic"];
const RUN: &str = "scene-1";

/// Eight views of 320 by 256, and the cloud that one undisturbed process makes of them.
fn of_plane() -> Bench {
    let bench = Bench::new(|folder| drop(plane_of_size(folder, 8, 320, 256)));
    let _ = bench.reconstruct("calm", &[&ANALYTIC[..], &["--workers", "1"]].concat()).expect_code(0);
    bench
}

/// Takes all room that is left.
fn fill(disk: &Path) {
    let mut rest = fs::File::create(disk.join("rest")).expect("made");
    while std::io::Write::write_all(&mut rest, &[0; 1024]).is_ok() {}
}

/// No job was tried again or failed for want of room.
#[track_caller]
fn no_attempt_was_used_up(cluster: &Cluster) {
    let said = cluster.coordinator_stderr();
    for wrong in ["tried again", "failed for good", "died or froze"] {
        assert!(!said.contains(wrong), "{wrong}: {said}");
    }
    assert_eq!(cluster.status(RUN, &[])["failures"], serde_json::json!([]));
}

#[test]
fn a_full_disk_under_the_store_is_waited_for_until_there_is_room() {
    let test = "a_full_disk_under_the_store_is_waited_for_until_there_is_room";
    let bench = of_plane();
    let store = bench.path("store");
    // Room for a few depth maps.
    let Some(disk) = SmallDisk::mount(test, Path::new(&store), 160 << 10) else { return };
    if !can_mount(test) {
        return;
    }
    let cluster = Cluster::start(&bench, &["-v"]);
    // One writes itself, the other through the coordinator.
    let given = ["worker", "--coordinator", cluster.url(), "--threads", "1"];
    let blind = Running::start_in_script(&hiding(&[&store]), [&given[..], &ANALYTIC].concat());
    let workers = [cluster.worker(&ANALYTIC), blind];
    let mut struck = bench.submit("struck", &cluster, &ANALYTIC);
    let message = format!("disk full at file://{store}");
    let is_full = || workers.iter().all(|worker| worker.stderr().contains(&message));
    assert!(wait_until(DEADLINE, is_full), "{}\n{}", workers[0].stderr(), workers[1].stderr());
    // Workers claim no more than they hold, although there is more to do.
    let status = cluster.status(RUN, &[]);
    assert!(status["jobs"]["infer"]["done"].as_u64() < Some(8), "{status}");
    let held = |status: &serde_json::Value| status["jobs"]["infer"]["leased"].as_u64();
    assert!(held(&status) <= Some(4) && struck.is_running(), "{status}");
    disk.grow(LARGE);
    let _ = struck.wait().expect_code(0);
    assert!(workers[1].stderr().contains("its blobs go through the coordinator"), "{}", workers[1].stderr());
    let is_mended = || workers.iter().all(|worker| worker.stderr().contains("the store works again"));
    assert!(wait_until(DEADLINE, is_mended), "{}", workers[0].stderr());
    let temporary = files_below(Path::new(&store)).into_iter().find(|name| name.contains('#'));
    assert_eq!(temporary, None);
    no_attempt_was_used_up(&cluster);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_full_disk_under_the_ledger_is_waited_for_until_there_is_room() {
    let test = "a_full_disk_under_the_ledger_is_waited_for_until_there_is_room";
    let bench = of_plane();
    let folder = bench.path("ledger");
    let Some(_disk) = SmallDisk::mount(test, Path::new(&folder), 8 << 20) else { return };
    let ledger = format!("{folder}/ledger.sqlite");
    let cluster = Cluster::start_on(&ledger, &bench.path("store"), Vec::new(), &["-v"]);
    let mut struck = bench.submit("struck", &cluster, &ANALYTIC);
    let is_submitted = || struck.stderr().contains("run scene-1");
    assert!(wait_until(DEADLINE, is_submitted), "{}", struck.stderr());
    fill(Path::new(&folder));
    let workers = [cluster.worker(&ANALYTIC), cluster.worker(&ANALYTIC)];
    let message = format!("disk full at {ledger}");
    // The code tells a full disk from a broken ledger.
    let refusal = format!("no room: {message}");
    let is_told = || workers.iter().all(|worker| worker.stderr().contains(&refusal));
    assert!(wait_until(DEADLINE, is_told), "{}\n{}", workers[0].stderr(), cluster.coordinator_stderr());
    assert!(cluster.coordinator_stderr().contains(&message) && struck.is_running());
    fs::remove_file(format!("{folder}/rest")).expect("there is room again");
    let _ = struck.wait().expect_code(0);
    no_attempt_was_used_up(&cluster);
    bench.same_cloud("calm", "struck");
}

#[test]
fn a_full_disk_under_the_cloud_is_named_and_the_same_command_goes_on() {
    let test = "a_full_disk_under_the_cloud_is_named_and_the_same_command_goes_on";
    let bench = of_plane();
    let out = bench.path("struck");
    let Some(disk) = SmallDisk::mount(test, Path::new(&out), 256 << 10) else { return };
    let cluster = Cluster::start(&bench, &[]);
    let _worker = cluster.worker(&ANALYTIC);
    let struck = bench.submit("struck", &cluster, &ANALYTIC).wait().expect_code(1);
    assert!(struck.stderr.contains(&format!("disk full at {out}")), "{}", struck.stderr);
    assert!(struck.stderr.contains("same command again"), "{}", struck.stderr);
    assert!(!Path::new(&format!("{out}/cloud.ply")).exists());
    // What is there is whole: nothing has a temporary name.
    let names = files_below(Path::new(&out));
    assert!(!names.is_empty() && names.iter().all(|name| !name.contains("tmp")), "{names:?}");
    disk.grow(LARGE);
    let again = bench.submit("struck", &cluster, &ANALYTIC).wait().expect_code(0);
    assert!(again.stderr.contains("25 of 25 jobs are done already"), "{}", again.stderr);
    bench.same_cloud("calm", "struck");
}
