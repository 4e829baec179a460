//! The tables.

use std::path::Path;

use sqlx::{Executor, SqlitePool};

use super::LedgerError;

/// Raised with every change of the tables.
const SCHEMA: i64 = 2;

/// `jobs.position` is the order of submission, and so the order of the plan. What a job needs is a
/// list of ids in one column rather than a table of edges: it is written once, read whole, and the
/// graph of 100 000 views has two million edges. `ends` has one row: the highest `jobs.ended` there
/// ever was.
const TABLES: &str = "
CREATE TABLE runs (
    number    INTEGER PRIMARY KEY,
    id        TEXT NOT NULL UNIQUE,
    name      TEXT NOT NULL,
    cancelled INTEGER NOT NULL DEFAULT 0
);
CREATE TABLE jobs (
    position     INTEGER PRIMARY KEY,
    id           BLOB NOT NULL UNIQUE,
    kind         TEXT NOT NULL,
    view         BIGINT,
    spec         BLOB NOT NULL,
    needs        BLOB NOT NULL,
    state        TEXT NOT NULL DEFAULT 'open'
                 CHECK (state IN ('open', 'leased', 'done', 'failed', 'cancelled')),
    attempt      BIGINT NOT NULL DEFAULT 0,
    worker       TEXT,
    deadline_ms  BIGINT,
    failures     BIGINT NOT NULL DEFAULT 0,
    losses       BIGINT NOT NULL DEFAULT 0,
    suspect      INTEGER NOT NULL DEFAULT 0,
    deaths_alone BIGINT NOT NULL DEFAULT 0,
    outdated     INTEGER NOT NULL DEFAULT 0,
    ended        BIGINT NOT NULL DEFAULT 0,
    blob         BLOB,
    blob_length  BIGINT,
    measurements TEXT,
    seconds      DOUBLE PRECISION NOT NULL DEFAULT 0,
    failure_code TEXT,
    failure      TEXT
);
CREATE INDEX jobs_by_state ON jobs (state, kind);
CREATE INDEX jobs_by_end ON jobs (ended);
CREATE TABLE run_jobs (
    run BIGINT NOT NULL,
    seq BIGINT NOT NULL,
    job BIGINT NOT NULL,
    PRIMARY KEY (run, seq)
);
CREATE INDEX run_jobs_by_job ON run_jobs (job, run);
CREATE TABLE ends (latest BIGINT NOT NULL);
INSERT INTO ends (latest) VALUES (0);
";

/// Makes the tables in a new file; refuses a file with tables of another version.
pub(super) async fn create(pool: &SqlitePool, path: &Path) -> Result<(), LedgerError> {
    let failed = LedgerError::statement("read the schema");
    let found: i64 = sqlx::query_scalar("PRAGMA user_version").fetch_one(pool).await.map_err(&failed)?;
    match found {
        SCHEMA => Ok(()),
        0 => {
            let failed = LedgerError::statement("make the tables");
            let mut step = pool.begin_with("BEGIN IMMEDIATE").await.map_err(&failed)?;
            step.execute(TABLES).await.map_err(&failed)?;
            step.execute("PRAGMA user_version = 2").await.map_err(&failed)?;
            step.commit().await.map_err(&failed)
        }
        found => Err(LedgerError::Schema { path: path.to_owned(), found, expected: SCHEMA }),
    }
}
