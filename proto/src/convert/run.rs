//! Submissions, status and results.

use std::time::Duration;

use planesweep_plan::{Attempt, JobId, RunId, WorkerId};
use planesweep_scene::ViewId;

use super::check::{at_most, each, job_id, measurements, name, not_negative, optional_name, short};
use super::report::{role, worker_state};
use crate::limits::{MAX_JOBS, MAX_MESSAGE_TEXT_BYTES, MAX_REPORTED};
use crate::{
    JobResult, JobState, PROTOCOL_VERSION, RunStatus, RunSummary, SubmitHeader, Submitted, WireError,
    WorkerStatus, wire,
};

fn job_ids(ids: &[Vec<u8>]) -> Result<Vec<JobId>, WireError> {
    at_most("jobs", ids.len(), MAX_JOBS)?;
    ids.iter().map(|id| job_id("job", id)).collect()
}

impl From<&SubmitHeader> for wire::SubmitHeader {
    fn from(header: &SubmitHeader) -> Self {
        Self {
            protocol_version: PROTOCOL_VERSION,
            name: header.name.clone(),
            exclusive: header.exclusive,
            missing_results: header.missing_results.iter().map(|JobId(hash)| hash.to_vec()).collect(),
        }
    }
}

impl TryFrom<wire::SubmitHeader> for SubmitHeader {
    type Error = WireError;

    fn try_from(header: wire::SubmitHeader) -> Result<Self, WireError> {
        Ok(Self {
            name: name("run name", header.name)?,
            exclusive: header.exclusive,
            missing_results: job_ids(&header.missing_results)?,
        })
    }
}

impl From<&Submitted> for wire::SubmitReply {
    fn from(submitted: &Submitted) -> Self {
        Self { run: submitted.run.0.clone(), jobs: submitted.jobs, reused: submitted.reused }
    }
}

impl TryFrom<wire::SubmitReply> for Submitted {
    type Error = WireError;

    fn try_from(reply: wire::SubmitReply) -> Result<Self, WireError> {
        Ok(Self { run: RunId(name("run", reply.run)?), jobs: reply.jobs, reused: reply.reused })
    }
}

impl From<&RunSummary> for wire::Run {
    fn from(run: &RunSummary) -> Self {
        Self {
            run: run.run.0.clone(),
            name: run.name.clone(),
            cancelled: run.cancelled,
            jobs: run.jobs,
            done: run.done,
            failed: run.failed,
        }
    }
}

impl TryFrom<wire::Run> for RunSummary {
    type Error = WireError;

    fn try_from(run: wire::Run) -> Result<Self, WireError> {
        Ok(Self {
            run: RunId(name("run", run.run)?),
            name: name("run name", run.name)?,
            cancelled: run.cancelled,
            jobs: run.jobs,
            done: run.done,
            failed: run.failed,
        })
    }
}

impl From<JobState> for wire::JobState {
    fn from(state: JobState) -> Self {
        match state {
            JobState::Open => Self::Open,
            JobState::Leased => Self::Leased,
            JobState::Done => Self::Done,
            JobState::Failed => Self::Failed,
            JobState::Cancelled => Self::Cancelled,
        }
    }
}

fn job_state(value: i32) -> Result<JobState, WireError> {
    match wire::JobState::try_from(value) {
        Ok(wire::JobState::Open) => Ok(JobState::Open),
        Ok(wire::JobState::Leased) => Ok(JobState::Leased),
        Ok(wire::JobState::Done) => Ok(JobState::Done),
        Ok(wire::JobState::Failed) => Ok(JobState::Failed),
        Ok(wire::JobState::Cancelled) => Ok(JobState::Cancelled),
        _ => Err(WireError::UnknownValue { field: "job state", value }),
    }
}

impl From<&JobResult> for wire::JobResult {
    fn from(result: &JobResult) -> Self {
        let (failure_code, failure_message) = result.failure.clone().unwrap_or_default();
        Self {
            job: result.job.0.to_vec(),
            kind: result.kind.clone(),
            view: result.view.map(|ViewId(id)| id),
            state: wire::JobState::from(result.state).into(),
            attempt: result.attempt.0,
            ended: result.ended,
            blob: result.blob.map(Into::into),
            measurements: result.measurements.clone(),
            seconds: result.seconds,
            worker: result.worker.as_ref().map(|WorkerId(id)| id.clone()).unwrap_or_default(),
            failure_code,
            failure_message,
        }
    }
}

impl TryFrom<wire::JobResult> for JobResult {
    type Error = WireError;

    fn try_from(result: wire::JobResult) -> Result<Self, WireError> {
        let blob = result.blob.map(TryInto::try_into).transpose()?;
        let code = optional_name("failure code", result.failure_code)?;
        let message = short("failure message", result.failure_message, MAX_MESSAGE_TEXT_BYTES)?;
        let worker = optional_name("worker", result.worker)?;
        Ok(Self {
            job: job_id("job", &result.job)?,
            kind: name("kind", result.kind)?,
            view: result.view.map(ViewId),
            state: job_state(result.state)?,
            attempt: Attempt(result.attempt),
            ended: result.ended,
            blob,
            measurements: measurements(result.measurements)?,
            seconds: not_negative("seconds", result.seconds)?,
            worker: (!worker.is_empty()).then_some(WorkerId(worker)),
            failure: (!code.is_empty()).then_some((code, message)),
        })
    }
}

impl From<&WorkerStatus> for wire::Worker {
    fn from(worker: &WorkerStatus) -> Self {
        Self {
            id: worker.worker.0.clone(),
            host: worker.host.clone(),
            role: wire::Role::from(worker.role).into(),
            device: worker.device.clone(),
            state: wire::WorkerState::from(worker.state).into(),
            alive: worker.alive,
            last_report_ms_ago: worker.last_report_ago.as_millis() as u64,
            held: worker.held,
        }
    }
}

impl TryFrom<wire::Worker> for WorkerStatus {
    type Error = WireError;

    fn try_from(worker: wire::Worker) -> Result<Self, WireError> {
        Ok(Self {
            worker: WorkerId(name("worker", worker.id)?),
            host: name("host", worker.host)?,
            role: role(worker.role)?,
            device: optional_name("device", worker.device)?,
            state: worker_state(worker.state)?,
            alive: worker.alive,
            last_report_ago: Duration::from_millis(worker.last_report_ms_ago),
            held: worker.held,
        })
    }
}

impl From<&RunStatus> for wire::StatusReply {
    fn from(status: &RunStatus) -> Self {
        Self {
            name: status.name.clone(),
            finished: status.finished,
            cancelled: status.cancelled,
            counts: status
                .counts
                .iter()
                .map(|((kind, state), jobs)| wire::Count {
                    kind: kind.clone(),
                    state: wire::JobState::from(*state).into(),
                    jobs: *jobs,
                })
                .collect(),
            failures: status.failures.iter().map(Into::into).collect(),
            recent: status.recent.iter().map(Into::into).collect(),
            workers: status.workers.iter().map(Into::into).collect(),
            workers_alive: status.workers_alive,
            waiting_ms: status.waiting.map(|waiting| waiting.as_millis() as u64),
            late_results: status.late_results,
            divergent_results: status.divergent_results,
            refused_callers: status.refused_callers,
        }
    }
}

impl TryFrom<wire::StatusReply> for RunStatus {
    type Error = WireError;

    fn try_from(status: wire::StatusReply) -> Result<Self, WireError> {
        at_most("counts", status.counts.len(), MAX_REPORTED)?;
        at_most("failures", status.failures.len(), MAX_REPORTED)?;
        at_most("recent results", status.recent.len(), MAX_REPORTED)?;
        at_most("workers", status.workers.len(), MAX_JOBS)?;
        let counts = each(status.counts, |count| {
            Ok(((name("kind", count.kind)?, job_state(count.state)?), count.jobs))
        })?;
        Ok(Self {
            name: name("run name", status.name)?,
            finished: status.finished,
            cancelled: status.cancelled,
            counts: counts.into_iter().collect(),
            failures: each(status.failures, TryInto::try_into)?,
            recent: each(status.recent, TryInto::try_into)?,
            workers: each(status.workers, TryInto::try_into)?,
            workers_alive: status.workers_alive,
            waiting: status.waiting_ms.map(Duration::from_millis),
            late_results: status.late_results,
            divergent_results: status.divergent_results,
            refused_callers: status.refused_callers,
        })
    }
}

#[cfg(test)]
mod tests {
    use planesweep_plan::BlobKey;

    use super::*;
    use crate::{Role, WorkerState};

    fn result() -> JobResult {
        JobResult {
            job: JobId([3; 32]),
            kind: "infer".into(),
            view: Some(ViewId(0)),
            state: JobState::Done,
            attempt: Attempt(2),
            ended: 17,
            blob: Some((BlobKey::of(b"map"), 3)),
            measurements: [("pixels".to_owned(), 12.0)].into(),
            seconds: 1.5,
            worker: Some(WorkerId("w1".into())),
            failure: Some(("decode".into(), "could not decode a.jpg".into())),
        }
    }

    #[test]
    fn status_survives_the_wire() {
        let unended = JobResult {
            view: None,
            state: JobState::Open,
            attempt: Attempt(0),
            ended: 0,
            blob: None,
            measurements: [].into(),
            worker: None,
            failure: None,
            ..result()
        };
        let worker = WorkerStatus {
            worker: WorkerId("w1".into()),
            host: "h".into(),
            role: Role::Both,
            device: "cpu".into(),
            state: WorkerState::Draining,
            alive: false,
            last_report_ago: Duration::from_millis(1234),
            held: 2,
        };
        let counts = JobState::ALL.into_iter().zip(1..).map(|(state, n)| (("infer".to_owned(), state), n));
        let status = RunStatus {
            name: "castle".into(),
            finished: true,
            cancelled: false,
            counts: counts.collect(),
            failures: vec![unended],
            recent: vec![result()],
            workers: vec![worker],
            workers_alive: 1,
            waiting: Some(Duration::from_millis(9)),
            late_results: 4,
            divergent_results: 1,
            refused_callers: 7,
        };
        assert_eq!(RunStatus::try_from(wire::StatusReply::from(&status)), Ok(status));
    }

    #[test]
    fn lists_of_runs_survive_the_wire() {
        let run = RunSummary {
            run: RunId("castle-7".into()),
            name: "castle".into(),
            cancelled: false,
            jobs: 9,
            done: 7,
            failed: 1,
        };
        assert!(!run.is_finished() && RunSummary { failed: 2, ..run.clone() }.is_finished());
        assert_eq!(RunSummary::try_from(wire::Run::from(&run)), Ok(run));
    }

    #[test]
    fn headers_survive_the_wire_and_need_a_name() {
        let header =
            SubmitHeader { name: "castle".into(), exclusive: true, missing_results: vec![JobId([9; 32])] };
        let mut message = wire::SubmitHeader::from(&header);
        assert_eq!(SubmitHeader::try_from(message.clone()), Ok(header));
        message.missing_results[0].pop();
        assert_eq!(SubmitHeader::try_from(message), Err(WireError::HashLength { field: "job", got: 31 }));
        assert_eq!(
            SubmitHeader::try_from(wire::SubmitHeader::default()),
            Err(WireError::BadText { field: "run name", text: String::new() })
        );
    }

    #[test]
    fn unknown_states_are_refused() {
        let mut message = wire::JobResult::from(&result());
        message.state = 77;
        assert_eq!(
            JobResult::try_from(message),
            Err(WireError::UnknownValue { field: "job state", value: 77 })
        );
    }
}
