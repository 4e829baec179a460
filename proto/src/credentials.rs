//! The client's side of trust: what is shown to servers, and who vouches for them.

use std::io;

use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{self, CertificateError};
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint};

use crate::error::with_causes;
use crate::{Code, ServiceError};

/// What a client shows, and whom it trusts.
#[derive(Clone, Default)]
pub struct Credentials {
    /// The token, when the servers want one.
    pub token: Option<String>,
    /// Certificates that vouch for `https://` servers, PEM; those of the system by default.
    pub ca_pem: Option<Vec<u8>>,
}

impl Credentials {
    /// A token, and the system's certificates.
    pub fn of_token(token: Option<&str>) -> Self {
        Self { token: token.map(str::to_owned), ca_pem: None }
    }

    /// Where to connect to, with TLS for `https://`.
    pub(crate) fn endpoint(&self, url: &str) -> Result<Endpoint, ServiceError> {
        let invalid = |text: String| ServiceError::new(Code::Invalid, text);
        let no_address = |e: tonic::transport::Error| {
            let text = with_causes(&e);
            invalid(format!("\"{url}\" is no address: {text}"))
        };
        let endpoint = Endpoint::from_shared(url.to_owned()).map_err(no_address)?;
        let tls = match (&self.ca_pem, endpoint.uri().scheme_str() == Some("https")) {
            (None, false) => return Ok(endpoint),
            (Some(_), false) => {
                return Err(invalid(format!(
                    "no certificate can vouch for \"{url}\", which is not encrypted; write https://"
                )));
            }
            (Some(pem), true) => {
                if CertificateDer::pem_slice_iter(pem).next().is_none_or(|first| first.is_err()) {
                    return Err(invalid(
                        "there is no certificate in what is to vouch for the server".to_owned(),
                    ));
                }
                ClientTlsConfig::new().ca_certificate(Certificate::from_pem(pem))
            }
            (None, true) => ClientTlsConfig::new().with_native_roots(),
        };
        endpoint.tls_config(tls).map_err(no_address)
    }
}

/// What a person has to do when the certificate of a server is why a call failed.
pub(crate) fn certificate_trouble(error: &(dyn std::error::Error + 'static)) -> Option<String> {
    let mut cause = Some(error);
    while let Some(inner) = cause {
        let wrapped = inner.downcast_ref::<io::Error>().and_then(|io| io.get_ref()?.downcast_ref());
        if let Some(rustls::Error::InvalidCertificate(why)) = wrapped.or_else(|| inner.downcast_ref()) {
            return Some(advice(why));
        }
        cause = inner.source();
    }
    None
}

fn advice(why: &CertificateError) -> String {
    match why {
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
            "the server's certificate has expired; it must be renewed".to_owned()
        }
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
            "the server's certificate is not valid yet; compare the clocks of both hosts".to_owned()
        }
        CertificateError::UnknownIssuer => {
            "nobody who is trusted vouches for the server's certificate; name the authority's with --tls-ca"
                .to_owned()
        }
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            "the server's certificate is for another name; call it by the name in the certificate".to_owned()
        }
        why => format!("the server's certificate is refused: {why}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_certificate_vouches_for_nobody() {
        let trusting = Credentials { token: None, ca_pem: Some(b"none".to_vec()) };
        let refused = |url| trusting.endpoint(url).map(drop).map_err(|error| error.message);
        assert!(refused("https://host:7070").is_err_and(|text| text.contains("no certificate")));
        assert!(refused("http://host:7070").is_err_and(|text| text.contains("https://")));
    }

    #[test]
    fn certificates_are_told_from_other_trouble() {
        let expired = rustls::Error::InvalidCertificate(CertificateError::Expired);
        let wrapped = io::Error::new(io::ErrorKind::InvalidData, expired);
        assert!(certificate_trouble(&wrapped).is_some_and(|text| text.contains("renewed")));
        assert_eq!(certificate_trouble(&io::Error::from(io::ErrorKind::ConnectionRefused)), None);
    }
}
