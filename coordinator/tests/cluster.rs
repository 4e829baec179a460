//! A coordinator and toy workers over real sockets, in one process.

use std::collections::BTreeMap;
use std::time::Duration;

use planesweep_coordinator::{Config, Coordinator, Handle, StartError};
use planesweep_fusion::FilterOptions;
use planesweep_plan::{
    AssembleSpec, Attempt, BlobKey, EmitSpec, FilterSpec, ImageSpec, InferSpec, Job, JobId, JobSpec,
    NUMERICS_VERSION, RunId, WorkerId,
};
use planesweep_proto::{
    CODE_VERSION, Client, Code, FinishedJob, Grant, HeldJob, JobState, Order, Outcome, PROTOCOL_VERSION,
    Report, ReportReply, Role, RunStatus, ServiceError, Slots, SubmitHeader, Success, WorkerState,
};
use planesweep_scene::{Camera, DepthHypotheses, Distortion, Intrinsics, Pose, Sampling, ViewId};
use tempfile::TempDir;
use tokio::task::JoinHandle;

/// How long a test waits for a state before it fails.
const DEADLINE: Duration = Duration::from_mins(1);
const LEASE: Duration = Duration::from_millis(700);

fn image(view: u32) -> ImageSpec {
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, skew: 0.0, cx: 31.5, cy: 23.5 };
    let pose = Pose::look_at(&[view as f64, 0.0, -5.0].into(), &[0.0; 3].into(), &[0.0, 1.0, 0.0].into());
    ImageSpec {
        view: ViewId(view),
        name: format!("{view}.png"),
        path: format!("{view}.png").into(),
        hash: BlobKey::of(&view.to_be_bytes()),
        camera: Camera { intrinsics, pose },
        distortion: Distortion::None,
        working_width: 64,
        working_height: 48,
    }
}

/// Infer → filter → emit for each view, with the next view as neighbour, and the cloud.
fn plan(views: u32) -> Vec<Job> {
    let id = |kind: &str, view: u32| JobId(BlobKey::of(format!("{kind} {view}").as_bytes()).0);
    let next = |view: u32| (view + 1) % views;
    let pair = |kind, view| vec![id(kind, view), id(kind, next(view))];
    let mut jobs = Vec::new();
    for view in 0..views {
        let spec = InferSpec {
            reference: image(view),
            sources: vec![image(next(view))],
            hypotheses: DepthHypotheses::new(Sampling::Uniform, 1.0, 9.0, 64).expect("a valid range"),
            weights: BlobKey::of(b"weights"),
            threads: 1,
        };
        jobs.push(Job { id: id("infer", view), spec: JobSpec::Infer(spec), needs: vec![] });
    }
    for view in 0..views {
        let spec = FilterSpec {
            view: ViewId(view),
            neighbours: vec![ViewId(next(view))],
            options: FilterOptions::default(),
        };
        jobs.push(Job { id: id("filter", view), spec: JobSpec::Filter(spec), needs: pair("infer", view) });
    }
    for view in 0..views {
        let spec = EmitSpec { view: ViewId(view), neighbours: vec![ViewId(next(view))] };
        jobs.push(Job { id: id("emit", view), spec: JobSpec::Emit(spec), needs: pair("filter", view) });
    }
    let spec = JobSpec::Assemble(AssembleSpec { views: (0..views).map(ViewId).collect() });
    let needs = (0..views).map(|view| id("emit", view)).collect();
    jobs.push(Job { id: id("assemble", 0), spec, needs });
    jobs
}

/// The result of a job is a function of its id and of its inputs, so every order must give the same.
fn result_of(grant: &Grant) -> Success {
    let mut text = grant.job.to_string();
    for input in &grant.inputs {
        let blob = input.produced.as_ref().map(|produced| produced.blob.to_string());
        text += &blob.unwrap_or_else(|| "absent".to_owned());
    }
    Success {
        blob: BlobKey::of(text.as_bytes()),
        length: text.len() as u64,
        measurements: BTreeMap::from([("inputs".to_owned(), grant.inputs.len() as f64)]),
        seconds: 0.001,
    }
}

/// A worker with one slot, driven by hand.
struct Toy {
    client: Client,
    id: WorkerId,
    sequence: u64,
    held: Vec<HeldJob>,
    finished: Vec<FinishedJob>,
}

impl Toy {
    fn new(url: &str, name: &str) -> Self {
        let client = Client::connect(url, None).expect("a valid address");
        Self { client, id: WorkerId(name.into()), sequence: 0, held: vec![], finished: vec![] }
    }

    async fn report(&mut self) -> Result<ReportReply, ServiceError> {
        self.sequence += 1;
        let free = u32::from(self.held.is_empty());
        let report = Report {
            protocol_version: PROTOCOL_VERSION,
            code_version: CODE_VERSION.into(),
            numerics_version: NUMERICS_VERSION,
            worker: self.id.clone(),
            sequence: self.sequence,
            host: "toy".into(),
            boot_id: String::new(),
            role: Role::Both,
            device: "cpu".into(),
            state: WorkerState::Ready,
            free: Slots { infer: free, fuse: free },
            offset_ms: self.sequence,
            held: self.held.clone(),
            finished: self.finished.clone(),
            max_wait: LEASE,
        };
        let reply = self.client.report(&report).await?;
        assert_eq!(reply.offset_ms, self.sequence, "the offset is echoed");
        self.finished
            .retain(|f| !reply.acknowledged.iter().any(|ack| (ack.job, ack.attempt) == (f.job, f.attempt)));
        self.held.retain(|h| !reply.revoked.iter().any(|r| (r.job, r.attempt) == (h.job, h.attempt)));
        Ok(reply)
    }

    fn finish(&mut self, grant: &Grant) {
        self.held.retain(|held| held.job != grant.job);
        self.finished.push(FinishedJob {
            job: grant.job,
            attempt: grant.attempt,
            outcome: Outcome::Success(result_of(grant)),
        });
    }

    fn hold(&mut self, grant: &Grant) {
        self.held.push(HeldJob { job: grant.job, attempt: grant.attempt, started: true });
    }

    /// Works until told to stop; returns how many jobs it did.
    fn work(mut self) -> JoinHandle<usize> {
        tokio::spawn(async move {
            let mut done = 0;
            loop {
                let Ok(reply) = self.report().await else {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                    continue;
                };
                for grant in &reply.grants {
                    self.finish(grant);
                    done += 1;
                }
                if reply.order == Order::Stop {
                    return done;
                }
            }
        })
    }

    async fn until_granted(&mut self) -> Grant {
        let ask = async {
            loop {
                if let Some(grant) = self.report().await.expect("an answer").grants.into_iter().next() {
                    return grant;
                }
            }
        };
        tokio::time::timeout(DEADLINE, ask).await.expect("a grant in time")
    }
}

fn config(folder: &TempDir) -> Config {
    Config { lease: LEASE, ..Config::new(folder.path().join("ledger.sqlite"), "file:///store") }
}

async fn start(folder: &TempDir) -> Handle {
    Coordinator::start(config(folder)).await.expect("a free port and a good ledger")
}

async fn submit(handle: &Handle, jobs: Vec<Job>) -> (RunId, u32) {
    let header = SubmitHeader { name: "toy".into(), ..SubmitHeader::default() };
    let mut client = Client::connect(&handle.url(), None).expect("a valid address");
    let submitted = client.submit(&header, jobs).await.expect("a good plan");
    (submitted.run, submitted.reused)
}

async fn finished(handle: &Handle, run: &RunId) -> RunStatus {
    tokio::time::timeout(DEADLINE, handle.wait_finished(run))
        .await
        .expect("an end in time")
        .expect("a status")
}

/// What the cloud must be: computed in plan order, without a coordinator.
fn undisturbed(jobs: &[Job]) -> BlobKey {
    let mut results: BTreeMap<JobId, Success> = BTreeMap::new();
    for job in jobs {
        let input = |need: &JobId| planesweep_proto::Input {
            job: *need,
            produced: results.get(need).map(|success| planesweep_proto::Produced {
                blob: success.blob,
                length: success.length,
                worker: WorkerId("any".into()),
            }),
        };
        let inputs = job.needs.iter().map(input).collect();
        let grant = Grant { job: job.id, attempt: Attempt(1), spec: job.spec.clone(), inputs };
        results.insert(job.id, result_of(&grant));
    }
    results[&jobs.last().expect("a job").id].blob
}

async fn cloud(handle: &Handle, run: &RunId) -> BlobKey {
    let mut client = Client::connect(&handle.url(), None).expect("a valid address");
    let results = client.results(run).await.expect("results");
    results.last().and_then(|result| result.blob).expect("the cloud is the last result").0
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_workers_do_a_plan_and_the_next_run_does_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let handle = start(&folder).await;
    let jobs = plan(6);
    let workers = [Toy::new(&handle.url(), "w1").work(), Toy::new(&handle.url(), "w2").work()];
    let (run, reused) = submit(&handle, jobs.clone()).await;
    assert_eq!(reused, 0);
    let status = finished(&handle, &run).await;
    assert_eq!(status.count(JobState::Done), 19);
    assert_eq!((status.workers_alive, status.waiting, status.late_results), (2, None, 0));
    assert_eq!(status.recent.len(), 19);
    let last = status.recent.last().expect("19 results");
    assert_eq!((last.kind.as_str(), last.measurements["inputs"]), ("assemble", 6.0));
    assert_eq!(handle.status(&run, last.ended).await.expect("a status").recent, []);
    assert_eq!(cloud(&handle, &run).await, undisturbed(&jobs));

    let (again, reused) = submit(&handle, jobs.clone()).await;
    assert_ne!(again, run);
    assert_eq!(reused, 19);
    assert!(finished(&handle, &again).await.finished);

    // A result that vanished from the store is made again, and nothing else.
    let missing = vec![jobs[0].id];
    assert_eq!(handle.forget_results(missing).await, Ok(1));
    assert_eq!(finished(&handle, &again).await.count(JobState::Done), 19);
    handle.shutdown().await;
    let mut done = 0;
    for worker in workers {
        done += worker.await.expect("no panic");
    }
    assert_eq!(done, 20);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_silent_worker_loses_its_job_and_its_late_result_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let handle = start(&folder).await;
    let jobs = plan(3);
    let (run, _) = submit(&handle, jobs.clone()).await;
    let waits = handle.status(&run, 0).await.expect("a status");
    assert!(waits.waiting.is_some() && !waits.finished, "no worker yet, and the status says so");

    let mut frozen = Toy::new(&handle.url(), "frozen");
    let grant = frozen.until_granted().await;
    frozen.hold(&grant);
    frozen.report().await.expect("a renewal");
    // Not a word from now on; the other one does everything, this job included.
    let worker = Toy::new(&handle.url(), "steady").work();
    let status = finished(&handle, &run).await;
    assert_eq!((status.count(JobState::Done), status.workers_alive), (10, 1));
    let redone = handle.results(&run).await.expect("results").into_iter().find(|r| r.job == grant.job);
    let redone = redone.expect("the job is of this run");
    assert_eq!((redone.attempt, redone.worker), (Attempt(2), Some(WorkerId("steady".into()))));
    assert_eq!(cloud(&handle, &run).await, undisturbed(&jobs));

    frozen.finish(&grant);
    let reply = frozen.report().await.expect("it registers anew");
    assert_eq!(reply.acknowledged.len(), 1, "it may forget the result");
    let status = handle.status(&run, 0).await.expect("a status");
    assert_eq!((status.late_results, status.divergent_results, status.workers_alive), (1, 0, 2));
    handle.shutdown().await;
    worker.await.expect("no panic");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_coordinator_goes_on_and_takes_what_workers_kept() {
    let folder = tempfile::tempdir().expect("a folder");
    let first = start(&folder).await;
    let jobs = plan(4);
    let (run, _) = submit(&first, jobs.clone()).await;
    let mut toy = Toy::new(&first.url(), "keeps working");
    let done = toy.until_granted().await;
    toy.finish(&done);
    let kept = toy.until_granted().await;
    assert!(matches!(Coordinator::start(config(&folder)).await, Err(StartError::Ledger(_))), "one at a time");
    // Dropped, not shut down: nobody is told anything.
    drop(first);
    let second = tokio::time::timeout(DEADLINE, async {
        loop {
            match Coordinator::start(config(&folder)).await {
                Ok(handle) => return handle,
                Err(_) => tokio::time::sleep(Duration::from_millis(10)).await,
            }
        }
    });
    let second = second.await.expect("the ledger is free again");
    toy.client = Client::connect(&second.url(), None).expect("a valid address");
    toy.finish(&kept);
    // Its first report delivers what it kept: the lease still runs.
    let worker = toy.work();
    let status = finished(&second, &run).await;
    assert_eq!((status.count(JobState::Done), status.late_results), (13, 0));
    let results = second.results(&run).await.expect("results");
    assert!(results.iter().all(|result| result.attempt == Attempt(1)), "nothing was done twice");
    assert_eq!(cloud(&second, &run).await, undisturbed(&jobs));
    second.shutdown().await;
    worker.await.expect("no panic");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_uninvited_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let open = Config { listen: ([0, 0, 0, 0], 0).into(), ..config(&folder) };
    assert!(matches!(Coordinator::start(open).await, Err(StartError::Config(_))), "no token, no other hosts");
    let guarded = Config { token: Some("s3cret".into()), ..config(&folder) };
    let handle = Coordinator::start(guarded).await.expect("a good configuration");
    let run = RunId("none-1".into());
    for (token, code) in [
        (None, Code::Unauthenticated),
        (Some("wrong"), Code::Unauthenticated),
        (Some("s3cret"), Code::NotFound),
    ] {
        let mut client = Client::connect(&handle.url(), token).expect("a valid address");
        let error = client.status(&run, 0).await.expect_err("there is no such run");
        assert_eq!(error.code, code, "{error}");
    }
    let mut client = Client::connect(&handle.url(), Some("s3cret")).expect("a valid address");
    let header = SubmitHeader { name: "odd".into(), ..SubmitHeader::default() };
    let error = client.submit(&header, plan(3).split_off(1)).await.expect_err("a need is missing");
    assert_eq!(error.code, Code::Invalid);
    assert!(error.message.contains("not listed before it"), "{error}");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn other_versions_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let handle = start(&folder).await;
    let mut client = planesweep_proto::wire::coordinator_client::CoordinatorClient::connect(handle.url())
        .await
        .expect("a connection");
    let request = planesweep_proto::wire::ReportRequest {
        protocol_version: PROTOCOL_VERSION,
        code_version: "0.0.9".into(),
        numerics_version: NUMERICS_VERSION,
        worker: "old".into(),
        sequence: 1,
        host: "h".into(),
        role: 3,
        state: 1,
        free: Some(planesweep_proto::wire::Slots::default()),
        ..Default::default()
    };
    let status = client.report(request).await.expect_err("an old worker");
    let error = ServiceError::from(status);
    assert_eq!(error.code, Code::VersionMismatch);
    assert!(error.message.contains("0.0.9") && error.message.contains(CODE_VERSION), "{error}");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_submitted_alone_ends_the_others_and_cancelled_jobs_are_revoked() {
    let folder = tempfile::tempdir().expect("a folder");
    let handle = start(&folder).await;
    let (old, _) = submit(&handle, plan(5)).await;
    let mut toy = Toy::new(&handle.url(), "w1");
    let grant = toy.until_granted().await;
    toy.hold(&grant);
    let header = SubmitHeader { name: "new".into(), exclusive: true, ..SubmitHeader::default() };
    // Shares nothing with the old one but the first jobs' ids.
    let jobs: Vec<Job> = plan(5).into_iter().skip(1).take(1).collect();
    let new = handle.submit(header, jobs).await.expect("a good plan").run;
    let reply = toy.report().await.expect("an answer");
    assert_eq!(reply.revoked.len(), 1);
    let status = handle.status(&old, 0).await.expect("a status");
    assert!(status.cancelled && status.finished);
    assert_eq!(status.count(JobState::Cancelled), 15);
    let worker = toy.work();
    assert_eq!(finished(&handle, &new).await.count(JobState::Done), 1);
    handle.cancel(&new).await.expect("a known run");
    handle.shutdown().await;
    assert_eq!(worker.await.expect("no panic"), 1);
}
