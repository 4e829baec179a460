//! Where a ledger lies.

use std::fmt;
use std::path::{Path, PathBuf};

use url::Url;

/// A file of one coordinator's, or a database that several share.
#[derive(Clone, PartialEq, Eq)]
pub enum LedgerPlace {
    /// An SQLite file; made when it is not there.
    File(PathBuf),
    /// A database of a PostgreSQL server, `postgres://user:password@host/database`.
    Postgres(String),
}

impl From<&str> for LedgerPlace {
    fn from(text: &str) -> Self {
        if text.starts_with("postgres://") || text.starts_with("postgresql://") {
            Self::Postgres(text.to_owned())
        } else {
            Self::File(text.into())
        }
    }
}

impl From<PathBuf> for LedgerPlace {
    fn from(path: PathBuf) -> Self {
        Self::File(path)
    }
}

impl From<&Path> for LedgerPlace {
    fn from(path: &Path) -> Self {
        Self::File(path.to_owned())
    }
}

impl fmt::Display for LedgerPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) => write!(f, "{}", path.display()),
            // Messages and logs are read by more people than know the password.
            Self::Postgres(url) => match Url::parse(url) {
                Ok(mut url) => {
                    let _ = url.set_password(None);
                    url.set_query(None);
                    write!(f, "{url}")
                }
                Err(_) => f.write_str("postgres://"),
            },
        }
    }
}

impl fmt::Debug for LedgerPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LedgerPlace({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_not_shown() {
        let place = LedgerPlace::from("postgres://me:s3cret@host:5433/runs?password=s3cret");
        assert_eq!(place.to_string(), "postgres://me@host:5433/runs");
        assert_eq!(LedgerPlace::from("runs.sqlite").to_string(), "runs.sqlite");
    }
}
