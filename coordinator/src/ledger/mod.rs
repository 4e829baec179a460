//! The ledger: SQL is the truth about every job.
//!
//! | file | statements |
//! | --- | --- |
//! | `schema` | the tables |
//! | `step` | submit, claim, renew, complete, fail, sweep: conditional, in one transaction |
//! | `query` | what clients ask: status, failures, results |
//! | `rows` | what coordinators read: all jobs at the start, later those that others changed |
//!
//! A step is durable once it is committed: the process may be killed at any moment, and
//! the next one finds either all of a step or nothing of it. The statements are the same for SQLite
//! and PostgreSQL, but for the beginning of a step and for the claim.
//!
//! **Several coordinators** may share a PostgreSQL ledger. Steps have numbers without gaps, and taking
//! the next number is taking the right to write, so steps come one after the other. A coordinator that
//! gets a number that does not follow its own last one reads what was changed in between before it
//! decides; so each decides on the truth, and a statement that changes no row is one that somebody was
//! faster with. One that freezes within a step is cut off by the server.

mod error;
mod place;
mod query;
mod rows;
mod schema;
mod step;
mod store;

use std::fs::{File, TryLockError};
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use planesweep_plan::JobId;
use planesweep_proto::ServiceError;
use sqlx::any::{AnyConnectOptions, AnyPoolOptions};
use sqlx::{AnyPool, Connection, Executor};
use url::Url;

pub use error::LedgerError;
pub use place::LedgerPlace;
pub(crate) use rows::{Change, Changes};
pub(crate) use step::Step;

use crate::schedule::{Reopening, Timestamp};

/// How long a statement waits for a connection; whoever asked may ask again.
const CONNECTING: Duration = Duration::from_secs(4);

/// The jobs, attempts, leases and results of all runs.
#[derive(Debug)]
pub struct Ledger {
    pool: AnyPool,
    kind: Kind,
    place: LedgerPlace,
    /// Held for as long as the ledger is open: two coordinators on one SQLite file would each
    /// renew leases by a clock of their own.
    _lock: Option<File>,
}

/// Which database it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Sqlite,
    Postgres,
}

impl Kind {
    /// How a transaction begins.
    fn begin(self) -> &'static str {
        match self {
            // Immediate: the right to write is taken now, so no statement fails for the lack of it.
            Self::Sqlite => "BEGIN IMMEDIATE",
            Self::Postgres => "BEGIN",
        }
    }

    /// What each connection is told first.
    fn settings(self) -> &'static str {
        match self {
            // In WAL mode, anything less than full may lose the last commits when the power fails.
            Self::Sqlite => "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL",
            // A coordinator that freezes within a step must not keep the others out.
            Self::Postgres => "SET idle_in_transaction_session_timeout = '10s'",
        }
    }
}

impl Ledger {
    /// Opens the ledger, or makes it. Only one process can have a file open; a PostgreSQL may be shared.
    pub async fn open(place: &LedgerPlace) -> Result<Self, LedgerError> {
        sqlx::any::install_default_drivers();
        let failed = |source| LedgerError::Open { ledger: place.clone(), source };
        let (kind, url, lock) = match place {
            LedgerPlace::File(path) => (Kind::Sqlite, sqlite_url(path), Some(lock(path)?)),
            LedgerPlace::Postgres(url) => (Kind::Postgres, url.clone(), None),
        };
        let options = AnyConnectOptions::from_str(&url).map_err(failed)?;
        let pool = AnyPoolOptions::new()
            .max_connections(4)
            .acquire_timeout(CONNECTING)
            .after_connect(move |connection, _| {
                Box::pin(async move {
                    connection.execute(sqlx::raw_sql(kind.settings())).await?;
                    Ok(())
                })
            })
            // When a commit fails for want of room, SQLite has rolled back already, and the connection counts a
            // transaction for ever that no longer is; another connection takes its place.
            .before_acquire(|connection, _| Box::pin(async move { Ok(!connection.is_in_transaction()) }))
            .connect_with(options)
            .await
            .map_err(failed)?;
        schema::create(&pool, kind, place).await?;
        Ok(Self { pool, kind, place: place.clone(), _lock: lock })
    }

    /// A failure of it as callers learn of it.
    pub(crate) fn refusal(&self, error: &LedgerError) -> ServiceError {
        error.refusal(&self.place)
    }

    /// Whether other coordinators may change it, too.
    pub(crate) fn is_shared(&self) -> bool {
        self.kind == Kind::Postgres
    }

    /// Begins to change the ledger.
    pub(crate) async fn begin(&self, now: Timestamp) -> Result<Step, LedgerError> {
        Step::begin(&self.pool, self.kind, now).await
    }

    /// Every job, in plan order, as of the latest step.
    pub(crate) async fn load(&self, now: Timestamp) -> Result<Changes, LedgerError> {
        self.changes(-1, now).await
    }

    /// What changed after a step. What another coordinator is just changing may be left out or be in it;
    /// then it is in the next changes, too.
    pub(crate) async fn changes(&self, after: i64, now: Timestamp) -> Result<Changes, LedgerError> {
        let mut connection = self.pool.acquire().await.map_err(LedgerError::statement("reach the ledger"))?;
        rows::changes(&mut connection, self.kind, after, now).await
    }

    /// Makes done jobs run again whose results are no longer in the store; says how many there were.
    ///
    /// For a ledger without a coordinator; a running one is told with
    /// [`crate::Handle::forget_results`] or with the submission.
    pub async fn forget_results(&self, jobs: &[JobId]) -> Result<usize, LedgerError> {
        let mut step = self.begin(Timestamp::default()).await?;
        let mut forgotten = 0;
        for job in jobs {
            forgotten += usize::from(step.reopen(job, Reopening::ResultLost).await?);
        }
        step.commit().await?;
        Ok(forgotten)
    }

    /// Closes the ledger; what was committed stays.
    pub async fn close(self) {
        self.pool.close().await;
    }
}

fn sqlite_url(path: &Path) -> String {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let encoded = Url::from_file_path(&absolute).map(|url| url.path().to_owned());
    format!("sqlite://{}?mode=rwc", encoded.unwrap_or_else(|()| absolute.display().to_string()))
}

fn lock(path: &Path) -> Result<File, LedgerError> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let failed = |source| LedgerError::Lock { ledger: path.into(), source };
    let file = File::options().create(true).write(true).truncate(false).open(&name).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(LedgerError::InUse { ledger: path.into() }),
        Err(TryLockError::Error(source)) => Err(failed(source)),
    }
}
