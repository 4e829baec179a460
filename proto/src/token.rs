//! The token, checked before any body is read.

use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::{Request, Status};

use crate::{Code, ServiceError, TOKEN_HEADER};

/// Refuses calls without the token, if there is one.
#[derive(Clone, Debug)]
pub struct CheckToken(pub Option<MetadataValue<Ascii>>);

impl Interceptor for CheckToken {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        let Some(expected) = &self.0 else { return Ok(request) };
        let shown = request.metadata().get(TOKEN_HEADER);
        if shown.is_some_and(|shown| equal(shown.as_bytes(), expected.as_bytes())) {
            return Ok(request);
        }
        let what = if shown.is_some() { "the token is wrong" } else { "a token is needed" };
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
        CheckToken(expected).call(request).map(|_| ()).map_err(|status| status.code())
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
