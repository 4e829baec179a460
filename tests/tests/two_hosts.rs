//! Two hosts, simulated by containers: workers of one exchange depth maps by shared memory, those of the other send
//! them as streams and see no photograph and no store, and the cloud is that of one process.

use std::fs;
use std::os::unix::fs::{PermissionsExt, chown};
use std::process::Command;

use planesweep_tests::{Bench, Containers, courtyard, run, shared_data};
use serde_json::Value;

const IMAGE: &str = "planesweep:test";
/// Who the program is in the image.
const USER: u32 = 65532;
const VIEWS: usize = 8;
/// Longest side of the real photographs, in pixels.
const SCEAUX_SIZE: &str = "480";

/// What workers on two hosts make of a scene, hosts being containers: on the first are the coordinator, the client, a
/// worker that fuses and one that infers, which share memory; on the second one that infers and has the token, nothing
/// else. Returns `report.json`.
fn on_two_hosts(containers: &mut Containers, bench: &Bench, name: &str, options: &[&str]) -> Value {
    let shared = bench.path("");
    fs::set_permissions(&shared, fs::Permissions::from_mode(0o777)).expect("the folder is ours");
    let (token, ledger, store) = (bench.path("token"), bench.path("ledger.sqlite"), bench.path("store"));
    fs::write(&token, "s3cret\n").expect("written");
    let services = bench.path("services");
    fs::create_dir(&services).expect("made");
    chown(&services, Some(USER), Some(USER)).expect("this process is root's");
    let network = containers.network(name);
    let full = |role: &str| format!("{name}-{role}");
    let coordinator_url = format!("PLANESWEEP_COORDINATOR=http://{}:7070", full("coordinator"));
    let (volume, secret) = (format!("{shared}:{shared}"), format!("{token}:/run/secrets/token:ro"));
    let services = format!("{services}:/tmp/planesweep-{USER}");
    let anywhere = ["--network", &network, "--volume", &secret, "--tmpfs", "/tmp:size=256m"];
    let told = ["--env", "PLANESWEEP_TOKEN_FILE=/run/secrets/token", "--env", &coordinator_url];
    let anywhere = [&anywhere[..], &told].concat();
    let first = ["--volume", &volume, "--volume", &services];
    let mut start = |role: &str, place: &[&str], command: &[&str]| {
        let name = full(role);
        let alias = ["--network-alias", &name, "--no-healthcheck"];
        containers.run(&name, &[&alias[..], &anywhere, place, &[IMAGE], command].concat())
    };
    let worker = ["worker", "--threads=1", "--listen=0.0.0.0:7071", "--role"];
    let options_of_coordinator =
        ["coordinator", "--listen", "0.0.0.0:7070", "--ledger", &ledger, "--store", &store];
    let coordinator = start("coordinator", &first, &options_of_coordinator);
    let owner = [&first[..], &["--ipc", "shareable", "--shm-size", "256m"]].concat();
    let fuse = start("fuse", &owner, &[&worker[..], &["fuse"]].concat());
    // Owners of shared memory are told apart by their process ids.
    let owned_by = format!("container:{fuse}");
    let sharer = [&first[..], &["--ipc", &owned_by, "--pid", &owned_by]].concat();
    let near = start("near", &sharer, &[&worker[..], &["infer"]].concat());
    let cache = ["--env", "PLANESWEEP_CACHE=/tmp/photographs"];
    let far = start("far", &cache, &[&worker[..], &["infer"]].concat());
    let (scene, out) = (bench.scene(), bench.path("together"));
    let submit = [&["submit", &scene, "-o", &out, "--upload"], options].concat();
    let client = start("client", &first, &submit);
    let ended = containers.docker(&["wait", &client]);
    let logs = |of: &str| containers.logs(of);
    assert_eq!(ended, "0", "{}\n{}\n{}\n{}", logs(&client), logs(&near), logs(&far), logs(&fuse));
    assert!(logs(&far).contains("its blobs go through the coordinator"), "{}", logs(&far));
    for container in [&near, &far, &fuse, &coordinator] {
        containers.docker(&["kill", container]);
    }
    serde_json::from_slice(&bench.read("together/report.json")).expect("a report")
}

#[test]
fn hosts_of_containers_exchange_by_memory_and_streams_and_give_the_cloud_of_one_process() {
    let test = "hosts_of_containers_exchange_by_memory_and_streams_and_give_the_cloud_of_one_process";
    let Some(mut containers) = Containers::new(test) else { return };
    if !containers.make_image(test, IMAGE) {
        return;
    }
    let bench = Bench::new(|folder| courtyard(folder, VIEWS, 320, 256));
    let _ = bench.reconstruct("alone", &["--workers", "1"]).expect_code(0);
    let weights = bench.weights();
    let easy = ["--min-confidence", "0", "--min-views", "1", "--views", "3", "--depths", "32"];
    let report =
        on_two_hosts(&mut containers, &bench, "courtyard", &[&["--weights", &weights], &easy[..]].concat());
    let maps = |way: &str| report["maps_by_way"][way].as_u64();
    assert!(maps("by shared memory") > Some(0) && maps("by stream") > Some(0), "{}", report["maps_by_way"]);
    assert!(report["images_fetched"].as_u64() > Some(0), "{report}");
    let cloud = bench.read("together/cloud.ply");
    assert!(cloud.len() > 10_000 && cloud == bench.read("alone/cloud.ply"), "the clouds differ");

    // Real photographs, and the weights of the program.
    let Some(sceaux) = shared_data(test, "colmap/sceaux") else { return };
    let bench = Bench::new(|folder| {
        let copied = Command::new("cp").arg("-r").args([&sceaux, folder]).status().expect("cp starts");
        assert!(copied.success(), "{} cannot be copied", sceaux.display());
    });
    let size = ["--max-size", SCEAUX_SIZE];
    let alone = ["reconstruct", &bench.scene(), "-o", &bench.path("alone"), "--workers", "1"];
    let _ = run([&alone[..], &size].concat()).expect_code(0);
    let report = on_two_hosts(&mut containers, &bench, "sceaux", &size);
    eprintln!(
        "sceaux at {SCEAUX_SIZE}: {} points; maps {}; {} photographs fetched",
        report["totals"]["points"], report["maps_by_way"], report["images_fetched"]
    );
    let cloud = bench.read("together/cloud.ply");
    assert!(cloud.len() > 10_000 && cloud == bench.read("alone/cloud.ply"), "the clouds of sceaux differ");
}
