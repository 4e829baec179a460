//! What went wrong in a job, and what follows from it.

use planesweep_fusion::EmptyCloud;
use planesweep_mvsnet::InferError;
use planesweep_plan::JobId;
use planesweep_proto::{Failure, with_causes};
use planesweep_scene::StitchError;
use thiserror::Error;

use crate::blob::BlobError;
use crate::device::DeviceError;
use crate::files::FileError;
use crate::images::ImagesError;
use crate::store::StoreError;

/// Why a job has no result.
#[derive(Debug, Error)]
pub enum JobError {
    /// An image could not be had.
    #[error(transparent)]
    Image(#[from] ImagesError),
    /// The network failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The result of a needed job could not be read.
    #[error("cannot read the result of job {job}")]
    Input {
        /// The needed job.
        job: JobId,
        /// What the store said.
        #[source]
        source: StoreError,
    },
    /// Results of needed jobs are gone or damaged.
    #[error("the results of {} needed jobs are no longer in the store", jobs.len())]
    Lost {
        /// The needed jobs.
        jobs: Vec<JobId>,
    },
    /// The result of a needed job is not what it must be.
    #[error("the result of job {job} makes no sense")]
    Malformed {
        /// The needed job.
        job: JobId,
        /// What is wrong with it.
        #[source]
        source: BlobError,
    },
    /// The weights could not be read.
    #[error("cannot read the weights")]
    Weights(#[source] StoreError),
    /// The result could not be stored.
    #[error("cannot store the result")]
    Store(#[source] StoreError),
    /// Bands do not make a depth map.
    #[error("cannot put the bands of the view together")]
    Bands(#[from] StitchError),
    /// The depth map of the view itself, or a band of it, failed for good.
    #[error("there is no depth map of the view itself")]
    NoDepthMap,
    /// No view gave a point.
    #[error(transparent)]
    EmptyCloud(#[from] EmptyCloud),
    /// The code panicked: a bug.
    #[error("the job panicked: {message}")]
    Panicked {
        /// What the panic said.
        message: String,
    },
    /// The job was taken back before it was done.
    #[error("given up: the worker is stopping or its lease is over")]
    GivenUp,
}

impl JobError {
    /// What the coordinator is told.
    pub fn to_failure(&self) -> Failure {
        let (code, retryable, counts_against_job) = match self {
            // The store's trouble is not the job's.
            Self::Image(ImagesError::File(FileError::Store { .. }))
            | Self::Input { .. }
            | Self::Weights(_) => ("store-read", true, false),
            // The bytes are fixed by their hash, so another try sees the same.
            Self::Image(ImagesError::File(FileError::Read { .. })) => ("image-read", true, true),
            Self::Image(_) => ("image", false, true),
            // The device is the worker's trouble, not the job's: the worker goes, see `is_fatal`.
            Self::Device(DeviceError::Load { .. }) => ("load", true, false),
            Self::Device(DeviceError::Infer(InferError::OutOfMemory { .. })) => ("out-of-memory", true, true),
            Self::Device(DeviceError::Infer(InferError::Library { .. })) => ("library", true, true),
            Self::Device(DeviceError::Infer(_)) => ("infer", false, true),
            Self::Device(DeviceError::Gone) => ("device-gone", true, true),
            Self::Lost { .. } => ("input-lost", true, false),
            Self::Malformed { .. } => ("input-malformed", true, true),
            Self::Store(_) => ("store-write", true, false),
            Self::Bands(_) => ("bands", false, true),
            Self::NoDepthMap => ("no-depth-map", false, true),
            Self::EmptyCloud(_) => ("empty-cloud", false, true),
            Self::Panicked { .. } => ("panic", true, true),
            Self::GivenUp => ("given-up", true, false),
        };
        let lost_inputs = match self {
            Self::Lost { jobs } => jobs.clone(),
            Self::Malformed { job, .. } => vec![*job],
            _ => Vec::new(),
        };
        let code = code.to_owned();
        Failure { code, message: with_causes(self), retryable, counts_against_job, lost_inputs }
    }
}

impl JobError {
    /// Whether the worker can do no further job: its device does not work.
    pub fn is_fatal(&self) -> bool {
        matches!(self, Self::Device(DeviceError::Load { .. } | DeviceError::Gone))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lost_input_names_the_job_that_must_run_again_and_does_not_count() {
        let job = JobId([7; 32]);
        let failure = JobError::Lost { jobs: vec![job] }.to_failure();
        assert_eq!(failure.lost_inputs, [job]);
        assert!(failure.retryable && !failure.counts_against_job);
    }

    #[test]
    fn a_damaged_image_is_not_tried_again() {
        let error = JobError::Image(FileError::Changed { path: "a.jpg".into() }.into());
        assert!(!error.to_failure().retryable);
        assert_eq!(error.to_failure().message, "image a.jpg has changed since the run was planned");
    }
}
