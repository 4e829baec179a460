//! MVSNet folders: cams/00000000_cam.txt and pair.txt.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use super::held::DEFAULT_PLANES;
use super::{WriteError, create_folder, write_file};
use crate::{Camera, DepthRange, Distortion, Scene, SourceScore, ViewId};

/// Writes `cams/00000000_cam.txt` for every view, by its id, and `pair.txt` below `root`; images
/// are not copied. Distorted images are refused, for the format has no lens; sparse points, names
/// and image sizes have no place in it either and are left out.
pub fn write_mvsnet(scene: &Scene, root: &Path) -> Result<(), WriteError> {
    if let Some(view) = scene.views.values().find(|view| view.distortion != Distortion::None) {
        let (view, format) = (view.name.clone(), "MVSNet's folder layout");
        return Err(WriteError::NotHeld { view, format, what: "lens distortion" });
    }
    let cams = root.join("cams");
    create_folder(&cams)?;
    for (id, view) in &scene.views {
        let text = mvsnet_cam_text(&view.camera, view.depth_range.as_ref());
        write_file(&cams.join(format!("{:08}_cam.txt", id.0)), text.as_bytes())?;
    }
    write_file(&root.join("pair.txt"), mvsnet_pair_text(&scene.pairs).as_bytes())
}

/// The text of a cam.txt. The depth line has all four numbers, with 192 planes where the range
/// states no number, for files of two are read in two ways; without a range it is missing. Numbers
/// have all their digits, so that reading gives the same bits.
pub fn mvsnet_cam_text(camera: &Camera, range: Option<&DepthRange>) -> String {
    let mut text = "extrinsic\n".to_owned();
    for row in 0..3 {
        for column in 0..3 {
            push(&mut text, camera.pose.rotation[(row, column)], ' ');
        }
        push(&mut text, camera.pose.translation[row], '\n');
    }
    text.push_str("0 0 0 1\n\nintrinsic\n");
    let k = camera.intrinsics.matrix();
    for row in 0..3 {
        for column in 0..3 {
            push(&mut text, k[(row, column)], if column < 2 { ' ' } else { '\n' });
        }
    }
    if let Some(DepthRange { min, max, count }) = range {
        let count = count.unwrap_or(DEFAULT_PLANES);
        let interval = (max - min) / count.saturating_sub(1).max(1) as f64;
        text.push('\n');
        push(&mut text, *min, ' ');
        push(&mut text, interval, ' ');
        push(&mut text, count as f64, ' ');
        push(&mut text, *max, '\n');
    }
    text
}

fn push(text: &mut String, number: f64, end: char) {
    write!(text, "{number}{end}").expect("a String takes any text");
}

/// The text of a pair.txt.
pub fn mvsnet_pair_text(pairs: &BTreeMap<ViewId, Vec<SourceScore>>) -> String {
    let mut text = format!("{}\n", pairs.len());
    for (reference, sources) in pairs {
        write!(text, "{reference}\n{}", sources.len()).expect("a String takes any text");
        for SourceScore { view, score } in sources {
            write!(text, " {view} {score}").expect("a String takes any text");
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Vector3};

    use super::*;
    use crate::{Intrinsics, Pose, ReadOptions, View, read_scene};

    #[test]
    fn reading_inverts_writing() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let images = folder.path().join("images");
        std::fs::create_dir_all(&images).expect("made");
        let mut written = Scene::default();
        for id in [0, 5, 12] {
            let name = format!("{id:08}.png");
            let image = images.join(&name);
            image::RgbImage::new(16, 10).save(&image).expect("written");
            let centre = Point3::new(id as f64 * 0.1, 0.3, -4.0);
            let pose = Pose::look_at(&centre, &Point3::origin(), &Vector3::y());
            let intrinsics =
                Intrinsics { width: 16, height: 10, fx: 20.1, fy: 20.0, skew: 0.1, cx: 7.3, cy: 4.5 };
            let (id, camera, distortion) = (ViewId(id), Camera { intrinsics, pose }, Distortion::None);
            let depth_range =
                (id.0 > 0).then(|| DepthRange { min: 1.0, max: 1.0 + 63.0 / 64.0, count: Some(64) });
            written.views.insert(id, View { id, name, image, camera, distortion, depth_range });
        }
        written.pairs.insert(
            ViewId(5),
            vec![SourceScore { view: ViewId(12), score: 1.25 }, SourceScore { view: ViewId(0), score: 0.1 }],
        );
        written.pairs.insert(ViewId(12), vec![]);
        write_mvsnet(&written, folder.path()).expect("written");
        assert_eq!(read_scene(folder.path(), &ReadOptions::default()).expect("read"), written);

        written.views.get_mut(&ViewId(5)).expect("a view").distortion =
            Distortion::Radial { k1: 0.1, k2: 0.0 };
        let error = write_mvsnet(&written, folder.path()).expect_err("a lens");
        assert!(error.to_string().contains("00000005.png"), "{error}");
    }
}
