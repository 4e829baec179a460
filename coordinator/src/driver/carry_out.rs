//! Commands to statements.

use std::collections::BTreeMap;

use planesweep_plan::{Attempt, Job, JobId};
use planesweep_proto::{Failure, Outcome, Produced, Success};

use super::Driver;
use crate::ledger::{LedgerError, Step};
use crate::schedule::{Command, Event, Timestamp, decide};

/// What the statements write beyond the commands.
#[derive(Default)]
pub(super) struct Payload<'a> {
    /// Submitted jobs.
    pub jobs: BTreeMap<JobId, &'a Job>,
    /// Reported outcomes.
    pub outcomes: BTreeMap<(JobId, Attempt), &'a Outcome>,
}

impl Payload<'_> {
    fn success(&self, job: &JobId, attempt: Attempt) -> &Success {
        match self.outcomes.get(&(*job, attempt)) {
            Some(Outcome::Success(success)) => success,
            _ => unreachable!("only reported successes are completed"),
        }
    }

    /// The reported failure, or the one that a worker's death is.
    fn failure(&self, job: &JobId, attempt: Attempt) -> Failure {
        match self.outcomes.get(&(*job, attempt)) {
            Some(Outcome::Failure(failure)) => failure.clone(),
            _ => Failure {
                code: "quarantined".to_owned(),
                message: "each worker that ran this job, and nothing else, died or stopped reporting"
                    .to_owned(),
                retryable: false,
                counts_against_job: true,
                lost_inputs: Vec::new(),
            },
        }
    }
}

impl Driver {
    /// Carries out what follows from an event as a step of its own; says how much changed.
    pub(super) async fn carry_out_alone(
        &mut self,
        event: Event,
        now: Timestamp,
    ) -> Result<usize, planesweep_proto::ServiceError> {
        match self.try_alone(event, now).await {
            Ok(changed) => Ok(changed),
            Err(error) => Err(self.recover(&error).await),
        }
    }

    async fn try_alone(&mut self, event: Event, now: Timestamp) -> Result<usize, LedgerError> {
        let mut step = self.begin(now).await?;
        let commands = decide(&self.snapshot, event, now);
        let changed = self.carry_out(&mut step, &commands, &Payload::default(), now).await?.len();
        self.commit(step).await?;
        Ok(changed)
    }

    /// Carries out commands within a step; returns those that changed something.
    pub(super) async fn carry_out(
        &mut self,
        step: &mut Step,
        commands: &[Command],
        payload: &Payload<'_>,
        now: Timestamp,
    ) -> Result<Vec<Command>, LedgerError> {
        let mut effective = Vec::new();
        for command in commands {
            if !execute(step, command, payload).await? {
                tracing::debug!(?command, "came too late for the ledger");
                continue;
            }
            if !self.snapshot.apply(command, now) {
                // Cannot be: the snapshot is the ledger's at this step.
                tracing::error!(?command, "the ledger and the snapshot disagree");
            }
            self.note(command, payload);
            effective.push(command.clone());
        }
        Ok(effective)
    }

    /// Keeps results and counters up to date.
    fn note(&mut self, command: &Command, payload: &Payload<'_>) {
        match command {
            Command::Complete { job, attempt, worker } => {
                let Success { blob, length, .. } = payload.success(job, *attempt);
                self.results.insert(*job, Produced { blob: *blob, length: *length, worker: worker.clone() });
            }
            Command::Reopen { job, .. } => {
                self.results.remove(job);
            }
            Command::Suspect { job, attempt, deaths_alone } => {
                tracing::warn!(%job, %attempt, deaths_alone, "a worker died or froze while it ran this job; it runs alone next");
            }
            Command::GiveUp { job, attempt, quarantined } => {
                let failure = payload.failure(job, *attempt);
                tracing::warn!(%job, %attempt, quarantined, code = failure.code, message = failure.message, "job failed for good");
            }
            Command::Retry { job, attempt, failures, losses, .. } => {
                let failure = payload.failure(job, *attempt);
                tracing::info!(%job, %attempt, failures, losses, code = failure.code, message = failure.message, "job is tried again");
            }
            Command::Dismiss { worker } => tracing::info!(%worker, "worker stopped reporting"),
            Command::CountLate { job, attempt } => {
                self.late_results += 1;
                let late = payload.success(job, *attempt);
                let published = self.results.get(job);
                tracing::info!(%job, %attempt, "late result refused");
                if published.is_some_and(|published| published.blob != late.blob) {
                    self.divergent_results += 1;
                    tracing::warn!(%job, %attempt, "late result differs from the published one");
                }
            }
            _ => {}
        }
    }
}

/// Runs a command's statement; says whether it changed a row. Commands without one always do.
async fn execute(step: &mut Step, command: &Command, payload: &Payload<'_>) -> Result<bool, LedgerError> {
    match command {
        Command::Insert { shape } => {
            step.insert_job(payload.jobs.get(&shape.id).expect("every inserted job was submitted")).await
        }
        Command::Reopen { job, why } => step.reopen(job, *why).await,
        Command::Renew { job, attempt, worker, deadline, .. } => {
            step.renew(job, *attempt, worker, *deadline).await
        }
        Command::Grant { job, attempt, worker, deadline } => {
            step.claim(job, *attempt, worker, *deadline).await
        }
        Command::Complete { job, attempt, worker } => {
            step.complete(job, *attempt, worker, payload.success(job, *attempt)).await
        }
        Command::Retry { job, attempt, failures, losses, .. } => {
            step.retry(job, *attempt, (*failures, *losses), &payload.failure(job, *attempt)).await
        }
        Command::GiveUp { job, attempt, .. } => {
            step.give_up(job, *attempt, &payload.failure(job, *attempt)).await
        }
        Command::Release { job, attempt } => step.release(job, *attempt).await,
        Command::Suspect { job, attempt, deaths_alone } => step.suspect(job, *attempt, *deaths_alone).await,
        Command::Cancel { job } => step.cancel(job).await,
        Command::Admit { .. }
        | Command::Dismiss { .. }
        | Command::Revoke { .. }
        | Command::Acknowledge { .. }
        | Command::CountLate { .. } => Ok(true),
    }
}
