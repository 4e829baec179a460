//! A cluster of containers on two networks, as `docker/compose.yaml` starts it: the cloud is that of one process,
//! although a worker is killed, another is cut off for a while and the coordinator dies.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use planesweep_tests::{Bench, Containers, courtyard, wait_until};
use serde_json::Value;

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
const IMAGE: &str = "planesweep:test";
const RUN: &str = "scene-1";
const VIEWS: usize = 8;
/// Each view is slow enough for a fault to meet it, also because no worker gets a whole processor.
const SLOW: [&str; 2] = ["--depths", "128"];
const WORKER: [&str; 8] =
    ["--cpus", "0.5", "--no-healthcheck", IMAGE, "worker", "--device", "torch", "--threads=1"];

/// The containers, and how far their run is.
struct Scenario<'a> {
    containers: &'a Containers,
    coordinator: &'a str,
}

impl Scenario<'_> {
    /// What `planesweep status` says within the coordinator's container; `None` while it cannot.
    fn status(&self) -> Option<Value> {
        // Each question is a process.
        std::thread::sleep(Duration::from_millis(200));
        let ask = ["exec", self.coordinator, "planesweep", "status", RUN, "--json"];
        let (answered, said) = self.containers.try_docker(&ask);
        serde_json::from_str(&said).ok().filter(|_| answered)
    }

    /// Waits until the status has something.
    #[track_caller]
    fn wait_for(&self, what: &str, is_there: impl Fn(&Value) -> bool) -> Value {
        let mut last = None;
        let came = wait_until(DEADLINE, || {
            last = self.status();
            last.as_ref().is_some_and(&is_there)
        });
        assert!(came, "{what} does not come: {last:?}\n{}", self.containers.logs(self.coordinator));
        last.expect("there was a status")
    }

    #[track_caller]
    fn wait_for_health(&self) {
        let is_healthy = || self.containers.state(self.coordinator)["Health"]["Status"] == "healthy";
        assert!(wait_until(DEADLINE, is_healthy), "{}", self.containers.logs(self.coordinator));
    }
}

fn worker<'a>(status: &'a Value, host: &str) -> Option<&'a Value> {
    status["workers"].as_array()?.iter().find(|worker| worker["host"] == host)
}

fn is_alive(status: &Value, host: &str) -> bool {
    worker(status, host).is_some_and(|worker| worker["alive"] == true)
}

fn is_busy(status: &Value, host: &str) -> bool {
    worker(status, host).is_some_and(|worker| worker["jobs"].as_u64() > Some(0))
}

#[test]
fn containers_on_two_networks_survive_kill_partition_and_restart() {
    let test = "containers_on_two_networks_survive_kill_partition_and_restart";
    let Some(mut containers) = Containers::new(test) else { return };
    if !containers.make_image(test, IMAGE) {
        return;
    }
    let bench = Bench::new(|folder| courtyard(folder, VIEWS, 320, 256));
    let _ = bench.reconstruct("calm", &[&SLOW[..], &["--device", "torch"]].concat()).expect_code(0);

    // In the containers an ordinary user writes to the folder that they share with this process.
    let shared = bench.path("");
    fs::set_permissions(&shared, fs::Permissions::from_mode(0o777)).expect("the folder is ours");
    let (token, ledger, store) = (bench.path("token"), bench.path("ledger.sqlite"), bench.path("store"));
    fs::write(&token, "s3cret\n").expect("written");
    let volume = format!("{shared}:{shared}");
    let secret = format!("{token}:/run/secrets/token:ro");
    let common = [
        "--volume",
        &volume,
        "--volume",
        &secret,
        "--tmpfs",
        "/tmp:size=64m",
        "--env",
        "PLANESWEEP_TOKEN_FILE=/run/secrets/token",
        "--env",
        "PLANESWEEP_COORDINATOR=http://coordinator:7070",
    ];

    let (north, south) = (containers.network("north"), containers.network("south"));
    let options = ["--listen", "0.0.0.0:7070", "--ledger", &ledger, "--store", &store, "--lease", "3"];
    let listen = ["--network-alias", "coordinator", "--health-interval", "1s", IMAGE, "coordinator"];
    let command = [&["--network", &north][..], &common, &listen, &options].concat();
    let coordinator = containers.run("coordinator", &command);
    containers.docker(&["network", "connect", "--alias", "coordinator", &south, &coordinator]);
    let mut place = |name: &str, network: &str, role: &str| {
        containers.run(name, &[&["--network", network][..], &common, &WORKER, &["--role", role]].concat())
    };
    let _fuse = place("fuse", &north, "fuse");
    let (killed, cut) = (place("killed", &north, "infer"), place("cut", &south, "infer"));
    let (scene, out, weights) = (bench.scene(), bench.path("struck"), bench.weights());
    let submit = ["--no-healthcheck", IMAGE, "submit", &scene, "-o", &out, "--weights", &weights];
    let settings = ["--min-confidence", "0", "--min-views", "1", "--views", "3"];
    let command = [&["--network", &north][..], &common, &submit, &settings, &SLOW].concat();
    let client = containers.run("client", &command);
    let containers = &containers;
    let scenario = Scenario { containers, coordinator: &coordinator };
    scenario.wait_for_health();

    // Both infer; then one is killed, and the other loses its network.
    let both = scenario.wait_for("work for both", |s| is_busy(s, "killed") && is_busy(s, "cut"));
    containers.docker(&["kill", &killed]);
    containers.docker(&["network", "disconnect", &south, &cut]);
    assert!(
        both["state"] == "running" && both["jobs"]["infer"]["done"].as_u64() < Some(VIEWS as u64),
        "{both}"
    );
    let lost = scenario.wait_for("their loss", |s| !is_alive(s, "killed") && !is_alive(s, "cut"));
    assert!(lost["state"] == "running" && is_alive(&lost, "fuse"), "{lost}");
    assert_eq!(containers.state(&killed)["ExitCode"], 128 + 9);
    assert_eq!(containers.state(&cut)["Running"], true);

    // The coordinator dies and comes back on its ledger.
    containers.docker(&["kill", &coordinator]);
    assert_eq!(containers.state(&coordinator)["Running"], false);
    let is_missed = || containers.logs(&client).contains("the coordinator does not answer");
    assert!(wait_until(DEADLINE, is_missed), "{}", containers.logs(&client));
    containers.docker(&["start", &coordinator]);
    scenario.wait_for_health();
    let waiting = scenario.wait_for("the run", |s| is_alive(s, "fuse"));
    assert!(waiting["state"] == "running" && !is_alive(&waiting, "cut"), "{waiting}");

    // The network heals; the same worker does what is left.
    containers.docker(&["network", "connect", &south, &cut]);
    scenario.wait_for("its return", |s| is_alive(s, "cut"));
    assert!(containers.logs(&cut).contains("cannot report to the coordinator"), "{}", containers.logs(&cut));
    let ended = containers.docker(&["wait", &client]);
    assert_eq!(ended, "0", "{}", containers.logs(&client));
    assert!(containers.logs(&client).contains("the coordinator is back"), "{}", containers.logs(&client));
    let cloud = bench.read("struck/cloud.ply");
    assert!(cloud.len() > 10_000 && cloud == bench.read("calm/cloud.ply"), "the clouds differ");

    // A worker that its platform ends says so.
    containers.docker(&["stop", "--time", "60", &cut]);
    assert_eq!(containers.state(&cut)["ExitCode"], 75, "{}", containers.logs(&cut));
}
