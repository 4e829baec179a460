//! From a plan to the graph of jobs, each named by what determines its result.

use std::collections::BTreeMap;

use planesweep_fusion::{DepthSampling, FusionMethod, VertexFormat};
use planesweep_scene::{Camera, DepthHypotheses, Sampling, Scene, ViewId};
use thiserror::Error;

use crate::job::{
    AssembleSpec, EmitSpec, FilterSpec, FitSpec, ImageSpec, InferSpec, Job, JobSpec, NUMERICS_VERSION,
    StitchSpec,
};
use crate::size::working_size;
use crate::{BlobKey, JobId, Plan};

/// Why a plan does not become jobs.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum JobsError {
    /// The plan names a view that the scene does not have, or whose image has no hash.
    #[error("cannot make a job of view {view}: its image was not read")]
    UnknownView {
        /// The view.
        view: ViewId,
    },
}

/// The jobs of a plan, every job after the jobs it needs: all `Infer` jobs in the order of the plan,
/// then all `Stitch`, all `Fit`, all `Filter`, all `Emit`, and `Assemble`.
///
/// `image_hashes` are the hashes of the image files' bytes; `weights` is the key of the weights.
pub fn jobs(
    scene: &Scene,
    plan: &Plan,
    image_hashes: &BTreeMap<ViewId, BlobKey>,
    weights: BlobKey,
) -> Result<Vec<Job>, JobsError> {
    let cameras = scene.undistorted_cameras();
    let image = |view: ViewId| -> Result<ImageSpec, JobsError> {
        let unknown = JobsError::UnknownView { view };
        let (Some(known), Some(hash)) = (scene.views.get(&view), image_hashes.get(&view)) else {
            return Err(unknown);
        };
        let size = &cameras[&view].intrinsics;
        let (working_width, working_height) = working_size(size.width, size.height, plan.options.max_size);
        Ok(ImageSpec {
            view,
            name: known.name.clone(),
            path: known.image.clone(),
            hash: *hash,
            camera: known.camera,
            distortion: known.distortion,
            working_width,
            working_height,
        })
    };
    let mut infer = Vec::with_capacity(plan.views.len());
    let mut stitch = Vec::new();
    let mut fit = Vec::new();
    // Who gives the depth map of each view.
    let mut maps = BTreeMap::new();
    for view in &plan.views {
        let whole = InferSpec {
            reference: image(view.view)?,
            sources: view.sources.iter().map(|source| image(*source)).collect::<Result<_, _>>()?,
            hypotheses: view.hypotheses,
            rows: None,
            weights,
        };
        if view.bands.is_empty() {
            let map = job(JobSpec::Infer(whole), Vec::new());
            maps.insert(view.view, map.id);
            infer.push(map);
            continue;
        }
        let bands = view.bands.iter().map(|rows| InferSpec { rows: Some(rows.clone()), ..whole.clone() });
        let bands: Vec<Job> = bands.map(|band| job(JobSpec::Infer(band), Vec::new())).collect();
        let needs = bands.iter().map(|band| band.id).collect();
        let whole = job(JobSpec::Stitch(StitchSpec { view: view.view }), needs);
        maps.insert(view.view, whole.id);
        infer.extend(bands);
        stitch.push(whole);
    }
    let full_resolution = plan.options.full_resolution;
    for view in plan.views.iter().map(|view| view.view) {
        let mask = plan.masks.get(&view).cloned();
        if mask.is_some() || full_resolution {
            let spec = FitSpec { image: image(view)?, mask, full_resolution };
            let fitted = job(JobSpec::Fit(spec), vec![maps[&view]]);
            maps.insert(view, fitted.id);
            fit.push(fitted);
        }
    }
    let by_neighbourhood = |ids: &BTreeMap<ViewId, JobId>,
                            with_neighbours: bool,
                            spec: &dyn Fn(ViewId, Vec<ViewId>) -> JobSpec|
     -> Vec<Job> {
        let of_view = plan.views.iter().map(|view| {
            let known = view.neighbours.iter().copied().filter(|n| with_neighbours && ids.contains_key(n));
            let neighbours: Vec<ViewId> = known.collect();
            let needs = std::iter::once(&view.view).chain(&neighbours).map(|view| ids[view]).collect();
            job(spec(view.view, neighbours), needs)
        });
        of_view.collect()
    };
    let options = plan.options.filter;
    let filter = by_neighbourhood(&maps, true, &|view, neighbours| {
        JobSpec::Filter(FilterSpec { view, neighbours, options })
    });
    let filtered = filter.iter().filter_map(|job| Some((job.spec.view()?, job.id))).collect();
    let max_relative_depth = options.max_relative_depth;
    // The whole cloud has one format.
    let double = plan.views.iter().any(|view| {
        VertexFormat::needs_doubles(&scene.views[&view.view].camera, Some(view.hypotheses.min()))
    });
    let emit = by_neighbourhood(&filtered, plan.options.once_per_surface, &|view, neighbours| {
        JobSpec::Emit(EmitSpec { view, neighbours, max_relative_depth, double })
    });
    // The cloud is in the order of view ids, which does not change when the plan's order does.
    let mut emitted: Vec<(ViewId, JobId)> =
        emit.iter().filter_map(|job| Some((job.spec.view()?, job.id))).collect();
    emitted.sort_unstable();
    let (views, needs) = emitted.into_iter().unzip();
    let assemble = job(JobSpec::Assemble(AssembleSpec { views }), needs);
    Ok(infer.into_iter().chain(stitch).chain(fit).chain(filter).chain(emit).chain([assemble]).collect())
}

/// Names a job by the hash of its specification, of the jobs it needs and of the code's numerics.
/// Paths, names and ids of views do not enter: they do not change a number.
fn job(spec: JobSpec, needs: Vec<JobId>) -> Job {
    let mut digest = Digest(blake3::Hasher::new());
    digest.u32(NUMERICS_VERSION);
    digest.bytes(spec.kind().as_bytes());
    match &spec {
        JobSpec::Infer(infer) => {
            digest.image(&infer.reference);
            digest.u32(infer.sources.len() as u32);
            for source in &infer.sources {
                digest.image(source);
            }
            digest.hypotheses(&infer.hypotheses);
            digest.bytes(&infer.weights.0);
            for row in infer.rows.iter().flat_map(|rows| [rows.start, rows.end]) {
                digest.u32(row);
            }
        }
        JobSpec::Fit(fit) => {
            digest.image(&fit.image);
            digest.u32(u32::from(fit.full_resolution));
            digest.bytes(fit.mask.as_ref().map_or(&[], |mask| &mask.hash.0));
        }
        JobSpec::Filter(filter) => {
            let options = filter.options;
            digest.u32(match options.method {
                FusionMethod::Consistency => 0,
                FusionMethod::Dynamic => 1,
                FusionMethod::Visibility => 2,
                FusionMethod::VisibilityConfidence => 3,
            });
            digest.f64(options.min_confidence as f64);
            digest.f64(options.max_reprojection_px as f64);
            digest.f64(options.max_relative_depth as f64);
            digest.u32(options.min_views);
            digest.f64(options.network_pixel as f64);
            digest.u32(match options.sampling {
                DepthSampling::Bilinear => 0,
                DepthSampling::Continuous => 1,
            });
        }
        JobSpec::Emit(emit) => {
            digest.f64(emit.max_relative_depth as f64);
            digest.u32(u32::from(emit.double));
        }
        JobSpec::Stitch(_) | JobSpec::Assemble(_) => {}
    }
    digest.u32(needs.len() as u32);
    for need in &needs {
        digest.bytes(&need.0);
    }
    Job { id: JobId(*digest.0.finalize().as_bytes()), spec, needs }
}

/// Feeds values to a hash so that no two different sequences feed the same bytes.
struct Digest(blake3::Hasher);

impl Digest {
    fn bytes(&mut self, bytes: &[u8]) {
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }

    fn u32(&mut self, value: u32) {
        self.0.update(&value.to_le_bytes());
    }

    fn f64(&mut self, value: f64) {
        self.0.update(&value.to_bits().to_le_bytes());
    }

    fn camera(&mut self, camera: &Camera) {
        let k = &camera.intrinsics;
        self.u32(k.width);
        self.u32(k.height);
        let (rotation, translation) = (&camera.pose.rotation, &camera.pose.translation);
        let inner = [k.fx, k.fy, k.skew, k.cx, k.cy];
        for value in inner.iter().chain(rotation.iter()).chain(translation.iter()) {
            self.f64(*value);
        }
    }

    fn image(&mut self, image: &ImageSpec) {
        self.bytes(&image.hash.0);
        self.camera(&image.camera);
        self.bytes(image.distortion.model().as_bytes());
        for coefficient in image.distortion.coefficients() {
            self.f64(coefficient);
        }
        self.u32(image.working_width);
        self.u32(image.working_height);
    }

    fn hypotheses(&mut self, hypotheses: &DepthHypotheses) {
        self.u32(match hypotheses.sampling() {
            Sampling::Uniform => 0,
            Sampling::Inverse => 1,
        });
        self.f64(hypotheses.min());
        self.f64(hypotheses.max());
        self.u32(hypotheses.count());
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use nalgebra::{Point3, Vector3};
    use planesweep_scene::{DepthRange, Distortion, Intrinsics, Pose, View};

    use super::*;
    use crate::{MaskSpec, PlanOptions, plan};

    fn scene() -> Scene {
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, skew: 0.0, cx: 31.5, cy: 23.5 };
        let mut scene = Scene::default();
        for k in 0..4_u32 {
            let centre = Point3::new(0.3 * k as f64, 0.0, 0.0);
            let pose = Pose::look_at(&centre, &Point3::new(0.5, 0.0, 5.0), &-Vector3::y());
            let view = View {
                id: ViewId(k),
                name: format!("{k}.png"),
                image: format!("{k}.png").into(),
                camera: Camera { intrinsics, pose },
                distortion: Distortion::None,
                depth_range: Some(DepthRange { min: 4.0, max: 6.0, count: Some(16) }),
            };
            scene.views.insert(view.id, view);
        }
        scene
    }

    fn jobs_of(scene: &Scene, options: &PlanOptions, weights: &[u8]) -> Vec<Job> {
        let hashes = scene.views.values().map(|v| (v.id, BlobKey::of(v.name.as_bytes()))).collect();
        jobs(scene, &plan(scene, options), &hashes, BlobKey::of(weights)).expect("all views are known")
    }

    fn ids(jobs: &[Job]) -> BTreeSet<JobId> {
        jobs.iter().map(|job| job.id).collect()
    }

    #[test]
    fn every_need_stands_before_the_job_that_needs_it() {
        let jobs = jobs_of(&scene(), &PlanOptions::default(), b"w");
        assert_eq!(jobs.len(), 3 * 4 + 1);
        let mut done = BTreeSet::new();
        for job in &jobs {
            assert!(job.needs.iter().all(|need| done.contains(need)), "{}", job.spec.kind());
            assert!(done.insert(job.id), "two jobs have the same id");
        }
        assert_eq!(jobs[12].spec.kind(), "assemble");
        assert_eq!(jobs[4].needs.len(), 1 + 3);
    }

    #[test]
    fn ids_change_with_what_changes_numbers_and_with_nothing_else() {
        let plain = jobs_of(&scene(), &PlanOptions::default(), b"w");
        assert_eq!(ids(&plain), ids(&jobs_of(&scene(), &PlanOptions::default(), b"w")));

        let mut moved = scene();
        moved.views.values_mut().for_each(|view| view.image = "elsewhere".into());
        assert_eq!(ids(&plain), ids(&jobs_of(&moved, &PlanOptions::default(), b"w")));

        let other_weights = jobs_of(&scene(), &PlanOptions::default(), b"v");
        assert!(ids(&plain).is_disjoint(&ids(&other_weights)));

        let mut options = PlanOptions::default();
        options.filter.min_views = 2;
        let other_filter = jobs_of(&scene(), &options, b"w");
        let (kept, fresh): (Vec<&Job>, Vec<&Job>) =
            other_filter.iter().partition(|job| ids(&plain).contains(&job.id));
        assert!(kept.iter().all(|job| job.spec.kind() == "infer") && kept.len() == 4 && fresh.len() == 9);

        let every_view = PlanOptions { once_per_surface: false, ..PlanOptions::default() };
        let every_view = jobs_of(&scene(), &every_view, b"w");
        assert_eq!(ids(&plain).intersection(&ids(&every_view)).count(), 8, "inference and filter stay");
        assert!(every_view[8..12].iter().all(|job| job.needs.len() == 1));

        let mut georeferenced = scene();
        for view in georeferenced.views.values_mut() {
            view.camera.pose.translation.x += 5e6;
        }
        let doubles = jobs_of(&georeferenced, &PlanOptions::default(), b"w");
        assert!(doubles.iter().all(|job| !matches!(&job.spec, JobSpec::Emit(emit) if !emit.double)));
        assert!(plain.iter().all(|job| !matches!(&job.spec, JobSpec::Emit(emit) if emit.double)));

        let mut bent = scene();
        bent.views.get_mut(&ViewId(0)).expect("exists").distortion = Distortion::Radial { k1: 0.1, k2: 0.0 };
        assert!(ids(&plain).is_disjoint(&ids(&jobs_of(&bent, &PlanOptions::default(), b"w"))));
    }

    #[test]
    fn masks_and_full_resolution_change_what_is_filtered_and_not_what_is_inferred() {
        let plain = jobs_of(&scene(), &PlanOptions::default(), b"w");
        let hashes = scene().views.values().map(|v| (v.id, BlobKey::of(v.name.as_bytes()))).collect();
        let masked = |bytes: &[u8]| {
            let mut plan = plan(&scene(), &PlanOptions::default());
            let mask = MaskSpec { path: "1.png".into(), hash: BlobKey::of(bytes) };
            plan.masks.insert(ViewId(1), mask);
            jobs(&scene(), &plan, &hashes, BlobKey::of(b"w")).expect("all views are known")
        };
        let one = masked(b"m");
        assert_eq!((one[4].spec.kind(), one[4].spec.view()), ("fit", Some(ViewId(1))));
        let inferred = one[..4].iter().find(|job| job.spec.view() == Some(ViewId(1))).expect("inferred");
        assert_eq!(one[4].needs, [inferred.id]);
        assert_eq!(ids(&plain).intersection(&ids(&one)).count(), 4, "inference stays");
        assert_eq!(ids(&masked(b"other")).intersection(&ids(&one)).count(), 4);
        let options = PlanOptions { full_resolution: true, ..PlanOptions::default() };
        let full = jobs_of(&scene(), &options, b"w");
        assert_eq!(full.iter().filter(|job| job.spec.kind() == "fit").count(), 4);
        assert!(full[8].needs.iter().all(|need| full[4..8].iter().any(|fit| fit.id == *need)));
        assert_eq!(ids(&plain).intersection(&ids(&full)).count(), 4);
    }

    #[test]
    fn a_view_in_bands_is_stitched_before_it_is_filtered() {
        let mut scene = scene();
        for view in scene.views.values_mut() {
            view.camera.intrinsics = Intrinsics { height: 150, cy: 74.5, ..view.camera.intrinsics };
        }
        let options = PlanOptions { band_rows: Some(32), ..PlanOptions::default() };
        let banded = jobs_of(&scene, &options, b"w");
        let kinds = |kind: &str| banded.iter().filter(|job| job.spec.kind() == kind).count();
        // 38 rows of the depth map: 8, 8, 8 and the rest.
        assert_eq!(["infer", "stitch", "filter", "emit", "assemble"].map(kinds), [16, 4, 4, 4, 1]);
        let mut done = BTreeSet::new();
        for job in &banded {
            assert!(job.needs.iter().all(|need| done.contains(need)), "{}", job.spec.kind());
            assert!(done.insert(job.id), "two jobs have the same id");
        }
        let rows = |job: &JobId| {
            banded.iter().find_map(|other| match &other.spec {
                JobSpec::Infer(spec) if other.id == *job => spec.rows.clone(),
                _ => None,
            })
        };
        assert_eq!(
            banded[16].needs.iter().filter_map(rows).collect::<Vec<_>>(),
            [0..8, 8..16, 16..24, 24..38]
        );
        let stitched: BTreeSet<JobId> = banded[16..20].iter().map(|job| job.id).collect();
        assert!(banded[20].needs.iter().all(|need| stitched.contains(need)));
        let whole = jobs_of(&scene, &PlanOptions::default(), b"w");
        assert!(ids(&banded).is_disjoint(&ids(&whole)));
    }

    #[test]
    fn a_view_without_an_image_hash_is_named() {
        let scene = scene();
        let hashes = BTreeMap::from([(ViewId(0), BlobKey::of(b"0"))]);
        let error = jobs(&scene, &plan(&scene, &PlanOptions::default()), &hashes, BlobKey::of(b"w"));
        assert!(matches!(error, Err(JobsError::UnknownView { view }) if view != ViewId(0)));
    }
}
