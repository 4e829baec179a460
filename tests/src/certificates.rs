//! An authority of a test's own, and certificates of it.

use std::fs;
use std::path::{Path, PathBuf};

use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, date_time_ymd};

/// Somebody who vouches for servers.
pub struct Authority {
    folder: PathBuf,
    name: &'static str,
    issuer: Issuer<'static, KeyPair>,
}

/// The files of a certificate.
pub struct ServerCertificate {
    /// The certificate.
    pub cert: String,
    /// Its key.
    pub key: String,
}

impl ServerCertificate {
    /// The options of a server that has it.
    pub fn options(&self) -> [&str; 4] {
        ["--tls-cert", &self.cert, "--tls-key", &self.key]
    }
}

impl Authority {
    /// Makes one whose certificate lies in a folder under its name.
    pub fn new(folder: &str, name: &'static str) -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect("no names");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(rcgen::DnType::CommonName, name);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.self_signed(&key).expect("a certificate");
        let folder = PathBuf::from(folder);
        write(&folder.join(format!("{name}.pem")), &certificate.pem());
        Self { folder, name, issuer: Issuer::new(params, key) }
    }

    /// The file of its own certificate.
    pub fn file(&self) -> String {
        text(&self.folder.join(format!("{}.pem", self.name)))
    }

    /// A certificate of the loopback address that ends with a year.
    pub fn certificate(&self, name: &str, last_year: i32) -> ServerCertificate {
        let mut params = CertificateParams::new(vec!["127.0.0.1".to_owned()]).expect("an address");
        params.not_before = date_time_ymd(2000, 1, 1);
        params.not_after = date_time_ymd(last_year, 1, 1);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.signed_by(&key, &self.issuer).expect("a certificate");
        let file = |extension: &str| self.folder.join(format!("{name}.{extension}"));
        write(&file("pem"), &certificate.pem());
        write(&file("key"), &key.serialize_pem());
        ServerCertificate { cert: text(&file("pem")), key: text(&file("key")) }
    }
}

fn write(path: &Path, pem: &str) {
    fs::write(path, pem).expect("written");
}

fn text(path: &Path) -> String {
    path.to_str().expect("a temporary folder is UTF-8").to_owned()
}
