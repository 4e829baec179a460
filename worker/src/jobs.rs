//! One job from grant to stored result: load, compute, check, store.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use planesweep_fusion::{
    FilteredMap, Funnel, VertexFormat, decode_filtered_map, emit, emitted, encode, encode_filtered_map,
    filter,
};
use planesweep_plan::{BlobKey, EmitSpec, FilterSpec, InferSpec, JobId, JobSpec};
use planesweep_proto::{Grant, Input, Success};
use planesweep_scene::DepthMap;
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::blob::{decode_depth_map, encode_depth_map, encode_points};
use crate::cache::cache;
use crate::cloud::assemble;
use crate::device::{Device, InferRequest};
use crate::failure::JobError;
use crate::images::Images;
use crate::store::Store;

#[derive(Clone)]
struct ByPixels;

impl Weighter<BlobKey, Arc<DepthMap>> for ByPixels {
    fn weight(&self, _: &BlobKey, map: &Arc<DepthMap>) -> u64 {
        map.depth.values().len() as u64 * 11
    }
}

impl Weighter<BlobKey, Arc<FilteredMap>> for ByPixels {
    fn weight(&self, _: &BlobKey, map: &Arc<FilteredMap>) -> u64 {
        map.depth.values().len() as u64 * 18
    }
}

/// All that jobs share on a worker.
pub(crate) struct Jobs {
    store: Store,
    images: Images,
    device: Device,
    /// One inference at a time; the next one loads its images meanwhile.
    device_turn: Semaphore,
    maps: Cache<BlobKey, Arc<DepthMap>, ByPixels>,
    filtered: Cache<BlobKey, Arc<FilteredMap>, ByPixels>,
}

/// The bytes of a result and what was measured on the way.
type Made = (Vec<u8>, BTreeMap<String, f64>);

impl Jobs {
    /// `cache_bytes` is the budget of images in memory, of depth maps, and of filtered ones, each.
    pub fn new(store: Store, device: Device, cache_bytes: u64) -> Self {
        Self {
            store,
            images: Images::new(cache_bytes),
            device,
            device_turn: Semaphore::new(1),
            maps: cache(cache_bytes, ByPixels),
            filtered: cache(cache_bytes, ByPixels),
        }
    }

    /// Does a job. `started` is called when computing begins; a job cancelled before its result is
    /// stored has none.
    pub async fn run(
        &self,
        grant: &Grant,
        cancelled: &CancellationToken,
        started: impl FnOnce(),
    ) -> Result<Success, JobError> {
        let begun = Instant::now();
        let (bytes, measurements) = match &grant.spec {
            JobSpec::Infer(spec) => self.infer(spec, cancelled, started).await?,
            JobSpec::Stitch(_) => {
                started();
                self.stitch(&grant.inputs).await?
            }
            JobSpec::Filter(spec) => {
                started();
                self.filter(spec, &grant.inputs).await?
            }
            JobSpec::Emit(spec) => {
                started();
                self.emit(spec, &grant.inputs).await?
            }
            JobSpec::Assemble(_) => {
                started();
                self.assemble(&grant.inputs).await?
            }
        };
        check(cancelled)?;
        let length = bytes.len() as u64;
        let blob = self.store.put(bytes.into()).await.map_err(JobError::Store)?;
        Ok(Success { blob, length, measurements, seconds: begun.elapsed().as_secs_f64() })
    }

    async fn infer(
        &self,
        spec: &InferSpec,
        cancelled: &CancellationToken,
        started: impl FnOnce(),
    ) -> Result<Made, JobError> {
        check(cancelled)?;
        let weights = self.store.get(&spec.weights).await.map_err(JobError::Weights)?;
        let reference = self.images.get(&spec.reference).await?;
        let mut sources = Vec::with_capacity(spec.sources.len());
        for source in &spec.sources {
            sources.push(self.images.get(source).await?);
        }
        let turn = tokio::select! {
            turn = self.device_turn.acquire() => turn,
            () = cancelled.cancelled() => return Err(JobError::GivenUp),
        };
        started();
        let begun = Instant::now();
        let request = InferRequest {
            weights: (spec.weights, weights),
            reference,
            sources,
            hypotheses: spec.hypotheses,
            rows: spec.rows.as_ref().map(|rows| rows.start as usize..rows.end as usize),
        };
        let map = self.device.infer(request).await?;
        drop(turn);
        let network_seconds = ("network_seconds".to_owned(), begun.elapsed().as_secs_f64());
        Ok((self.keep(map), BTreeMap::from([network_seconds])))
    }

    async fn stitch(&self, inputs: &[Input]) -> Result<Made, JobError> {
        let mut bands = Vec::with_capacity(inputs.len());
        for input in inputs {
            bands.push(self.depth_map(input).await);
        }
        let bands =
            all_or_lost(bands)?.into_iter().collect::<Option<Vec<_>>>().ok_or(JobError::NoDepthMap)?;
        let bands: Vec<DepthMap> = bands.iter().map(|band| DepthMap::clone(band)).collect();
        Ok((self.keep(DepthMap::stitch(&bands)?), BTreeMap::new()))
    }

    /// The map as bytes. It stays in memory too, for neighbouring views filter against it soon.
    fn keep(&self, map: DepthMap) -> Vec<u8> {
        let bytes = encode_depth_map(&map);
        self.maps.insert(BlobKey::of(&bytes), Arc::new(map));
        bytes
    }

    async fn filter(&self, spec: &FilterSpec, inputs: &[Input]) -> Result<Made, JobError> {
        if inputs.is_empty() {
            return Err(JobError::NoDepthMap);
        }
        let mut maps = Vec::with_capacity(inputs.len());
        for input in inputs {
            maps.push(self.depth_map(input).await);
        }
        let mut neighbours = all_or_lost(maps)?;
        let reference = neighbours.remove(0).ok_or(JobError::NoDepthMap)?;
        let neighbours: Vec<Arc<DepthMap>> = neighbours.into_iter().flatten().collect();
        let options = spec.options;
        let filtered = compute(move || {
            let neighbours: Vec<&DepthMap> = neighbours.iter().map(AsRef::as_ref).collect();
            filter(&reference, &neighbours, &options)
        })
        .await;
        let Funnel { pixels, with_depth, photometric, visible, geometric, .. } = filtered.funnel;
        let counts = [
            ("pixels", pixels),
            ("with_depth", with_depth),
            ("photometric", photometric),
            ("visible", visible),
            ("geometric", geometric),
        ];
        let measurements = counts.map(|(name, count)| (name.to_owned(), count as f64)).into();
        let filtered = Arc::new(filtered);
        let bytes = encode_filtered_map(&filtered);
        // Neighbouring views ask soon who emits what: keep it.
        self.filtered.insert(BlobKey::of(&bytes), filtered);
        Ok((bytes, measurements))
    }

    async fn emit(&self, spec: &EmitSpec, inputs: &[Input]) -> Result<Made, JobError> {
        let mut maps = Vec::with_capacity(inputs.len());
        for input in inputs {
            maps.push(self.filtered_map(input).await);
        }
        let mut maps = all_or_lost(maps)?.into_iter();
        let map = maps.next().flatten().ok_or(JobError::NoDepthMap)?;
        let others: Vec<Arc<FilteredMap>> = maps.flatten().collect();
        let max_relative_depth = spec.max_relative_depth;
        let format = VertexFormat { double: spec.double, quality: false };
        let (funnel, vertices) = compute(move || {
            let others: Vec<&FilteredMap> = others.iter().map(AsRef::as_ref).collect();
            let points = emit(&map, &emitted(&map, &others, max_relative_depth));
            (Funnel { emitted: points.len() as u64, ..map.funnel }, encode(&points, format))
        })
        .await;
        let measurements = BTreeMap::from([("points".to_owned(), funnel.emitted as f64)]);
        Ok((encode_points(&funnel, format, &vertices), measurements))
    }

    async fn assemble(&self, inputs: &[Input]) -> Result<Made, JobError> {
        let mut clouds = Vec::with_capacity(inputs.len());
        for input in inputs {
            clouds.push(self.input(input).await.map(|bytes| Some((input.job, bytes?))));
        }
        let clouds: Vec<(JobId, Bytes)> = all_or_lost(clouds)?.into_iter().flatten().collect();
        compute(move || {
            let (bytes, points) = assemble(&clouds)?;
            Ok((bytes, BTreeMap::from([("points".to_owned(), points as f64)])))
        })
        .await
    }

    /// The result of a needed job; `None` when that job failed for good.
    async fn input(&self, input: &Input) -> Result<Option<Bytes>, JobError> {
        let Some(produced) = &input.produced else { return Ok(None) };
        match self.store.get(&produced.blob).await {
            Ok(bytes) => Ok(Some(bytes)),
            Err(source) if source.is_lost() => Err(JobError::Lost { jobs: vec![input.job] }),
            Err(source) => Err(JobError::Input { job: input.job, source }),
        }
    }

    async fn depth_map(&self, input: &Input) -> Result<Option<Arc<DepthMap>>, JobError> {
        let Some(produced) = &input.produced else { return Ok(None) };
        let read = async {
            let bytes = self.input(input).await?.unwrap_or_default();
            let map =
                decode_depth_map(&bytes).map_err(|source| JobError::Malformed { job: input.job, source })?;
            Ok(Arc::new(map))
        };
        self.maps.get_or_insert_async(&produced.blob, read).await.map(Some)
    }

    async fn filtered_map(&self, input: &Input) -> Result<Option<Arc<FilteredMap>>, JobError> {
        let Some(produced) = &input.produced else { return Ok(None) };
        let read = async {
            let bytes = self.input(input).await?.unwrap_or_default();
            let map = decode_filtered_map(&bytes)
                .map_err(|source| JobError::Malformed { job: input.job, source: source.into() })?;
            Ok(Arc::new(map))
        };
        self.filtered.get_or_insert_async(&produced.blob, read).await.map(Some)
    }
}

/// All values, or one error that names every lost result, so that all are made again at once.
fn all_or_lost<T>(values: Vec<Result<T, JobError>>) -> Result<Vec<T>, JobError> {
    let mut lost = Vec::new();
    let mut all = Vec::with_capacity(values.len());
    for value in values {
        match value {
            Ok(value) => all.push(value),
            Err(JobError::Lost { jobs }) => lost.extend(jobs),
            Err(error) => return Err(error),
        }
    }
    if lost.is_empty() { Ok(all) } else { Err(JobError::Lost { jobs: lost }) }
}

fn check(cancelled: &CancellationToken) -> Result<(), JobError> {
    if cancelled.is_cancelled() { Err(JobError::GivenUp) } else { Ok(()) }
}

/// Runs something long outside the threads that keep the heartbeat going.
async fn compute<T: Send + 'static>(f: impl FnOnce() -> T + Send + 'static) -> T {
    spawn_blocking(f).await.expect("computing does not panic")
}
