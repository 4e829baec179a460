//! The ledger: SQL is the truth about every job.
//!
//! | file | statements |
//! | --- | --- |
//! | `schema` | the tables |
//! | `step` | submit, claim, renew, complete, fail, sweep: conditional, in one transaction |
//! | `query` | what clients ask: status, failures, results |
//!
//! A step is durable once it is committed: the process may be killed at any moment, and
//! the next one finds either all of a step or nothing of it. Placeholders and types are those that
//! SQLite and PostgreSQL share.

mod error;
mod query;
mod schema;
mod step;

use std::fs::{File, TryLockError};
use std::path::Path;

use planesweep_plan::JobId;
use planesweep_proto::Produced;
use sqlx::SqlitePool;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};

pub use error::LedgerError;
pub(crate) use step::Step;

use crate::schedule::{JobRecord, Reopening};

/// The jobs, attempts, leases and results of all runs.
#[derive(Debug)]
pub struct Ledger {
    pool: SqlitePool,
    /// Held for as long as the ledger is open: two coordinators on one SQLite file would each
    /// decide on a picture that the other one changes.
    _lock: File,
}

impl Ledger {
    /// Opens the ledger in this file, or makes it. Only one process can have it open.
    pub async fn open(path: &Path) -> Result<Self, LedgerError> {
        let lock = lock(path)?;
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            // In WAL mode, anything less may lose the last commits when the power fails.
            .synchronous(SqliteSynchronous::Full);
        let pool = SqlitePoolOptions::new()
            .max_connections(4)
            .connect_with(options)
            .await
            .map_err(|source| LedgerError::Open { path: path.to_owned(), source })?;
        schema::create(&pool, path).await?;
        Ok(Self { pool, _lock: lock })
    }

    /// Begins to change the ledger.
    pub(crate) async fn begin(&self) -> Result<Step, LedgerError> {
        Step::begin(&self.pool).await
    }

    /// Every job, in plan order.
    pub(crate) async fn load(&self) -> Result<Vec<JobRecord>, LedgerError> {
        query::records(&self.pool).await
    }

    /// The result of every job that is done.
    pub(crate) async fn load_results(&self) -> Result<Vec<(JobId, Produced)>, LedgerError> {
        query::produced(&self.pool).await
    }

    /// Makes done jobs run again whose results are no longer in the store; says how many there were.
    ///
    /// For a ledger without a coordinator; a running one is told with
    /// [`crate::Handle::forget_results`] or with the submission.
    pub async fn forget_results(&self, jobs: &[JobId]) -> Result<usize, LedgerError> {
        let mut step = self.begin().await?;
        let mut forgotten = 0;
        for job in jobs {
            forgotten += usize::from(step.reopen(job, Reopening::ResultLost).await?);
        }
        step.commit().await?;
        Ok(forgotten)
    }

    /// Closes the file; what was committed stays.
    pub async fn close(self) {
        self.pool.close().await;
    }
}

fn lock(path: &Path) -> Result<File, LedgerError> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let failed = |source| LedgerError::Lock { path: path.to_owned(), source };
    let file = File::options().create(true).write(true).truncate(false).open(&name).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(LedgerError::InUse { path: path.to_owned() }),
        Err(TryLockError::Error(source)) => Err(failed(source)),
    }
}
