//! What of a scene a format can hold, and what it loses.

use std::collections::BTreeMap;

use super::TargetFormat;
use crate::{Camera, Distortion, Intrinsics, Scene, SparsePoints, View, ViewId, undistorted_intrinsics};

/// Planes of a depth range whose number of planes is not known, as in the paper.
pub(super) const DEFAULT_PLANES: u32 = 192;

/// A scene as a format holds it: reading what was written gives the same again.
#[derive(Clone, Debug, PartialEq)]
pub struct Held {
    /// The scene, with the cameras of the images that are written.
    pub scene: Scene,
    /// What the format cannot hold, each in a line.
    pub losses: Vec<String>,
    /// Views whose image has to be resampled for the camera that it gets here.
    pub resampled: Vec<ViewId>,
}

/// Reduces a scene to what `format` can hold.
///
/// A view whose lens or pinhole camera the format cannot hold gets one that it can, and its image is
/// to be resampled; with `undistort` every view with a lens is. Pure.
pub fn held(scene: &Scene, format: TargetFormat, undistort: bool) -> Held {
    let mut losses = Losses::default();
    let mut resampled = Vec::new();
    let mut held = Scene::default();
    let keeps_views = format == TargetFormat::Mvsnet;
    for view in scene.views.values() {
        let mut view = view.clone();
        if let Some(what) = unheld(&view, format) {
            losses.add(format!("{what}: the image is resampled"), &view.name);
        } else if undistort && view.distortion != Distortion::None {
            losses.add("the lens: the image is undistorted, as asked for".to_owned(), &view.name);
        } else {
            view.distortion = same_in(format, view.distortion, &view.camera.intrinsics);
            finish(&mut view, format, &mut losses);
            held.views.insert(view.id, view);
            continue;
        }
        let pinhole = undistorted_intrinsics(&view.camera.intrinsics, &view.distortion);
        view.camera = Camera { intrinsics: fitted(&pinhole, format), pose: view.camera.pose };
        view.distortion = Distortion::None;
        resampled.push(view.id);
        finish(&mut view, format, &mut losses);
        held.views.insert(view.id, view);
    }
    if keeps_views {
        held.pairs.clone_from(&scene.pairs);
    } else {
        for reference in scene.pairs.keys().filter_map(|id| scene.views.get(id)) {
            losses.add("the list of source views".to_owned(), &reference.name);
        }
    }
    let mut losses = losses.lines();
    if keeps_views {
        if !scene.points.is_empty() {
            losses.push(format!("{} sparse points with their tracks", scene.points.len()));
        }
    } else {
        held.points = known_tracks(scene);
        if !scene.points.is_empty() {
            losses.push(
                "colours of the sparse points and positions of their features in the images: \
                         the colours are grey, the positions are those of the projected points"
                    .to_owned(),
            );
        }
    }
    Held { scene: held, losses, resampled }
}

/// What is lost, each with the first view and the number of views it is lost of.
#[derive(Default)]
struct Losses(BTreeMap<String, (String, usize)>);

impl Losses {
    fn add(&mut self, what: String, view: &str) {
        self.0.entry(what).or_insert_with(|| (view.to_owned(), 0)).1 += 1;
    }

    fn lines(self) -> Vec<String> {
        let line = |(what, (view, count)): (String, (String, usize))| match count {
            1 => format!("view {view:?}: {what}"),
            count => format!("{count} views, the first {view:?}: {what}"),
        };
        self.0.into_iter().map(line).collect()
    }
}

/// What of a view's camera the format has no place for.
fn unheld(view: &View, format: TargetFormat) -> Option<&'static str> {
    let k = &view.camera.intrinsics;
    let is_pinhole = view.distortion == Distortion::None;
    match format {
        TargetFormat::Mvsnet => (!is_pinhole).then_some("the lens"),
        TargetFormat::Colmap | TargetFormat::ColmapText => {
            (k.skew != 0.0).then_some("the skew of its pixels")
        }
        TargetFormat::OpenMvg => match view.distortion {
            _ if k.skew != 0.0 => Some("the skew of its pixels"),
            _ if k.fx != k.fy => Some("two focal lengths"),
            Distortion::Fov { .. } => Some("the fov lens"),
            Distortion::ThinPrismFisheye { .. } => Some("the thin prism lens"),
            Distortion::FullOpenCv { k4, k5, k6, .. } if [k4, k5, k6] != [0.0; 3] => {
                Some("the rational lens")
            }
            _ => None,
        },
    }
}

/// A pinhole camera that the format holds, with the pose and about the field of view of `pinhole`.
fn fitted(pinhole: &Intrinsics, format: TargetFormat) -> Intrinsics {
    match format {
        TargetFormat::Mvsnet => *pinhole,
        TargetFormat::Colmap | TargetFormat::ColmapText => Intrinsics { skew: 0.0, ..*pinhole },
        TargetFormat::OpenMvg => {
            let stretch = pinhole.fx / pinhole.fy;
            let height = (pinhole.height as f64 * stretch).round().clamp(1.0, u32::MAX as f64) as u32;
            let cy = (pinhole.cy + 0.5) * stretch - 0.5;
            Intrinsics { height, fy: pinhole.fx, skew: 0.0, cy, ..*pinhole }
        }
    }
}

/// The same lens in the words of the format, which has fewer models.
fn same_in(format: TargetFormat, lens: Distortion, k: &Intrinsics) -> Distortion {
    match lens {
        Distortion::Radial { k1, k2 } if format != TargetFormat::OpenMvg && k.fx != k.fy => {
            Distortion::OpenCv { k1, k2, p1: 0.0, p2: 0.0 }
        }
        Distortion::FullOpenCv { k1, k2, p1, p2, k3, .. } if format == TargetFormat::OpenMvg && k3 == 0.0 => {
            Distortion::OpenCv { k1, k2, p1, p2 }
        }
        lens => lens,
    }
}

/// Name and depth range as the format holds them.
fn finish(view: &mut View, format: TargetFormat, losses: &mut Losses) {
    if format != TargetFormat::Mvsnet {
        if view.depth_range.take().is_some() {
            losses.add("the depth range".to_owned(), &view.name);
        }
        return;
    }
    if let Some(range) = &mut view.depth_range
        && range.count.is_none()
    {
        range.count = Some(DEFAULT_PLANES);
        losses.add(format!("a depth range without a number of planes: it gets {DEFAULT_PLANES}"), &view.name);
    }
    let extension = view.name.rsplit_once('.').map_or("png", |(_, extension)| extension);
    let numbered = format!("{:08}.{}", view.id.0, extension.to_ascii_lowercase());
    if numbered != view.name {
        losses.add("the name of the image: it is numbered".to_owned(), &view.name);
        view.name = numbered;
    }
}

/// The points with tracks of views that the scene has.
fn known_tracks(scene: &Scene) -> SparsePoints {
    let mut points = SparsePoints::default();
    for (position, track) in scene.points.iter() {
        points.push(*position, track.iter().copied().filter(|id| scene.views.contains_key(id)));
    }
    points
}
