//! What is to be done: pure functions from a scene to source views, depth hypotheses and jobs.
//!
//! ```text
//! Scene ── views (who helps whom) ── depth_range ── size ──> Plan ── jobs ──> [Job]
//! ```
//!
//! Nothing here reads a disk, a clock or a random number: the same scene and options give the same
//! plan, and the same plan the same job ids, so that work already done is recognised.
#![warn(missing_docs)]

mod bands;
mod checkup;
mod depth_range;
mod focus;
mod ids;
mod job;
mod jobs;
mod options;
mod order;
mod plan;
mod size;
mod views;

pub use checkup::{Finding, Severity, checkup, sparse_depths};
pub use depth_range::{DEPTH_MULTIPLE, MIN_POINTS};
pub use ids::{Attempt, BlobHasher, BlobKey, JobId, ParseHashError, RunId, WorkerId};
pub use job::{
    AssembleSpec, EmitSpec, FilterSpec, FitSpec, ImageSpec, InferSpec, Job, JobSpec, MaskSpec,
    NUMERICS_VERSION, StitchSpec,
};
pub use jobs::{JobsError, jobs};
pub use options::{MAX_DEPTHS, MIN_DEPTHS, PlanOptions, SamplingChoice};
pub use order::{order_views, symmetric_neighbours};
pub use plan::{Plan, RangeOrigin, SkipReason, ViewPlan, plan};
pub use size::working_size;
pub use views::{SourceRanking, angle_score, rank_sources};
