//! What is read from the ledger.

use std::collections::BTreeMap;

use planesweep_plan::{Attempt, BlobKey, JobId, RunId, WorkerId};
use planesweep_proto::{JobResult, JobState, RunSummary};
use planesweep_scene::ViewId;
use sqlx::Row;
use sqlx::any::AnyRow;

use super::{Ledger, LedgerError};

/// Failures and ended jobs listed in one status.
const LISTED: i64 = 500;
/// Runs in the list of all.
const LISTED_RUNS: i64 = 50;

/// The columns that [`result`] reads; `LEFT JOIN`ed nowhere, so all are of `jobs`.
macro_rules! select_results {
    ($rest:literal) => {
        concat!(
            "SELECT jobs.id, kind, view, state, attempt, ended, blob, blob_length, measurements, seconds, worker, \
             failure_code, failure, position ",
            $rest
        )
    };
}

/// A run as the ledger knows it.
#[derive(Debug)]
pub(crate) struct RunRow {
    pub name: String,
    pub cancelled: bool,
    pub counts: BTreeMap<(String, JobState), u64>,
    pub failures: Vec<JobResult>,
    pub recent: Vec<JobResult>,
}

impl Ledger {
    /// How far a run is, with the jobs that ended after `after`.
    pub(crate) async fn run(&self, run: &RunId, after: u64) -> Result<RunRow, LedgerError> {
        let failed = LedgerError::statement("read a run");
        let (number, name, cancelled) = self.find(run).await?;
        let counts = self.counts(number).await?;
        let failures = sqlx::query(select_results!(
            "FROM jobs JOIN run_jobs ON jobs.position = run_jobs.job
             WHERE state = 'failed' AND run = $1 ORDER BY seq LIMIT $2"
        ));
        let failures = failures.bind(number).bind(LISTED).fetch_all(&self.pool).await.map_err(&failed)?;
        let recent = sqlx::query(select_results!(
            "FROM jobs WHERE ended > $2
             AND EXISTS (SELECT 1 FROM run_jobs WHERE run_jobs.job = jobs.position AND run = $1)
             ORDER BY ended LIMIT $3"
        ));
        let recent = recent.bind(number).bind(after as i64).bind(LISTED);
        let recent = recent.fetch_all(&self.pool).await.map_err(&failed)?;
        Ok(RunRow {
            name,
            cancelled,
            counts,
            failures: failures.iter().map(result).collect::<Result<_, _>>()?,
            recent: recent.iter().map(result).collect::<Result<_, _>>()?,
        })
    }

    /// Jobs of a run by kind and state.
    async fn counts(&self, run: i64) -> Result<BTreeMap<(String, JobState), u64>, LedgerError> {
        // Over indices alone, in their order: the rows are large, and this is asked every second.
        let rows = sqlx::query(
            "SELECT kind, state, COUNT(*) AS jobs FROM jobs CROSS JOIN run_jobs
             WHERE run_jobs.job = jobs.position AND run = $1 GROUP BY state, kind",
        )
        .bind(run)
        .fetch_all(&self.pool)
        .await
        .map_err(LedgerError::statement("count the jobs of a run"))?;
        let mut counts = BTreeMap::new();
        for row in rows {
            let jobs: i64 = get(&row, "jobs")?;
            counts.insert((get(&row, "kind")?, state(&row)?), jobs as u64);
        }
        Ok(counts)
    }

    /// The latest runs, newest first.
    pub(crate) async fn runs(&self) -> Result<Vec<RunSummary>, LedgerError> {
        let rows: Vec<(i64, String, String, i64)> =
            sqlx::query_as("SELECT number, id, name, cancelled FROM runs ORDER BY number DESC LIMIT $1")
                .bind(LISTED_RUNS)
                .fetch_all(&self.pool)
                .await
                .map_err(LedgerError::statement("list runs"))?;
        let mut runs = Vec::with_capacity(rows.len());
        for (number, id, name, cancelled) in rows {
            let counts = self.counts(number).await?;
            let of = |wanted: Option<JobState>| {
                let counted = counts.iter().filter(|((_, state), _)| wanted.is_none_or(|w| w == *state));
                counted.map(|(_, jobs)| jobs).sum()
            };
            runs.push(RunSummary {
                run: RunId(id),
                name,
                cancelled: cancelled != 0,
                jobs: of(None),
                done: of(Some(JobState::Done)),
                failed: of(Some(JobState::Failed)),
            });
        }
        Ok(runs)
    }

    /// Up to `limit` jobs of a run in plan order, from place `from` on.
    pub(crate) async fn results(
        &self,
        run: &RunId,
        from: usize,
        limit: usize,
    ) -> Result<Vec<JobResult>, LedgerError> {
        let (number, ..) = self.find(run).await?;
        let query = sqlx::query(select_results!(
            "FROM run_jobs JOIN jobs ON jobs.position = run_jobs.job
             WHERE run = $1 AND seq >= $2 ORDER BY seq LIMIT $3"
        ));
        let query = query.bind(number).bind(from as i64).bind(limit as i64);
        let rows = query.fetch_all(&self.pool).await.map_err(LedgerError::statement("read results"))?;
        rows.iter().map(result).collect()
    }

    /// Whether every job of a run ended, or the run was cancelled.
    pub(crate) async fn is_finished(&self, run: &RunId) -> Result<bool, LedgerError> {
        let (number, _, cancelled) = self.find(run).await?;
        // Starts from the jobs to be done, so that it is quick at the end, when it is asked most.
        let unfinished: i64 = sqlx::query_scalar(
            "SELECT COUNT(*) FROM (SELECT 1 FROM jobs JOIN run_jobs ON run_jobs.job = jobs.position
                                   WHERE state IN ('open', 'leased') AND run = $1 LIMIT 1) AS unfinished",
        )
        .bind(number)
        .fetch_one(&self.pool)
        .await
        .map_err(LedgerError::statement("look for unfinished jobs"))?;
        Ok(cancelled || unfinished == 0)
    }

    async fn find(&self, run: &RunId) -> Result<(i64, String, bool), LedgerError> {
        let query = sqlx::query_as("SELECT number, name, cancelled FROM runs WHERE id = $1").bind(&run.0);
        let found: Option<(i64, String, i64)> =
            query.fetch_optional(&self.pool).await.map_err(LedgerError::statement("find a run"))?;
        let (number, name, cancelled) = found.ok_or_else(|| LedgerError::NoSuchRun { run: run.clone() })?;
        Ok((number, name, cancelled != 0))
    }
}

fn result(row: &AnyRow) -> Result<JobResult, LedgerError> {
    let view: Option<i64> = get(row, "view")?;
    let blob: Option<Vec<u8>> = get(row, "blob")?;
    let length: Option<i64> = get(row, "blob_length")?;
    let blob = match (blob, length) {
        (Some(key), Some(length)) => Some((BlobKey(hash("blob", key)?), length as u64)),
        _ => None,
    };
    let measurements: Option<String> = get(row, "measurements")?;
    let measurements = match measurements {
        None => BTreeMap::new(),
        Some(json) => serde_json::from_str(&json)
            .map_err(|_| LedgerError::Damaged { what: "measurements", found: json })?,
    };
    let code: Option<String> = get(row, "failure_code")?;
    let message: Option<String> = get(row, "failure")?;
    let worker: Option<String> = get(row, "worker")?;
    let ended: i64 = get(row, "ended")?;
    Ok(JobResult {
        job: job_id(get(row, "id")?)?,
        kind: get(row, "kind")?,
        view: view.map(|id| ViewId(id as u32)),
        state: state(row)?,
        attempt: Attempt(number(row, "attempt")?),
        ended: ended as u64,
        blob,
        measurements,
        seconds: get(row, "seconds")?,
        worker: worker.map(WorkerId),
        failure: code.zip(message),
    })
}

pub(super) fn get<'r, T>(row: &'r AnyRow, column: &str) -> Result<T, LedgerError>
where
    T: sqlx::Decode<'r, sqlx::Any> + sqlx::Type<sqlx::Any>,
{
    row.try_get(column).map_err(LedgerError::statement("read a column"))
}

/// A count that is never large or negative.
pub(super) fn number(row: &AnyRow, column: &'static str) -> Result<u32, LedgerError> {
    let number: i64 = get(row, column)?;
    u32::try_from(number).map_err(|_| LedgerError::Damaged { what: column, found: number.to_string() })
}

pub(super) fn flag(row: &AnyRow, column: &str) -> Result<bool, LedgerError> {
    get::<i64>(row, column).map(|flag| flag != 0)
}

pub(super) fn state(row: &AnyRow) -> Result<JobState, LedgerError> {
    let name: String = get(row, "state")?;
    JobState::from_name(&name).ok_or(LedgerError::Damaged { what: "state", found: name })
}

pub(super) fn job_id(bytes: Vec<u8>) -> Result<JobId, LedgerError> {
    hash("id", bytes).map(JobId)
}

pub(super) fn hash(what: &'static str, bytes: Vec<u8>) -> Result<[u8; 32], LedgerError> {
    bytes.try_into().map_err(|bytes: Vec<u8>| LedgerError::Damaged {
        what,
        found: format!("{} bytes instead of 32", bytes.len()),
    })
}
