//! The token, checked before any body is read.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::{Request, Status};

use crate::{Code, ServiceError, TOKEN_HEADER};

/// How many callers were not let in; clones count together.
#[derive(Clone, Debug, Default)]
pub struct Refusals(Arc<AtomicU64>);

impl Refusals {
    /// One more.
    pub fn count(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    /// So many until now.
    pub fn total(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Refuses and counts calls without the token, if there is one.
#[derive(Clone, Debug)]
pub struct CheckToken {
    /// What callers must show.
    pub expected: Option<MetadataValue<Ascii>>,
    /// Who did not.
    pub refusals: Refusals,
}

impl Interceptor for CheckToken {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        let Some(expected) = &self.expected else { return Ok(request) };
        let shown = request.metadata().get(TOKEN_HEADER);
        if shown.is_some_and(|shown| equal(shown.as_bytes(), expected.as_bytes())) {
            return Ok(request);
        }
        let what = if shown.is_some() {
            "the token is wrong; it must be the coordinator's"
        } else {
            "a token is needed; name its file with --token-file"
        };
        self.refusals.count();
        tracing::warn!(what, "call refused");
        Err(ServiceError::new(Code::Unauthenticated, what).into())
    }
}

/// Compares without telling by its time how much agrees.
fn equal(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bearer;

    fn call(expected: Option<&str>, shown: Option<&str>) -> Result<(), tonic::Code> {
        let expected = expected.map(|token| bearer(token).expect("plain ASCII"));
        let mut request = Request::new(());
        if let Some(token) = shown {
            request.metadata_mut().insert(TOKEN_HEADER, bearer(token).expect("plain ASCII"));
        }
        let refusals = Refusals::default();
        let answer = CheckToken { expected, refusals: refusals.clone() }.call(request);
        assert_eq!(refusals.total(), u64::from(answer.is_err()));
        answer.map(|_| ()).map_err(|status| status.code())
    }

    #[test]
    fn only_the_token_opens() {
        assert_eq!(call(None, None), Ok(()));
        assert_eq!(call(Some("abc"), Some("abc")), Ok(()));
        for shown in [None, Some("abd"), Some("ab"), Some("abcd")] {
            assert_eq!(call(Some("abc"), shown), Err(tonic::Code::Unauthenticated), "{shown:?}");
        }
    }
}
