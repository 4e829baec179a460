//! The jobs of `deploy/slurm` on a real Slurm of one node: the cloud is that of one process, although the workers are
//! preempted and the coordinator reaches its time limit.

use std::ffi::OsStr;
use std::fs;
use std::net::ToSocketAddrs;
use std::path::Path;
use std::time::Duration;

use planesweep_tests::{Bench, Running, Slurm, courtyard, free_port, program, wait_until};
use serde_json::Value;

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(5);
/// Each view is slow enough for a fault to meet it.
const SLOW: [&str; 4] = ["--depths", "128", "--device", "torch"];

fn sbatch(name: &str) -> String {
    format!("{}/../deploy/slurm/{name}.sbatch", env!("CARGO_MANIFEST_DIR"))
}

/// Waits for a state; `folder` has the output of the jobs.
#[track_caller]
fn wait_for(what: &str, slurm: &Slurm, folder: &Path, mut is_there: impl FnMut() -> bool) {
    let came = wait_until(DEADLINE, || {
        // Each question is a process.
        std::thread::sleep(Duration::from_millis(200));
        is_there()
    });
    let logs = || {
        let files = fs::read_dir(folder).into_iter().flatten().flatten();
        let logs = files.filter(|file| file.file_name().to_string_lossy().ends_with(".log"));
        logs.filter_map(|file| fs::read_to_string(file.path()).ok()).collect::<String>()
    };
    assert!(came, "{what} does not come:\n{}\n{}", logs(), slurm.describe());
}

#[test]
fn jobs_of_slurm_survive_preemption_and_time_limit() {
    let test = "jobs_of_slurm_survive_preemption_and_time_limit";
    let Some(slurm) = Slurm::new(test) else { return };
    let node = fs::read_to_string("/proc/sys/kernel/hostname").expect("a node has a name");
    let bench = Bench::new(|folder| courtyard(folder, 8, 320, 256));
    let _ = bench.reconstruct("calm", &[&SLOW[..], &["--workers", "2"]].concat()).expect_code(0);

    let shared = bench.path("shared");
    fs::create_dir(&shared).expect("made");
    let folder = Path::new(&shared);
    let port = free_port().to_string();
    let binaries = program().parent().expect("a program lies in a folder");
    let path = [binaries.as_os_str(), std::env::var_os("PATH").unwrap_or_default().as_os_str()]
        .join(OsStr::new(":"));
    let variables: [(&str, &OsStr); 5] = [
        ("PLANESWEEP_SHARED", shared.as_ref()),
        ("PLANESWEEP_HOST", "127.0.0.1".as_ref()),
        ("PLANESWEEP_PORT", port.as_ref()),
        // Workers say where they serve their maps.
        ("PLANESWEEP_LOG", "info".as_ref()),
        ("PATH", &path),
    ];
    let coordinator = slurm.batch(folder, &["--partition=service", &sbatch("coordinator")], &variables);
    let worker = sbatch("worker");
    // What is given here counts before what the script gives.
    let workers = ["--array=0-1", "--cpus-per-task=1", &worker, "--device", "torch", "--threads", "1"];
    let workers = slurm.batch(folder, &workers, &variables);
    wait_for("the coordinator's address", &slurm, folder, || folder.join("address").exists());
    let url = format!("http://127.0.0.1:{port}");
    let token = format!("{shared}/token");
    let mut struck = bench.submit_to("struck", &url, &[&SLOW[..], &["--token-file", &token]].concat());
    let has_result = |run: &Running| run.stderr().lines().any(|line| line.contains("/25 jobs"));
    wait_for("a result", &slurm, folder, || has_result(&struck) || !struck.is_running());
    assert!(struck.is_running(), "{}", struck.stderr());

    // An urgent job takes all processors but the coordinator's.
    let urgent = slurm.batch(folder, &["--partition=urgent", "--ntasks=3", "--wrap=sleep 1"], &[]);
    let is_preempted =
        || ["0", "1"].iter().all(|task| slurm.field(&format!("{workers}_{task}"), "Restarts") != "0");
    wait_for("the preemption", &slurm, folder, is_preempted);
    wait_for("the urgent job's end", &slurm, folder, || slurm.field(&urgent, "JobState") == "COMPLETED");

    let log = |task: u32| fs::read_to_string(folder.join(format!("planesweep-worker-{workers}-{task}.log")));
    for task in [0, 1] {
        let log = log(task).expect("a job has a log");
        assert!(log.contains("stopped by SIGTERM"), "a worker was ended, not told to go: {log}");
    }
    assert!(struck.is_running(), "{}", struck.stderr());

    // What comes a minute before the time limit.
    slurm.ask("scancel", &["--batch", "--signal=TERM", &coordinator]);
    wait_for("the requeue", &slurm, folder, || slurm.field(&coordinator, "Restarts") != "0");
    let struck = struck.wait().expect_code(0);
    assert!(struck.stderr.contains("the coordinator is back"), "{}", struck.stderr);
    let cloud = bench.read("struck/cloud.ply");
    assert!(cloud.len() > 10_000 && cloud == bench.read("calm/cloud.ply"), "the clouds differ");

    // Other nodes would find a worker by the name of its node, and its maps come from there.
    for task in [0, 1] {
        let log = log(task).expect("a job has a log");
        let address = format!("maps are served at http://{}:", node.trim());
        assert!(log.contains(&address), "no '{address}' in {log}");
    }
    if (node.trim(), 0).to_socket_addrs().is_ok() {
        let other = ["--depths", "64", "--device", "torch", "--token-file", &token];
        let _ = bench.submit_to("other", &url, &other).wait().expect_code(0);
        let report: Value = serde_json::from_slice(&bench.read("other/report.json")).expect("a report");
        let ways = &report["maps_by_way"];
        assert!(ways["by stream"].as_u64() > Some(0), "{ways}");
    } else {
        eprintln!(
            "SKIPPED {test}, maps as streams: this host has no address under its name, {}",
            node.trim()
        );
    }

    // The end: the coordinator takes its workers along.
    slurm.ask("scancel", &["--batch", "--signal=INT", &coordinator]);
    wait_for("the end", &slurm, folder, || slurm.ask("squeue", &["-h"]).is_empty());
    for job in [&coordinator, &format!("{workers}_0"), &format!("{workers}_1")] {
        assert_eq!(slurm.field(job, "JobState"), "COMPLETED");
        assert_eq!(slurm.field(job, "ExitCode"), "0:0");
    }
}
