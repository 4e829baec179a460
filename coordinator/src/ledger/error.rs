//! What can go wrong with the ledger.

use std::io;

use planesweep_plan::RunId;
use planesweep_proto::{Code, ServiceError, with_causes};
use thiserror::Error;

use super::LedgerPlace;

/// Why the ledger could not be read or changed.
#[derive(Debug, Error)]
pub enum LedgerError {
    /// The lock file could not be made.
    #[error("could not lock the ledger {ledger}")]
    Lock {
        /// The ledger.
        ledger: LedgerPlace,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// Another process has it.
    #[error("the ledger {ledger} is in use by another coordinator; stop it or choose another")]
    InUse {
        /// The ledger.
        ledger: LedgerPlace,
    },
    /// The file could not be opened as a database, or the server not be reached.
    #[error("could not open the ledger {ledger}")]
    Open {
        /// The ledger.
        ledger: LedgerPlace,
        /// Why.
        #[source]
        source: sqlx::Error,
    },
    /// It was made by another version.
    #[error("the ledger {ledger} has schema {found}, this version reads {expected}")]
    Schema {
        /// The ledger.
        ledger: LedgerPlace,
        /// What it has.
        found: i64,
        /// What is understood.
        expected: i64,
    },
    /// Its results lie elsewhere.
    #[error(
        "the results of the ledger {ledger} lie in another store than {url}; name that one, or begin another ledger. If \
         that store was emptied or replaced on purpose, write {identity} into the object \"identity\" of {url}: what is \
         missing there is computed again"
    )]
    OtherStore {
        /// The ledger.
        ledger: LedgerPlace,
        /// The store that was named.
        url: String,
        /// What the ledger's store says of itself.
        identity: String,
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
    /// Whether the disk that the ledger lies on has no room left.
    pub fn is_disk_full(&self) -> bool {
        let (Self::Open { source, .. } | Self::Statement { source, .. }) = self else { return false };
        let code = source.as_database_error().and_then(sqlx::error::DatabaseError::code);
        // Of SQLite, and of PostgreSQL.
        code.is_some_and(|code| code == "13" || code == "53100")
    }

    /// For `map_err` on a statement.
    pub(super) fn statement(what: &'static str) -> impl Fn(sqlx::Error) -> Self {
        move |source| Self::Statement { what, source }
    }

    /// The failure of a ledger at this place as callers learn of it.
    pub(super) fn refusal(&self, place: &LedgerPlace) -> ServiceError {
        match self {
            Self::NoSuchRun { .. } => ServiceError::new(Code::NotFound, with_causes(self)),
            full if full.is_disk_full() => {
                ServiceError::disk_full(place, "nothing goes on until there is room")
            }
            _ => ServiceError::new(Code::Internal, with_causes(self)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;
    use std::error::Error;
    use std::fmt;

    use sqlx::error::{DatabaseError, ErrorKind};

    use super::*;

    /// What a database says with this code.
    #[derive(Debug)]
    struct Said(&'static str);

    impl fmt::Display for Said {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str(self.message())
        }
    }

    impl Error for Said {}

    impl DatabaseError for Said {
        fn message(&self) -> &'static str {
            "said by a database"
        }

        fn code(&self) -> Option<Cow<'_, str>> {
            Some(self.0.into())
        }

        fn as_error(&self) -> &(dyn Error + Send + Sync + 'static) {
            self
        }

        fn as_error_mut(&mut self) -> &mut (dyn Error + Send + Sync + 'static) {
            self
        }

        fn into_error(self: Box<Self>) -> Box<dyn Error + Send + Sync + 'static> {
            self
        }

        fn kind(&self) -> ErrorKind {
            ErrorKind::Other
        }
    }

    #[test]
    fn callers_are_told_which_disk_is_full() {
        let place = LedgerPlace::from("/runs/ledger.sqlite");
        let told =
            |code| LedgerError::statement("begin a step")(sqlx::Error::from(Said(code))).refusal(&place);
        // SQLite, PostgreSQL.
        for code in ["13", "53100"] {
            let full = told(code);
            assert_eq!(full.code, Code::DiskFull);
            assert_eq!(full.message, "disk full at /runs/ledger.sqlite; nothing goes on until there is room");
        }
        // Too many connections.
        let other = told("53300");
        assert_eq!(other.code, Code::Internal);
        assert!(other.message.ends_with("said by a database"), "{}", other.message);
    }
}
