//! One job from grant to stored result: load, compute, check, store.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use planesweep_fusion::{
    FilteredMap, Funnel, VertexFormat, decode_filtered_map, emit, emitted, encode, encode_filtered_map,
    filter,
};
use planesweep_plan::{BlobKey, EmitSpec, FilterSpec, FitSpec, InferSpec, JobId, JobSpec};
use planesweep_proto::{Grant, IMAGES_FETCHED, Input, Produced, Success, Way};
use planesweep_scene::DepthMap;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;

use crate::blob::{decode_depth_map, depth_map_bytes, encode_depth_map, encode_points};
use crate::cloud::assemble;
use crate::device::{Device, InferRequest};
use crate::disk_cache::DiskCache;
use crate::exchange::{Exchange, Written};
use crate::failure::JobError;
use crate::files::Files;
use crate::images::Images;
use crate::maps::Maps;
use crate::store::{Store, StoreError};
use crate::weights::WeightsFiles;

/// All that jobs share on a worker.
pub(crate) struct Jobs {
    store: Store,
    weights: WeightsFiles,
    images: Images,
    device: Device,
    /// One inference at a time; the next one loads its images meanwhile.
    device_turn: Semaphore,
    maps: Arc<Maps>,
    exchange: Arc<Exchange>,
}

/// The bytes of a result and what was measured on the way.
type Made = (Written, BTreeMap<String, f64>);

/// How many maps came on each way.
type Ways = BTreeMap<Way, u32>;

impl Jobs {
    /// `cache_bytes` is the budget of images in memory, `disk` keeps the files that come from the store.
    pub fn new(
        store: Store,
        device: Device,
        cache_bytes: u64,
        disk: DiskCache,
        maps: Arc<Maps>,
        exchange: Arc<Exchange>,
    ) -> Self {
        let weights = WeightsFiles::new(store.clone());
        let images = Images::new(Files::new(store.clone(), disk), cache_bytes);
        Self { store, weights, images, device, device_turn: Semaphore::new(1), maps, exchange }
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
        let (written, measurements) = match &grant.spec {
            JobSpec::Infer(spec) => self.infer(spec, cancelled, started).await?,
            JobSpec::Stitch(_) => {
                started();
                self.stitch(&grant.inputs).await?
            }
            JobSpec::Fit(spec) => {
                started();
                self.fit(spec, &grant.inputs).await?
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
        let bytes = written.bytes();
        let length = bytes.len() as u64;
        let blob = self.store.put(bytes).await.map_err(JobError::Store)?;
        written.send(&blob);
        Ok(Success { blob, length, measurements, seconds: begun.elapsed().as_secs_f64() })
    }

    async fn infer(
        &self,
        spec: &InferSpec,
        cancelled: &CancellationToken,
        started: impl FnOnce(),
    ) -> Result<Made, JobError> {
        check(cancelled)?;
        let weights = self.weights.get(&spec.weights).await.map_err(JobError::Weights)?;
        let mut fetched = 0;
        let reference = self.images.get(&spec.reference, &mut fetched).await?;
        let mut sources = Vec::with_capacity(spec.sources.len());
        for source in &spec.sources {
            sources.push(self.images.get(source, &mut fetched).await?);
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
        let measurements = [
            ("network_seconds".to_owned(), begun.elapsed().as_secs_f64()),
            (IMAGES_FETCHED.to_owned(), fetched.into()),
        ];
        Ok((self.keep(map).await, BTreeMap::from(measurements)))
    }

    async fn stitch(&self, inputs: &[Input]) -> Result<Made, JobError> {
        let mut ways = Ways::new();
        let mut bands = Vec::with_capacity(inputs.len());
        for input in inputs {
            bands.push(self.depth_map(input, &mut ways).await);
        }
        let bands =
            all_or_lost(bands)?.into_iter().collect::<Option<Vec<_>>>().ok_or(JobError::NoDepthMap)?;
        let bands: Vec<DepthMap> = bands.iter().map(|band| DepthMap::clone(band)).collect();
        Ok((self.keep(DepthMap::stitch(&bands)?).await, counted(&ways)))
    }

    async fn fit(&self, spec: &FitSpec, inputs: &[Input]) -> Result<Made, JobError> {
        let input = inputs.first().ok_or(JobError::NoDepthMap)?;
        let mut ways = Ways::new();
        let map = self.depth_map(input, &mut ways).await?.ok_or(JobError::NoDepthMap)?;
        let mut fetched = 0;
        let image = self.images.get(&spec.image, &mut fetched).await?;
        let mask = match spec.mask.clone() {
            Some(mask) => Some(self.images.mask(mask, &mut fetched).await?),
            None => None,
        };
        let full_resolution = spec.full_resolution;
        let fitted = compute(move || {
            let mut map = DepthMap::clone(&map);
            if let Some(mask) = &mask {
                map.leave_out(mask);
            }
            if full_resolution { map.upsampled(&image) } else { map }
        })
        .await;
        let mut measurements = counted(&ways);
        measurements.insert(IMAGES_FETCHED.to_owned(), fetched.into());
        Ok((self.keep(fitted).await, measurements))
    }

    /// The map as bytes. It stays in memory too, for neighbouring views filter against it soon.
    async fn keep(&self, map: DepthMap) -> Written {
        let map = Arc::new(map);
        let source = Arc::clone(&map);
        let written =
            self.exchange.write(depth_map_bytes(&map), move |out| encode_depth_map(&source, out)).await;
        self.maps.depth.insert(BlobKey::of(&written.bytes()), map);
        written
    }

    async fn filter(&self, spec: &FilterSpec, inputs: &[Input]) -> Result<Made, JobError> {
        if inputs.is_empty() {
            return Err(JobError::NoDepthMap);
        }
        let mut ways = Ways::new();
        let mut maps = Vec::with_capacity(inputs.len());
        for input in inputs {
            maps.push(self.depth_map(input, &mut ways).await);
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
        let mut measurements = counted(&ways);
        measurements.extend(counts.map(|(name, count)| (name.to_owned(), count as f64)));
        let filtered = Arc::new(filtered);
        let bytes = encode_filtered_map(&filtered);
        // Neighbouring views ask soon who emits what: keep it.
        self.maps.filtered.insert(BlobKey::of(&bytes), filtered);
        Ok((bytes.into(), measurements))
    }

    async fn emit(&self, spec: &EmitSpec, inputs: &[Input]) -> Result<Made, JobError> {
        let mut ways = Ways::new();
        let mut maps = Vec::with_capacity(inputs.len());
        for input in inputs {
            maps.push(self.filtered_map(input, &mut ways).await);
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
        let mut measurements = counted(&ways);
        measurements.insert("points".to_owned(), funnel.emitted as f64);
        Ok((encode_points(&funnel, format, &vertices).into(), measurements))
    }

    async fn assemble(&self, inputs: &[Input]) -> Result<Made, JobError> {
        let mut clouds = Vec::with_capacity(inputs.len());
        for Input { job, produced } in inputs {
            let Some(produced) = produced else { continue };
            let bytes = self.store.get(&produced.blob, produced.length).await;
            let bytes = bytes.map_err(|source| unreadable(*job, source));
            clouds.push(bytes.map(|bytes| (*job, bytes)));
        }
        let clouds: Vec<(JobId, Bytes)> = all_or_lost(clouds)?;
        compute(move || {
            let (bytes, points) = assemble(&clouds)?;
            Ok((bytes.into(), BTreeMap::from([("points".to_owned(), points as f64)])))
        })
        .await
    }

    /// The map that a needed job made; `None` when that job failed for good.
    async fn depth_map(&self, input: &Input, ways: &mut Ways) -> Result<Option<Arc<DepthMap>>, JobError> {
        let Some(produced) = &input.produced else { return Ok(None) };
        let mut way = Way::Process;
        let read = async {
            let bytes = self.fetch(input.job, produced, &mut way).await?;
            let map =
                decode_depth_map(&bytes).map_err(|source| JobError::Malformed { job: input.job, source })?;
            Ok::<_, JobError>(Arc::new(map))
        };
        let map = self.maps.depth.get_or_insert_async(&produced.blob, read).await?;
        *ways.entry(way).or_default() += 1;
        Ok(Some(map))
    }

    async fn filtered_map(
        &self,
        input: &Input,
        ways: &mut Ways,
    ) -> Result<Option<Arc<FilteredMap>>, JobError> {
        let Some(produced) = &input.produced else { return Ok(None) };
        let mut way = Way::Process;
        let read = async {
            let bytes = self.fetch(input.job, produced, &mut way).await?;
            let map = decode_filtered_map(&bytes)
                .map_err(|source| JobError::Malformed { job: input.job, source: source.into() })?;
            Ok::<_, JobError>(Arc::new(map))
        };
        let map = self.maps.filtered.get_or_insert_async(&produced.blob, read).await?;
        *ways.entry(way).or_default() += 1;
        Ok(Some(map))
    }

    /// The bytes of a map that is not in this process' memory.
    async fn fetch(&self, job: JobId, produced: &Produced, way: &mut Way) -> Result<Bytes, JobError> {
        let fetched = self.exchange.get(produced, &self.store).await;
        let (bytes, came) = fetched.map_err(|source| unreadable(job, source))?;
        *way = came;
        Ok(bytes)
    }
}

/// What follows when the result of a needed job cannot be read.
fn unreadable(job: JobId, source: StoreError) -> JobError {
    if source.is_lost() { JobError::Lost { jobs: vec![job] } } else { JobError::Input { job, source } }
}

/// The ways as measurements.
fn counted(ways: &Ways) -> BTreeMap<String, f64> {
    ways.iter().map(|(way, maps)| (way.measurement().to_owned(), f64::from(*maps))).collect()
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
pub(crate) async fn compute<T: Send + 'static>(f: impl FnOnce() -> T + Send + 'static) -> T {
    spawn_blocking(f).await.expect("computing does not panic")
}
