//! A neighbour's depth map as the reference sees it.
#![allow(
    unsafe_code,
    clippy::inline_always,
    reason = "compiled for the instructions of the processor, as the kernel"
)]

use planesweep_scene::Raster;

use super::Candidate;
use crate::geometric::Neighbour;
use crate::kernel::{Kernel, Lanes, Level};

/// The nearest confident depth of one neighbour at each pixel of the reference.
pub(crate) struct Rendered {
    /// Depth in the reference; 0 where nothing of the neighbour lies.
    depth: Raster<f32>,
    confidence: Raster<f32>,
}

impl Rendered {
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> Option<Candidate> {
        let depth = self.depth.at(x, y);
        (depth > 0.0).then(|| Candidate { depth, confidence: self.confidence.at(x, y) })
    }
}

/// Draws each pixel of the neighbour with a confident depth into the pixel of the reference (of `width`
/// by `height`) that its point lies in; the nearest wins.
///
/// Where the reference sees the surface larger than the neighbour does, pixels stay empty in between:
/// they have one candidate less.
pub(crate) fn render(
    level: Level,
    neighbour: &Neighbour<'_>,
    width: usize,
    height: usize,
    min_confidence: f32,
) -> Rendered {
    let depth = Raster::filled(width, height, 0.0_f32);
    let confidence = Raster::filled(width, height, 0.0_f32);
    let mut rendered = Rendered { depth, confidence };
    level.run(Rendering { neighbour, min_confidence, rendered: &mut rendered });
    rendered
}

struct Rendering<'a, 'b> {
    neighbour: &'a Neighbour<'b>,
    min_confidence: f32,
    rendered: &'a mut Rendered,
}

impl Kernel for Rendering<'_, '_> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<L: Lanes>(self) {
        let map = self.neighbour.map;
        let Rendered { depth: depths, confidence: confidences } = self.rendered;
        let (width, height) = (depths.width(), depths.height());
        for y in 0..map.height() {
            let transfer = self.neighbour.row_back(y);
            for (x, (&depth, &confidence)) in map.depth.row(y).iter().zip(map.confidence.row(y)).enumerate() {
                if !(depth > 0.0 && confidence >= self.min_confidence) {
                    continue;
                }
                let (u, v, z) = transfer.project(x as f32, depth);
                // The sum may round up to the next pixel: it is what must lie within.
                let (column, line) = ((u + 0.5) as usize, (v + 0.5) as usize);
                if !(u > -0.5 && v > -0.5 && column < width && line < height && z.is_finite()) {
                    continue;
                }
                let index = line * width + column;
                let nearest = &mut depths.values_mut()[index];
                if *nearest == 0.0 || z < *nearest {
                    *nearest = z;
                    confidences.values_mut()[index] = confidence;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use planesweep_scene::Intrinsics;

    use super::*;
    use crate::analytic::{Surface, camera_at, set_confidence};

    #[test]
    fn what_rounds_up_to_a_pixel_behind_the_last_is_not_seen() {
        let map = |cx: f64| {
            let mut map = Surface::Plane { slope: 0.0 }.map(camera_at(0.0, 0.0, 1, 2));
            map.depth = Raster::filled(1, 2, 1.0);
            map.camera.intrinsics =
                Intrinsics { width: 1, height: 2, fx: 1.0, fy: 1.0, skew: 0.0, cx, cy: 0.0 };
            map
        };
        // With this, u + 0.5 is 1 as a float, though u is less than 0.5.
        let below_half = 0.499_999_97;
        let rendered =
            render(Level::detect(), &Neighbour::new(&map(below_half).camera, &map(0.0)), 1, 2, 0.8);
        assert!(rendered.at(0, 0).is_none() && rendered.at(0, 1).is_none());
    }

    #[test]
    fn the_nearest_surface_is_seen_where_it_lies() {
        let surface = Surface::BallBeforePlane;
        let (reference, neighbour) =
            (surface.map(camera_at(0.0, 0.0, 80, 60)), surface.map(camera_at(0.5, 0.1, 80, 60)));
        let rendered = render(Level::detect(), &Neighbour::new(&reference.camera, &neighbour), 80, 60, 0.8);
        let (mut same, mut hidden) = (0, 0);
        for y in 0..60 {
            for x in 0..80 {
                let Some(seen) = rendered.at(x, y) else { continue };
                let truth = reference.depth.at(x, y);
                assert_eq!(seen.confidence, 1.0);
                // Half a pixel at the ball's edge is another surface; a pixel's rim is nearer than its
                // centre.
                same += usize::from((seen.depth - truth).abs() < 0.02 * truth);
                hidden += usize::from(seen.depth > 1.1 * truth);
            }
        }
        assert!(same > 3000, "{same}");
        // What the neighbour sees beside the ball lies behind the ball for the reference, in a gap
        // that no pixel of the ball falls into.
        assert!(hidden < 60, "{hidden}");
    }

    #[test]
    fn doubtful_depths_and_what_lies_outside_are_not_drawn() {
        let mut map = Surface::Plane { slope: 0.0 }.map(camera_at(0.0, 0.0, 10, 8));
        for (x, y) in (0..10).flat_map(|x| (0..8).map(move |y| (x, y))) {
            set_confidence(&mut map, x, y, if x < 5 { 0.7 } else { 0.9 });
        }
        let rendered = render(Level::detect(), &Neighbour::new(&map.camera, &map), 10, 8, 0.8);
        for x in 0..10 {
            assert_eq!(rendered.at(x, 3).is_some(), x >= 5);
        }
        let away = camera_at(90.0, 0.0, 10, 8);
        let rendered = render(Level::detect(), &Neighbour::new(&away, &map), 10, 8, 0.0);
        assert!(rendered.depth.values().iter().filter(|depth| **depth > 0.0).count() < 80);
    }
}
