//! A coordinator and toy workers over real sockets, in one process.

#[path = "../../../tests/src/postgres.rs"]
mod postgres;
mod shared;
mod submissions;
mod toy;

use std::time::Duration;

use planesweep_coordinator::{Config, Coordinator, LedgerError, ServedStore, StartError};
use planesweep_plan::{Attempt, Job, NUMERICS_VERSION, RunId, WorkerId};
use planesweep_proto::wire::coordinator_client::CoordinatorClient;
use planesweep_proto::{
    CODE_VERSION, Client, Code, JobState, Outcome, PROTOCOL_VERSION, ServiceError, SubmitHeader,
};

use planesweep_store::Objects;
use toy::{DEADLINE, Place, Toy, cloud, config, finished, plan, result_of, start, submit, undisturbed};

/// What every ledger must do.
macro_rules! on_every_ledger {
    ($($test:ident),* $(,)?) => {
        mod on_sqlite {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                super::$test(super::Place::file()).await;
            })*
        }
        mod on_postgres {
            $(#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
            async fn $test() {
                if let Some(place) = super::Place::postgres(stringify!($test)) {
                    super::$test(place).await;
                }
            })*
        }
    };
}

on_every_ledger!(
    two_workers_do_a_plan_and_the_next_run_does_nothing,
    a_silent_worker_loses_its_job_and_its_late_result_is_refused,
    a_restarted_coordinator_goes_on_and_takes_what_workers_kept,
    a_run_submitted_alone_ends_the_others_and_cancelled_jobs_are_revoked,
    a_ledger_has_one_store,
);

async fn two_workers_do_a_plan_and_the_next_run_does_nothing(place: Place) {
    let handle = start(&place).await;
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

async fn a_silent_worker_loses_its_job_and_its_late_result_is_refused(place: Place) {
    let handle = start(&place).await;
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

    // One that made something else of it is counted, too.
    let mut different = result_of(&grant);
    different.blob.0[0] ^= 1;
    frozen.end(&grant, Outcome::Success(different));
    frozen.report().await.expect("an answer");
    let status = handle.status(&run, 0).await.expect("a status");
    assert_eq!((status.late_results, status.divergent_results), (2, 1));
    assert_eq!(cloud(&handle, &run).await, undisturbed(&jobs));
    handle.shutdown().await;
    worker.await.expect("no panic");
}

async fn a_restarted_coordinator_goes_on_and_takes_what_workers_kept(place: Place) {
    let first = start(&place).await;
    let jobs = plan(4);
    let (run, _) = submit(&first, jobs.clone()).await;
    let mut toy = Toy::new(&first.url(), "keeps working");
    let done = toy.until_granted().await;
    toy.finish(&done);
    let kept = toy.until_granted().await;
    if place.postgres.is_none() {
        let other = Coordinator::start(config(&place)).await;
        assert!(matches!(other, Err(StartError::Ledger(_))), "one at a time");
    }
    // Dropped, not shut down: nobody is told anything.
    drop(first);
    let second = tokio::time::timeout(DEADLINE, async {
        loop {
            match Coordinator::start(config(&place)).await {
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
    let place = Place::file();
    let open = Config { listen: ([0, 0, 0, 0], 0).into(), ..config(&place) };
    assert!(matches!(Coordinator::start(open).await, Err(StartError::Config(_))), "no token, no other hosts");
    let guarded = Config { token: Some("s3cret".into()), ..config(&place) };
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
    // The answer does not wait for the body, which never comes.
    let mut stub = CoordinatorClient::connect(handle.url()).await.expect("a connection");
    let refused = tokio::time::timeout(DEADLINE, stub.submit(tokio_stream::pending())).await;
    let error = ServiceError::from(refused.expect("answered at once").expect_err("no token"));
    assert_eq!(error.code, Code::Unauthenticated, "{error}");

    let mut client = Client::connect(&handle.url(), Some("s3cret")).expect("a valid address");
    let header = SubmitHeader { name: "odd".into(), ..SubmitHeader::default() };
    let error = client.submit(&header, plan(3).split_off(1)).await.expect_err("a need is missing");
    assert_eq!(error.code, Code::Invalid);
    assert!(error.message.contains("not listed before it"), "{error}");
    let run = client.submit(&header, plan(3)).await.expect("a good plan").run;
    assert_eq!(client.status(&run, 0).await.expect("a status").refused_callers, 3);
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn other_versions_are_refused_by_name() {
    let place = Place::file();
    let handle = start(&place).await;
    let mut client = CoordinatorClient::connect(handle.url()).await.expect("a connection");
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

async fn a_run_submitted_alone_ends_the_others_and_cancelled_jobs_are_revoked(place: Place) {
    let handle = start(&place).await;
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

async fn a_ledger_has_one_store(place: Place) {
    let folder = tempfile::tempdir().expect("a folder");
    let begin = async |store: &str, new: &str| {
        let url = format!("file://{}", folder.path().join(store).display());
        let served =
            ServedStore { store: Objects::open(&url).expect("a store"), new_identity: new.to_owned() };
        Coordinator::start(Config { served: Some(served), ..config(&place) }).await
    };
    begin("a", "one").await.expect("the first store is taken").shutdown().await;
    let error = begin("b", "two").await.err().expect("another store");
    let text = error.to_string();
    assert!(matches!(error, StartError::Ledger(LedgerError::OtherStore { .. })), "{text}");
    assert!(text.contains("write one into") && text.contains("/b"), "{text}");
    let identity = folder.path().join("b/identity");
    assert!(!identity.exists(), "something is written into a store that is refused");
    for said in ["", "two"] {
        std::fs::write(&identity, said).expect("written");
        assert!(begin("b", "three").await.is_err(), "'{said}' is another one's");
        assert_eq!(std::fs::read(&identity).expect("it is there"), said.as_bytes());
    }
    // It was moved, and coordinators without one of their own do not mind.
    std::fs::write(&identity, "one").expect("written");
    begin("b", "three").await.expect("the same store").shutdown().await;
    start(&place).await.shutdown().await;
}
