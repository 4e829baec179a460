//! Which store the results of a ledger lie in.

use super::{Ledger, LedgerError};

impl Ledger {
    /// What the store of its results says of itself; `None` before a coordinator has come with one.
    pub(crate) async fn store(&self) -> Result<Option<String>, LedgerError> {
        sqlx::query_scalar("SELECT store FROM counters")
            .fetch_one(&self.pool)
            .await
            .map_err(LedgerError::statement("read which store it has"))
    }

    /// Ties the ledger to the store that says so of itself, and lies at `url`; the first one is kept, and another one
    /// refused: half of the results would not be found.
    pub(crate) async fn tie_to_store(&self, identity: &str, url: &str) -> Result<(), LedgerError> {
        let failed = LedgerError::statement("note the store");
        let query = sqlx::query("UPDATE counters SET store = $1 WHERE store IS NULL").bind(identity);
        query.execute(&self.pool).await.map_err(&failed)?;
        let kept = self.store().await?.unwrap_or_default();
        if kept == identity {
            return Ok(());
        }
        Err(LedgerError::OtherStore { ledger: self.place.clone(), url: url.to_owned(), identity: kept })
    }
}
