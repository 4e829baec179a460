//! Who does it: the ledger of jobs, scheduling decisions, and the gRPC service that workers report to.
//!
//! ```text
//! workers, clients ══ gRPC ══> service ── messages ──> driver ── events ──> schedule (pure)
//!                                                        │ <── commands ──────┘
//!                                                        └──── statements ──> ledger (SQL)
//! ```
//!
//! [`Coordinator::start`] runs one in this process. [`schedule`] holds every decision and its
//! invariants; [`Ledger`] is the truth, and a coordinator that was killed goes on from it.

#![warn(missing_docs)]

mod config;
mod driver;
mod ledger;
pub mod schedule;
mod server;
mod service;

pub use config::{Config, ConfigError, ServedStore};
pub use ledger::{Ledger, LedgerError, LedgerPlace};
pub use server::{Coordinator, Handle, StartError};
