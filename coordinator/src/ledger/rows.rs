//! What coordinators read of jobs.

use planesweep_plan::{Attempt, BlobKey, WorkerId};
use planesweep_proto::{JobState, Produced};
use sqlx::AnyConnection;
use sqlx::any::AnyRow;

use super::query::{flag, get, hash, job_id, number, state};
use super::{Kind, LedgerError};
use crate::schedule::{Class, JobRecord, JobShape, LedgerState, Timestamp};

/// What the ledger holds that is newer than a step.
#[derive(Debug)]
pub(crate) struct Changes {
    /// The latest step.
    pub step: i64,
    /// The jobs that changed since, in plan order.
    pub jobs: Vec<Change>,
}

/// A job that somebody changed.
#[derive(Debug)]
pub(crate) struct Change {
    pub record: JobRecord,
    /// When its lease ends, if it has one and the ledger has a clock of its own.
    pub deadline: Option<Timestamp>,
    /// Its result, if it is done.
    pub produced: Option<Produced>,
}

/// The jobs that changed after a step; `now` is the driver's time of this moment.
pub(super) async fn changes(
    connection: &mut AnyConnection,
    kind: Kind,
    after: i64,
    now: Timestamp,
) -> Result<Changes, LedgerError> {
    let failed = LedgerError::statement("read what changed");
    let clock = match kind {
        Kind::Sqlite => "SELECT step, $1 AS now FROM counters",
        Kind::Postgres => {
            "SELECT step, CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT) AS now
             FROM counters WHERE $1 >= 0"
        }
    };
    let query = sqlx::query_as(clock).bind(now.0 as i64);
    let (step, ledger_now): (i64, i64) = query.fetch_one(&mut *connection).await.map_err(&failed)?;
    let jobs =
        if step == after { Vec::new() } else { rows(connection, kind, after, now, ledger_now).await? };
    Ok(Changes { step, jobs })
}

/// The jobs that changed after a step, where the clocks of driver and ledger are known.
pub(super) async fn rows(
    connection: &mut AnyConnection,
    kind: Kind,
    after: i64,
    now: Timestamp,
    ledger_now: i64,
) -> Result<Vec<Change>, LedgerError> {
    let rows = sqlx::query(
        "SELECT id, kind, needs, state, worker, attempt, failures, losses, suspect, deaths_alone, outdated,
                deadline_ms, blob, blob_length
         FROM jobs WHERE changed > $1 ORDER BY position",
    );
    let rows = rows.bind(after).fetch_all(connection).await;
    let rows = rows.map_err(LedgerError::statement("read what changed"))?;
    let deadline = |ledger_deadline: i64| match kind {
        // By the clock of a coordinator that is gone.
        Kind::Sqlite => None,
        Kind::Postgres => Some(now.plus((ledger_deadline - ledger_now).max(0) as u64)),
    };
    rows.iter().map(|row| change(row, deadline)).collect()
}

fn change(row: &AnyRow, deadline: impl Fn(i64) -> Option<Timestamp>) -> Result<Change, LedgerError> {
    let kind: String = get(row, "kind")?;
    let needs: Vec<u8> = get(row, "needs")?;
    let needs = needs.chunks(32).map(|hash| job_id(hash.to_vec())).collect::<Result<_, _>>()?;
    let worker = || Ok::<_, LedgerError>(WorkerId(get(row, "worker")?));
    let (mut ends, mut produced) = (None, None);
    let state = match state(row)? {
        JobState::Open => LedgerState::Open,
        JobState::Leased => {
            ends = get::<Option<i64>>(row, "deadline_ms")?.and_then(deadline);
            LedgerState::Leased(worker()?)
        }
        JobState::Done => {
            let (blob, length): (Vec<u8>, i64) = (get(row, "blob")?, get(row, "blob_length")?);
            let blob = BlobKey(hash("blob", blob)?);
            produced = Some(Produced { blob, length: length as u64, worker: worker()? });
            LedgerState::Done
        }
        JobState::Failed => LedgerState::Failed,
        JobState::Cancelled => LedgerState::Cancelled,
    };
    let record = JobRecord {
        shape: JobShape { id: job_id(get(row, "id")?)?, class: Class::of(&kind), needs },
        state,
        attempt: Attempt(number(row, "attempt")?),
        failures: number(row, "failures")?,
        losses: number(row, "losses")?,
        suspect: flag(row, "suspect")?,
        deaths_alone: number(row, "deaths_alone")?,
        outdated: flag(row, "outdated")?,
    };
    Ok(Change { record, deadline: ends, produced })
}
