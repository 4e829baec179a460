//! Jobs.

use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};
use planesweep_fusion::{DepthSampling, FilterOptions, FusionMethod};
use planesweep_plan::{
    AssembleSpec, BlobKey, EmitSpec, FilterSpec, FitSpec, ImageSpec, InferSpec, Job, JobId, JobSpec,
    MaskSpec, StitchSpec,
};
use planesweep_scene::{
    Camera, CameraError, DepthHypotheses, Distortion, Intrinsics, Pose, Sampling, ViewId,
};
use prost::Message;

use super::check::{at_most, blob_key, each, finite, in_range, job_id, required, short};
use crate::limits::{MAX_JOBS, MAX_PATH_BYTES, MAX_PLANES, MAX_SIDE, MAX_SOURCES, MAX_VIEWS};
use crate::{ServiceError, WireError, wire};

/// A job as bytes, for the ledger.
pub fn encode_job(job: &Job) -> Vec<u8> {
    wire::Job::from(job).encode_to_vec()
}

/// The job that [`encode_job`] made these bytes of, checked as if it came over the wire.
pub fn decode_job(bytes: &[u8]) -> Result<Job, WireError> {
    let job = wire::Job::decode(bytes)
        .map_err(|e| WireError::Undecodable { message: "job", reason: e.to_string() })?;
    Job::try_from(job)
}

/// Whether the job would pass if it came over the wire; for jobs that do not.
pub fn check_job(job: &Job) -> Result<(), WireError> {
    Job::try_from(wire::Job::from(job)).map(drop)
}

/// Whether all jobs of a submission would pass; the first that does not is named by its kind and view.
pub fn check_jobs(jobs: &[Job]) -> Result<(), ServiceError> {
    at_most("jobs", jobs.len(), MAX_JOBS)?;
    for job in jobs {
        check_job(job).map_err(|error| {
            let ServiceError { code, message } = error.into();
            let of_view = job.spec.view().map(|view| format!(" of view {view}")).unwrap_or_default();
            ServiceError::new(code, format!("{} job{of_view} is refused: {message}", job.spec.kind()))
        })?;
    }
    Ok(())
}

impl From<&Job> for wire::Job {
    fn from(job: &Job) -> Self {
        Self {
            id: job.id.0.to_vec(),
            spec: Some((&job.spec).into()),
            needs: job.needs.iter().map(|JobId(hash)| hash.to_vec()).collect(),
        }
    }
}

impl TryFrom<wire::Job> for Job {
    type Error = WireError;

    fn try_from(job: wire::Job) -> Result<Self, WireError> {
        at_most("needs", job.needs.len(), MAX_VIEWS)?;
        Ok(Self {
            id: job_id("job", &job.id)?,
            spec: required("spec", job.spec)?.try_into()?,
            needs: each(job.needs, |id| job_id("needs", &id))?,
        })
    }
}

impl From<&JobSpec> for wire::JobSpec {
    fn from(spec: &JobSpec) -> Self {
        use wire::job_spec::Spec;
        Self {
            spec: Some(match spec {
                JobSpec::Infer(spec) => Spec::Infer(spec.into()),
                JobSpec::Stitch(spec) => Spec::Stitch(wire::StitchSpec { view: spec.view.0 }),
                JobSpec::Fit(spec) => Spec::Fit(wire::FitSpec {
                    image: Some((&spec.image).into()),
                    mask: spec.mask.as_ref().map(|mask| wire::Mask {
                        path: mask.path.as_os_str().as_bytes().to_vec(),
                        hash: mask.hash.0.to_vec(),
                    }),
                    full_resolution: spec.full_resolution,
                }),
                JobSpec::Filter(spec) => Spec::Filter(wire::FilterSpec {
                    view: spec.view.0,
                    neighbours: numbers(&spec.neighbours),
                    options: Some(spec.options.into()),
                }),
                JobSpec::Emit(spec) => Spec::Emit(wire::EmitSpec {
                    view: spec.view.0,
                    neighbours: numbers(&spec.neighbours),
                    max_relative_depth: spec.max_relative_depth,
                    double: spec.double,
                }),
                JobSpec::Assemble(spec) => Spec::Assemble(wire::AssembleSpec { views: numbers(&spec.views) }),
            }),
        }
    }
}

impl TryFrom<wire::JobSpec> for JobSpec {
    type Error = WireError;

    fn try_from(spec: wire::JobSpec) -> Result<Self, WireError> {
        use wire::job_spec::Spec;
        Ok(match required("spec", spec.spec)? {
            Spec::Infer(spec) => Self::Infer(spec.try_into()?),
            Spec::Stitch(spec) => Self::Stitch(StitchSpec { view: ViewId(spec.view) }),
            Spec::Fit(spec) => Self::Fit(FitSpec {
                image: required("image", spec.image)?.try_into()?,
                mask: spec.mask.map(mask).transpose()?,
                full_resolution: spec.full_resolution,
            }),
            Spec::Filter(spec) => Self::Filter(FilterSpec {
                view: ViewId(spec.view),
                neighbours: views("neighbours", spec.neighbours)?,
                options: required("options", spec.options)?.try_into()?,
            }),
            Spec::Emit(spec) => Self::Emit(EmitSpec {
                view: ViewId(spec.view),
                neighbours: views("neighbours", spec.neighbours)?,
                max_relative_depth: threshold("max_relative_depth", spec.max_relative_depth)?,
                double: spec.double,
            }),
            Spec::Assemble(spec) => Self::Assemble(AssembleSpec { views: views("views", spec.views)? }),
        })
    }
}

fn mask(mask: wire::Mask) -> Result<MaskSpec, WireError> {
    Ok(MaskSpec { path: path(mask.path)?, hash: blob_key("mask hash", &mask.hash)? })
}

fn numbers(views: &[ViewId]) -> Vec<u32> {
    views.iter().map(|ViewId(id)| *id).collect()
}

fn views(field: &'static str, ids: Vec<u32>) -> Result<Vec<ViewId>, WireError> {
    at_most(field, ids.len(), MAX_VIEWS)?;
    Ok(ids.into_iter().map(ViewId).collect())
}

impl From<&InferSpec> for wire::InferSpec {
    fn from(spec: &InferSpec) -> Self {
        let sampling = match spec.hypotheses.sampling() {
            Sampling::Uniform => wire::Sampling::Uniform,
            Sampling::Inverse => wire::Sampling::Inverse,
        };
        Self {
            reference: Some((&spec.reference).into()),
            sources: spec.sources.iter().map(Into::into).collect(),
            hypotheses: Some(wire::Hypotheses {
                sampling: sampling.into(),
                min: spec.hypotheses.min(),
                max: spec.hypotheses.max(),
                count: spec.hypotheses.count(),
            }),
            weights: spec.weights.0.to_vec(),
            rows: spec.rows.as_ref().map(|rows| wire::Rows { start: rows.start, end: rows.end }),
        }
    }
}

impl TryFrom<wire::InferSpec> for InferSpec {
    type Error = WireError;

    fn try_from(spec: wire::InferSpec) -> Result<Self, WireError> {
        at_most("sources", spec.sources.len(), MAX_SOURCES)?;
        if spec.sources.is_empty() {
            return Err(WireError::Missing { field: "sources" });
        }
        let reference: ImageSpec = required("reference", spec.reference)?.try_into()?;
        let height = reference.working_height.div_ceil(4);
        let rows = match spec.rows {
            None => None,
            Some(rows) => {
                let end = in_range("end of the rows", rows.end, 1, height)?;
                Some(in_range("start of the rows", rows.start, 0, end - 1)?..end)
            }
        };
        Ok(Self {
            reference,
            sources: each(spec.sources, TryInto::try_into)?,
            hypotheses: required("hypotheses", spec.hypotheses)?.try_into()?,
            rows,
            weights: blob_key("weights", &spec.weights)?,
        })
    }
}

impl TryFrom<wire::Hypotheses> for DepthHypotheses {
    type Error = WireError;

    fn try_from(hypotheses: wire::Hypotheses) -> Result<Self, WireError> {
        let sampling = match wire::Sampling::try_from(hypotheses.sampling) {
            Ok(wire::Sampling::Uniform) => Sampling::Uniform,
            Ok(wire::Sampling::Inverse) => Sampling::Inverse,
            _ => return Err(WireError::UnknownValue { field: "sampling", value: hypotheses.sampling }),
        };
        let count = in_range("depth count", hypotheses.count, 2, MAX_PLANES)?;
        Ok(Self::new(sampling, hypotheses.min, hypotheses.max, count)?)
    }
}

impl From<&ImageSpec> for wire::Image {
    fn from(image: &ImageSpec) -> Self {
        Self {
            view: image.view.0,
            name: image.name.clone(),
            path: image.path.as_os_str().as_bytes().to_vec(),
            hash: image.hash.0.to_vec(),
            camera: Some((&image.camera).into()),
            distortion: Some(image.distortion.into()),
            working_width: image.working_width,
            working_height: image.working_height,
        }
    }
}

impl TryFrom<wire::Image> for ImageSpec {
    type Error = WireError;

    fn try_from(image: wire::Image) -> Result<Self, WireError> {
        let camera = required("camera", image.camera)?;
        Ok(Self {
            view: ViewId(image.view),
            name: image_name(image.name)?,
            path: path(image.path)?,
            hash: BlobKey(blob_key("image hash", &image.hash)?.0),
            camera: camera_from(image.view, &camera)?,
            distortion: required("distortion", image.distortion)?.try_into()?,
            working_width: in_range("working width", image.working_width, 1, MAX_SIDE)?,
            working_height: in_range("working height", image.working_height, 1, MAX_SIDE)?,
        })
    }
}

/// Names become file names at the end, so what leads out of a folder is refused here too.
fn image_name(name: String) -> Result<String, WireError> {
    let name = short("image name", name, MAX_PATH_BYTES)?;
    let leads_out = name.starts_with('/') || name.split('/').any(|part| part == "..");
    if name.is_empty() || leads_out || name.chars().any(char::is_control) {
        return Err(WireError::BadText { field: "image name", text: name });
    }
    Ok(name)
}

fn path(bytes: Vec<u8>) -> Result<PathBuf, WireError> {
    if bytes.len() > MAX_PATH_BYTES {
        return Err(WireError::TooLong { field: "image path", got: bytes.len(), limit: MAX_PATH_BYTES });
    }
    if bytes.contains(&0) {
        let text = String::from_utf8_lossy(&bytes).into_owned();
        return Err(WireError::BadText { field: "image path", text });
    }
    Ok(PathBuf::from(OsString::from_vec(bytes)))
}

impl From<&Camera> for wire::Camera {
    fn from(camera: &Camera) -> Self {
        let Intrinsics { width, height, fx, fy, skew, cx, cy } = camera.intrinsics;
        let Pose { rotation, translation } = camera.pose;
        Self {
            width,
            height,
            fx,
            fy,
            skew,
            cx,
            cy,
            // nalgebra iterates by column, the wire has rows.
            rotation: rotation.transpose().iter().copied().collect(),
            translation: translation.iter().copied().collect(),
        }
    }
}

fn camera_from(view: u32, camera: &wire::Camera) -> Result<Camera, WireError> {
    let &wire::Camera { width, height, fx, fy, skew, cx, cy, .. } = camera;
    in_range("image width", width, 1, MAX_SIDE)?;
    in_range("image height", height, 1, MAX_SIDE)?;
    exactly("rotation", camera.rotation.len(), 9)?;
    exactly("translation", camera.translation.len(), 3)?;
    let refused = |source: CameraError| WireError::Camera { view, source };
    let intrinsics = Intrinsics { width, height, fx, fy, skew, cx, cy }.checked().map_err(refused)?;
    let rotation = Matrix3::from_row_slice(&camera.rotation);
    let pose = Pose::new(rotation, Vector3::from_row_slice(&camera.translation)).map_err(refused)?;
    Ok(Camera { intrinsics, pose })
}

fn exactly(field: &'static str, got: usize, expected: usize) -> Result<(), WireError> {
    if got == expected { Ok(()) } else { Err(WireError::WrongCount { field, got, expected }) }
}

impl From<Distortion> for wire::Distortion {
    fn from(distortion: Distortion) -> Self {
        use wire::distortion::Model;
        Self {
            model: match distortion {
                Distortion::None => None,
                Distortion::Radial { k1, k2 } => Some(Model::Radial(wire::RadialDistortion { k1, k2 })),
                Distortion::OpenCv { k1, k2, p1, p2 } => {
                    Some(Model::Opencv(wire::OpenCvDistortion { k1, k2, p1, p2 }))
                }
                Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 } => {
                    let lens = wire::FullOpenCvDistortion { k1, k2, p1, p2, k3, k4, k5, k6 };
                    Some(Model::FullOpencv(lens))
                }
                Distortion::Fov { omega } => Some(Model::Fov(wire::FovDistortion { omega })),
                Distortion::Fisheye { k1, k2, k3, k4 } => {
                    Some(Model::Fisheye(wire::FisheyeDistortion { k1, k2, k3, k4 }))
                }
                Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 } => {
                    let lens = wire::ThinPrismFisheyeDistortion { k1, k2, p1, p2, k3, k4, sx1, sy1 };
                    Some(Model::ThinPrismFisheye(lens))
                }
            },
        }
    }
}

impl TryFrom<wire::Distortion> for Distortion {
    type Error = WireError;

    fn try_from(distortion: wire::Distortion) -> Result<Self, WireError> {
        use wire::distortion::Model;
        let distortion = match distortion.model {
            None => Self::None,
            Some(Model::Radial(d)) => Self::Radial { k1: d.k1, k2: d.k2 },
            Some(Model::Opencv(d)) => Self::OpenCv { k1: d.k1, k2: d.k2, p1: d.p1, p2: d.p2 },
            Some(Model::FullOpencv(d)) => {
                let wire::FullOpenCvDistortion { k1, k2, p1, p2, k3, k4, k5, k6 } = d;
                Self::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 }
            }
            Some(Model::Fov(d)) => Self::Fov { omega: d.omega },
            Some(Model::Fisheye(d)) => Self::Fisheye { k1: d.k1, k2: d.k2, k3: d.k3, k4: d.k4 },
            Some(Model::ThinPrismFisheye(d)) => {
                let wire::ThinPrismFisheyeDistortion { k1, k2, p1, p2, k3, k4, sx1, sy1 } = d;
                Self::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 }
            }
        };
        for coefficient in distortion.coefficients() {
            finite("distortion coefficient", coefficient)?;
        }
        Ok(distortion)
    }
}

impl From<FilterOptions> for wire::FilterOptions {
    fn from(options: FilterOptions) -> Self {
        let sampling = match options.sampling {
            DepthSampling::Bilinear => wire::DepthSampling::Bilinear,
            DepthSampling::Continuous => wire::DepthSampling::Continuous,
        };
        let method = match options.method {
            FusionMethod::Consistency => wire::FusionMethod::Consistency,
            FusionMethod::Dynamic => wire::FusionMethod::Dynamic,
            FusionMethod::Visibility => wire::FusionMethod::Visibility,
            FusionMethod::VisibilityConfidence => wire::FusionMethod::VisibilityConfidence,
        };
        Self {
            min_confidence: options.min_confidence,
            max_reprojection_px: options.max_reprojection_px,
            max_relative_depth: options.max_relative_depth,
            min_views: options.min_views,
            sampling: sampling.into(),
            method: method.into(),
            network_pixel: options.network_pixel,
        }
    }
}

/// A threshold; it may be infinite, which switches a criterion off.
fn threshold(field: &'static str, value: f32) -> Result<f32, WireError> {
    if value >= 0.0 {
        Ok(value)
    } else {
        Err(WireError::BadNumber { field, value: value.into(), expected: "at least 0" })
    }
}

impl TryFrom<wire::FilterOptions> for FilterOptions {
    type Error = WireError;

    fn try_from(options: wire::FilterOptions) -> Result<Self, WireError> {
        Ok(Self {
            min_confidence: threshold("min_confidence", options.min_confidence)?,
            max_reprojection_px: threshold("max_reprojection_px", options.max_reprojection_px)?,
            max_relative_depth: threshold("max_relative_depth", options.max_relative_depth)?,
            min_views: in_range("min_views", options.min_views, 1, MAX_VIEWS as u32)?,
            sampling: match wire::DepthSampling::try_from(options.sampling) {
                Ok(wire::DepthSampling::Bilinear) => DepthSampling::Bilinear,
                Ok(wire::DepthSampling::Continuous) => DepthSampling::Continuous,
                _ => return Err(WireError::UnknownValue { field: "sampling", value: options.sampling }),
            },
            method: match wire::FusionMethod::try_from(options.method) {
                Ok(wire::FusionMethod::Consistency) => FusionMethod::Consistency,
                Ok(wire::FusionMethod::Dynamic) => FusionMethod::Dynamic,
                Ok(wire::FusionMethod::Visibility) => FusionMethod::Visibility,
                Ok(wire::FusionMethod::VisibilityConfidence) => FusionMethod::VisibilityConfidence,
                _ => return Err(WireError::UnknownValue { field: "method", value: options.method }),
            },
            network_pixel: match options.network_pixel {
                0.0 => 1.0,
                pixel if pixel > 0.0 && pixel.is_finite() => pixel,
                pixel => {
                    let (field, value) = ("network_pixel", pixel.into());
                    return Err(WireError::BadNumber { field, value, expected: "positive" });
                }
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use proptest::collection::vec;
    use proptest::prelude::*;
    use proptest::sample::select;

    use super::*;

    fn camera() -> impl Strategy<Value = Camera> {
        let intrinsics =
            (1..9000_u32, 1..9000_u32, 1.0..1e5, 1.0..1e5, -1.0..1.0, -1e4..1e4, -1e4..1e4).prop_map(
                |(width, height, fx, fy, skew, cx, cy)| Intrinsics { width, height, fx, fy, skew, cx, cy },
            );
        let pose =
            ([-3.0..3.0_f64, -3.0..3.0, -3.0..3.0], [-1e6..1e6, -1e6..1e6, -1e6..1e6]).prop_map(|(r, t)| {
                let rotation = Rotation3::new(Vector3::from(r)).into_inner();
                Pose { rotation, translation: Vector3::from(t) }
            });
        (intrinsics, pose).prop_map(|(intrinsics, pose)| Camera { intrinsics, pose })
    }

    fn distortion() -> impl Strategy<Value = Distortion> {
        (0..7, proptest::array::uniform8(-1.0..1.0)).prop_map(|(model, [k1, k2, p1, p2, a, b, c, d])| {
            match model {
                0 => Distortion::None,
                1 => Distortion::Radial { k1, k2 },
                2 => Distortion::OpenCv { k1, k2, p1, p2 },
                3 => Distortion::FullOpenCv { k1, k2, p1, p2, k3: a, k4: b, k5: c, k6: d },
                4 => Distortion::Fov { omega: k1 },
                5 => Distortion::Fisheye { k1, k2, k3: a, k4: b },
                _ => Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3: a, k4: b, sx1: c, sy1: d },
            }
        })
    }

    fn image() -> impl Strategy<Value = ImageSpec> {
        let file = (any::<u32>(), "[a-zäß ]{1,9}(/[a-z.]{3}x)?", vec(1..=255_u8, 0..40), any::<[u8; 32]>());
        (file, camera(), distortion(), 1..=MAX_SIDE, 1..=MAX_SIDE).prop_map(
            |((view, name, path, hash), camera, distortion, working_width, working_height)| ImageSpec {
                view: ViewId(view),
                name,
                path: PathBuf::from(OsString::from_vec(path)),
                hash: BlobKey(hash),
                camera,
                distortion,
                working_width,
                working_height,
            },
        )
    }

    fn view_list() -> impl Strategy<Value = Vec<ViewId>> {
        vec(any::<u32>().prop_map(ViewId), 0..12)
    }

    fn infer() -> impl Strategy<Value = InferSpec> {
        let planes =
            (any::<bool>(), 1e-3..1e3, 1.001..1e3, 2..MAX_PLANES).prop_map(|(inverse, min, ratio, count)| {
                let sampling = if inverse { Sampling::Inverse } else { Sampling::Uniform };
                DepthHypotheses::new(sampling, min, min * ratio, count).expect("a valid range")
            });
        let of_map = any::<Option<(prop::sample::Index, prop::sample::Index)>>();
        (image(), vec(image(), 1..4), planes, any::<[u8; 32]>(), of_map).prop_map(
            |(reference, sources, hypotheses, weights, rows)| InferSpec {
                rows: rows.map(|(start, length)| {
                    let height = reference.working_height.div_ceil(4) as usize;
                    let start = start.index(height);
                    start as u32..(start + 1 + length.index(height - start)) as u32
                }),
                reference,
                sources,
                hypotheses,
                weights: BlobKey(weights),
            },
        )
    }

    fn options() -> impl Strategy<Value = FilterOptions> {
        let methods = [
            FusionMethod::Consistency,
            FusionMethod::Dynamic,
            FusionMethod::Visibility,
            FusionMethod::VisibilityConfidence,
        ];
        let method = select(methods.to_vec());
        (method, 0.0..=1.0_f32, 0.01..9.0_f32, 1e-4..0.5_f32, 1..9_u32, any::<bool>()).prop_map(
            |(method, min_confidence, max_reprojection_px, max_relative_depth, min_views, plain)| {
                FilterOptions {
                    method,
                    min_confidence,
                    max_reprojection_px,
                    max_relative_depth,
                    min_views,
                    sampling: if plain { DepthSampling::Bilinear } else { DepthSampling::Continuous },
                    network_pixel: if plain { 1.0 } else { 4.0 },
                }
            },
        )
    }

    prop_compose! {
        fn filter()(view in any::<u32>(), neighbours in view_list(), options in options()) -> FilterSpec {
            FilterSpec { view: ViewId(view), neighbours, options }
        }
    }

    fn fit() -> impl Strategy<Value = FitSpec> {
        let mask = prop::option::of((vec(1..=255_u8, 0..40), any::<[u8; 32]>()));
        (image(), mask, any::<bool>()).prop_map(|(image, mask, full_resolution)| {
            let mask = mask.map(|(path, hash)| MaskSpec {
                path: PathBuf::from(OsString::from_vec(path)),
                hash: BlobKey(hash),
            });
            FitSpec { image, mask, full_resolution }
        })
    }

    fn job() -> impl Strategy<Value = Job> {
        let spec = prop_oneof![
            infer().prop_map(JobSpec::Infer),
            any::<u32>().prop_map(|view| JobSpec::Stitch(StitchSpec { view: ViewId(view) })),
            fit().prop_map(JobSpec::Fit),
            filter().prop_map(JobSpec::Filter),
            (any::<u32>(), view_list(), 0.0..1.0_f32, any::<bool>()).prop_map(
                |(view, neighbours, max_relative_depth, double)| {
                    JobSpec::Emit(EmitSpec { view: ViewId(view), neighbours, max_relative_depth, double })
                },
            ),
            view_list().prop_map(|views| JobSpec::Assemble(AssembleSpec { views })),
        ];
        (any::<[u8; 32]>(), spec, vec(any::<[u8; 32]>(), 0..12)).prop_map(|(id, spec, needs)| Job {
            id: JobId(id),
            spec,
            needs: needs.into_iter().map(JobId).collect(),
        })
    }

    proptest! {
        #[test]
        fn jobs_survive_the_wire(job in job()) {
            prop_assert_eq!(decode_job(&encode_job(&job)), Ok(job));
        }

        #[test]
        fn garbage_never_panics(bytes in vec(any::<u8>(), 0..300)) {
            let _ = decode_job(&bytes);
        }

        /// One byte of a good job changed: refused, or still a job that survives the wire.
        #[test]
        fn damaged_jobs_are_refused_or_whole(job in job(), at in any::<prop::sample::Index>(), to in any::<u8>()) {
            let mut bytes = encode_job(&job);
            let at = at.index(bytes.len());
            bytes[at] = to;
            if let Ok(job) = decode_job(&bytes) {
                prop_assert_eq!(decode_job(&encode_job(&job)), Ok(job));
            }
        }
    }

    fn an_image() -> wire::Image {
        let camera = Camera {
            intrinsics: Intrinsics { width: 8, height: 6, fx: 5.0, fy: 5.0, skew: 0.0, cx: 3.5, cy: 2.5 },
            pose: Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() },
        };
        (&ImageSpec {
            view: ViewId(7),
            name: "a/b.jpg".into(),
            path: "/scene/a/b.jpg".into(),
            hash: BlobKey::of(b"image"),
            camera,
            distortion: Distortion::None,
            working_width: 8,
            working_height: 6,
        })
            .into()
    }

    fn refused(change: impl FnOnce(&mut wire::Image)) -> String {
        let mut image = an_image();
        change(&mut image);
        ImageSpec::try_from(image).expect_err("the change is bad").to_string()
    }

    #[test]
    fn each_bad_field_is_named() {
        assert!(ImageSpec::try_from(an_image()).is_ok());
        assert_eq!(refused(|i| i.hash.truncate(31)), "image hash has 31 bytes, a hash has 32");
        assert_eq!(refused(|i| i.camera = None), "camera is missing");
        assert_eq!(
            refused(|i| {
                if let Some(camera) = &mut i.camera {
                    camera.rotation.pop();
                }
            }),
            "rotation has 8 values instead of 9"
        );
        let mirrored = |i: &mut wire::Image| {
            if let Some(camera) = &mut i.camera {
                camera.rotation[0] = -1.0;
            }
        };
        assert_eq!(refused(mirrored), "camera of view 7 is refused");
        for name in ["", "../up", "/root", "a\0b", "a/../b"] {
            assert!(refused(|i| i.name = name.into()).starts_with("image name is empty or"), "{name:?}");
        }
        assert!(refused(|i| i.path.push(0)).starts_with("image path"));
        assert!(refused(|i| i.working_width = 0).starts_with("working width is 0"));
        let nan = wire::RadialDistortion { k1: f64::NAN, k2: 0.0 };
        let nan = wire::Distortion { model: Some(wire::distortion::Model::Radial(nan)) };
        assert_eq!(
            refused(|i| i.distortion = Some(nan)),
            "distortion coefficient is NaN, which is not finite"
        );
    }
}
