//! Jobs.

use planesweep_plan::{
    AssembleSpec, EmitSpec, FilterSpec, FitSpec, ImageSpec, InferSpec, Job, JobId, JobSpec, StitchSpec,
};
use planesweep_scene::{DepthHypotheses, Sampling, ViewId};
use prost::Message;

use super::check::{at_most, blob_key, each, in_range, job_id, required};
use super::filter::threshold;
use crate::limits::{MAX_JOBS, MAX_PLANES, MAX_SOURCES, MAX_VIEWS};
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
                    mask: spec.mask.as_ref().map(Into::into),
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
                mask: spec.mask.map(TryInto::try_into).transpose()?,
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

#[cfg(test)]
mod tests {
    use std::ffi::OsString;
    use std::os::unix::ffi::OsStringExt;
    use std::path::PathBuf;

    use planesweep_plan::{BlobKey, MaskSpec};
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::super::filter::tests::options;
    use super::super::image::tests::image;
    use super::*;

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
}
