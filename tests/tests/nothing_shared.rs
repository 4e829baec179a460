//! Workers and clients with the coordinator's address and a token, that see neither the photographs nor the store:
//! the cloud is that of one process.

use std::fs;
use std::path::Path;
use std::time::Duration;

use planesweep_plan::BlobKey;
use planesweep_tests::{
    Bench, Cluster, Finished, Running, can_mount, courtyard, files_below, hiding, mounted, plane_of_size,
    send, wait_until,
};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
/// Views of the scene whose photographs are slow to come.
const VIEWS: u32 = 6;
const THROUGH: &str = "its blobs go through the coordinator";
/// Exit code of a worker that gets SIGTERM.
const TERMINATED: i32 = 75;

/// Starts a worker that sees neither the photographs nor the store, and keeps what it gets in the folder `cache`.
fn blind_worker(bench: &Bench, cluster: &Cluster, more: &[&str]) -> Running {
    worker_in(&hiding(&[&bench.scene(), &bench.path("store")]), bench, cluster, more)
}

/// The same by a shell script, which has the program in `"$0" "$@"`.
fn worker_in(script: &str, bench: &Bench, cluster: &Cluster, more: &[&str]) -> Running {
    let script = format!("export PLANESWEEP_LOG=warn,planesweep_worker=debug; {script}");
    let cache = bench.path("cache");
    let given = ["worker", "--coordinator", cluster.url(), "--threads", "1", "--cache", &cache];
    Running::start_in_script(&script, [&given[..], more].concat())
}

/// Files in the cache of photographs; each is whole.
#[track_caller]
fn kept(bench: &Bench) -> usize {
    let folder = bench.path("cache");
    let mut files = files_below(Path::new(&folder));
    files.retain(|name| name != "lock");
    for name in &files {
        let bytes = fs::read(Path::new(&folder).join(name)).expect("a file");
        assert_eq!(&BlobKey::of(&bytes).to_string(), name, "{} bytes", bytes.len());
    }
    files.len()
}

#[track_caller]
fn images_fetched(run: &Finished) -> u64 {
    run.json()["report"]["images_fetched"].as_u64().expect("a number of photographs")
}

#[test]
fn an_address_and_a_token_are_enough_and_no_photograph_comes_twice() {
    if !can_mount("an_address_and_a_token_are_enough_and_no_photograph_comes_twice") {
        return;
    }
    let bench = Bench::new(|folder| courtyard(folder, 4, 160, 128));
    let alone = bench.reconstruct("alone", &["--workers", "1"]).expect_code(0);
    assert_eq!(images_fetched(&alone), 0);
    let token = bench.path("token");
    fs::write(&token, "s3cret\n").expect("written");
    let shown = ["--token-file", &token];
    let cluster = Cluster::start(&bench, &shown);

    let worker = blind_worker(&bench, &cluster, &shown);
    let script = hiding(&[&bench.path("store")]);
    let first = bench.submit_in_script(&script, "first", cluster.url(), &shown).wait().expect_code(0);
    assert!(first.stderr.contains("4 of 4 photographs and masks uploaded"), "{}", first.stderr);
    assert!(first.stderr.contains(THROUGH) && worker.stderr().contains(THROUGH), "{}", worker.stderr());
    assert_eq!((images_fetched(&first), kept(&bench)), (4, 4), "{}", worker.stderr());
    bench.same_cloud("alone", "first");
    assert!(send("TERM", worker.pid()));
    let _ = worker.wait().expect_code(TERMINATED);

    // One that may not write to the store does not see it either.
    let store = bench.path("store");
    let unwritable = mounted(&[
        format!("mount -t tmpfs tmpfs {}", bench.scene()),
        format!("mount --bind {store} {store}"),
        format!("mount -o remount,bind,ro {store}"),
    ]);
    let worker = worker_in(&unwritable, &bench, &cluster, &shown);
    let again = [&shown[..], &["--depths", "40"]].concat();
    let second = bench.submit_in_script(&script, "second", cluster.url(), &again).wait().expect_code(0);
    assert!(second.stderr.contains("0 of 4 photographs and masks uploaded"), "{}", second.stderr);
    assert!(!second.stderr.contains("jobs are done already"), "{}", second.stderr);
    assert_eq!((images_fetched(&second), kept(&bench)), (0, 4), "{}", worker.stderr());
    assert!(worker.stderr().contains(THROUGH), "{}", worker.stderr());
}

#[test]
fn a_worker_killed_while_it_downloads_leaves_nothing_half() {
    if !can_mount("a_worker_killed_while_it_downloads_leaves_nothing_half") {
        return;
    }
    // Photographs of some megabytes, for no file format makes noise smaller.
    let bench = Bench::new(|folder| {
        for view in plane_of_size(folder, VIEWS, 1200, 900).views.values() {
            let mut noise = u64::from(view.id.0);
            let pixel = |_, _| {
                noise = noise.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                image::Rgb([(noise >> 40) as u8, (noise >> 48) as u8, (noise >> 56) as u8])
            };
            image::RgbImage::from_fn(1200, 900, pixel).save(&view.image).expect("written");
        }
    });
    let analytic = ["--device", "analytic"];
    let _ = bench.reconstruct("alone", &[&analytic[..], &["--workers", "1"]].concat()).expect_code(0);
    let mut cluster = Cluster::start(&bench, &[]);
    let mut run = bench.submit("struck", &cluster, &[&analytic[..], &["--upload"]].concat());
    let is_uploaded = || run.stderr().contains("6 of 6 photographs and masks uploaded");
    assert!(wait_until(DEADLINE, is_uploaded), "{}", run.stderr());

    let mut struck = blind_worker(&bench, &cluster, &analytic);
    let count = |what: &str| struck.stderr().matches(what).count();
    assert!(wait_until(DEADLINE, || count("fetching from the store") > 0), "{}", struck.stderr());
    assert!(send("STOP", cluster.coordinator().pid()));
    // The photograph under way does not come any more.
    let downloads = || {
        let state = (count("fetching from the store"), count(" fetched"));
        std::thread::sleep(Duration::from_millis(300));
        state.0 > state.1 && state == (count("fetching from the store"), count(" fetched"))
    };
    assert!(wait_until(DEADLINE, downloads), "{}", struck.stderr());
    assert!(struck.is_running() && send("KILL", struck.pid()) && run.is_running());
    assert!(wait_until(DEADLINE, || !struck.is_running()));
    assert!(send("CONT", cluster.coordinator().pid()));
    let kept_then = kept(&bench);
    assert!(kept_then < VIEWS as usize, "nothing was under way");

    let _successor = blind_worker(&bench, &cluster, &analytic);
    let run = run.wait().expect_code(0);
    assert_eq!(images_fetched(&run), u64::from(VIEWS) - kept_then as u64, "the rest, and only the rest");
    assert_eq!(kept(&bench), VIEWS as usize);
    bench.same_cloud("alone", "struck");
}
