//! Toy plans, and toy workers that are driven by hand.

use std::collections::BTreeMap;
use std::time::Duration;

use planesweep_coordinator::{Config, Coordinator, Handle, LedgerPlace};
use planesweep_fusion::FilterOptions;
use planesweep_plan::{
    AssembleSpec, Attempt, BlobKey, EmitSpec, FilterSpec, ImageSpec, InferSpec, Job, JobId, JobSpec,
    NUMERICS_VERSION, RunId, WorkerId,
};
use planesweep_proto::{
    CODE_VERSION, Client, Endpoint, FinishedJob, Grant, HeldJob, Order, Outcome, PROTOCOL_VERSION, Report,
    ReportReply, Role, RunStatus, ServiceError, Slots, SubmitHeader, Success, WorkerState,
};
use planesweep_scene::{Camera, DepthHypotheses, Distortion, Intrinsics, Pose, Sampling, ViewId};
use tempfile::TempDir;
use tokio::task::JoinHandle;

use crate::postgres::Postgres;

/// How long a test waits for a state before it fails.
pub(crate) const DEADLINE: Duration = Duration::from_mins(1);
pub(crate) const LEASE: Duration = Duration::from_millis(700);

pub(crate) fn image(view: u32) -> ImageSpec {
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
pub(crate) fn plan(views: u32) -> Vec<Job> {
    let id = |kind: &str, view: u32| JobId(BlobKey::of(format!("{kind} {view}").as_bytes()).0);
    let next = |view: u32| (view + 1) % views;
    let pair = |kind, view| vec![id(kind, view), id(kind, next(view))];
    let mut jobs = Vec::new();
    for view in 0..views {
        let spec = InferSpec {
            reference: image(view),
            sources: vec![image(next(view))],
            hypotheses: DepthHypotheses::new(Sampling::Uniform, 1.0, 9.0, 64).expect("a valid range"),
            rows: None,
            weights: BlobKey::of(b"weights"),
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
        let spec = EmitSpec {
            view: ViewId(view),
            neighbours: vec![ViewId(next(view))],
            max_relative_depth: 0.01,
            double: false,
        };
        jobs.push(Job { id: id("emit", view), spec: JobSpec::Emit(spec), needs: pair("filter", view) });
    }
    let spec = JobSpec::Assemble(AssembleSpec { views: (0..views).map(ViewId).collect() });
    let needs = (0..views).map(|view| id("emit", view)).collect();
    jobs.push(Job { id: id("assemble", 0), spec, needs });
    jobs
}

/// The result of a job is a function of its id and of its inputs, so every order must give the same.
pub(crate) fn result_of(grant: &Grant) -> Success {
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
pub(crate) struct Toy {
    pub(crate) client: Client,
    pub(crate) id: WorkerId,
    sequence: u64,
    pub(crate) held: Vec<HeldJob>,
    pub(crate) finished: Vec<FinishedJob>,
}

impl Toy {
    pub(crate) fn new(url: &str, name: &str) -> Self {
        let client = Client::connect(url, None).expect("a valid address");
        Self { client, id: WorkerId(name.into()), sequence: 0, held: vec![], finished: vec![] }
    }

    pub(crate) async fn report(&mut self) -> Result<ReportReply, ServiceError> {
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
            endpoint: Endpoint::default(),
        };
        let reply = self.client.report(&report).await?;
        assert_eq!(reply.offset_ms, self.sequence, "the offset is echoed");
        self.finished
            .retain(|f| !reply.acknowledged.iter().any(|ack| (ack.job, ack.attempt) == (f.job, f.attempt)));
        self.held.retain(|h| !reply.revoked.iter().any(|r| (r.job, r.attempt) == (h.job, h.attempt)));
        Ok(reply)
    }

    pub(crate) fn finish(&mut self, grant: &Grant) {
        self.end(grant, Outcome::Success(result_of(grant)));
    }

    pub(crate) fn end(&mut self, grant: &Grant, outcome: Outcome) {
        self.held.retain(|held| held.job != grant.job);
        self.finished.push(FinishedJob { job: grant.job, attempt: grant.attempt, outcome });
    }

    pub(crate) fn hold(&mut self, grant: &Grant) {
        self.held.push(HeldJob { job: grant.job, attempt: grant.attempt, started: true });
    }

    /// Works until told to stop; returns how many jobs it did.
    pub(crate) fn work(mut self) -> JoinHandle<usize> {
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

    pub(crate) async fn until_granted(&mut self) -> Grant {
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

/// Where a test's ledger lies.
pub(crate) struct Place {
    pub(crate) folder: TempDir,
    pub(crate) postgres: Option<Postgres>,
}

impl Place {
    pub(crate) fn file() -> Self {
        Self { folder: tempfile::tempdir().expect("a folder"), postgres: None }
    }

    /// `None` where there is no PostgreSQL; then `test` is skipped.
    pub(crate) fn postgres(test: &str) -> Option<Self> {
        Some(Self { postgres: Some(Postgres::start(test)?), ..Self::file() })
    }
}

pub(crate) fn config(place: &Place) -> Config {
    let ledger = match &place.postgres {
        Some(postgres) => LedgerPlace::from(&*postgres.url()),
        None => place.folder.path().join("ledger.sqlite").into(),
    };
    Config { lease: LEASE, ..Config::new(ledger, "file:///store") }
}

pub(crate) async fn start(place: &Place) -> Handle {
    Coordinator::start(config(place)).await.expect("a free port and a good ledger")
}

pub(crate) async fn submit(handle: &Handle, jobs: Vec<Job>) -> (RunId, u32) {
    let header = SubmitHeader { name: "toy".into(), ..SubmitHeader::default() };
    let mut client = Client::connect(&handle.url(), None).expect("a valid address");
    let submitted = client.submit(&header, jobs).await.expect("a good plan");
    (submitted.run, submitted.reused)
}

pub(crate) async fn finished(handle: &Handle, run: &RunId) -> RunStatus {
    tokio::time::timeout(DEADLINE, handle.wait_finished(run))
        .await
        .expect("an end in time")
        .expect("a status")
}

/// What the cloud must be: computed in plan order, without a coordinator.
pub(crate) fn undisturbed(jobs: &[Job]) -> BlobKey {
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

pub(crate) async fn cloud(handle: &Handle, run: &RunId) -> BlobKey {
    let mut client = Client::connect(&handle.url(), None).expect("a valid address");
    let results = client.results(run).await.expect("results");
    results.last().and_then(|result| result.blob).expect("the cloud is the last result").0
}
