use nalgebra::{Point2, Point3};
use planesweep_scene::DepthMap;

use super::*;
use crate::analytic::{Surface, camera_at, set_confidence};
use crate::filter::filter;
use crate::options::FilterOptions;

const PLANE: Surface = Surface::Plane { slope: 0.0 };

fn options() -> FilterOptions {
    FilterOptions { min_views: 1, ..FilterOptions::default() }
}

/// The camera of `camera_at`, `closer` times as near to the origin.
fn closer(x: f64, y: f64, closer: f64) -> Camera {
    let mut camera = camera_at(x, y, 40, 30);
    let centre = camera.pose.centre() * (1.0 / closer);
    camera.pose.translation = -(camera.pose.rotation * centre.coords);
    camera
}

/// Each map filtered against those that the graph names.
fn filtered(maps: &[DepthMap], graph: &[&[usize]]) -> Vec<FilteredMap> {
    let of = |(map, neighbours): (&DepthMap, &&[usize])| {
        let neighbours: Vec<&DepthMap> = neighbours.iter().map(|k| &maps[*k]).collect();
        filter(map, &neighbours, &options())
    };
    maps.iter().zip(graph).map(of).collect()
}

/// What each map emits when it knows those that the graph names.
fn emissions(filtered: &[FilteredMap], graph: &[&[usize]]) -> Vec<Raster<bool>> {
    let of = |(map, neighbours): (&FilteredMap, &&[usize])| {
        let others: Vec<&FilteredMap> = neighbours.iter().map(|k| &filtered[*k]).collect();
        emitted(map, &others, 0.01)
    };
    filtered.iter().zip(graph).map(of).collect()
}

/// Asserts that every kept pixel's place is emitted by some view: that a point of the cloud lies within
/// two of its pixel widths. Returns the numbers of kept and of emitted pixels.
fn assert_no_hole(filtered: &[FilteredMap], emissions: &[Raster<bool>]) -> (usize, usize) {
    let points = |map: &FilteredMap, chosen: &dyn Fn(usize, usize) -> bool| -> Vec<Point3<f64>> {
        let (width, height) = (map.depth.width(), map.depth.height());
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
        let chosen = pixels.filter(|(x, y)| chosen(*x, *y));
        let point =
            |(x, y)| map.camera.unproject(&Point2::new(x as f64, y as f64), map.depth.at(x, y) as f64);
        chosen.map(point).collect()
    };
    let each = filtered.iter().zip(emissions);
    let cloud: Vec<_> = each.flat_map(|(map, emitted)| points(map, &|x, y| emitted.at(x, y))).collect();
    let mut kept = 0;
    for map in filtered {
        for point in points(map, &|x, y| map.depth.at(x, y) > 0.0) {
            kept += 1;
            let depth = map.camera.pose.to_camera(&point).z;
            let near = 2.0 * depth / map.camera.intrinsics.fx;
            assert!(cloud.iter().any(|p| (p - point).norm() < near), "no point near {point}");
        }
    }
    (kept, cloud.len())
}

/// Whether a pixel of `map` that owns its surface has the point in it; `None` where rounding decides.
fn covers(map: &FilteredMap, point: &Point3<f64>, max_relative_depth: f64) -> Option<bool> {
    let Some((pixel, depth)) = map.camera.project(point) else { return Some(false) };
    let [x, y] = [pixel.x, pixel.y].map(|at| at + 0.5);
    if [x, y].iter().any(|at| (at - at.round()).abs() < 1e-3) {
        return None;
    }
    let seen = map.depth.get(x.floor().max(-1.0) as usize, y.floor().max(-1.0) as usize);
    let within = x > 0.0 && y > 0.0;
    let Some(seen) = seen.filter(|seen| within && *seen > 0.0) else { return Some(false) };
    let relative = (f64::from(seen) - depth).abs() / depth;
    let owns = map.owns.at(x as usize, y as usize);
    ((relative - max_relative_depth).abs() > 1e-5).then_some(owns && relative < max_relative_depth)
}

#[test]
fn every_level_drops_what_owners_cover() {
    let places = [(0.0, 0.0, 1.0), (0.3, 0.1, 1.2), (-0.2, 0.3, 1.25), (0.1, -0.4, 0.9), (0.0, 0.0, -1.0)];
    let maps = places.map(|(x, y, nearer)| Surface::BallBeforePlane.map(closer(x, y, nearer)));
    let all: Vec<&DepthMap> = maps.iter().collect();
    let filtered: Vec<FilteredMap> = maps.iter().map(|map| filter(map, &all, &options())).collect();
    let (map, others) = (&filtered[0], filtered[1..].iter().collect::<Vec<_>>());
    let emitted = emitted(map, &others, 0.01);
    let (mut dropped, mut undecided) = (0, 0);
    for (x, y) in (0..30).flat_map(|y| (0..40).map(move |x| (x, y))) {
        let point = map.camera.unproject(&Point2::new(x as f64, y as f64), map.depth.at(x, y).into());
        let covering: Vec<_> = others.iter().map(|other| covers(other, &point, 0.01)).collect();
        if covering.contains(&None) {
            undecided += 1;
            continue;
        }
        let is_covered = covering.contains(&Some(true));
        let expected = map.depth.at(x, y) > 0.0 && (map.owns.at(x, y) || !is_covered);
        assert_eq!(emitted.at(x, y), expected, "{x}, {y}");
        dropped += usize::from(!expected);
    }
    assert!(dropped > 400 && dropped < 1100 && undecided < 60, "{dropped} dropped, {undecided} undecided");
    for level in Level::available() {
        assert!(emitted_with(level, map, &others, 0.01) == emitted, "{level:?}");
    }
}

#[test]
fn rows_of_any_width_and_maps_of_any_size_are_emitted_alike_on_every_level() {
    let sized = |x: f64, width: u32, height: u32| {
        let mut camera = camera_at(x, 0.0, width.max(1), height.max(1));
        camera.intrinsics.fx = 40.0;
        camera.intrinsics.fy = 40.0;
        let map = filter(&PLANE.map(camera), &[], &options());
        let mut cut = map.clone();
        if width * height == 0 {
            cut.depth = Raster::filled(0, 0, 0.0);
            cut.owns = Raster::filled(0, 0, false);
        }
        cut
    };
    let others =
        [(1, 1), (1, 9), (0, 0), (33, 2), (17, 30)].map(|(width, height)| sized(0.02, width, height));
    let others: Vec<&FilteredMap> = others.iter().collect();
    for width in [1, 2, 15, 16, 17, 31, 32, 33] {
        let mut map = sized(0.0, width, 7);
        map.owns.values_mut().iter_mut().step_by(3).for_each(|owns| *owns = false);
        let emitted = emitted(&map, &others, 0.01);
        let count = emitted.values().iter().filter(|emitted| **emitted).count();
        assert!(
            count < emitted.values().len() && 2 * count > emitted.values().len(),
            "{count} of {width} columns"
        );
        for level in Level::available() {
            assert!(emitted_with(level, &map, &others, 0.01) == emitted, "{level:?}, {width} columns");
        }
    }
}

#[test]
#[should_panic(expected = "owners of a map")]
fn a_map_whose_owners_have_another_size_is_refused() {
    let mut map = filter(&PLANE.map(camera_at(0.0, 0.0, 8, 6)), &[], &options());
    map.owns = Raster::filled(7, 6, true);
    emitted(&map, &[], 0.01);
}

#[test]
fn the_closest_view_emits_and_nothing_is_lost() {
    let maps = [closer(0.0, 0.0, 1.0), closer(0.3, 0.0, 1.3), closer(0.1, 0.3, 1.6)].map(|c| PLANE.map(c));
    let graph: [&[usize]; 3] = [&[1, 2], &[0, 2], &[0, 1]];
    let filtered = filtered(&maps, &graph);
    let emissions = emissions(&filtered, &graph);
    let (kept, points) = assert_no_hole(&filtered, &emissions);
    assert_eq!(kept, 3 * 1200);
    assert!(emissions[2].values().iter().all(|emitted| *emitted), "the closest view owns all it sees");
    assert!(points < 2300, "{points} points of {kept} pixels");
    let all: usize = filtered
        .iter()
        .map(|map| emitted(map, &[], 0.01).values().iter().filter(|emitted| **emitted).count())
        .sum();
    assert_eq!(all, kept);
}

/// A defers to B and B to C, but A and C do not know each other.
#[test]
fn a_chain_of_views_that_defer_loses_no_surface() {
    let maps = [closer(0.0, 0.0, 1.0), closer(0.2, 0.0, 1.2), closer(0.4, 0.0, 1.5)].map(|c| PLANE.map(c));
    let graph: [&[usize]; 3] = [&[1], &[0, 2], &[1]];
    let filtered = filtered(&maps, &graph);
    let owners = |map: &FilteredMap| map.owns.values().iter().filter(|owns| **owns).count();
    assert!(owners(&filtered[0]) < 700 && owners(&filtered[1]) < 700 && owners(&filtered[2]) == 1200);
    let emissions = emissions(&filtered, &graph);
    assert_no_hole(&filtered, &emissions);
    // B's middle is left to C, so A, whose middle was B's, emits its own.
    assert!(!emissions[1].at(20, 15) && !filtered[0].owns.at(20, 15) && emissions[0].at(20, 15));
}

#[test]
fn equal_footprints_lose_no_surface_and_do_not_double_it() {
    // Side by side before a plane: the footprints are equal to rounding.
    let maps = [-0.3, 0.0, 0.3].map(|x| {
        let mut camera = camera_at(0.0, 0.0, 40, 30);
        camera.pose.translation.x = x;
        PLANE.map(camera)
    });
    let graph: [&[usize]; 3] = [&[1, 2], &[0, 2], &[0, 1]];
    let filtered = filtered(&maps, &graph);
    let emissions = emissions(&filtered, &graph);
    let (kept, points) = assert_no_hole(&filtered, &emissions);
    // The three together see 40 + 2 * 4 columns of the plane.
    assert!(kept == 3600 && points < 30 * 52, "{points} of {kept}");
    // Twice the same view: neither is better, both stay.
    let twice = [maps[0].clone(), maps[0].clone()];
    let graph: [&[usize]; 2] = [&[1], &[0]];
    let filtered = self::filtered(&twice, &graph);
    assert_no_hole(&filtered, &self::emissions(&filtered, &graph));
}

#[test]
fn where_the_owner_was_filtered_out_the_others_emit() {
    let mut maps = [closer(0.0, 0.0, 1.0), closer(0.2, 0.0, 1.4)].map(|c| PLANE.map(c));
    let graph: [&[usize]; 2] = [&[1], &[0]];
    // The closer view is unsure of a block in its middle.
    for y in 10..20 {
        for x in 15..25 {
            set_confidence(&mut maps[1], x, y, 0.1);
        }
    }
    let mut filtered = filtered(&maps, &graph);
    let emissions = emissions(&filtered, &graph);
    assert_no_hole(&filtered, &emissions);
    assert!(emissions[0].at(20, 15));
    assert!(!emissions[0].at(8, 15));
    // And where its pixel is gone for a reason that the other could not know.
    filtered[1].depth.values_mut().fill(0.0);
    filtered[1].owns.values_mut().fill(false);
    let emissions = self::emissions(&filtered, &graph);
    assert!(emissions[0].values().iter().all(|emitted| *emitted));
}

#[test]
fn another_surface_in_the_same_pixel_is_not_covered() {
    let map = Surface::BallBeforePlane.map(camera_at(0.0, 0.0, 40, 30));
    let mut far = filter(&map, &[], &options());
    far.owns.values_mut().fill(false);
    let mut near = far.clone();
    near.owns.values_mut().fill(true);
    near.depth.values_mut().iter_mut().for_each(|depth| *depth *= 0.97);
    assert!(emitted(&far, &[&near], 0.01).values().iter().all(|emitted| *emitted));
    assert!(emitted(&far, &[&near], 0.05).values().iter().all(|emitted| !*emitted));
}
