//! Depth maps of a triangle mesh from given cameras: how scans become training data (paper, section 4.1).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Point2, Point3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, ImageError, PrepareError, Raster, Scene, View, ViewId, WorkingImage,
    read_image, undistorted_intrinsics,
};
use rayon::prelude::*;
use thiserror::Error;

use crate::data_set::range_of;
use crate::geometry::{MeshHit, Ray, Span, TriangleMesh};
use crate::render::Eye;
use crate::training_folder::{TrainingFolder, TrainingFolderError};

/// The share of its depth that a point's way to another view may be blocked over: rounding.
const SAME_DEPTH: f64 = 1e-5;

/// Which depth is kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MeshDepthOptions {
    /// Also what no source view sees.
    pub keep_unseen: bool,
    /// Also what shows its back: the far side seen through a hole, the inside of a surface. For meshes
    /// whose triangles are not all turned the same way.
    pub keep_back_faces: bool,
}

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MeshDepthReport {
    /// Views with a depth map.
    pub views: usize,
    /// Views that the mesh is not in, or whose part of it no source sees.
    pub empty_views: usize,
    /// Pixels with depth.
    pub pixels: u64,
}

/// Why depth could not be rendered into a folder.
#[derive(Debug, Error)]
pub enum MeshDepthError {
    /// An image could not be read.
    #[error("cannot read the image of view {view}")]
    ReadImage {
        /// The view's name.
        view: String,
        /// Why.
        #[source]
        source: ImageError,
    },
    /// An image is not that of its camera.
    #[error("cannot undistort the image of view {view}")]
    Undistort {
        /// The view's name.
        view: String,
        /// Why.
        #[source]
        source: PrepareError,
    },
    /// The folder could not be written.
    #[error(transparent)]
    Folder(#[from] TrainingFolderError),
}

/// The depth (z) of the first surface at each pixel of `camera`; 0 where there is none, where it shows
/// its back, and where none of `sources` sees it, each unless the options keep it.
///
/// A source sees a point that falls into its image, shows it its front, and is not hidden by the mesh.
pub fn render_mesh_depth(
    mesh: &TriangleMesh,
    camera: &Camera,
    sources: &[Camera],
    options: &MeshDepthOptions,
) -> Raster<f32> {
    let eye = Eye::new(camera);
    let sources: Vec<(&Camera, Point3<f64>)> = sources.iter().map(|c| (c, c.pose.centre())).collect();
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let mut depth = Raster::filled(width, height, 0.0);
    depth.values_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let ray = eye.ray(&Point2::new(x as f64, y as f64));
            let Some(hit) = mesh.intersect(&ray, Span { min: 0.0, max: f64::INFINITY }) else { continue };
            if !hit.front && !options.keep_back_faces {
                continue;
            }
            let seen = || sources.iter().any(|(source, centre)| sees(mesh, source, centre, &ray, &hit));
            if options.keep_unseen || seen() {
                *value = hit.t as f32;
            }
        }
    });
    depth
}

/// Whether a camera sees where `ray` hit the mesh, from the same side.
fn sees(mesh: &TriangleMesh, camera: &Camera, centre: &Point3<f64>, ray: &Ray, hit: &MeshHit) -> bool {
    let point = ray.at(hit.t);
    let Some((pixel, _)) = camera.project(&point) else { return false };
    let (right, bottom) =
        (f64::from(camera.intrinsics.width) - 1.0, f64::from(camera.intrinsics.height) - 1.0);
    if !(0.0..=right).contains(&pixel.x) || !(0.0..=bottom).contains(&pixel.y) {
        return false;
    }
    let normal: Vector3<f64> = mesh.normal(hit, false);
    let way = point - centre;
    if (normal.dot(&way) < 0.0) != (normal.dot(&ray.direction) < 0.0) {
        return false;
    }
    let there = Ray { origin: *centre, direction: way };
    mesh.intersect(&there, Span { min: 0.0, max: 1.0 - SAME_DEPTH }).is_none()
}

/// The depth range of a mesh in a view, as a plan would take it from sparse points; from rays four pixels
/// apart. `None` where the view does not show the mesh.
pub fn depth_range_of_mesh(
    mesh: &TriangleMesh,
    camera: &Camera,
    options: &MeshDepthOptions,
) -> Option<DepthRange> {
    let map = Camera { intrinsics: camera.intrinsics.quartered(), pose: camera.pose };
    range_of(&render_mesh_depth(mesh, &map, &[], &MeshDepthOptions { keep_unseen: true, ..*options }))
}

/// Renders the mesh from every view of `scene` and writes an MVSNet folder for training into `out`:
/// `images` (undistorted where there is a lens), `cams` with the depth range, `pair.txt`, and
/// `rendered_depth_maps`, all by the views' ids. Sources are the scene's pairs. Views without depth get no
/// map and are left out of pair.txt as references.
pub fn write_mesh_depth(
    mesh: &TriangleMesh,
    scene: &Scene,
    out: &Path,
    options: &MeshDepthOptions,
) -> Result<MeshDepthReport, MeshDepthError> {
    let folder = TrainingFolder::create(out)?;
    let pinhole = |view: &View| {
        let intrinsics = undistorted_intrinsics(&view.camera.intrinsics, &view.distortion);
        Camera { intrinsics, pose: view.camera.pose }
    };
    let cameras: BTreeMap<ViewId, Camera> =
        scene.views.iter().map(|(id, view)| (*id, pinhole(view))).collect();
    let mut written = Scene { pairs: scene.pairs.clone(), ..Scene::default() };
    let mut report = MeshDepthReport::default();
    for (id, view) in &scene.views {
        let pairs = scene.pairs.get(id).map(Vec::as_slice).unwrap_or_default();
        let sources: Vec<Camera> = pairs.iter().filter_map(|s| cameras.get(&s.view).copied()).collect();
        let depth = render_mesh_depth(mesh, &cameras[id], &sources, options);
        let depth_range = range_of(&depth);
        if depth_range.is_some() {
            folder.write_depth(*id, &depth)?;
            report.views += 1;
            report.pixels += depth.values().iter().filter(|d| **d > 0.0).count() as u64;
        } else {
            report.empty_views += 1;
            written.pairs.remove(id);
        }
        let image = write_image(&folder, *id, view, &cameras[id])?;
        let name = format!("{:08}", id.0);
        let camera = cameras[id];
        let distortion = Distortion::None;
        written.views.insert(*id, View { id: *id, name, image, camera, distortion, depth_range });
    }
    folder.write_cameras(&written)?;
    Ok(report)
}

/// Copies the image of a view, or writes it undistorted.
fn write_image(
    folder: &TrainingFolder,
    id: ViewId,
    view: &View,
    camera: &Camera,
) -> Result<PathBuf, MeshDepthError> {
    if view.distortion == Distortion::None {
        return Ok(folder.copy_image(id, &view.image)?);
    }
    let stored = read_image(&view.image)
        .map_err(|source| MeshDepthError::ReadImage { view: view.name.clone(), source })?;
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let working = WorkingImage::prepare(stored, &view.camera, &view.distortion, width, height)
        .map_err(|source| MeshDepthError::Undistort { view: view.name.clone(), source })?;
    Ok(folder.write_image(id, &working.pixels)?)
}

#[cfg(test)]
mod tests {
    use planesweep_scene::{Intrinsics, Pose, SourceScore};
    use proptest::prelude::*;

    use super::*;
    use crate::data_set::{DataSet, SampleShape};

    fn camera(centre: [f64; 3], target: [f64; 3]) -> Camera {
        let intrinsics =
            Intrinsics { width: 48, height: 40, fx: 60.0, fy: 61.0, skew: 0.0, cx: 23.2, cy: 20.1 };
        Camera { intrinsics, pose: Pose::look_at(&centre.into(), &target.into(), &Vector3::z()) }
    }

    /// A ball of triangles about the origin, turned outwards.
    fn ball(rings: u32, sectors: u32) -> TriangleMesh {
        let at = |ring: u32, sector: u32| ring * sectors + sector % sectors;
        let mut positions = Vec::new();
        for ring in 0..=rings {
            let polar = std::f64::consts::PI * f64::from(ring) / f64::from(rings);
            for sector in 0..sectors {
                let around = std::f64::consts::TAU * f64::from(sector) / f64::from(sectors);
                let (sin, cos) = polar.sin_cos();
                positions.push(Point3::new(sin * around.cos(), sin * around.sin(), -cos));
            }
        }
        let mut triangles = Vec::new();
        for (r, s) in (0..rings).flat_map(|r| (0..sectors).map(move |s| (r, s))) {
            triangles.push([at(r, s), at(r, s + 1), at(r + 1, s + 1)]);
            triangles.push([at(r, s), at(r + 1, s + 1), at(r + 1, s)]);
        }
        TriangleMesh::new(positions, &triangles, &[])
    }

    /// A box along the axes about the origin with these half sides, turned outwards.
    fn cuboid(half: [f64; 3]) -> TriangleMesh {
        let corner =
            |i: u32| Point3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { half[k] } else { -half[k] }));
        let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        let triangles: Vec<[u32; 3]> =
            sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        TriangleMesh::new((0..8).map(corner).collect(), &triangles, &[])
    }

    const ALL: MeshDepthOptions = MeshDepthOptions { keep_unseen: true, keep_back_faces: false };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn a_ball_has_the_depth_of_a_sphere(
            around in 0.0_f64..6.2, up in -1.0_f64..1.0, distance in 2.0_f64..5.0, aside in -0.2_f64..0.2,
        ) {
            let (rings, sectors) = (60, 120);
            let mesh = ball(rings, sectors);
            let centre = [distance * around.cos() * up.cos(), distance * around.sin() * up.cos(), distance * up.sin()];
            let camera = camera(centre, [aside, 0.0, -aside]);
            let depth = render_mesh_depth(&mesh, &camera, &[], &ALL);
            let eye = Eye::new(&camera);
            // The triangles lie at most this far below the sphere.
            let sagitta = 1.0 - (std::f64::consts::PI / f64::from(rings)).cos();
            for (x, y) in (0..40).flat_map(|y| (0..48).map(move |x| (x, y))) {
                let ray = eye.ray(&Point2::new(x as f64, y as f64));
                let (a, b) = (ray.direction.norm_squared(), ray.origin.coords.dot(&ray.direction));
                let discriminant = |radius: f64| b * b - a * (ray.origin.coords.norm_squared() - radius * radius);
                let seen = f64::from(depth.at(x, y));
                let (outer, inner) = (discriminant(1.0), discriminant(1.0 - sagitta));
                if outer < 0.0 {
                    prop_assert_eq!(seen, 0.0);
                } else if inner > 0.0 {
                    let (near, far) = ((-b - outer.sqrt()) / a, (-b - inner.sqrt()) / a);
                    prop_assert!(near - 1e-6 <= seen && seen <= far + 1e-6, "{} not in {}..{}", seen, near, far);
                }
            }
        }

        #[test]
        fn a_box_has_the_depth_of_its_planes(
            half in prop::array::uniform3(0.3_f64..1.2),
            way in prop::array::uniform3(-1.0_f64..1.0),
        ) {
            let way = Vector3::from(way);
            prop_assume!(way.norm() > 0.2 && way.xy().norm() > 0.1);
            let centre = way.normalize() * 4.0;
            let camera = camera(centre.into(), [0.1, -0.05, 0.02]);
            let depth = render_mesh_depth(&cuboid(half), &camera, &[], &ALL);
            let eye = Eye::new(&camera);
            for (x, y) in (0..40).flat_map(|y| (0..48).map(move |x| (x, y))) {
                let ray = eye.ray(&Point2::new(x as f64, y as f64));
                let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
                for (axis, half) in half.iter().enumerate() {
                    let planes = [-half, *half].map(|h| (h - ray.origin[axis]) / ray.direction[axis]);
                    enter = enter.max(planes[0].min(planes[1]));
                    leave = leave.min(planes[0].max(planes[1]));
                }
                let seen = f64::from(depth.at(x, y));
                // Within rounding of a silhouette either answer is right.
                if enter < leave - 1e-9 {
                    prop_assert!((seen - enter).abs() < 1e-5, "{} instead of {}", seen, enter);
                } else if enter > leave + 1e-9 {
                    prop_assert_eq!(seen, 0.0);
                }
            }
        }
    }

    #[test]
    fn what_shows_its_back_or_no_source_sees_is_dropped_unless_kept() {
        // A box without its side towards -y, seen through the opening from there.
        let mesh = cuboid([1.0, 1.0, 1.0]);
        let open = {
            let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
            let triangles: Vec<[u32; 3]> =
                sides.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
            let corner = |i: u32| Point3::from([0, 1, 2].map(|k| if i >> k & 1 == 1 { 1.0 } else { -1.0 }));
            TriangleMesh::new((0..8).map(corner).collect(), &triangles, &[])
        };
        let front = camera([0.0, -5.0, 0.0], [0.0, 0.0, 0.0]);
        let middle = |mesh: &TriangleMesh, sources: &[Camera], options: &MeshDepthOptions| {
            render_mesh_depth(mesh, &front, sources, options).at(23, 20)
        };
        assert_eq!(middle(&open, &[], &ALL), 0.0);
        let kept = MeshDepthOptions { keep_back_faces: true, ..ALL };
        assert!((middle(&open, &[], &kept) - 6.0).abs() < 1e-6);
        // The closed box: a camera behind it does not see the front, one aside does.
        let masked = MeshDepthOptions::default();
        let behind = camera([0.0, 5.0, 0.0], [0.0, 0.0, 0.0]);
        let aside = camera([1.0, -5.0, 0.5], [0.0, 0.0, 0.0]);
        assert_eq!(middle(&mesh, &[behind], &masked), 0.0);
        assert!((middle(&mesh, &[behind, aside], &masked) - 4.0).abs() < 1e-6);
        assert_eq!(middle(&mesh, &[], &masked), 0.0);
    }

    #[test]
    fn the_folder_is_a_data_set() {
        let root = tempfile::tempdir().expect("a temporary folder");
        let mut scene = Scene::default();
        for (i, x) in [0.0, 0.6, 50.0].into_iter().enumerate() {
            let image = root.path().join(format!("photo{i}.png"));
            image::save_buffer(&image, &[90; 48 * 40 * 3], 48, 40, image::ExtendedColorType::Rgb8)
                .expect("written");
            let id = ViewId(i as u32 + 7);
            let camera = camera([x, -4.0, 0.3], [1.2 * x, 0.0, 0.0]);
            let name = format!("photo{i}.png");
            scene.views.insert(
                id,
                View { id, name, image, camera, distortion: Distortion::None, depth_range: None },
            );
            let others = (7..10).filter(|k| *k != id.0).map(|k| SourceScore { view: ViewId(k), score: 1.0 });
            scene.pairs.insert(id, others.collect());
        }
        let out = root.path().join("out");
        let mesh = ball(30, 60);
        let report = write_mesh_depth(&mesh, &scene, &out, &MeshDepthOptions::default()).expect("written");
        assert_eq!((report.views, report.empty_views), (2, 1));
        let set = DataSet::open(&out).expect("a data set");
        assert_eq!(set.len(), 2);
        let sample = set.sample(0, &SampleShape { width: 48, height: 40, views: 2 }, 0).expect("a sample");
        let known = sample.depth.values().iter().filter(|d| **d > 0.0).count();
        assert!(known > 20, "{known} pixels known");
        assert!((sample.depth.at(6, 5) - 3.0).abs() < 0.1, "{} before the ball", sample.depth.at(6, 5));
    }
}
