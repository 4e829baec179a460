//! How the parts of a cluster find and trust each other.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_proto::{Client, Credentials, ServerTls};

use super::values::coordinator;

/// Where the token comes from when no file is named.
const TOKEN_VARIABLE: &str = "PLANESWEEP_TOKEN";

/// What callers of a coordinator must show. Never an argument itself: every user of a host can read those.
#[derive(Clone, Debug, Args)]
pub struct TokenArgs {
    /// The file that holds the token; by default the variable PLANESWEEP_TOKEN does, if there is one.
    #[arg(long, env = "PLANESWEEP_TOKEN_FILE", value_name = "FILE")]
    pub token_file: Option<PathBuf>,
}

impl TokenArgs {
    /// The token, if there is one.
    pub fn read(&self) -> Result<Option<String>> {
        let Some(path) = &self.token_file else {
            return Ok(std::env::var(TOKEN_VARIABLE).ok().filter(|token| !token.is_empty()));
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the token in {}", path.display()))?;
        let token = text.trim();
        if token.is_empty() {
            bail!("there is no token in {}", path.display());
        }
        Ok(Some(token.to_owned()))
    }
}

/// What is shown to a coordinator, and who vouches for it.
#[derive(Clone, Debug, Args)]
pub struct CredentialArgs {
    #[command(flatten)]
    pub token: TokenArgs,
    /// The certificates that vouch for an https:// coordinator, PEM; by default those of the system.
    #[arg(long, env = "PLANESWEEP_TLS_CA", value_name = "FILE")]
    pub tls_ca: Option<PathBuf>,
}

impl CredentialArgs {
    /// The options of another command that call the coordinator at `url` with the same credentials.
    pub fn passed_on(&self, url: &str) -> Vec<String> {
        let files = [("--token-file", &self.token.token_file), ("--tls-ca", &self.tls_ca)];
        let files = files.into_iter().filter_map(|(option, file)| Some((option, file.as_ref()?)));
        let files = files.flat_map(|(option, file)| [option.to_owned(), file.to_string_lossy().into_owned()]);
        ["--coordinator".to_owned(), url.to_owned()].into_iter().chain(files).collect()
    }

    /// What the files hold.
    pub fn read(&self) -> Result<Credentials> {
        let ca_pem = self.tls_ca.as_deref().map(read_pem).transpose()?;
        Ok(Credentials { token: self.token.read()?, ca_pem })
    }
}

/// Who a server is.
#[derive(Clone, Debug, Args)]
pub struct ServerTlsArgs {
    /// The certificate of this server, with those that vouch for it, PEM; with it, only TLS is spoken.
    #[arg(long, env = "PLANESWEEP_TLS_CERT", value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,
    /// The certificate's private key, PEM.
    #[arg(long, env = "PLANESWEEP_TLS_KEY", value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,
}

impl ServerTlsArgs {
    /// What the files hold, if they are named.
    pub fn read(&self) -> Result<Option<ServerTls>> {
        let (Some(cert), Some(key)) = (&self.tls_cert, &self.tls_key) else { return Ok(None) };
        Ok(Some(ServerTls { cert_pem: read_pem(cert)?, key_pem: read_pem(key)? }))
    }
}

fn read_pem(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).with_context(|| format!("cannot read the certificate or key in {}", path.display()))
}

/// How a coordinator is reached.
#[derive(Clone, Debug, Args)]
pub struct ConnectArgs {
    /// The coordinator's address, such as http://10.0.0.1:7070 or https://head:7070; with commas between, several
    /// that share a ledger, of which the next is called when one cannot be reached.
    #[arg(long, env = "PLANESWEEP_COORDINATOR", value_name = "URL", value_parser = coordinator)]
    pub coordinator: String,
    #[command(flatten)]
    pub credentials: CredentialArgs,
}

impl ConnectArgs {
    /// A client of the coordinator; must be called within a tokio runtime.
    pub fn client(&self) -> Result<Client> {
        Client::connect_with(&self.coordinator, &self.credentials.read()?)
            .with_context(|| format!("cannot call the coordinator at {}", self.coordinator))
    }
}

/// The address of a store that is named by its address or by a folder.
pub fn store_url(text: &str) -> Result<String, String> {
    if text.contains("://") {
        return Ok(text.to_owned());
    }
    let folder = std::path::absolute(Path::new(text)).map_err(|e| format!("{text} is no folder: {e}"))?;
    Ok(format!("file://{}", folder.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_a_line_of_a_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("token");
        let read = |text: &str| {
            std::fs::write(&path, text).expect("written");
            TokenArgs { token_file: Some(path.clone()) }.read()
        };
        assert_eq!(read("s3cret\n").expect("a token"), Some("s3cret".to_owned()));
        assert!(read(" \n").is_err());
        assert!(TokenArgs { token_file: Some(folder.path().join("none")) }.read().is_err());
    }

    #[test]
    fn a_store_is_an_address_or_a_folder() {
        assert_eq!(store_url("s3://bucket/prefix"), Ok("s3://bucket/prefix".to_owned()));
        assert_eq!(store_url("/var/store"), Ok("file:///var/store".to_owned()));
        assert!(store_url("store").is_ok_and(|url| url.starts_with("file:///") && url.ends_with("/store")));
    }
}
