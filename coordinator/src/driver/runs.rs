//! What clients ask: submit, cancel, forget.

use std::collections::BTreeMap;

use planesweep_plan::{Job, JobId, RunId};
use planesweep_proto::{Code, ServiceError, SubmitHeader, Submitted};

use super::Driver;
use super::carry_out::Payload;
use super::repeats::without_repeats;
use crate::ledger::LedgerError;
use crate::schedule::{Class, Event, JobShape, check_order, decide};

impl Driver {
    pub(super) async fn submit(
        &mut self,
        header: SubmitHeader,
        jobs: Vec<Job>,
    ) -> Result<Submitted, ServiceError> {
        let jobs = without_repeats(jobs);
        let shapes: Vec<JobShape> = jobs.iter().map(shape).collect();
        check_order(&shapes).map_err(|e| ServiceError::new(Code::Invalid, e.to_string()))?;
        match self.try_submit(&header, &jobs, shapes).await {
            Ok(submitted) => Ok(submitted),
            Err(error) => Err(self.recover(&error).await),
        }
    }

    async fn try_submit(
        &mut self,
        header: &SubmitHeader,
        jobs: &[Job],
        shapes: Vec<JobShape>,
    ) -> Result<Submitted, LedgerError> {
        let now = self.now();
        let by_id: BTreeMap<JobId, &Job> = jobs.iter().map(|job| (job.id, job)).collect();
        let payload = Payload { jobs: by_id, ..Payload::default() };
        let mut step = self.begin(now).await?;
        let lost = Event::ResultsLost { jobs: header.missing_results.clone() };
        let commands = decide(&self.snapshot, lost, now);
        self.carry_out(&mut step, &commands, &payload, now).await?;

        // The scene may have moved, and its views been numbered anew, since a job was first submitted.
        // A leased one too: whoever gets it next must find the images.
        for job in jobs.iter().filter(|job| self.snapshot.knows(&job.id)) {
            step.refresh(job).await?;
        }
        let (run, number) = step.insert_run(&header.name).await?;
        let commands = decide(&self.snapshot, Event::Submitted { jobs: shapes }, now);
        self.carry_out(&mut step, &commands, &payload, now).await?;
        for (seq, job) in jobs.iter().enumerate() {
            step.add_to_run(number, seq, &job.id).await?;
        }
        if header.exclusive {
            step.cancel_other_runs(number).await?;
            let unwanted = Event::Cancelled { jobs: step.unwanted().await? };
            let commands = decide(&self.snapshot, unwanted, now);
            self.carry_out(&mut step, &commands, &payload, now).await?;
        }
        self.commit(step).await?;
        let reused = jobs.iter().filter(|job| self.snapshot.is_done(&job.id)).count() as u32;
        tracing::info!(%run, jobs = jobs.len(), reused, "run submitted");
        Ok(Submitted { run, jobs: jobs.len() as u32, reused })
    }

    pub(super) async fn cancel(&mut self, run: RunId) -> Result<(), ServiceError> {
        match self.try_cancel(&run).await {
            Ok(()) => Ok(()),
            Err(error @ LedgerError::NoSuchRun { .. }) => Err(self.ledger.refusal(&error)),
            Err(error) => Err(self.recover(&error).await),
        }
    }

    async fn try_cancel(&mut self, run: &RunId) -> Result<(), LedgerError> {
        let now = self.now();
        let mut step = self.begin(now).await?;
        step.cancel_run(run).await?;
        let unwanted = Event::Cancelled { jobs: step.unwanted().await? };
        let commands = decide(&self.snapshot, unwanted, now);
        self.carry_out(&mut step, &commands, &Payload::default(), now).await?;
        self.commit(step).await
    }

    /// Makes done jobs run again; says how many there were.
    pub(super) async fn forget_results(&mut self, jobs: Vec<JobId>) -> Result<usize, ServiceError> {
        self.carry_out_alone(Event::ResultsLost { jobs }, self.now()).await
    }
}

fn shape(job: &Job) -> JobShape {
    JobShape { id: job.id, class: Class::of(job.spec.kind()), needs: job.needs.clone() }
}
