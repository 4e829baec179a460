//! From the address of a store to something that keeps objects.

use std::path::PathBuf;
use std::sync::{Arc, Once};

use object_store::local::LocalFileSystem;
use object_store::prefix::PrefixStore;
use object_store::{ObjectStore, parse_url_opts};
use url::Url;

use crate::StoreError;

/// Opens what lies at an address. A local folder is made if it is not there.
/// `variables` say the endpoint, region and keys of an object store, under the names that the tools of each
/// provider use.
pub(crate) fn open(
    url: &str,
    variables: impl IntoIterator<Item = (String, String)>,
) -> Result<Arc<dyn ObjectStore>, StoreError> {
    let error = |problem: String| StoreError::Open { url: url.to_owned(), problem };
    if let Some(folder) = url.strip_prefix("file://").map(PathBuf::from) {
        std::fs::create_dir_all(&folder).map_err(|e| error(e.to_string()))?;
        let local = LocalFileSystem::new_with_prefix(&folder).map_err(|e| error(e.to_string()))?;
        return Ok(Arc::new(local.with_fsync(true)));
    }
    let parsed = Url::parse(url).map_err(|e| error(e.to_string()))?;
    if !["s3", "s3a", "gs", "az", "azure", "abfs", "abfss"].contains(&parsed.scheme()) {
        return Err(error("only file://, s3://, gs:// and az:// are understood".to_owned()));
    }
    choose_cryptography();
    let (objects, prefix) = parse_url_opts(&parsed, options(variables)).map_err(|e| error(e.to_string()))?;
    Ok(Arc::new(PrefixStore::new(objects, prefix)))
}

fn options(variables: impl IntoIterator<Item = (String, String)>) -> Vec<(String, String)> {
    let mut options: Vec<(String, String)> =
        variables.into_iter().map(|(name, value)| (name.to_ascii_lowercase(), value)).collect();
    // Who names an endpoint without TLS means it.
    let is_plain = |(name, value): &(String, String)| {
        ["aws_endpoint_url_s3", "aws_endpoint_url", "aws_endpoint"].contains(&name.as_str())
            && value.starts_with("http://")
    };
    if options.iter().any(is_plain) {
        options.push(("aws_allow_http".to_owned(), "true".to_owned()));
    }
    options
}

/// Says which implementation TLS takes, once per process; another choice made before stays.
fn choose_cryptography() {
    static CHOSEN: Once = Once::new();
    CHOSEN.call_once(|| drop(rustls::crypto::ring::default_provider().install_default()));
}
