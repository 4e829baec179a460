//! Training samples as folders, to look at or to train on elsewhere.

use std::path::Path;

use planesweep_scene::{Distortion, Scene, SourceScore, TrainingSample, View, ViewId};

use crate::training_folder::{TrainingFolder, TrainingFolderError};

/// Writes a sample as an MVSNet folder into `out`: the reference view is 0, its sources 1 and up, best
/// first. Only the reference has depth, at a quarter of the size of its image as the network's maps are;
/// only its camera names the range.
pub fn write_training_sample(out: &Path, sample: &TrainingSample) -> Result<(), TrainingFolderError> {
    let folder = TrainingFolder::create(out)?;
    let mut scene = Scene::default();
    for (i, view) in sample.views.iter().enumerate() {
        let id = ViewId(i as u32);
        let image = folder.write_image(id, &view.pixels)?;
        let (camera, distortion) = (view.camera, Distortion::None);
        let depth_range = (i == 0).then_some(sample.range);
        scene.views.insert(id, View { id, name: format!("{i:08}"), image, camera, distortion, depth_range });
    }
    let count = sample.views.len();
    let score = |i: usize| SourceScore { view: ViewId(i as u32), score: (count - i) as f64 };
    scene.pairs.insert(ViewId(0), (1..count).map(score).collect());
    // Such folders tell sky and unseen surfaces by nothing.
    folder.write_depth(ViewId(0), &sample.depth.map(|d| if d.is_finite() { *d } else { 0.0 }))?;
    folder.write_cameras(&scene)
}

#[cfg(test)]
mod tests {
    use crate::data_set::{DataSet, SampleShape};
    use crate::{TrainingOptions, training_sample};

    use super::*;

    #[test]
    fn what_is_written_is_read_as_the_same_sample() {
        let options = TrainingOptions { width: 96, height: 64, views: 3, setting: None };
        let folder = tempfile::tempdir().expect("a temporary folder");
        let samples: Vec<_> = (5..7).map(|seed| training_sample(seed, &options)).collect();
        for (i, sample) in samples.iter().enumerate() {
            write_training_sample(&folder.path().join(format!("{i:08}")), sample).expect("written");
        }
        let set = DataSet::open(folder.path()).expect("a data set");
        assert_eq!(set.len(), 2);
        for (i, sample) in samples.iter().enumerate() {
            let read = set.sample(i, &SampleShape { width: 96, height: 64, views: 3 }, 0).expect("read");
            assert_eq!(read.views, sample.views);
            assert_eq!(read.depth, sample.depth.map(|d| if d.is_finite() { *d } else { 0.0 }));
            assert!((read.range.min / sample.range.min - 1.0).abs() < 1e-9);
            assert!((read.range.max / sample.range.max - 1.0).abs() < 1e-9);
        }
    }
}
