//! Changes of the ledger. Each statement says on which state and attempt it depends; whether it
//! changed a row is the answer, not an error.

use planesweep_plan::{Attempt, Job, JobId, RunId, WorkerId};
use planesweep_proto::{Failure, Success, decode_job, encode_job};
use planesweep_scene::ViewId;
use sqlx::any::{AnyArguments, AnyQueryResult};
use sqlx::query::Query;
use sqlx::{Any, AnyPool, Transaction};

use super::rows::{self, Change};
use super::{Kind, LedgerError};
use crate::schedule::{Reopening, Timestamp};

/// Bytes of a run's name that go into its id.
const RUN_ID_NAME_BYTES: usize = 200;

/// A transaction; dropped without [`Step::commit`], it changes nothing.
#[derive(Debug)]
pub struct Step {
    transaction: Transaction<'static, Any>,
    kind: Kind,
    number: i64,
    /// The same moment by the clocks of the driver and of the ledger.
    now: (Timestamp, i64),
}

impl Step {
    /// Begins the next step; waits while another coordinator is within one.
    pub(super) async fn begin(pool: &AnyPool, kind: Kind, now: Timestamp) -> Result<Self, LedgerError> {
        let failed = LedgerError::statement("begin a step");
        let mut transaction = pool.begin_with(kind.begin()).await.map_err(&failed)?;
        let next = match kind {
            Kind::Sqlite => "UPDATE counters SET step = step + 1 RETURNING step, $1",
            Kind::Postgres => {
                "UPDATE counters SET step = step + 1 WHERE $1 >= 0
                 RETURNING step, CAST(EXTRACT(EPOCH FROM clock_timestamp()) * 1000 AS BIGINT)"
            }
        };
        let next = sqlx::query_as(next).bind(now.0 as i64);
        let (number, ledger_now): (i64, i64) = next.fetch_one(&mut *transaction).await.map_err(&failed)?;
        Ok(Self { transaction, kind, number, now: (now, ledger_now) })
    }

    /// Its number: one more than that of the step before it, whoever took that.
    pub fn number(&self) -> i64 {
        self.number
    }

    /// What others changed after a step.
    pub async fn changes(&mut self, after: i64) -> Result<Vec<Change>, LedgerError> {
        rows::rows(&mut self.transaction, self.kind, after, self.now.0, self.now.1).await
    }

    /// A moment of the driver by the ledger's clock.
    fn on_ledger_clock(&self, moment: Timestamp) -> i64 {
        moment.0 as i64 - self.now.0.0 as i64 + self.now.1
    }

    /// Makes the step durable.
    pub async fn commit(self) -> Result<(), LedgerError> {
        self.transaction.commit().await.map_err(LedgerError::statement("commit a step"))
    }

    async fn execute(
        &mut self,
        what: &'static str,
        query: Query<'_, Any, AnyArguments>,
    ) -> Result<AnyQueryResult, LedgerError> {
        query.execute(&mut *self.transaction).await.map_err(LedgerError::statement(what))
    }

    async fn changed(
        &mut self,
        what: &'static str,
        query: Query<'_, Any, AnyArguments>,
    ) -> Result<bool, LedgerError> {
        Ok(self.execute(what, query).await?.rows_affected() > 0)
    }

    /// Adds a run; its id is its name with a number.
    pub async fn insert_run(&mut self, name: &str) -> Result<(RunId, i64), LedgerError> {
        let what = "add a run";
        let number: i64 = sqlx::query_scalar("SELECT COALESCE(MAX(number), 0) + 1 FROM runs")
            .fetch_one(&mut *self.transaction)
            .await
            .map_err(LedgerError::statement(what))?;
        let id = format!("{}-{number}", &name[..name.floor_char_boundary(RUN_ID_NAME_BYTES)]);
        let query = sqlx::query("INSERT INTO runs (number, id, name) VALUES ($1, $2, $3)");
        self.execute(what, query.bind(number).bind(&id).bind(name)).await?;
        Ok((RunId(id), number))
    }

    /// Adds a job to a run, at a place in its plan.
    pub async fn add_to_run(&mut self, run: i64, seq: usize, job: &JobId) -> Result<(), LedgerError> {
        let query = sqlx::query(
            "INSERT INTO run_jobs (run, seq, job) SELECT $1, $2, position FROM jobs WHERE id = $3",
        );
        self.execute("add a job to a run", query.bind(run).bind(seq as i64).bind(job.0.to_vec())).await?;
        Ok(())
    }

    /// Adds a job, behind all others.
    pub async fn insert_job(&mut self, job: &Job) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "INSERT INTO jobs (id, kind, view, spec, needs, changed) VALUES ($1, $2, $3, $4, $5, $6)
             ON CONFLICT DO NOTHING",
        )
        .bind(job.id.0.to_vec())
        .bind(job.spec.kind())
        .bind(view(job))
        .bind(encode_job(job))
        .bind(job.needs.iter().flat_map(|JobId(hash)| *hash).collect::<Vec<u8>>())
        .bind(self.number);
        self.changed("add a job", query).await
    }

    /// Gives a known job the paths, names and view ids of a new submission; the rest is in its id.
    pub async fn refresh(&mut self, job: &Job) -> Result<(), LedgerError> {
        let query = sqlx::query("UPDATE jobs SET spec = $2, view = $3 WHERE id = $1 AND spec <> $2")
            .bind(job.id.0.to_vec())
            .bind(encode_job(job))
            .bind(view(job));
        self.execute("refresh a job", query).await?;
        Ok(())
    }

    /// Makes a job open again.
    pub async fn reopen(&mut self, job: &JobId, why: Reopening) -> Result<bool, LedgerError> {
        let query = match why {
            Reopening::Resubmitted => sqlx::query(
                "UPDATE jobs SET changed = $2, state = 'open', worker = NULL, ended = 0, failures = 0, losses = 0, suspect = 0, deaths_alone = 0
                 WHERE id = $1 AND state IN ('failed', 'cancelled')",
            ),
            Reopening::ResultLost => sqlx::query(
                "UPDATE jobs SET changed = $2, state = 'open', worker = NULL, ended = 0, failures = 0, losses = 0, suspect = 0, deaths_alone = 0,
                                 blob = NULL, blob_length = NULL
                 WHERE id = $1 AND state = 'done'",
            ),
            Reopening::NewInput => sqlx::query(
                "UPDATE jobs SET changed = $2, state = 'open', worker = NULL, ended = 0, failures = 0, losses = 0, suspect = 0, deaths_alone = 0,
                                 blob = NULL, blob_length = NULL
                 WHERE id = $1 AND state IN ('done', 'leased')",
            ),
        };
        let changed = self.changed("reopen a job", query.bind(job.0.to_vec()).bind(self.number)).await?;
        if why != Reopening::NewInput {
            return Ok(changed);
        }
        let query = sqlx::query("UPDATE jobs SET outdated = 1, changed = $2 WHERE id = $1");
        let query = query.bind(job.0.to_vec()).bind(self.number);
        self.changed("mark a job as outdated", query).await
    }

    /// Gives an open job to a worker, as the attempt that follows its latest one.
    pub async fn claim(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        worker: &WorkerId,
        deadline: Timestamp,
    ) -> Result<bool, LedgerError> {
        let query = match self.kind {
            Kind::Sqlite => sqlx::query(
                "UPDATE jobs SET state = 'leased', attempt = $2, worker = $3, deadline_ms = $4, changed = $5
                 WHERE id = $1 AND state = 'open' AND attempt = $2 - 1",
            ),
            // A row that somebody else has his hands on is not waited for: there are others.
            Kind::Postgres => sqlx::query(
                "UPDATE jobs SET state = 'leased', attempt = $2, worker = $3, deadline_ms = $4, changed = $5
                 WHERE position = (SELECT position FROM jobs
                                   WHERE id = $1 AND state = 'open' AND attempt = $2 - 1
                                   FOR UPDATE SKIP LOCKED)",
            ),
        };
        let query = query.bind(job.0.to_vec()).bind(i64::from(attempt.0)).bind(&worker.0);
        let query = query.bind(self.on_ledger_clock(deadline)).bind(self.number);
        self.changed("claim a job", query).await
    }

    /// Prolongs a lease.
    pub async fn renew(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        worker: &WorkerId,
        deadline: Timestamp,
    ) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET deadline_ms = $4, changed = $5
             WHERE id = $1 AND attempt = $2 AND worker = $3 AND state = 'leased'",
        );
        let query = query.bind(job.0.to_vec()).bind(i64::from(attempt.0)).bind(&worker.0);
        let query = query.bind(self.on_ledger_clock(deadline)).bind(self.number);
        self.changed("renew a lease", query).await
    }

    /// Publishes a result.
    pub async fn complete(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        worker: &WorkerId,
        success: &Success,
    ) -> Result<bool, LedgerError> {
        let measurements = serde_json::to_string(&success.measurements)
            .expect("a map of names and finite numbers is always JSON");
        let query = sqlx::query(
            "UPDATE jobs SET state = 'done', blob = $4, blob_length = $5, measurements = $6, seconds = $7,
                             failures = 0, losses = 0, suspect = 0, deaths_alone = 0, outdated = 0,
                             failure_code = NULL, failure = NULL,
                             ended = $8, changed = $9
             WHERE id = $1 AND attempt = $2 AND worker = $3 AND state = 'leased'",
        );
        let query = query
            .bind(job.0.to_vec())
            .bind(i64::from(attempt.0))
            .bind(&worker.0)
            .bind(success.blob.0.to_vec())
            .bind(success.length as i64)
            .bind(measurements)
            .bind(success.seconds)
            .bind(self.next_end().await?)
            .bind(self.number);
        self.changed("publish a result", query).await
    }

    /// Opens a job again whose try failed.
    pub async fn retry(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        (failures, losses): (u32, u32),
        failure: &Failure,
    ) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET state = 'open', worker = NULL, failures = $3, losses = $4, failure_code = $5, failure = $6,
                             changed = $7
             WHERE id = $1 AND attempt = $2 AND state = 'leased'",
        );
        let query = query.bind(job.0.to_vec()).bind(i64::from(attempt.0));
        let query = query.bind(i64::from(failures)).bind(i64::from(losses));
        let query = query.bind(&failure.code).bind(text(&failure.message)).bind(self.number);
        self.changed("open a failed job again", query).await
    }

    /// Lets a job fail for good.
    pub async fn give_up(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        failure: &Failure,
    ) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET state = 'failed', failures = 0, losses = 0, suspect = 0, deaths_alone = 0, outdated = 1,
                             failure_code = $3, failure = $4,
                             ended = $5, changed = $6
             WHERE id = $1 AND attempt = $2 AND state = 'leased'",
        );
        let query = query.bind(job.0.to_vec()).bind(i64::from(attempt.0));
        let query = query.bind(&failure.code).bind(text(&failure.message));
        let query = query.bind(self.next_end().await?).bind(self.number);
        self.changed("let a job fail", query).await
    }

    /// The number of the next job that ends. Never given twice, not even when the job that had the
    /// highest runs again: who has seen the end of that one must see the new one too.
    async fn next_end(&mut self) -> Result<i64, LedgerError> {
        sqlx::query_scalar("UPDATE counters SET ended = ended + 1 RETURNING ended")
            .fetch_one(&mut *self.transaction)
            .await
            .map_err(LedgerError::statement("number the end of a job"))
    }

    /// Takes a lease back without blame.
    pub async fn release(&mut self, job: &JobId, attempt: Attempt) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET state = 'open', worker = NULL, changed = $3
             WHERE id = $1 AND attempt = $2 AND state = 'leased'",
        );
        let query = query.bind(job.0.to_vec()).bind(i64::from(attempt.0)).bind(self.number);
        self.changed("release a job", query).await
    }

    /// Takes a lease back and blames its end on the job.
    pub async fn suspect(
        &mut self,
        job: &JobId,
        attempt: Attempt,
        deaths_alone: u32,
    ) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET state = 'open', worker = NULL, suspect = 1, deaths_alone = $3, changed = $4
             WHERE id = $1 AND attempt = $2 AND state = 'leased'",
        );
        let query = query
            .bind(job.0.to_vec())
            .bind(i64::from(attempt.0))
            .bind(i64::from(deaths_alone))
            .bind(self.number);
        self.changed("suspect a job", query).await
    }

    /// Cancels a job.
    pub async fn cancel(&mut self, job: &JobId) -> Result<bool, LedgerError> {
        let query = sqlx::query(
            "UPDATE jobs SET state = 'cancelled', worker = NULL, changed = $2
             WHERE id = $1 AND state IN ('open', 'leased')",
        );
        self.changed("cancel a job", query.bind(job.0.to_vec()).bind(self.number)).await
    }

    /// Marks a run as cancelled.
    pub async fn cancel_run(&mut self, run: &RunId) -> Result<(), LedgerError> {
        let query = sqlx::query("UPDATE runs SET cancelled = 1 WHERE id = $1").bind(&run.0);
        if self.changed("cancel a run", query).await? {
            Ok(())
        } else {
            Err(LedgerError::NoSuchRun { run: run.clone() })
        }
    }

    /// Marks all runs but one as cancelled.
    pub async fn cancel_other_runs(&mut self, run: i64) -> Result<(), LedgerError> {
        let query = sqlx::query("UPDATE runs SET cancelled = 1 WHERE number <> $1").bind(run);
        self.execute("cancel other runs", query).await?;
        Ok(())
    }

    /// The jobs to be done that no run wants any more.
    pub async fn unwanted(&mut self) -> Result<Vec<JobId>, LedgerError> {
        let what = "list unwanted jobs";
        let ids: Vec<Vec<u8>> = sqlx::query_scalar(
            "SELECT id FROM jobs WHERE state IN ('open', 'leased') AND NOT EXISTS (
                 SELECT 1 FROM run_jobs JOIN runs ON runs.number = run_jobs.run
                 WHERE run_jobs.job = jobs.position AND runs.cancelled = 0)
             ORDER BY position",
        )
        .fetch_all(&mut *self.transaction)
        .await
        .map_err(LedgerError::statement(what))?;
        ids.into_iter().map(super::query::job_id).collect()
    }

    /// A job, to be handed out.
    pub async fn job(&mut self, job: &JobId) -> Result<Job, LedgerError> {
        let spec: Vec<u8> = sqlx::query_scalar("SELECT spec FROM jobs WHERE id = $1")
            .bind(job.0.to_vec())
            .fetch_one(&mut *self.transaction)
            .await
            .map_err(LedgerError::statement("read a job"))?;
        decode_job(&spec).map_err(|e| LedgerError::Damaged { what: "spec", found: e.to_string() })
    }
}

fn view(job: &Job) -> Option<i64> {
    job.spec.view().map(|ViewId(id)| i64::from(id))
}

/// PostgreSQL keeps no text with a zero in it.
fn text(message: &str) -> String {
    message.replace('\0', "")
}
