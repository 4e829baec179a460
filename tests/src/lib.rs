//! What the tests that cross crates share: the program as a process, scenes, weights, shared data, faults.
//!
//! These tests know the program as its users do, by its arguments, its files and its exit codes.

#![warn(missing_docs)]
#![allow(clippy::missing_panics_doc, reason = "a helper that cannot do its work fails the test")]

mod bench;
pub mod benchmarks;
mod certificates;
mod cluster;
mod composition;
mod containers;
mod convert_middlebury;
mod convert_rgbd;
mod data;
mod faults;
mod mounts;
mod postgres;
mod program;
mod results;
mod s3;
mod scenes;
mod scripts;
mod shared_scenes;
mod slurm;
mod small_disk;

pub use bench::Bench;
pub use certificates::{Authority, ServerCertificate};
pub use cluster::Cluster;
pub use composition::Composition;
pub use containers::Containers;
pub use convert_middlebury::{Bounds, convert_middlebury};
pub use convert_rgbd::convert_rgbd;
pub use data::{reference_weights, shared_data};
pub use faults::{children, is_alive, is_frozen, send, wait_until};
pub use mounts::{can_mount, hiding, mounted};
pub use postgres::Postgres;
pub use program::{Finished, Running, program, run};
pub use results::{blobs, confident_share, files_below};
pub use s3::{S3Server, serve_s3};
pub use scenes::{courtyard, plane, plane_of_size, seeded_weights, seeded_weights_with};
pub use scripts::{python, script, unavailable};
pub use shared_scenes::shared_scenes;
pub use slurm::{Slurm, free_port};
pub use small_disk::SmallDisk;
