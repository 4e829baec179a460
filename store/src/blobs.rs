//! Writing, reading and checking blobs, wherever they lie.

use std::time::Duration;

use bytes::Bytes;
use planesweep_plan::BlobKey;
use planesweep_proto::limits::MAX_FILE_BYTES;
use planesweep_proto::{BlobClient, Client, Code, ServiceError, StorePlace};
use tokio_util::sync::CancellationToken;

use crate::patience::patiently;
use crate::{Objects, StoreError};

/// How long a store may take to say who it is: one that cannot be reached says nothing.
const LOOK: Duration = Duration::from_secs(10);

/// A store of blobs; clones share it.
#[derive(Clone, Debug)]
pub struct Store {
    place: Place,
    /// Ends the waiting for a store in trouble.
    impatience: CancellationToken,
}

#[derive(Clone, Debug)]
enum Place {
    /// Reached from here.
    Objects(Objects),
    /// Reached by the coordinator, which passes the bytes on.
    Coordinator { client: BlobClient, url: String },
}

impl From<Objects> for Store {
    fn from(objects: Objects) -> Self {
        Self::at(Place::Objects(objects))
    }
}

impl Store {
    /// Opens a store that is reached from here, as [`Objects::open`] does.
    pub fn open(url: &str) -> Result<Self, StoreError> {
        Objects::open(url).map(Self::from)
    }

    /// The store of a coordinator: that at its address if it is seen from here, else through the
    /// coordinator.
    pub async fn of(client: &Client, told: &StorePlace) -> Result<Self, StoreError> {
        let Some(identity) = &told.identity else { return Self::open(&told.url) };
        let why = match tokio::time::timeout(LOOK, Objects::find(&told.url, identity)).await {
            Ok(Ok(objects)) => return Ok(objects.into()),
            Ok(Err(error)) => error.to_string(),
            Err(_) => format!("the store at {} does not answer", told.url),
        };
        tracing::warn!("{why}; its blobs go through the coordinator");
        Ok(Self::at(Place::Coordinator { client: client.blobs(), url: told.url.clone() }))
    }

    /// Whether bytes go to the store and come from it without the coordinator.
    pub fn is_reached_from_here(&self) -> bool {
        matches!(self.place, Place::Objects(_))
    }

    fn at(place: Place) -> Self {
        let impatience = CancellationToken::new();
        impatience.cancel();
        Self { place, impatience }
    }

    /// The same store, which waits while it cannot be reached or has no room, until `impatience` is
    /// cancelled: what was computed is kept until it can be stored, and no try of a job is lost.
    #[must_use]
    pub fn patient(self, impatience: CancellationToken) -> Self {
        Self { impatience, ..self }
    }

    /// The store's address.
    pub fn url(&self) -> &str {
        match &self.place {
            Place::Objects(objects) => objects.url(),
            Place::Coordinator { url, .. } => url,
        }
    }

    /// Writes a blob, unless it is there already, and returns its key.
    pub async fn put(&self, bytes: Bytes) -> Result<BlobKey, StoreError> {
        let key = BlobKey::of(&bytes);
        patiently(&self.impatience, || self.try_put(key, bytes.clone())).await?;
        Ok(key)
    }

    async fn try_put(&self, key: BlobKey, bytes: Bytes) -> Result<(), StoreError> {
        match &self.place {
            Place::Objects(objects) => objects.put(key, bytes).await,
            Place::Coordinator { .. } if self.try_holds(key).await? => Ok(()),
            Place::Coordinator { .. } => self.try_write(key, bytes).await,
        }
    }

    /// Writes a blob that the store was found not to hold, and returns its key.
    pub async fn write(&self, bytes: Bytes) -> Result<BlobKey, StoreError> {
        let key = BlobKey::of(&bytes);
        patiently(&self.impatience, || self.try_write(key, bytes.clone())).await?;
        Ok(key)
    }

    async fn try_write(&self, key: BlobKey, bytes: Bytes) -> Result<(), StoreError> {
        match &self.place {
            Place::Objects(objects) => objects.write(key, bytes).await,
            Place::Coordinator { client, url } => {
                client.clone().write(&key, bytes).await.map_err(|source| not_passed_on(key, url, source))
            }
        }
    }

    /// Reads a blob of this length and checks its hash.
    pub async fn get(&self, key: &BlobKey, length: u64) -> Result<Bytes, StoreError> {
        patiently(&self.impatience, || self.try_get(*key, length)).await
    }

    /// Reads a blob of which nobody has said how long it is: a photograph, or weights.
    pub async fn get_file(&self, key: &BlobKey) -> Result<Bytes, StoreError> {
        self.get(key, MAX_FILE_BYTES).await
    }

    async fn try_get(&self, key: BlobKey, at_most: u64) -> Result<Bytes, StoreError> {
        match &self.place {
            Place::Objects(objects) => objects.get(key, at_most).await,
            Place::Coordinator { client, url } => {
                let bytes = client.clone().read(&key, at_most).await.map_err(|source| match source.code {
                    Code::TooLarge => StoreError::TooLarge { key, at_most },
                    _ => not_passed_on(key, url, source),
                })?;
                if BlobKey::of(&bytes) == key { Ok(bytes) } else { Err(StoreError::Damaged { key }) }
            }
        }
    }

    /// Whether a blob is there with all its bytes, which are read and hashed where the store is reached.
    pub async fn holds(&self, key: &BlobKey) -> Result<bool, StoreError> {
        patiently(&self.impatience, || self.try_holds(*key)).await
    }

    async fn try_holds(&self, key: BlobKey) -> Result<bool, StoreError> {
        match &self.place {
            Place::Objects(objects) => objects.holds(key).await,
            Place::Coordinator { client, url } => {
                client.clone().find(&key).await.map_err(|source| not_passed_on(key, url, source))
            }
        }
    }
}

fn not_passed_on(key: BlobKey, url: &str, source: ServiceError) -> StoreError {
    match source.code {
        Code::NotFound => StoreError::Missing { key },
        _ => StoreError::Coordinator { key, url: url.to_owned(), source },
    }
}
