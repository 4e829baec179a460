//! A scene's photographs and masks on their way to the store, for workers that do not find them under their paths.

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::{Context, Result, bail};
use planesweep_plan::{BlobKey, Job, JobSpec};
use planesweep_store::Store;
use tokio::task::JoinSet;

/// Files on their way at once, each as a whole in memory.
const AT_A_TIME: usize = 4;

/// What became of the files of a plan.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Uploaded {
    /// Files that the store did not have.
    pub sent: usize,
    /// All of them.
    pub files: usize,
}

/// Stores every file that the jobs read, unless the store has it.
pub async fn upload(jobs: &[Job], store: &Store) -> Result<Uploaded> {
    let files = files(jobs);
    let mut uploaded = Uploaded { sent: 0, files: files.len() };
    let mut waiting = files.into_iter();
    let mut under_way = JoinSet::new();
    loop {
        while under_way.len() < AT_A_TIME
            && let Some((key, path)) = waiting.next()
        {
            under_way.spawn(send(store.clone(), key, path));
        }
        let Some(done) = under_way.join_next().await else { return Ok(uploaded) };
        uploaded.sent += usize::from(done.context("the upload panicked")??);
    }
}

/// The files that the jobs read, each once.
fn files(jobs: &[Job]) -> BTreeMap<BlobKey, PathBuf> {
    let mut files = BTreeMap::new();
    for job in jobs {
        let (images, mask) = match &job.spec {
            JobSpec::Infer(spec) => (std::slice::from_ref(&spec.reference).iter().chain(&spec.sources), None),
            JobSpec::Fit(spec) => (std::slice::from_ref(&spec.image).iter().chain(&[]), spec.mask.as_ref()),
            _ => continue,
        };
        files.extend(images.map(|image| (image.hash, image.path.clone())));
        files.extend(mask.map(|mask| (mask.hash, mask.path.clone())));
    }
    files
}

/// Whether the file had to be sent.
async fn send(store: Store, key: BlobKey, path: PathBuf) -> Result<bool> {
    let what = || format!("cannot upload {}", path.display());
    if store.holds(&key).await.with_context(what)? {
        return Ok(false);
    }
    let bytes = tokio::fs::read(&path).await.with_context(what)?;
    if BlobKey::of(&bytes) != key {
        bail!("{} has changed while the run was planned", path.display());
    }
    store.write(bytes.into()).await.with_context(what)?;
    Ok(true)
}
