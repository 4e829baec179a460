//! Wire to domain and back. All foreign input is checked here, once: behind this module numbers
//! are finite, rotations are rotations, hashes have 32 bytes and counts are within the limits.

mod blob;
mod check;
mod filter;
mod image;
mod job;
mod reply;
mod report;
mod run;

pub use check::WireError;
pub use job::{check_job, check_jobs, decode_job, encode_job};
