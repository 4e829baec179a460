//! Who does what, when: decisions only. No I/O, no clock, nothing random.
//!
//! | the driver does | this module decides |
//! | --- | --- |
//! | receives reports, submissions and ticks, reads the clock | [`decide`]: what follows from an event |
//! | carries out each command as a conditional SQL statement | nothing: the command leaves no choice |
//! | [`Snapshot::apply`]s those that changed a row, drops the others | how the snapshot changes |
//!
//! A job lives like this; *open* is one state in the ledger, and what kind of open follows from
//! the jobs it needs and from the time:
//!
//! ```text
//!            ┌────────────── open ──────────────┐
//!  submit ──>│ waiting ──> ready <── delayed     │──cancel──> cancelled
//!            └───▲──────────┬─────────▲─────────┘               │ submit again: open
//!     release,   │          │ grant   │ retry
//!     suspect    │          ▼         │
//!                └──────  leased ─────┘──give up──> failed ── submit again: open
//!                           │
//!                           └──complete──> done ── result lost, new input: open
//! ```
//!
//! Invariants, tested with random histories:
//!
//! - A job has one lease at most, and none when it is done, failed or cancelled.
//! - Each grant has a higher attempt than all before it; only the attempt that holds the lease can
//!   complete or fail the job, so each effect happens once.
//! - A job is granted only when each job it needs is done or failed for good.
//! - A job fails for good by itself, after [`MAX_FAILURES`] failures that count, after
//!   [`MAX_LOSSES`] tries that found an input lost, after [`MAX_DEATHS_ALONE`] deaths of workers that
//!   held nothing else, or when the ledger cannot give it out; not by anything else.
//! - While a worker that takes its class lives and reports, every job that a run wants ends.

mod assign;
mod change;
mod event;
mod lease;
mod report;
mod state;
mod submit;

pub use event::{Class, Command, Ending, Event, Finished, FreeSlots, Held, JobShape, Reopening, Timestamp};
pub use state::{JobRecord, LedgerState, Snapshot};
pub use submit::{OrderError, check_order};

/// Failures that count against a job before it fails for good.
pub const MAX_FAILURES: u32 = 3;

/// Tries of a job that found an input lost, and did not count, before it fails for good: a store that
/// loses everything must end the job at last.
pub const MAX_LOSSES: u32 = 20;

/// Deaths of workers running a job alone before it is quarantined.
pub const MAX_DEATHS_ALONE: u32 = 3;

/// What follows from an event.
pub fn decide(snapshot: &Snapshot, event: Event, now: Timestamp) -> Vec<Command> {
    match event {
        Event::Submitted { jobs } => submit::submitted(snapshot, jobs),
        Event::Reported { worker, host, ready, held, finished } => {
            report::reported(snapshot, (&worker, host), ready, &held, &finished, now)
        }
        Event::WantsWork { worker, free, waiting } => {
            assign::wants_work(snapshot, &worker, free, &waiting, now)
        }
        // No other try would read more; without it the jobs that need it go on.
        Event::Unreadable { job, attempt } => vec![Command::GiveUp { job, attempt, quarantined: false }],
        Event::Tick => lease::tick(snapshot, now),
        Event::Cancelled { jobs } => submit::cancelled(snapshot, &jobs),
        Event::ResultsLost { jobs } => submit::results_lost(snapshot, &jobs),
    }
}
