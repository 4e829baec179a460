//! Reports.

use std::time::Duration;

use planesweep_plan::{JobId, WorkerId};

use super::check::{
    at_most, attempt, blob_key, each, in_range, job_id, measurements, name, not_negative, optional_name,
    required, short,
};
use crate::limits::{
    MAX_MEASUREMENTS, MAX_MESSAGE_TEXT_BYTES, MAX_NAME_BYTES, MAX_REPORTED, MAX_SLOTS, MAX_VIEWS,
};
use crate::{
    Endpoint, Failure, FinishedJob, HeldJob, Outcome, Report, Role, Slots, Success, WireError, WorkerState,
    wire,
};

impl From<&Report> for wire::ReportRequest {
    fn from(report: &Report) -> Self {
        Self {
            protocol_version: report.protocol_version,
            code_version: report.code_version.clone(),
            numerics_version: report.numerics_version,
            worker: report.worker.0.clone(),
            sequence: report.sequence,
            host: report.host.clone(),
            boot_id: report.boot_id.clone(),
            role: wire::Role::from(report.role).into(),
            device: report.device.clone(),
            state: wire::WorkerState::from(report.state).into(),
            free: Some(wire::Slots { infer: report.free.infer, fuse: report.free.fuse }),
            offset_ms: report.offset_ms,
            held: report.held.iter().map(|job| (*job).into()).collect(),
            finished: report.finished.iter().map(Into::into).collect(),
            max_wait_ms: millis(report.max_wait),
            address: report.endpoint.address.clone().unwrap_or_default(),
            inbox: report.endpoint.inbox.clone().unwrap_or_default(),
        }
    }
}

impl TryFrom<wire::ReportRequest> for Report {
    type Error = WireError;

    fn try_from(report: wire::ReportRequest) -> Result<Self, WireError> {
        at_most("held", report.held.len(), MAX_REPORTED)?;
        at_most("finished", report.finished.len(), MAX_REPORTED)?;
        let free = required("free", report.free)?;
        Ok(Self {
            protocol_version: report.protocol_version,
            code_version: name("code version", report.code_version)?,
            numerics_version: report.numerics_version,
            worker: WorkerId(name("worker", report.worker)?),
            sequence: report.sequence,
            host: name("host", report.host)?,
            boot_id: optional_name("boot id", report.boot_id)?,
            role: role(report.role)?,
            device: optional_name("device", report.device)?,
            state: worker_state(report.state)?,
            free: Slots {
                infer: in_range("free infer slots", free.infer, 0, MAX_SLOTS)?,
                fuse: in_range("free fuse slots", free.fuse, 0, MAX_SLOTS)?,
            },
            offset_ms: report.offset_ms,
            held: each(report.held, TryInto::try_into)?,
            finished: each(report.finished, TryInto::try_into)?,
            max_wait: Duration::from_millis(report.max_wait_ms.into()),
            endpoint: endpoint(report.address, report.inbox)?,
        })
    }
}

pub(super) fn endpoint(address: String, inbox: String) -> Result<Endpoint, WireError> {
    let present = |text: String| (!text.is_empty()).then_some(text);
    Ok(Endpoint {
        address: present(optional_name("address", address)?),
        inbox: present(optional_name("inbox", inbox)?),
    })
}

pub(super) fn millis(duration: Duration) -> u32 {
    u32::try_from(duration.as_millis()).unwrap_or(u32::MAX)
}

impl From<Role> for wire::Role {
    fn from(role: Role) -> Self {
        match role {
            Role::Infer => Self::Infer,
            Role::Fuse => Self::Fuse,
            Role::Both => Self::Both,
        }
    }
}

pub(super) fn role(value: i32) -> Result<Role, WireError> {
    match wire::Role::try_from(value) {
        Ok(wire::Role::Infer) => Ok(Role::Infer),
        Ok(wire::Role::Fuse) => Ok(Role::Fuse),
        Ok(wire::Role::Both) => Ok(Role::Both),
        _ => Err(WireError::UnknownValue { field: "role", value }),
    }
}

impl From<WorkerState> for wire::WorkerState {
    fn from(state: WorkerState) -> Self {
        match state {
            WorkerState::Ready => Self::Ready,
            WorkerState::Draining => Self::Draining,
            WorkerState::Drained => Self::Drained,
        }
    }
}

pub(super) fn worker_state(value: i32) -> Result<WorkerState, WireError> {
    match wire::WorkerState::try_from(value) {
        Ok(wire::WorkerState::Ready) => Ok(WorkerState::Ready),
        Ok(wire::WorkerState::Draining) => Ok(WorkerState::Draining),
        Ok(wire::WorkerState::Drained) => Ok(WorkerState::Drained),
        _ => Err(WireError::UnknownValue { field: "worker state", value }),
    }
}

impl From<HeldJob> for wire::HeldJob {
    fn from(held: HeldJob) -> Self {
        Self { job: held.job.0.to_vec(), attempt: held.attempt.0, started: held.started }
    }
}

impl TryFrom<wire::HeldJob> for HeldJob {
    type Error = WireError;

    fn try_from(held: wire::HeldJob) -> Result<Self, WireError> {
        Ok(Self {
            job: job_id("held job", &held.job)?,
            attempt: attempt(held.attempt)?,
            started: held.started,
        })
    }
}

impl From<&FinishedJob> for wire::FinishedJob {
    fn from(finished: &FinishedJob) -> Self {
        use wire::finished_job::Outcome as Wire;
        let outcome = match &finished.outcome {
            Outcome::Success(success) => Wire::Success(wire::Success {
                blob: success.blob.0.to_vec(),
                length: success.length,
                measurements: success
                    .measurements
                    .iter()
                    .filter(|(_, value)| value.is_finite())
                    .take(MAX_MEASUREMENTS)
                    .map(|(key, value)| (key.clone(), *value))
                    .collect(),
                seconds: success.seconds,
            }),
            Outcome::Failure(failure) => Wire::Failure(wire::Failure {
                code: one_line(&failure.code),
                message: cut(&failure.message, MAX_MESSAGE_TEXT_BYTES).to_owned(),
                retryable: failure.retryable,
                counts_against_job: failure.counts_against_job,
                lost_inputs: failure.lost_inputs.iter().map(|JobId(hash)| hash.to_vec()).collect(),
            }),
        };
        Self { job: finished.job.0.to_vec(), attempt: finished.attempt.0, outcome: Some(outcome) }
    }
}

/// A failure's code as the receiver accepts it: a failure must never be refused for its words.
fn one_line(code: &str) -> String {
    let code: String = cut(code, MAX_NAME_BYTES).chars().filter(|c| !c.is_control()).collect();
    if code.is_empty() { "unnamed".to_owned() } else { code }
}

/// The longest start of `text` with at most `limit` bytes.
fn cut(text: &str, limit: usize) -> &str {
    &text[..text.floor_char_boundary(limit)]
}

impl TryFrom<wire::FinishedJob> for FinishedJob {
    type Error = WireError;

    fn try_from(finished: wire::FinishedJob) -> Result<Self, WireError> {
        use wire::finished_job::Outcome as Wire;
        let outcome = match required("outcome", finished.outcome)? {
            Wire::Success(success) => Outcome::Success(Success {
                blob: blob_key("result blob", &success.blob)?,
                length: success.length,
                measurements: measurements(success.measurements)?,
                seconds: not_negative("seconds", success.seconds)?,
            }),
            Wire::Failure(failure) => {
                at_most("lost inputs", failure.lost_inputs.len(), MAX_VIEWS)?;
                Outcome::Failure(Failure {
                    code: name("failure code", failure.code)?,
                    message: short("failure message", failure.message, MAX_MESSAGE_TEXT_BYTES)?,
                    retryable: failure.retryable,
                    counts_against_job: failure.counts_against_job,
                    lost_inputs: each(failure.lost_inputs, |id| job_id("lost input", &id))?,
                })
            }
        };
        Ok(Self { job: job_id("finished job", &finished.job)?, attempt: attempt(finished.attempt)?, outcome })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use planesweep_plan::{Attempt, BlobKey};
    use proptest::collection::{btree_map, vec};
    use proptest::prelude::*;
    use prost::Message;

    use super::*;

    /// Any try of a job.
    pub fn job() -> impl Strategy<Value = (JobId, Attempt)> {
        (any::<[u8; 32]>().prop_map(JobId), (1..u32::MAX).prop_map(Attempt))
    }

    fn outcome() -> impl Strategy<Value = Outcome> {
        let measurements = btree_map("[a-z ]{1,9}", -1e9..1e9, 0..5);
        prop_oneof![
            (any::<[u8; 32]>(), any::<u64>(), measurements, 0.0..1e6).prop_map(
                |(blob, length, measurements, seconds)| Outcome::Success(Success {
                    blob: BlobKey(blob),
                    length,
                    measurements,
                    seconds
                })
            ),
            ("[a-z-]{1,9}", ".{0,20}", any::<bool>(), any::<bool>(), vec(any::<[u8; 32]>(), 0..3)).prop_map(
                |(code, message, retryable, counts_against_job, lost)| Outcome::Failure(Failure {
                    code,
                    message,
                    retryable,
                    counts_against_job,
                    lost_inputs: lost.into_iter().map(JobId).collect()
                })
            ),
        ]
    }

    fn report() -> impl Strategy<Value = Report> {
        let held = vec((job(), any::<bool>()), 0..4).prop_map(|jobs| {
            jobs.into_iter().map(|((job, attempt), started)| HeldJob { job, attempt, started }).collect()
        });
        let finished = vec((job(), outcome()), 0..4).prop_map(|jobs| {
            jobs.into_iter().map(|((job, attempt), outcome)| FinishedJob { job, attempt, outcome }).collect()
        });
        let role = prop_oneof![Just(Role::Infer), Just(Role::Fuse), Just(Role::Both)];
        let state =
            prop_oneof![Just(WorkerState::Ready), Just(WorkerState::Draining), Just(WorkerState::Drained)];
        let numbers = (any::<u32>(), any::<u64>(), any::<u64>(), 0..MAX_SLOTS, 0..MAX_SLOTS, any::<u32>());
        ("[a-z0-9-]{1,20}", numbers, role, state, held, finished).prop_map(
            |(worker, (version, sequence, offset_ms, infer, fuse, wait), role, state, held, finished)| {
                Report {
                    protocol_version: version,
                    code_version: "0.1.0".into(),
                    numerics_version: 1,
                    worker: WorkerId(worker),
                    sequence,
                    host: "host".into(),
                    boot_id: String::new(),
                    role,
                    device: "cpu".into(),
                    state,
                    free: Slots { infer, fuse },
                    offset_ms,
                    held,
                    finished,
                    max_wait: Duration::from_millis(wait.into()),
                    endpoint: Endpoint {
                        address: (wait > 9).then(|| "http://10.0.0.2:7071".into()),
                        inbox: (infer > 0).then(|| "inbox".into()),
                    },
                }
            },
        )
    }

    proptest! {
        #[test]
        fn reports_survive_the_wire(report in report()) {
            prop_assert_eq!(Report::try_from(wire::ReportRequest::from(&report)), Ok(report));
        }

        #[test]
        fn garbage_never_panics(report in report(), at in any::<prop::sample::Index>(), to in any::<u8>()) {
            let mut bytes = wire::ReportRequest::from(&report).encode_to_vec();
            let at = at.index(bytes.len());
            bytes[at] = to;
            if let Ok(message) = wire::ReportRequest::decode(bytes.as_slice())
                && let Ok(report) = Report::try_from(message)
            {
                prop_assert_eq!(Report::try_from(wire::ReportRequest::from(&report)), Ok(report));
            }
        }

        #[test]
        fn no_failure_is_refused_for_its_words(code in any::<String>(), message in ".{0,30}", times in 0..2000_usize) {
            let failure = Failure {
                code,
                message: message.repeat(times),
                retryable: true,
                counts_against_job: false,
                lost_inputs: vec![],
            };
            let finished = FinishedJob {
                job: JobId([1; 32]),
                attempt: Attempt(1),
                outcome: Outcome::Failure(failure),
            };
            prop_assert!(FinishedJob::try_from(wire::FinishedJob::from(&finished)).is_ok());
        }
    }

    #[test]
    fn measurements_that_are_no_numbers_stay_behind() {
        let success = Success {
            blob: BlobKey::of(b"map"),
            length: 3,
            measurements: [("nan".into(), f64::NAN), ("pixels".into(), 7.0)].into(),
            seconds: 0.5,
        };
        let finished =
            FinishedJob { job: JobId([1; 32]), attempt: Attempt(1), outcome: Outcome::Success(success) };
        let mut message = wire::FinishedJob::from(&finished);
        let Some(wire::finished_job::Outcome::Success(success)) = &mut message.outcome else {
            panic!("a success stays one");
        };
        assert_eq!(success.measurements, [("pixels".to_owned(), 7.0)].into());
        success.seconds = f64::INFINITY;
        let error = FinishedJob::try_from(message).expect_err("infinite time");
        assert_eq!(error.to_string(), "seconds is inf, which is not finite and at least 0");
    }
}
