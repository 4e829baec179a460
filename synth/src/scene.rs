//! A scene from a seed.

use nalgebra::{Point3, Vector3};
use planesweep_scene::{Camera, Intrinsics, Raster, SparsePoints};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::camera_path::CameraPath;
use crate::courtyard::{self, Courtyard};
use crate::geometry::World;
use crate::shade::Light;
use crate::texture::Material;
use crate::{render, sparse};

/// What kind of scene is made; everything else follows from the seed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Style {
    /// Number of cameras.
    pub views: usize,
    /// Columns of the images.
    pub width: u32,
    /// Rows of the images.
    pub height: u32,
    /// Horizontal field of view, in degrees.
    pub field_of_view_degrees: f64,
    /// The angle between neighbouring cameras, seen from the middle of the scene, in degrees.
    pub step_degrees: f64,
    /// How many things stand in the scene.
    pub things: usize,
    /// How many pebbles lie between them.
    pub pebbles: usize,
}

impl Default for Style {
    fn default() -> Self {
        Self {
            views: 10,
            width: 640,
            height: 480,
            field_of_view_degrees: 58.0,
            step_degrees: 6.5,
            things: 11,
            pebbles: 24,
        }
    }
}

/// A procedural scene with its cameras, ready to be rendered from anywhere.
///
/// Lengths are metres, z is up. The same seed and style give the same scene, and the same scene,
/// camera and supersampling the same pixels, whatever the number of threads.
#[derive(Clone, Debug)]
pub struct SynthScene {
    pub(crate) world: World,
    pub(crate) materials: Vec<Material>,
    pub(crate) light: Light,
    cameras: Vec<Camera>,
}

impl SynthScene {
    /// Makes the scene of a seed.
    pub fn new(seed: u64, style: &Style) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let Courtyard { bodies, materials } = courtyard::build(style.things, style.pebbles, &mut rng);
        let light = afternoon(&mut rng);
        let path = CameraPath {
            target: Point3::new(0.0, 0.6, 0.55),
            radius: 6.4,
            height: 1.5,
            step_degrees: style.step_degrees,
        };
        let cameras = path.cameras(style.views, &intrinsics(style), &mut rng);
        Self { world: World::new(bodies), materials, light, cameras }
    }

    /// The cameras, neighbours in order.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// The `i`-th camera.
    ///
    /// # Panics
    /// When `i` is not below the number of views.
    pub fn camera(&self, i: usize) -> Camera {
        self.cameras[i]
    }

    /// The image of a camera, `supersampling` squared rays per pixel, and its exact depth (z, at
    /// pixel centres, 0 where there is only sky).
    pub fn render(&self, camera: &Camera, supersampling: u32) -> (Raster<[u8; 3]>, Raster<f32>) {
        (render::color(self, camera, supersampling), self.depth(camera))
    }

    /// The exact depth alone.
    pub fn depth(&self, camera: &Camera) -> Raster<f32> {
        render::depth(&self.world, camera)
    }

    /// Points on surfaces, about `per_view` from each of `cameras`, with the indices of all cameras
    /// that see them unoccluded as their tracks (at least two, as structure from motion needs).
    /// A camera's index is its [`ViewId`](planesweep_scene::ViewId) less 1: COLMAP counts from 1.
    pub fn sparse_points(&self, cameras: &[Camera], per_view: usize) -> SparsePoints {
        sparse::sample(&self.world, cameras, per_view)
    }
}

fn intrinsics(style: &Style) -> Intrinsics {
    let focal = f64::from(style.width) / 2.0 / (style.field_of_view_degrees / 2.0).to_radians().tan();
    Intrinsics {
        width: style.width,
        height: style.height,
        fx: focal,
        fy: focal,
        skew: 0.0,
        cx: (f64::from(style.width) - 1.0) / 2.0,
        cy: (f64::from(style.height) - 1.0) / 2.0,
    }
}

/// A sun over the photographer's shoulder, so that most of what is seen is lit.
fn afternoon(rng: &mut ChaCha8Rng) -> Light {
    let azimuth: f64 = rng.random_range(0.35..0.95);
    let side = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let elevation: f64 = rng.random_range(0.65..0.95);
    let sun = Vector3::new(
        side * azimuth.sin() * elevation.cos(),
        -azimuth.cos() * elevation.cos(),
        elevation.sin(),
    );
    Light { sun, sun_radius: 0.012, sun_color: [2.5, 2.3, 1.95], sky_color: [0.62, 0.72, 0.88] }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point2;

    use super::*;

    const SMALL: Style = Style {
        views: 4,
        width: 120,
        height: 90,
        field_of_view_degrees: 58.0,
        step_degrees: 7.0,
        things: 8,
        pebbles: 6,
    };

    #[test]
    fn a_seed_gives_the_same_bytes_on_any_number_of_threads() {
        let run = |threads: usize, seed: u64| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| {
                let scene = SynthScene::new(seed, &SMALL);
                (scene.render(&scene.camera(1), 2), scene.sparse_points(scene.cameras(), 50))
            })
        };
        let (first, second) = (run(1, 7), run(3, 7));
        assert!(first == second, "one and three threads differ");
        assert!(first.0.0 != run(2, 8).0.0, "seeds do not matter");
    }

    #[test]
    fn depth_of_one_view_is_never_in_front_of_what_another_sees() {
        let scene = SynthScene::new(3, &SMALL);
        let (a, b) = (scene.camera(0), scene.camera(1));
        let depth = scene.depth(&a);
        let eye = render::Eye::new(&b);
        let (mut agree, mut hidden) = (0, 0);
        for (x, y) in (0..90).step_by(3).flat_map(|y| (0..120).step_by(3).map(move |x| (x, y))) {
            let world = a.unproject(&Point2::new(x as f64, y as f64), f64::from(depth.at(x, y)));
            let Some((pixel, expected)) = b.project(&world) else { continue };
            let (seen, _) = scene.world.nearest(&eye.ray(&pixel)).expect("the yard is closed");
            // Depth is stored with 24 bits; at a grazing angle an error grows.
            assert!(seen < expected * (1.0 + 1e-4), "{seen} seen through the surface at {expected}");
            if seen > expected * (1.0 - 1e-4) { agree += 1 } else { hidden += 1 }
        }
        assert!(agree > 900 && hidden > 10, "{agree} visible, {hidden} occluded");
    }

    #[test]
    fn sparse_points_lie_on_the_depth_maps_of_their_tracks() {
        let scene = SynthScene::new(5, &SMALL);
        let maps: Vec<_> = scene.cameras().iter().map(|camera| scene.depth(camera)).collect();
        let points = scene.sparse_points(scene.cameras(), 200);
        assert!(points.len() > 500, "{} points", points.len());
        let (mut bracketed, mut all) = (0, 0);
        for (position, track) in points.iter() {
            assert!(track.len() >= 2);
            for view in track {
                let index = view.0 as usize - 1;
                let (pixel, z) = scene.cameras()[index].project(position).expect("in front");
                let (x, y) = (pixel.x as usize, pixel.y as usize);
                let corners: Vec<f64> = [(0, 0), (1, 0), (0, 1), (1, 1)]
                    .iter()
                    .filter_map(|(dx, dy)| maps[index].get(x + dx, y + dy))
                    .map(f64::from)
                    .collect();
                let low = corners.iter().copied().fold(f64::INFINITY, f64::min);
                let high = corners.iter().copied().fold(0.0, f64::max);
                all += 1;
                bracketed += usize::from(low * 0.995 <= z && z <= high * 1.005);
            }
        }
        // The rest lie on things thinner than a pixel of these small images.
        assert!(bracketed * 100 >= all * 98, "{bracketed} of {all}");
    }

    #[test]
    fn two_views_agree_in_colour_where_both_see_a_surface() {
        let style = Style { width: 240, height: 180, ..SMALL };
        let scene = SynthScene::new(9, &style);
        let (a, b) = (scene.camera(1), scene.camera(2));
        let ((color_a, depth_a), (color_b, depth_b)) = (scene.render(&a, 3), scene.render(&b, 3));
        let difference = |p: [u8; 3], q: [u8; 3]| {
            p.iter().zip(q).map(|(p, q)| f64::from(p.abs_diff(q))).sum::<f64>() / 3.0
        };
        let (mut same, mut other, mut count) = (0.0, 0.0, 0.0);
        for (x, y) in (0..180).step_by(2).flat_map(|y| (0..240).step_by(2).map(move |x| (x, y))) {
            let world = a.unproject(&Point2::new(x as f64, y as f64), f64::from(depth_a.at(x, y)));
            let Some((pixel, z)) = b.project(&world) else { continue };
            let (u, v) = (pixel.x.round(), pixel.y.round());
            let inside = u >= 0.0 && v >= 0.0 && u < 240.0 && v < 180.0;
            if !inside || (f64::from(depth_b.at(u as usize, v as usize)) / z - 1.0).abs() > 0.01 {
                continue;
            }
            let here = color_a.at(x, y);
            same += difference(here, color_b.at(u as usize, v as usize));
            other += difference(here, color_b.at((u as usize + 7) % 240, (v as usize + 5) % 180));
            count += 1.0;
        }
        assert!(count > 5000.0, "{count} pixels in both");
        assert!(same / count < 13.0, "colours differ by {}", same / count);
        assert!(same < 0.6 * other, "{} where it belongs, {} elsewhere", same / count, other / count);
    }
}
