//! What is to be done: pure functions from a scene to source views, depth hypotheses and jobs.

mod ids;
mod job;

pub use ids::{Attempt, BlobKey, JobId, ParseHashError, RunId, WorkerId};
pub use job::{AssembleSpec, EmitSpec, FilterSpec, ImageSpec, InferSpec, Job, JobSpec, NUMERICS_VERSION};
