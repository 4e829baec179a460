//! DTU as the authors of MVSNet laid it out for training.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use planesweep_scene::{ReadOptions, ViewId, read_mvsnet_cam, read_mvsnet_pairs};
use serde::{Deserialize, Serialize};

use super::{DataSetError, DepthGrid, SceneFiles, ViewFiles};

/// Which scans of DTU.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DtuSplit {
    /// All but the others'.
    Train,
    /// The 18 scans to choose settings by.
    Validation,
    /// The 22 scans that results are compared on.
    Test,
}

const VALIDATION: [u32; 18] = [3, 5, 17, 21, 28, 35, 37, 38, 40, 43, 56, 59, 66, 67, 82, 86, 106, 117];
const TEST: [u32; 22] =
    [1, 4, 9, 10, 11, 12, 13, 15, 23, 24, 29, 32, 33, 34, 48, 49, 62, 75, 77, 110, 114, 118];
/// In none of the published lists, which have 79 scans to train on.
const LEFT_OUT: [u32; 5] = [25, 26, 27, 54, 73];
const LAST_SCAN: u32 = 128;

/// Size of the training images.
const SIZE: [u32; 2] = [640, 512];
const LIGHTS: u32 = 7;
/// Cameras of the robot's positions; the scans have 49 or 64 of them.
const POSITIONS: u32 = 64;

impl DtuSplit {
    /// Whether a scan belongs to it.
    pub fn contains(self, scan: u32) -> bool {
        match self {
            Self::Validation => VALIDATION.contains(&scan),
            Self::Test => TEST.contains(&scan),
            Self::Train => ![&VALIDATION[..], &TEST, &LEFT_OUT].iter().any(|list| list.contains(&scan)),
        }
    }
}

/// The scans of a split that lie in `root`, in order.
pub fn scenes(root: &Path, split: DtuSplit) -> Result<Vec<SceneFiles>, DataSetError> {
    let cameras = root.join("Cameras");
    let mut views = Vec::new();
    for id in 0..POSITIONS {
        let path = cameras.join(format!("train/{id:08}_cam.txt"));
        if !path.is_file() {
            continue;
        }
        // Their K is that of the network's maps: four times it is that of the images.
        let (mut camera, range) = read_mvsnet_cam(&path, SIZE[0] / 4, SIZE[1] / 4, &ReadOptions::default())?;
        let k = &mut camera.intrinsics;
        for entry in [&mut k.fx, &mut k.fy, &mut k.cx, &mut k.cy, &mut k.skew] {
            *entry *= 4.0;
        }
        camera.intrinsics = k.with_size(SIZE[0], SIZE[1]);
        views.push((ViewId(id), camera, range));
    }
    let known = |id: ViewId| views.iter().any(|(view, ..)| *view == id);
    let pairs = read_mvsnet_pairs(&cameras.join("pair.txt"), known)?;
    let scans = (1..=LAST_SCAN).filter(|scan| split.contains(*scan));
    let scene = |scan: u32| {
        let rectified = root.join(format!("Rectified/scan{scan}_train"));
        let files = views.iter().filter_map(|(id, camera, range)| {
            let image = |light: u32| rectified.join(format!("rect_{:03}_{light}_r5000.png", id.0 + 1));
            let images: Vec<PathBuf> = (0..LIGHTS).map(image).filter(|path| path.is_file()).collect();
            if images.is_empty() {
                return None;
            }
            let (depth, grid) = depth_file(root, scan, *id);
            let (id, camera, range) = (*id, *camera, *range);
            Some(ViewFiles { id, camera, images, depth, grid, range, sources: Vec::new() })
        });
        let mut files: Vec<ViewFiles> = files.collect();
        let positions: BTreeMap<ViewId, usize> = files.iter().map(|view| view.id).zip(0..).collect();
        for view in &mut files {
            let sources = pairs.get(&view.id).map(Vec::as_slice).unwrap_or_default();
            view.sources = sources.iter().filter_map(|s| positions.get(&s.view).copied()).collect();
        }
        SceneFiles { views: files }
    };
    Ok(scans.map(scene).filter(|scene| !scene.views.is_empty()).collect())
}

/// The map of the whole photograph, or the one at a quarter of the training image.
fn depth_file(root: &Path, scan: u32, id: ViewId) -> (Option<PathBuf>, DepthGrid) {
    let name = format!("depth_map_{:04}.pfm", id.0);
    let raw = root.join(format!("Depths_raw/scan{scan}")).join(&name);
    if raw.is_file() {
        return (Some(raw), DepthGrid::DtuRaw);
    }
    let small = root.join(format!("Depths/scan{scan}_train")).join(&name);
    (Some(small).filter(|path| path.is_file()), DepthGrid::Image)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use nalgebra::{Point2, Point3, Vector3};
    use planesweep_scene::{Camera, Intrinsics, Pose, Raster, mvsnet_cam_text, write_pfm};

    use super::super::{DataSet, SampleShape};
    use super::*;

    #[test]
    fn the_splits_do_not_meet_and_have_the_published_sizes() {
        let count =
            |split: DtuSplit| (1..=128).filter(|s| !(78..=81).contains(s) && split.contains(*s)).count();
        assert_eq!([DtuSplit::Train, DtuSplit::Validation, DtuSplit::Test].map(count), [79, 18, 22]);
    }

    /// The plane z = 600 + x / 2 + y / 4 (camera of view 0, millimetres) as the depth along a pixel's ray.
    fn depth_of_plane(camera: &Camera, pixel: Point2<f64>) -> f64 {
        let normal = Vector3::new(-0.5, -0.25, 1.0);
        let centre = camera.pose.centre();
        let way = camera.pose.rotation.tr_mul(&camera.intrinsics.unproject(&pixel, 1.0).coords);
        (600.0 - normal.dot(&centre.coords)) / normal.dot(&way)
    }

    fn write_scan(root: &Path, raw: bool) {
        let images = root.join("Rectified/scan2_train");
        let depths = root.join(if raw { "Depths_raw/scan2" } else { "Depths/scan2_train" });
        for folder in [&images, &depths, &root.join("Cameras/train")] {
            fs::create_dir_all(folder).expect("made");
        }
        let image =
            Intrinsics { width: 640, height: 512, fx: 720.0, fy: 725.0, skew: 0.0, cx: 322.0, cy: 255.0 };
        for id in 0..2_u32 {
            let centre = Point3::new(40.0 * f64::from(id), 0.0, 0.0);
            let pose = Pose::look_at(&centre, &(centre + Vector3::z()), &-Vector3::y());
            let camera = Camera { intrinsics: image, pose };
            let quarter = Camera { intrinsics: image.quartered(), pose };
            fs::write(
                root.join(format!("Cameras/train/{id:08}_cam.txt")),
                format!("{}\n425 2.5\n", mvsnet_cam_text(&quarter, None).trim_end()),
            )
            .expect("written");
            for light in 0..7_u8 {
                let pixels = vec![30 * light; 640 * 512 * 3];
                let path = images.join(format!("rect_{:03}_{light}_r5000.png", id + 1));
                image::save_buffer(path, &pixels, 640, 512, image::ExtendedColorType::Rgb8).expect("written");
            }
            let map = if raw {
                Raster::from_fn(1600, 1200, |x, y| {
                    let at = Point2::new((x as f64) / 2.0 - 80.0, (y as f64) / 2.0 - 44.0);
                    depth_of_plane(&camera, at) as f32
                })
            } else {
                Raster::from_fn(160, 128, |x, y| {
                    depth_of_plane(&camera, Point2::new(4.0 * x as f64, 4.0 * y as f64)) as f32
                })
            };
            write_pfm(&depths.join(format!("depth_map_{id:04}.pfm")), &map).expect("written");
        }
        fs::write(root.join("Cameras/pair.txt"), "2\n0\n1 1 10\n1\n2 0 10 7 5\n").expect("written");
    }

    #[test]
    fn both_layouts_of_depth_agree_with_the_cameras() {
        for raw in [false, true] {
            let root = tempfile::tempdir().expect("a temporary folder");
            write_scan(root.path(), raw);
            assert!(matches!(
                DataSet::open_dtu(root.path(), DtuSplit::Test),
                Err(DataSetError::NoSamples { .. })
            ));
            let set = DataSet::open_dtu(root.path(), DtuSplit::Train).expect("one scan");
            assert_eq!(set.len(), 14);
            let shape = SampleShape { width: 640, height: 512, views: 2 };
            let sample = set.sample(10, &shape, 0).expect("the second view under the fourth light");
            assert_eq!(sample.views[0].pixels.at(0, 0), [90; 3]);
            assert!((sample.range.min - 425.0).abs() < 1e-9 && (sample.range.max - 931.15).abs() < 0.1);
            let camera = sample.views[0].camera;
            assert!(
                (camera.intrinsics.fx - 720.0).abs() < 1e-3 && (camera.intrinsics.cx - 322.0).abs() < 1e-3
            );
            let mut known = 0;
            for (x, y) in (0..128).flat_map(|y| (0..160).map(move |x| (x, y))) {
                let depth = f64::from(sample.depth.at(x, y));
                if depth > 0.0 {
                    known += 1;
                    let truth = depth_of_plane(&camera, Point2::new(4.0 * x as f64, 4.0 * y as f64));
                    assert!((depth / truth - 1.0).abs() < 1e-4, "{depth} instead of {truth} at {x}, {y}");
                }
            }
            // What the other camera, 40 mm aside, does not see is masked.
            assert!((160 * 128 * 85 / 100..160 * 128).contains(&known), "{known} pixels known");
        }
    }
}
