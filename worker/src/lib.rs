//! Doing it: leases jobs, infers or fuses, stores the result and reports it.
//!
//! ```text
//! coordinator <── agent (the report loop) ── held (what it holds, pure)
//!                   │ spawns
//!                   └─> jobs (one job from grant to stored result)
//!                         ├─ images ── files (of the scene) ── disk_cache
//!                         ├─ device (one thread owns the network) ── weights
//!                         ├─ maps (decoded, in memory) ── exchange (from and to other workers)
//!                         ├─ cloud
//!                         └─ planesweep_store (the truth of every result) ── blob (maps as bytes)
//! ```
//!
//! A worker needs the coordinator's address, nothing else: where results lie, which weights to use
//! and what to do come with the replies.
#![warn(missing_docs)]

mod agent;
mod blob;
mod cache;
mod cloud;
mod device;
mod disk_cache;
mod exchange;
mod failure;
mod fault_point;
mod files;
mod held;
mod images;
mod jobs;
mod maps;
mod orders;
mod weights;

use planesweep_store as store;

pub use agent::{ConnectedHook, WorkerConfig, WorkerError, run_worker};
pub use blob::{BlobError, decode_depth_map};
pub use device::BackendFactory;
pub use exchange::{ExchangeConfig, ExchangeError};
