//! Jobs that a plan lists more than once.
//!
//! A job's id comes from what determines its result, so two views with the same image, camera and
//! neighbourhood give the same jobs. One of them is done; who needs the other needs the same id.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::path::PathBuf;

use planesweep_plan::{ImageSpec, Job, JobId, JobSpec};
use planesweep_scene::ViewId;

/// The jobs without those that repeat an earlier one. What has the id of an earlier job but another
/// content stays, to be refused as listed twice.
pub(super) fn without_repeats(jobs: Vec<Job>) -> Vec<Job> {
    let mut first: BTreeMap<JobId, usize> = BTreeMap::new();
    let mut kept: Vec<Job> = Vec::with_capacity(jobs.len());
    for job in jobs {
        match first.entry(job.id) {
            Entry::Vacant(entry) => {
                entry.insert(kept.len());
                kept.push(job);
            }
            Entry::Occupied(entry) if nameless(&kept[*entry.get()]) == nameless(&job) => {}
            Entry::Occupied(_) => kept.push(job),
        }
    }
    kept
}

/// The job without what does not enter its id: paths, names and ids of views.
fn nameless(job: &Job) -> Job {
    let image = |image: &ImageSpec| ImageSpec {
        view: ViewId(0),
        name: String::new(),
        path: PathBuf::new(),
        ..image.clone()
    };
    let mut job = job.clone();
    match &mut job.spec {
        JobSpec::Infer(spec) => {
            spec.reference = image(&spec.reference);
            spec.sources = spec.sources.iter().map(image).collect();
        }
        JobSpec::Stitch(spec) => spec.view = ViewId(0),
        JobSpec::Fit(spec) => {
            spec.image = image(&spec.image);
            spec.mask.iter_mut().for_each(|mask| mask.path = PathBuf::new());
        }
        JobSpec::Filter(spec) => {
            spec.view = ViewId(0);
            spec.neighbours.fill(ViewId(0));
        }
        JobSpec::Emit(spec) => {
            spec.view = ViewId(0);
            spec.neighbours.fill(ViewId(0));
        }
        JobSpec::Assemble(spec) => spec.views.fill(ViewId(0)),
    }
    job
}

#[cfg(test)]
mod tests {
    use planesweep_plan::{EmitSpec, JobId};

    use super::*;

    fn emit(view: u32, neighbours: &[u32], need: u8) -> Job {
        let neighbours = neighbours.iter().copied().map(ViewId).collect();
        let spec = JobSpec::Emit(EmitSpec {
            view: ViewId(view),
            neighbours,
            max_relative_depth: 0.01,
            double: false,
        });
        Job { id: JobId([1; 32]), spec, needs: vec![JobId([need; 32])] }
    }

    #[test]
    fn only_what_differs_in_names_is_a_repeat() {
        let first = emit(0, &[2, 3], 7);
        let repeat = emit(1, &[3, 2], 7);
        assert_eq!(without_repeats(vec![first.clone(), repeat]), std::slice::from_ref(&first));
        for other in [emit(1, &[2], 7), emit(1, &[2, 3], 8)] {
            assert_eq!(without_repeats(vec![first.clone(), other]).len(), 2);
        }
    }
}
