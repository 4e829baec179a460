//! MVSNet and BlendedMVS folders.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use planesweep_scene::{ReadOptions, SceneFormat, View, ViewId, read_scene};

use super::{DataSetError, DepthGrid, SceneFiles, ViewFiles};

/// Where depth maps may lie, the first that is there counts.
const DEPTH_FOLDERS: [&str; 5] = ["rendered_depth_maps", "depths", "depth_maps", "depth_gt", "depth"];

/// The scene in `root`, or those in its folders, by name.
pub fn scenes(root: &Path) -> Result<Vec<SceneFiles>, DataSetError> {
    if root.join("cams").is_dir() {
        return Ok(vec![scene(root)?]);
    }
    let failed = |source| DataSetError::List { path: root.to_owned(), source };
    let mut folders = Vec::new();
    for entry in fs::read_dir(root).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.join("cams").is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    folders.iter().map(|folder| scene(folder)).collect()
}

fn scene(root: &Path) -> Result<SceneFiles, DataSetError> {
    // One bad view of thousands must not stop the training.
    let format = Some(SceneFormat::Mvsnet);
    let options = ReadOptions { format, skip_bad_views: true, ..ReadOptions::default() };
    let scene = read_scene(root, &options)?;
    let positions: BTreeMap<ViewId, usize> = scene.views.keys().copied().zip(0..).collect();
    let depths = DEPTH_FOLDERS.iter().map(|name| root.join(name)).find(|folder| folder.is_dir());
    let views = scene.views.values().map(|view| {
        let sources = scene.pairs.get(&view.id).map(Vec::as_slice).unwrap_or_default();
        ViewFiles {
            id: view.id,
            camera: view.camera,
            images: vec![view.image.clone()],
            depth: depths.as_ref().and_then(|folder| depth_file(folder, view)),
            grid: DepthGrid::Image,
            range: view.depth_range,
            sources: sources.iter().filter_map(|s| positions.get(&s.view).copied()).collect(),
        }
    });
    Ok(SceneFiles { views: views.collect() })
}

/// The map of a view: named by its number of eight digits, or like its image.
fn depth_file(folder: &Path, view: &View) -> Option<PathBuf> {
    let by_id = folder.join(format!("{:08}.pfm", view.id.0));
    let by_name = folder.join(&view.name).with_extension("pfm");
    [by_id, by_name].into_iter().find(|path| path.is_file())
}

#[cfg(test)]
mod tests {
    use planesweep_scene::{Distortion, Raster, Scene, SourceScore, write_pfm};

    use super::super::{DataSet, SampleShape};
    use super::*;
    use crate::{Style, SynthScene};

    /// A scene as BlendedMVS lays it out: three views, depth at image size.
    fn write_folder(root: &Path) -> SynthScene {
        let style = Style { views: 3, width: 96, height: 72, ..Style::default() };
        let synth = SynthScene::new(4, &style);
        for folder in ["blended_images", "cams", "rendered_depth_maps"] {
            fs::create_dir_all(root.join(folder)).expect("made");
        }
        let mut scene = Scene::default();
        for (i, camera) in synth.cameras().iter().enumerate() {
            let (color, depth) = synth.render(camera, 1);
            let (name, id) = (format!("{i:08}.png"), ViewId(i as u32));
            let path = root.join("blended_images").join(&name);
            let bytes = color.values().as_flattened();
            image::save_buffer(&path, bytes, 96, 72, image::ExtendedColorType::Rgb8).expect("written");
            write_pfm(&root.join(format!("rendered_depth_maps/{i:08}.pfm")), &depth).expect("written");
            let view = View {
                id,
                name,
                image: path,
                camera: *camera,
                distortion: Distortion::None,
                depth_range: None,
            };
            scene.views.insert(id, view);
            let others =
                (0..3).filter(|k| *k != i).map(|k| SourceScore { view: ViewId(k as u32), score: 1.0 });
            scene.pairs.insert(id, others.collect());
        }
        for (id, view) in &scene.views {
            let text = planesweep_scene::mvsnet_cam_text(&view.camera, None);
            fs::write(root.join(format!("cams/{:08}_cam.txt", id.0)), text).expect("written");
        }
        fs::write(root.join("pair.txt"), planesweep_scene::mvsnet_pair_text(&scene.pairs)).expect("written");
        synth
    }

    #[test]
    fn a_folder_gives_samples_whose_depth_is_that_of_their_cameras() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let synth = write_folder(&root.path().join("a_scene"));
        let set = DataSet::open(root.path()).expect("a folder of scenes");
        assert_eq!(set.len(), 3);
        for (shape, seed) in [
            (SampleShape { width: 96, height: 72, views: 3 }, 0),
            (SampleShape { width: 64, height: 64, views: 2 }, 1),
            (SampleShape { width: 128, height: 64, views: 4 }, 2),
        ] {
            let sample = set.sample(1, &shape, seed).expect("a sample");
            assert_eq!(sample.views.len(), shape.views);
            for view in &sample.views {
                assert_eq!(
                    (view.pixels.width() as u32, view.pixels.height() as u32),
                    (shape.width, shape.height)
                );
            }
            let mut map = sample.views[0].camera;
            map.intrinsics = map.intrinsics.quartered();
            let truth: Raster<f32> = synth.depth(&map);
            let known: Vec<(f32, f32)> = sample
                .depth
                .values()
                .iter()
                .copied()
                .zip(truth.values().iter().copied())
                .filter(|(d, _)| *d > 0.0)
                .collect();
            let close = known.iter().filter(|(d, t)| (d / t - 1.0).abs() < 0.02).count();
            assert!(known.len() * 2 > truth.values().len(), "{} pixels known", known.len());
            // The rest are pixels at edges, where the nearest pixel of the map shows another body.
            assert!(close * 100 > known.len() * 90, "{close} of {} agree", known.len());
            let inside =
                known.iter().filter(|(d, _)| (sample.range.min..=sample.range.max).contains(&f64::from(*d)));
            assert!(inside.count() * 100 >= known.len() * 97);
        }
    }

    #[test]
    fn folders_without_depth_and_damaged_files_are_refused() {
        let root = tempfile::tempdir().expect("a temporary folder");
        write_folder(root.path());
        let shape = SampleShape { width: 96, height: 72, views: 3 };
        let set = DataSet::open(root.path()).expect("a scene");
        fs::write(root.path().join("rendered_depth_maps/00000001.pfm"), b"Pf\n96 72\n-1\n").expect("written");
        assert!(matches!(set.sample(1, &shape, 0), Err(DataSetError::Depth(_))));
        fs::write(root.path().join("blended_images/00000002.png"), b"no image").expect("written");
        assert!(matches!(set.sample(0, &shape, 0), Err(DataSetError::Image(_))));
        fs::remove_dir_all(root.path().join("rendered_depth_maps")).expect("removed");
        assert!(matches!(DataSet::open(root.path()), Err(DataSetError::NoSamples { .. })));
        fs::write(root.path().join("pair.txt"), "three\n").expect("written");
        assert!(matches!(DataSet::open(root.path()), Err(DataSetError::Cameras(_))));
        assert!(matches!(DataSet::open(&root.path().join("nowhere")), Err(DataSetError::List { .. })));
    }
}
