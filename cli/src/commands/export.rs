//! From the results in the store to the files that people use.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, ErrorKind};
use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use bytes::Bytes;
use planesweep_fusion::{VertexFormat, decode_filtered_map};
use planesweep_plan::{BlobKey, Job, JobId, NUMERICS_VERSION, ViewPlan, sparse_depths};
use planesweep_proto::{CODE_VERSION, JobResult, JobState, images_fetched, maps_by_way};
use planesweep_report::{
    Funnel, Pictures, RunReport, SkippedView, StageReport, Totals, ViewReport, encode_png, render_cloud,
    render_html,
};
use planesweep_scene::{
    Camera, Raster, Scene, SourceScore, ViewId, mvsnet_cam_text, mvsnet_pair_text, write_atomically,
};
use planesweep_store::Store;
use planesweep_worker::decode_depth_map;
use rayon::prelude::*;
use serde_json::json;
use tokio::runtime::Runtime;

use crate::computation::Computed;
use crate::console::{Outcome, shortest};
use crate::input::{Skipped, all_skipped};
use crate::out_folder::{OutFolder, depth_range, trajectory};
use crate::prepare::{Prepared, Stages};
use crate::run_record::{FILE_NAME, RecordedView, RunRecord};

/// Size of the picture of the cloud in the report.
const CLOUD_PICTURE: (u32, u32) = (1280, 960);

/// Results by kind of job and view; a view has several inferences when it is inferred in bands.
type ByView<'a> = BTreeMap<(&'static str, Option<ViewId>), Vec<&'a JobResult>>;

/// A run whose jobs have ended.
pub struct Finished<'a> {
    out: &'a Path,
    prepared: &'a Prepared,
    store: &'a Store,
    runtime: &'a Runtime,
    results: &'a [JobResult],
    /// How many of the jobs an earlier run had done.
    reused: u32,
    by_view: ByView<'a>,
}

impl<'a> Finished<'a> {
    /// Of what came of its jobs; their blobs are in the store.
    pub fn new(
        out: &'a Path,
        prepared: &'a Prepared,
        store: &'a Store,
        runtime: &'a Runtime,
        computed: &'a Computed,
    ) -> Self {
        let Computed { results, reused } = computed;
        let by_view = by_view(&prepared.jobs, results);
        Self { out, prepared, store, runtime, results, reused: *reused, by_view }
    }

    fn result(&self, kind: &'static str, view: Option<ViewId>) -> Option<&'a JobResult> {
        self.by_view.get(&(kind, view))?.last().copied()
    }

    /// The job whose result is the depth map of a view.
    fn depth_map(&self, view: ViewId) -> Option<&'a JobResult> {
        ["fit", "stitch", "infer"].into_iter().find_map(|kind| self.result(kind, Some(view)))
    }

    fn infer_seconds(&self, view: ViewId) -> f64 {
        self.by_view.get(&("infer", Some(view))).into_iter().flatten().map(|result| own_seconds(result)).sum()
    }
}

/// What is known of a view when its files are written.
struct ExportedView {
    record: RecordedView,
    report: ViewReport,
    preview: Raster<[u8; 3]>,
}

/// Writes the result folder.
pub fn run(run: &Finished<'_>, stages: Stages, begun: Instant) -> Result<Outcome> {
    write(run, stages, begun).map_err(|error| {
        let mut kinds = error.chain().filter_map(|cause| Some(cause.downcast_ref::<io::Error>()?.kind()));
        if kinds.any(|kind| matches!(kind, ErrorKind::StorageFull | ErrorKind::QuotaExceeded)) {
            let out = run.out.display();
            error.context(format!("disk full at {out}; make room and run the same command again"))
        } else {
            error
        }
    })
}

fn write(run: &Finished<'_>, mut stages: Stages, begun: Instant) -> Result<Outcome> {
    let writing = Instant::now();
    let scene = &run.prepared.input.scene;
    let planned = run.prepared.plan.views.iter().map(|v| (v.view, scene.views[&v.view].name.as_str()));
    let out = OutFolder::create(run.out, planned)?;
    out.clear()?;
    let mut views: Vec<&ViewPlan> = run.prepared.plan.views.iter().collect();
    views.sort_by_key(|view| view.view);
    let exported: Vec<Option<ExportedView>> =
        views.par_iter().map(|view| export_view(run, &out, view)).collect::<Result<_>>()?;
    let exported: Vec<ExportedView> = exported.into_iter().flatten().collect();
    write_mvsnet_side(&out, &exported)?;
    // Tanks and Temples matches cameras by their order, so those without a depth map are in it, too.
    let cameras = run.prepared.input.scene.views.values().map(|view| &view.camera);
    out.write_file("trajectory.log", trajectory(cameras).as_bytes())?;
    let skipped = skipped_views(run);
    let (cloud_key, cloud) = write_cloud(run, &out)?;
    let points = vertices(&cloud).count() as u64;

    // Kinds of jobs overlap in time and run on several workers, so these are sums, not parts.
    for kind in ["infer", "stitch", "fit", "filter", "emit", "assemble"] {
        let of_kind = run.results.iter().filter(|result| result.kind == kind);
        if of_kind.clone().next().is_some() {
            stages.push((format!("{kind}, summed"), of_kind.map(own_seconds).sum()));
        }
    }
    stages.push(("write".to_owned(), writing.elapsed().as_secs_f64()));
    let record = record(run, &exported, &skipped, cloud_key, points);
    out.write_file(FILE_NAME, &serde_json::to_vec_pretty(&record).context("cannot write run.json")?)?;
    let report = report(run, &exported, &skipped, &stages, points, begun);
    write_report(&out, &run.prepared.input.scene, &report, exported, &cloud)?;

    let mut text = String::new();
    for (name, seconds) in &stages {
        text.push_str(&format!("{seconds:8.1} s  {name}\n"));
    }
    text.push_str(&format!("{:8.1} s  {}\n", report.totals.wall_seconds, report.totals.span()));
    let ways: Vec<String> =
        maps_by_way(run.results).iter().map(|(way, maps)| format!("{maps} {way}")).collect();
    text.push_str(&format!("maps reached the fusion: {}\n", ways.join(", ")));
    if report.images_fetched > 0 {
        text.push_str(&format!("{} photographs and masks came from the store\n", report.images_fetched));
    }
    for view in &skipped {
        text.push_str(&format!("skipped: {}: {}\n", view.view, view.reason));
    }
    let root = out.root().display();
    text.push_str(&format!(
        "{points} points in {root}/cloud.ply; {root}/report.html shows the rest
"
    ));
    let value = json!({
        "out": out.root(),
        "points": points,
        "cloud_blake3": cloud_key.to_string(),
        "skipped": skipped,
        "stages": stages,
        "report": report,
    });
    Ok(Outcome { text, value, skipped_views: !skipped.is_empty() })
}

/// How long a job computed; what an inference waited for the device is not its own time.
fn own_seconds(result: &JobResult) -> f64 {
    result.measurements.get("network_seconds").copied().unwrap_or(result.seconds)
}

/// The results by kind of job and view. They are matched by the jobs' ids, for views with the same
/// content share their jobs.
fn by_view<'a>(jobs: &[Job], results: &'a [JobResult]) -> ByView<'a> {
    let by_id: BTreeMap<JobId, &JobResult> = results.iter().map(|result| (result.job, result)).collect();
    let mut found = ByView::new();
    for job in jobs {
        if let Some(result) = by_id.get(&job.id) {
            found.entry((job.spec.kind(), job.spec.view())).or_default().push(result);
        }
    }
    found
}

fn blob(run: &Finished<'_>, result: &JobResult) -> Result<Option<Bytes>> {
    let Some((key, length)) = &result.blob else { return Ok(None) };
    Ok(Some(run.runtime.block_on(run.store.get(key, *length))?))
}

/// Writes depth, confidence and preview; `None` when the view's inference failed.
fn export_view(run: &Finished<'_>, out: &OutFolder, plan: &ViewPlan) -> Result<Option<ExportedView>> {
    let view = &run.prepared.input.scene.views[&plan.view];
    let Some(map) = run.depth_map(plan.view) else { return Ok(None) };
    let Some(bytes) = blob(run, map)? else { return Ok(None) };
    let map =
        decode_depth_map(&bytes).with_context(|| format!("cannot read the depth map of {}", view.name))?;
    let mut funnel = Funnel { pixels: map.depth.values().len() as u64, ..Funnel::default() };
    let mut kept = Raster::filled(map.width(), map.height(), false);
    let filter = run.result("filter", Some(plan.view));
    if let Some(bytes) = filter.map(|result| blob(run, result)).transpose()?.flatten() {
        let filtered =
            decode_filtered_map(&bytes).with_context(|| format!("cannot read the mask of {}", view.name))?;
        kept = filtered.depth.map(|depth| *depth > 0.0);
        let left = filtered.funnel;
        funnel = Funnel {
            photometric: left.photometric,
            visible: left.visible,
            geometric: left.geometric,
            ..funnel
        };
    }
    let emit = run.result("emit", Some(plan.view));
    funnel.emitted = emit.and_then(|r| r.measurements.get("points")).map_or(0, |points| *points as u64);
    let files = out.write_map(plan.view, &map, &kept, &plan.hypotheses)?;
    let names =
        |ids: &[ViewId]| ids.iter().map(|id| run.prepared.input.scene.views[id].name.clone()).collect();
    let report = ViewReport {
        id: plan.view,
        name: view.name.clone(),
        width: plan.working_size.0,
        height: plan.working_size.1,
        depth_min: plan.hypotheses.min(),
        depth_max: plan.hypotheses.max(),
        depth_count: plan.hypotheses.count(),
        sampling: plan.hypotheses.sampling(),
        sources: names(&plan.sources),
        funnel,
        seconds: run.infer_seconds(plan.view),
        preview: Some(files.preview_name),
        warnings: [filter, emit].into_iter().flatten().filter_map(failure).collect(),
    };
    let record = RecordedView {
        id: plan.view,
        name: view.name.clone(),
        file: out.file_name(plan.view).to_owned(),
        image: view.image.clone(),
        image_blake3: run.prepared.input.image_hashes[&plan.view],
        image_camera: view.camera,
        distortion: view.distortion,
        depth_camera: map.camera,
        hypotheses: plan.hypotheses,
        sources: plan.sources.clone(),
        neighbours: plan.neighbours.clone(),
    };
    Ok(Some(ExportedView { record, report, preview: files.picture }))
}

fn failure(result: &JobResult) -> Option<String> {
    let (_, message) = result.failure.as_ref().filter(|_| result.state == JobState::Failed)?;
    Some(format!("{}: {message}", result.kind))
}

/// Cameras and pairs, as users of MVSNet folders want them.
fn write_mvsnet_side(out: &OutFolder, views: &[ExportedView]) -> Result<()> {
    let mut pairs = BTreeMap::new();
    let exported: BTreeSet<ViewId> = views.iter().map(|view| view.record.id).collect();
    for ExportedView { record, .. } in views {
        let cam = mvsnet_cam_text(&record.depth_camera, Some(&depth_range(&record.hypotheses)));
        out.write_file(&format!("cams/{:08}_cam.txt", record.id.0), cam.as_bytes())?;
        // The scores are ranks: best first is all that readers of the file use.
        let count = record.neighbours.len();
        let scored = record.neighbours.iter().filter(|view| exported.contains(view)).enumerate();
        let scored = scored.map(|(rank, view)| SourceScore { view: *view, score: (count - rank) as f64 });
        pairs.insert(record.id, scored.collect());
    }
    out.write_file("pair.txt", mvsnet_pair_text(&pairs).as_bytes())?;
    Ok(())
}

fn write_cloud(run: &Finished<'_>, out: &OutFolder) -> Result<(BlobKey, Bytes)> {
    let assembled = run.result("assemble", None).context("the ledger knows no cloud")?;
    let Some((key, _)) = assembled.blob else {
        let (_, message) = assembled.failure.clone().unwrap_or_default();
        bail!("there is no cloud: {message}; previews of the depth maps are in {}", out.root().display());
    };
    let bytes = blob(run, assembled)?.context("the cloud is not in the store")?;
    let path = out.root().join("cloud.ply");
    write_atomically(&path, &bytes).with_context(|| format!("cannot write {}", path.display()))?;
    Ok((key, bytes))
}

/// Position and colour of every point of a cloud that a worker assembled.
fn vertices(cloud: &[u8]) -> impl Iterator<Item = ([f64; 3], [u8; 3])> {
    const END: &[u8] = b"end_header\n";
    let header =
        cloud.windows(END.len()).position(|window| window == END).map_or(cloud.len(), |at| at + END.len());
    let double = String::from_utf8_lossy(&cloud[..header]).contains("property double x");
    let format = VertexFormat { double, quality: false };
    let (position, color) = if double { (8, 36) } else { (4, 24) };
    cloud[header..].chunks_exact(format.vertex_bytes()).map(move |v| {
        let number = |axis: usize| {
            let bytes = &v[axis * position..][..position];
            match bytes.try_into() {
                Ok(bytes) => f64::from_le_bytes(bytes),
                Err(_) => bytes.try_into().map_or(0.0, f32::from_le_bytes).into(),
            }
        };
        ([number(0), number(1), number(2)], [v[color], v[color + 1], v[color + 2]])
    })
}

/// All views that are not in the cloud: left out before, or with a job that failed for good.
fn skipped_views(run: &Finished<'_>) -> Vec<Skipped> {
    let mut skipped = all_skipped(&run.prepared.input, &run.prepared.plan);
    let mut failed = BTreeMap::new();
    for result in run.results.iter().filter(|result| result.state == JobState::Failed) {
        if let Some(view) = result.view.and_then(|id| run.prepared.input.scene.views.get(&id)) {
            // What follows from a failure fails too; the first says why.
            failed.entry(view.id).or_insert_with(|| {
                let (_, message) = result.failure.clone().unwrap_or_default();
                Skipped { view: view.name.clone(), reason: format!("{}: {message}", result.kind) }
            });
        }
    }
    skipped.extend(failed.into_values());
    skipped
}

fn record(
    run: &Finished<'_>,
    views: &[ExportedView],
    skipped: &[Skipped],
    cloud_blake3: BlobKey,
    points: u64,
) -> RunRecord {
    RunRecord {
        version: CODE_VERSION.to_owned(),
        numerics_version: NUMERICS_VERSION,
        scene: run.prepared.scene_path.clone(),
        options: run.prepared.plan.options.clone(),
        device: run.prepared.network.device.clone(),
        weights_blake3: run.prepared.network.key,
        weights: run.prepared.network.weights.metadata().clone(),
        views: views.iter().map(|view| view.record.clone()).collect(),
        skipped: skipped.to_vec(),
        points,
        cloud_blake3,
    }
}

fn report(
    run: &Finished<'_>,
    views: &[ExportedView],
    skipped: &[Skipped],
    stages: &Stages,
    points: u64,
    begun: Instant,
) -> RunReport {
    let options = &run.prepared.plan.options;
    let filter = &options.filter;
    let settings = [
        ("network images per depth map", json!(options.views)),
        ("longest side in pixels", json!(options.max_size)),
        ("depth hypotheses", options.depths.map_or(json!("by resolution"), |depths| json!(depths))),
        ("sampling", json!(options.sampling)),
        ("fusion", json!(filter.method)),
        ("each surface is emitted once", json!(options.once_per_surface)),
        ("full resolution", json!(options.full_resolution)),
        ("views with a mask", json!(run.prepared.plan.masks.len())),
        ("confidence threshold", shortest(&filter.min_confidence)),
        ("views that must agree, reference included", json!(filter.min_views)),
        ("reprojection threshold in pixels of the depth map", shortest(&filter.max_reprojection_px)),
        ("relative depth threshold", shortest(&filter.max_relative_depth)),
        ("fusion neighbours", json!(options.fusion_views)),
        ("device", json!(run.prepared.network.device)),
        ("weights", json!(run.prepared.network.file)),
    ];
    let versions = [
        ("planesweep", CODE_VERSION.to_owned()),
        ("numerics", NUMERICS_VERSION.to_string()),
        ("weights blake3", run.prepared.network.key.to_string()),
    ];
    RunReport {
        scene: run.prepared.scene_path.display().to_string(),
        settings: settings.map(|(name, value)| (name.to_owned(), value)).into(),
        versions: versions.map(|(name, value)| (name.to_owned(), value)).into(),
        stages: stages
            .iter()
            .map(|(name, seconds)| StageReport { name: name.clone(), seconds: *seconds })
            .collect(),
        views: views.iter().map(|view| view.report.clone()).collect(),
        skipped: skipped
            .iter()
            .map(|s| SkippedView { name: s.view.clone(), reason: s.reason.clone() })
            .collect(),
        warnings: run.prepared.input.scene.warnings.iter().map(ToString::to_string).collect(),
        maps_by_way: maps_by_way(run.results)
            .into_iter()
            .map(|(way, maps)| (way.to_string(), maps))
            .collect(),
        images_fetched: images_fetched(run.results),
        totals: Totals {
            points,
            wall_seconds: begun.elapsed().as_secs_f64(),
            jobs: run.results.len() as u64,
            jobs_done_before: u64::from(run.reused),
        },
    }
}

fn write_report(
    out: &OutFolder,
    scene: &Scene,
    report: &RunReport,
    views: Vec<ExportedView>,
    cloud: &[u8],
) -> Result<()> {
    out.write_file("report.json", report.to_json().context("cannot write report.json")?.as_bytes())?;
    let (width, height) = CLOUD_PICTURE;
    // As the middle view's photographer saw it.
    let camera: Option<Camera> = views.get(views.len() / 2).map(|view| view.record.depth_camera);
    let cloud = camera.map(|camera| render_cloud(vertices(cloud), &camera, width, height));
    if let Some(cloud) = &cloud {
        out.write_file("cloud.png", &encode_png(cloud)?)?;
    }
    let previews = views.into_iter().map(|view| (view.record.id, view.preview)).collect();
    let pictures = Pictures { cloud, previews, sparse_depths: sparse_depths(scene) };
    out.write_file("report.html", render_html(report, &pictures)?.as_bytes())?;
    Ok(())
}
