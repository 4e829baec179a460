//! Several coordinators on one PostgreSQL, and a PostgreSQL that goes and comes back.

use std::time::Duration;

use planesweep_plan::Attempt;
use planesweep_proto::{Client, JobState};

use crate::toy::{DEADLINE, LEASE, Place, Toy, cloud, finished, plan, start, submit, undisturbed};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn two_coordinators_give_no_job_to_two_workers() {
    let Some(place) = Place::postgres("two_coordinators_give_no_job_to_two_workers") else { return };
    let (one, two) = (start(&place).await, start(&place).await);
    let jobs = plan(30);
    let workers: Vec<_> = [&one, &two, &one, &two]
        .iter()
        .enumerate()
        .map(|(k, coordinator)| Toy::new(&coordinator.url(), &format!("w{k}")).work())
        .collect();
    let (run, _) = submit(&one, jobs.clone()).await;
    let status = finished(&two, &run).await;
    assert_eq!((status.count(JobState::Done), status.late_results), (91, 0));
    let results = one.results(&run).await.expect("results");
    assert!(results.iter().all(|result| result.attempt == Attempt(1)), "nothing was done twice");
    assert_eq!(cloud(&two, &run).await, undisturbed(&jobs));
    one.shutdown().await;
    two.shutdown().await;
    let mut done = Vec::new();
    for worker in workers {
        done.push(worker.await.expect("no panic"));
    }
    assert_eq!(done.iter().sum::<usize>(), 91);
    assert!(done[0] + done[2] > 0 && done[1] + done[3] > 0, "one coordinator did everything: {done:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_two_coordinators_one_is_killed_and_the_other_carries_on() {
    let test = "of_two_coordinators_one_is_killed_and_the_other_carries_on";
    let Some(place) = Place::postgres(test) else { return };
    let (one, two) = (start(&place).await, start(&place).await);
    let jobs = plan(5);
    let (run, _) = submit(&one, jobs.clone()).await;
    let mut orphan = Toy::new(&one.url(), "orphan");
    let lost = orphan.until_granted().await;
    orphan.hold(&lost);
    orphan.report().await.expect("a renewal");
    let worker = Toy::new(&two.url(), "steady").work();
    // While its own coordinator renews its lease, the other one leaves it alone.
    for _ in 0..8 {
        tokio::time::sleep(LEASE / 4).await;
        orphan.report().await.expect("a renewal");
    }
    let held = two.results(&run).await.expect("results").into_iter().find(|r| r.job == lost.job);
    assert_eq!(held.map(|result| result.attempt), Some(Attempt(1)));
    assert!(!two.status(&run, 0).await.expect("a status").finished);

    drop(one);
    let status = finished(&two, &run).await;
    assert_eq!(status.count(JobState::Done), 16);
    let redone = two.results(&run).await.expect("results").into_iter().find(|r| r.job == lost.job);
    assert_eq!(redone.map(|result| result.attempt), Some(Attempt(2)));
    assert_eq!(cloud(&two, &run).await, undisturbed(&jobs));
    // It finds the other coordinator, which knows better.
    orphan.client = Client::connect(&two.url(), None).expect("a valid address");
    orphan.finish(&lost);
    orphan.report().await.expect("it registers anew");
    assert_eq!(two.status(&run, 0).await.expect("a status").late_results, 1);
    two.shutdown().await;
    worker.await.expect("no panic");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_postgres_that_restarts_loses_nothing() {
    let Some(mut place) = Place::postgres("a_postgres_that_restarts_loses_nothing") else { return };
    let handle = start(&place).await;
    let jobs = plan(4);
    let (run, _) = submit(&handle, jobs.clone()).await;
    let mut toy = Toy::new(&handle.url(), "keeps its job");
    let kept = toy.until_granted().await;
    toy.hold(&kept);
    toy.report().await.expect("a renewal");

    let postgres = place.postgres.as_mut().expect("it is there");
    postgres.go_away();
    let refused = toy.report().await.expect_err("the ledger is gone");
    assert!(refused.is_retryable(), "{refused}");
    tokio::time::sleep(2 * LEASE).await;
    assert!(postgres.come_back());
    // The lease ended in the meantime, but nobody could renew it.
    let answered = tokio::time::timeout(DEADLINE, async {
        while toy.report().await.is_err() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    answered.await.expect("the ledger is back");
    assert_eq!(toy.held.len(), 1, "its job was not taken from it");
    toy.finish(&kept);
    let worker = toy.work();
    let status = finished(&handle, &run).await;
    assert_eq!((status.count(JobState::Done), status.late_results), (13, 0));
    let results = handle.results(&run).await.expect("results");
    assert!(results.iter().all(|result| result.attempt == Attempt(1)), "nothing was done twice");
    assert_eq!(cloud(&handle, &run).await, undisturbed(&jobs));
    handle.shutdown().await;
    worker.await.expect("no panic");
}
