//! The beginning and the end of a step, and what others did between steps.

use super::{Driver, read};
use crate::ledger::{Change, LedgerError, Step};
use crate::schedule::Timestamp;

impl Driver {
    /// Begins a step. The snapshot is that of the ledger at this step, and stays it until the commit, for
    /// no other coordinator can begin one.
    pub(super) async fn begin(&mut self, now: Timestamp) -> Result<Step, LedgerError> {
        if self.seen.is_none() {
            self.catch_up().await?;
        }
        let mut step = self.ledger.begin(now).await?;
        let seen = self.seen.unwrap_or(-1);
        if step.number() != seen + 1 {
            let changes = step.changes(seen).await?;
            self.take_over(changes, now);
        }
        Ok(step)
    }

    /// Makes a step durable and wakes those who wait for changes.
    pub(super) async fn commit(&mut self, step: Step) -> Result<(), LedgerError> {
        let number = step.number();
        step.commit().await?;
        self.seen = Some(number);
        self.changes.send_modify(|changes| *changes += 1);
        Ok(())
    }

    /// Learns what others did, or everything when a step failed before. Costs nothing where there are no
    /// others.
    pub(super) async fn catch_up(&mut self) -> Result<(), LedgerError> {
        let now = self.now();
        match self.seen {
            None => {
                let (snapshot, results, step) = read(&self.ledger, self.settings.lease, now).await?;
                (self.snapshot, self.results, self.seen) = (snapshot, results, Some(step));
            }
            Some(seen) if self.ledger.is_shared() => {
                let changes = self.ledger.changes(seen, now).await?;
                self.seen = Some(changes.step);
                if !changes.jobs.is_empty() {
                    self.take_over(changes.jobs, now);
                    self.changes.send_modify(|changes| *changes += 1);
                }
            }
            Some(_) => {}
        }
        Ok(())
    }

    fn take_over(&mut self, changes: Vec<Change>, now: Timestamp) {
        for Change { record, deadline, produced } in changes {
            let job = record.shape.id;
            match produced {
                Some(produced) => drop(self.results.insert(job, produced)),
                None => drop(self.results.remove(&job)),
            }
            if !self.snapshot.observe(record, deadline, now) {
                tracing::error!(%job, "a job of the ledger needs others that are not there");
            }
        }
    }
}
