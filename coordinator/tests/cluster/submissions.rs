//! What a submission may hold, and what it changes of jobs that are known already.

use std::path::{Path, PathBuf};

use planesweep_coordinator::{Coordinator, Handle};
use planesweep_plan::{Job, JobId, JobSpec};
use planesweep_proto::{Code, Failure, JobState, Order, Outcome, ServiceError, SubmitHeader, Submitted};
use planesweep_scene::{DepthHypotheses, Sampling, ViewId};
use sqlx::SqlitePool;
use sqlx::sqlite::SqliteConnectOptions;
use tempfile::TempDir;

use crate::toy::{Place, Toy, config, finished, plan, start, submit};

async fn submit_here(handle: &Handle, jobs: Vec<Job>) -> Result<Submitted, ServiceError> {
    handle.submit(SubmitHeader { name: "toy".into(), ..SubmitHeader::default() }, jobs).await
}

/// The ledger, behind the coordinator's back.
async fn rows(folder: &TempDir) -> SqlitePool {
    let options = SqliteConnectOptions::new().filename(folder.path().join("ledger.sqlite"));
    SqlitePool::connect_with(options).await.expect("the ledger's file")
}

fn rename(jobs: &mut [Job], by: u32, folder: &Path) {
    let renumber = |view: &mut ViewId| view.0 += by;
    for job in jobs {
        match &mut job.spec {
            JobSpec::Infer(spec) => {
                for image in std::iter::once(&mut spec.reference).chain(&mut spec.sources) {
                    renumber(&mut image.view);
                    image.path = folder.join(&image.path);
                }
            }
            JobSpec::Stitch(spec) => renumber(&mut spec.view),
            JobSpec::Fit(spec) => renumber(&mut spec.image.view),
            JobSpec::Filter(spec) => {
                renumber(&mut spec.view);
                spec.neighbours.iter_mut().for_each(renumber);
            }
            JobSpec::Emit(spec) => {
                renumber(&mut spec.view);
                spec.neighbours.iter_mut().for_each(renumber);
            }
            JobSpec::Assemble(spec) => spec.views.iter_mut().for_each(renumber),
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_the_wire_refuses_is_refused_in_process_by_name() {
    let place = Place::file();
    let handle = start(&place).await;
    let spoilt = |which: usize, spoil: &dyn Fn(&mut JobSpec)| {
        let mut jobs = plan(3);
        spoil(&mut jobs[which].spec);
        jobs
    };
    let no_views = spoilt(4, &|spec| {
        let JobSpec::Filter(spec) = spec else { panic!("the fifth job filters") };
        spec.options.min_views = 0;
    });
    let not_a_number = spoilt(5, &|spec| {
        let JobSpec::Filter(spec) = spec else { panic!("the sixth job filters") };
        spec.options.max_relative_depth = f32::NAN;
    });
    let many_planes = spoilt(2, &|spec| {
        let JobSpec::Infer(spec) = spec else { panic!("the third job infers") };
        spec.hypotheses = DepthHypotheses::new(Sampling::Uniform, 1.0, 9.0, 4097).expect("a valid range");
    });
    for (jobs, named) in [
        (no_views, ["filter job of view 1", "min_views"]),
        (not_a_number, ["filter job of view 2", "max_relative_depth"]),
        (many_planes, ["infer job of view 2", "depth count"]),
    ] {
        let error = submit_here(&handle, jobs).await.expect_err("a plan that the wire refuses");
        assert_eq!(error.code, Code::Invalid);
        assert!(named.iter().all(|part| error.message.contains(part)), "{error}");
    }
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_row_that_does_not_decode_fails_alone() {
    let place = Place::file();
    let handle = start(&place).await;
    let (run, _) = submit(&handle, plan(3)).await;
    let spoil = sqlx::query("UPDATE jobs SET spec = x'ff' WHERE kind = 'infer' AND view = 1");
    assert_eq!(spoil.execute(&rows(&place.folder).await).await.expect("a change").rows_affected(), 1);
    let worker = Toy::new(&handle.url(), "w1").work();
    let status = finished(&handle, &run).await;
    assert_eq!((status.count(JobState::Done), status.count(JobState::Failed)), (9, 1));
    let failed = &status.failures[0];
    assert_eq!((failed.kind.as_str(), failed.view), ("infer", Some(ViewId(1))));
    let (code, message) = failed.failure.as_ref().expect("a reason");
    assert!(code == "unreadable" && message.contains("spec"), "{code}: {message}");
    handle.shutdown().await;
    assert_eq!(worker.await.expect("no panic"), 9, "no result was thrown away");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_scene_that_moved_goes_on_with_the_new_paths_and_views() {
    let place = Place::file();
    let handle = start(&place).await;
    let (_, _) = submit(&handle, plan(3)).await;
    let mut toy = Toy::new(&handle.url(), "w1");
    let done = toy.until_granted().await;
    toy.finish(&done);
    let leased = toy.until_granted().await;
    toy.hold(&leased);
    let mut moved = plan(3);
    rename(&mut moved, 10, Path::new("/new"));
    let (run, reused) = submit(&handle, moved.clone()).await;
    assert_eq!(reused, 1);
    let views: Vec<_> = handle.results(&run).await.expect("results").iter().map(|r| r.view).collect();
    assert_eq!(views, moved.iter().map(|job| job.spec.view()).collect::<Vec<_>>());
    // One that was leased comes back with the new path too, as do those that nobody has had.
    drop(toy);
    let mut heir = Toy::new(&handle.url(), "w2");
    let mut paths: Vec<(JobId, PathBuf)> = Vec::new();
    while paths.len() < 2 {
        let grant = heir.until_granted().await;
        if let JobSpec::Infer(spec) = &grant.spec {
            paths.push((grant.job, spec.reference.path.clone()));
        }
        heir.finish(&grant);
    }
    assert!(paths.iter().any(|(job, _)| *job == leased.job));
    assert!(paths.iter().all(|(_, path)| path.starts_with("/new")), "{paths:?}");
    handle.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn twins_are_done_once_and_false_twins_are_refused() {
    let place = Place::file();
    let handle = start(&place).await;
    let mut twin = plan(3);
    rename(&mut twin[..1], 7, Path::new("/twin"));
    let mut jobs = plan(3);
    jobs.insert(3, twin[0].clone());
    let submitted = submit_here(&handle, jobs.clone()).await.expect("a plan with twins");
    assert_eq!(submitted.jobs, 10);
    let worker = Toy::new(&handle.url(), "w1").work();
    assert_eq!(finished(&handle, &submitted.run).await.count(JobState::Done), 10);
    let results = handle.results(&submitted.run).await.expect("results");
    assert_eq!((results.len(), results[0].view), (10, Some(ViewId(0))));

    let JobSpec::Infer(spec) = &mut jobs[3].spec else { panic!("the twin infers") };
    spec.reference.working_width += 1;
    let error = submit_here(&handle, jobs).await.expect_err("two jobs of one id");
    assert!(error.code == Code::Invalid && error.message.contains("different contents"), "{error}");
    handle.shutdown().await;
    assert_eq!(worker.await.expect("no panic"), 10);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn lost_inputs_do_not_use_up_the_tries_of_who_finds_them_lost() {
    let place = Place::file();
    let handle = start(&place).await;
    let jobs = plan(2);
    let filter = jobs[2].id;
    let (run, _) = submit(&handle, jobs.clone()).await;
    let mut toy = Toy::new(&handle.url(), "w1");
    let mut losses = 0;
    while losses < 4 {
        let grant = toy.until_granted().await;
        if grant.job != filter {
            toy.finish(&grant);
            continue;
        }
        losses += 1;
        let failure = Failure {
            code: "input-lost".into(),
            message: "the depth map is gone".into(),
            retryable: true,
            counts_against_job: false,
            lost_inputs: vec![jobs[0].id],
        };
        toy.end(&grant, Outcome::Failure(failure));
    }
    assert_eq!(toy.report().await.expect("an answer").order, Order::Work);
    let counted = sqlx::query_as::<_, (i64, i64)>("SELECT failures, losses FROM jobs WHERE id = $1");
    let counted = counted.bind(filter.0.to_vec()).fetch_one(&rows(&place.folder).await).await;
    assert_eq!(counted.expect("a row"), (0, 4));
    let worker = Toy::new(&handle.url(), "w2").work();
    assert_eq!(finished(&handle, &run).await.count(JobState::Done), 7);
    handle.shutdown().await;
    worker.await.expect("no panic");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_last_job_is_seen_again_when_it_ran_again() {
    let place = Place::file();
    let handle = start(&place).await;
    let jobs = plan(3);
    let cloud = jobs[9].id;
    let (run, _) = submit(&handle, jobs).await;
    let worker = Toy::new(&handle.url(), "w1").work();
    let seen = finished(&handle, &run).await.recent.last().expect("ten jobs ended").ended;
    assert_eq!(handle.forget_results(vec![cloud]).await, Ok(1));
    let recent = async |handle: &Handle, after| -> Vec<(JobId, u64)> {
        finished(handle, &run).await;
        let recent = handle.status(&run, after).await.expect("a status").recent;
        recent.iter().map(|result| (result.job, result.ended)).collect()
    };
    let again = recent(&handle, seen).await;
    assert!(matches!(again[..], [(job, ended)] if job == cloud && ended > seen), "{again:?}");
    assert_eq!(handle.forget_results(vec![cloud]).await, Ok(1));
    handle.shutdown().await;
    worker.await.expect("no panic");

    // Nor does a coordinator that starts while that job is open count from anew.
    let handle = Coordinator::start(config(&place)).await.expect("the ledger is free");
    let worker = Toy::new(&handle.url(), "w2").work();
    let once_more = recent(&handle, again[0].1).await;
    assert!(matches!(once_more[..], [(job, _)] if job == cloud), "{once_more:?}");
    handle.shutdown().await;
    worker.await.expect("no panic");
}
