//! The cluster of `docker/compose.yaml`: the cloud is that of one process, although a worker is killed and the
//! coordinator stopped.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::Duration;

use planesweep_tests::{Bench, Composition, Containers, courtyard, wait_until};
use serde_json::{Value, json};

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(2);
const IMAGE: &str = "planesweep:test";
const RUN: &str = "scene-1";
const VIEWS: usize = 8;
/// Each view is slow enough for a fault to meet it, also because no worker gets a whole processor.
const SLOW: [&str; 2] = ["--depths", "128"];

/// What `planesweep status` says within the coordinator's container; `None` while it cannot.
fn status(containers: &Containers, coordinator: &str) -> Option<Value> {
    // Each question is a process.
    std::thread::sleep(Duration::from_millis(200));
    let ask = ["exec", coordinator, "planesweep", "status", RUN, "--json"];
    let (answered, said) = containers.try_docker(&ask);
    serde_json::from_str(&said).ok().filter(|_| answered)
}

/// The id of the living worker in the container of this id, which begins with its process's.
fn living<'a>(status: &'a Value, host: &str) -> Option<&'a str> {
    let mut workers = status["workers"].as_array()?.iter();
    workers.find(|worker| worker["host"] == host && worker["alive"] == true)?["worker"].as_str()
}

#[test]
fn the_composition_survives_a_dead_worker_and_gives_the_cloud_of_one_process() {
    let test = "the_composition_survives_a_dead_worker_and_gives_the_cloud_of_one_process";
    let Some(containers) = Containers::new(test) else { return };
    if !containers.make_image(test, IMAGE) {
        return;
    }
    let bench = Bench::new(|folder| courtyard(folder, VIEWS, 320, 256));
    let _ = bench.reconstruct("calm", &SLOW).expect_code(0);
    // An ordinary user reads it there.
    let scenes = bench.path("");
    fs::set_permissions(&scenes, fs::Permissions::from_mode(0o755)).expect("the folder is ours");
    let s3_server = Path::new(env!("CARGO_BIN_EXE_s3_server"));
    let Some(cluster) = Composition::new(test, &containers, IMAGE, &scenes, s3_server) else { return };
    cluster.compose(&["up", "--detach", "--no-build", "--scale", "infer=2"]);
    let (coordinator, killed) = (cluster.container("coordinator", 1), cluster.container("infer", 1));

    // All are healthy, none is root, and none can write but where it should.
    let named = [("coordinator", 1), ("fuse", 1), ("infer", 1), ("infer", 2)];
    let ours = named.map(|(service, number)| cluster.container(service, number));
    for container in ours.iter().chain([&cluster.container("shared", 1)]) {
        let made = containers.inspect(container);
        let host = &made["HostConfig"];
        assert_eq!(made["Config"]["User"], "65532:65532", "{container}");
        assert_eq!(host["ReadonlyRootfs"], true, "{container}");
        assert_eq!(host["CapDrop"], json!(["ALL"]), "{container}");
        assert_eq!(host["SecurityOpt"], json!(["no-new-privileges:true"]), "{container}");
    }
    for container in &ours {
        let is_healthy = || containers.state(container)["Health"]["Status"] == "healthy";
        assert!(wait_until(DEADLINE, is_healthy), "{container}: {}", containers.logs(container));
    }

    let in_container = |path: &str| path.replace(&scenes, "/scenes/");
    let (scene, weights) = (in_container(&bench.scene()), in_container(&bench.weights()));
    let client = cluster.container("client", 1);
    let run = ["run", "--detach", "--name", &client, "submit", &scene, "-o", "out", "--weights", &weights];
    let settings = ["--min-confidence", "0", "--min-views", "1", "--views", "3"];
    cluster.compose(&[&run[..], &settings, &SLOW].concat());

    // A worker dies as it infers, and is started again.
    let host = containers.inspect(&killed)["Config"]["Hostname"].as_str().expect("a name").to_owned();
    let mut last = None;
    let is_busy = |status: &Value| {
        let workers = status["workers"].as_array().expect("workers");
        workers.iter().any(|worker| worker["host"] == host && worker["jobs"].as_u64() > Some(0))
    };
    wait_until(DEADLINE, || {
        last = status(&containers, &coordinator);
        last.as_ref().is_some_and(|status| is_busy(status) || status["state"] != "running")
    });
    let Some(before) = last.filter(is_busy) else { panic!("it gets no job: {}", containers.logs(&client)) };
    let worker = living(&before, &host).expect("it is alive").to_owned();
    let pid = worker.split('-').nth(1).expect("a worker's id has its process's");
    // Docker would not start again what Docker has killed. The command may die with its container.
    let _ = containers.try_docker(&["exec", &killed, "sh", "-c", &format!("kill -9 {pid}")]);
    let is_back = || {
        let now = containers.inspect(&killed);
        now["RestartCount"].as_u64() > Some(0) && now["State"]["Running"] == true
    };

    // The coordinator dies, too, before the run can end; what it knew is in PostgreSQL.
    cluster.compose(&["stop", "coordinator"]);
    assert_eq!(containers.state(&coordinator)["ExitCode"], 128 + 9);
    let is_missed = || containers.logs(&client).contains("the coordinator does not answer");
    assert!(wait_until(DEADLINE, is_missed), "{}", containers.logs(&client));
    assert!(wait_until(DEADLINE, is_back), "{}", containers.logs(&killed));
    cluster.compose(&["start", "coordinator"]);
    let replaced = wait_until(DEADLINE, || {
        let status = status(&containers, &coordinator);
        status.is_some_and(|status| living(&status, &host).is_some_and(|other| other != worker))
    });
    assert!(replaced, "{}", containers.logs(&killed));
    let ended = containers.docker(&["wait", &client]);
    assert_eq!(ended, "0", "{}", containers.logs(&client));

    let read = |name: &str| {
        let path = format!("out/{name}");
        cluster.compose(&["run", "--rm", "--no-TTY", "--entrypoint", "cat", "submit", &path])
    };
    let cloud = read("cloud.ply");
    assert!(cloud.len() > 10_000 && cloud == bench.read("calm/cloud.ply"), "the clouds differ");
    let report: Value = serde_json::from_slice(&read("report.json")).expect("a report");
    let ways = &report["maps_by_way"];
    assert!(ways["by shared memory"].as_u64() > Some(0), "{ways}");

    // Stopped, workers say that they were not done; removed, all is gone but the volumes, which go when told.
    cluster.compose(&["stop", "fuse", "infer"]);
    for worker in &ours[1..] {
        assert_eq!(containers.state(worker)["ExitCode"], 75, "{}", containers.logs(worker));
    }
    let label = format!("label=com.docker.compose.project={}", cluster.project());
    let volumes = || containers.docker(&["volume", "ls", "--quiet", "--filter", &label]);
    containers.docker(&["rm", &client]);
    cluster.compose(&["down"]);
    assert_eq!(containers.docker(&["ps", "--all", "--quiet", "--filter", &label]), "");
    assert_ne!(volumes(), "");
    cluster.compose(&["--profile", "submit", "down", "--volumes"]);
    assert_eq!(volumes(), "");

    // The images that stood in go, too.
    let images = "reference=planesweep-standin-*";
    let standins = || containers.docker(&["image", "ls", "--quiet", "--filter", images]);
    assert_eq!(standins().lines().count(), 2, "{}", standins());
    drop(cluster);
    assert_eq!(standins(), "");
}
