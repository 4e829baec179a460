//! What can go wrong with the ledger.

use std::io;
use std::path::PathBuf;

use planesweep_plan::RunId;
use thiserror::Error;

/// Why the ledger could not be read or changed.
#[derive(Debug, Error)]
pub enum LedgerError {
    /// The lock file could not be made.
    #[error("could not lock the ledger {}", path.display())]
    Lock {
        /// The ledger.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Another process has it.
    #[error("the ledger {} is in use by another coordinator; stop it or choose another output folder", path.display())]
    InUse {
        /// The ledger.
        path: PathBuf,
    },
    /// The file could not be opened as a database.
    #[error("could not open the ledger {}", path.display())]
    Open {
        /// The ledger.
        path: PathBuf,
        /// Why.
        #[source]
        source: sqlx::Error,
    },
    /// It was made by another version.
    #[error("the ledger {} has schema {found}, this version reads {expected}", path.display())]
    Schema {
        /// The ledger.
        path: PathBuf,
        /// What it has.
        found: i64,
        /// What is understood.
        expected: i64,
    },
    /// A statement failed.
    #[error("could not {what} in the ledger")]
    Statement {
        /// What was attempted.
        what: &'static str,
        /// Why.
        #[source]
        source: sqlx::Error,
    },
    /// A row holds what was never written.
    #[error("the ledger is damaged: {what} of a job is {found}")]
    Damaged {
        /// Which column.
        what: &'static str,
        /// What it holds.
        found: String,
    },
    /// There is no such run.
    #[error("there is no run {run}")]
    NoSuchRun {
        /// The run.
        run: RunId,
    },
}

impl LedgerError {
    /// For `map_err` on a statement.
    pub(super) fn statement(what: &'static str) -> impl Fn(sqlx::Error) -> Self {
        move |source| Self::Statement { what, source }
    }
}
