//! From the address of a store to something that keeps objects.

use std::path::PathBuf;
use std::sync::{Arc, Once};
use std::time::Duration;

use object_store::aws::AmazonS3Builder;
use object_store::azure::MicrosoftAzureBuilder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::local::LocalFileSystem;
use object_store::prefix::PrefixStore;
use object_store::{ObjectStore, ObjectStoreScheme, RetryConfig};
use url::Url;

use crate::StoreError;

/// The builders are alike, but share no trait.
macro_rules! built {
    ($builder:ident, $provider:literal, $url:ident, $variables:ident) => {{
        let mut builder = $builder::new().with_url($url).with_retry(retries());
        for (name, value) in options($provider, $variables) {
            if let Ok(key) = name.parse() {
                builder = builder.with_config(key, value);
            }
        }
        builder.build().map(|objects| Arc::new(objects) as Arc<dyn ObjectStore>)
    }};
}

/// What to do when a local folder is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum IfAbsent {
    Make,
    Refuse,
}

/// Opens what lies at an address.
///
/// `variables` say the endpoint, region and keys of an object store, under the names that the tools of each
/// provider use.
pub(crate) fn open(
    url: &str,
    variables: impl IntoIterator<Item = (String, String)>,
    if_absent: IfAbsent,
) -> Result<Arc<dyn ObjectStore>, StoreError> {
    let error = |problem: String| StoreError::Open { url: url.to_owned(), problem };
    if let Some(folder) = url.strip_prefix("file://").map(PathBuf::from) {
        if if_absent == IfAbsent::Make {
            std::fs::create_dir_all(&folder).map_err(|e| error(e.to_string()))?;
        }
        let local = LocalFileSystem::new_with_prefix(&folder).map_err(|e| error(e.to_string()))?;
        return Ok(Arc::new(local.with_fsync(true)));
    }
    let parsed = Url::parse(url).map_err(|e| error(e.to_string()))?;
    let (scheme, prefix) = ObjectStoreScheme::parse(&parsed).map_err(|e| error(e.to_string()))?;
    choose_cryptography();
    let built = match scheme {
        ObjectStoreScheme::AmazonS3 => built!(AmazonS3Builder, "aws_", url, variables),
        ObjectStoreScheme::GoogleCloudStorage => built!(GoogleCloudStorageBuilder, "google_", url, variables),
        ObjectStoreScheme::MicrosoftAzure => built!(MicrosoftAzureBuilder, "azure_", url, variables),
        _ => return Err(error("only file://, s3://, gs:// and az:// are understood".to_owned())),
    };
    let objects = built.map_err(|e: object_store::Error| error(e.to_string()))?;
    Ok(Arc::new(PrefixStore::new(objects, prefix)))
}

/// The tries of one request that follow each other at once; waiting for a store in trouble is not theirs.
fn retries() -> RetryConfig {
    RetryConfig { max_retries: 2, retry_timeout: Duration::from_secs(10), ..RetryConfig::default() }
}

/// The provider's variables, with small letters, as the builders parse them.
fn options(provider: &str, variables: impl IntoIterator<Item = (String, String)>) -> Vec<(String, String)> {
    // Builders take names without the provider's, too, and an environment may have a TOKEN of its own.
    let mut options: Vec<(String, String)> = variables
        .into_iter()
        .map(|(name, value)| (name.to_ascii_lowercase(), value))
        .filter(|(name, _)| name.starts_with(provider))
        .collect();
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
