use planesweep_scene::Raster;

use super::*;
use crate::analytic::{Surface, camera_at, set_confidence};
use crate::filter::{FilteredMap, filter};
use crate::kernel::Level;

const PLANE: Surface = Surface::Plane { slope: 0.2 };
const PLACES: [(f64, f64); 5] = [(0.0, 0.0), (0.4, 0.0), (-0.4, 0.1), (0.1, 0.4), (0.0, -0.3)];
const METHODS: [FusionMethod; 2] = [FusionMethod::Visibility, FusionMethod::VisibilityConfidence];

fn maps(surface: Surface) -> Vec<DepthMap> {
    PLACES.iter().map(|(x, y)| surface.map(camera_at(*x, *y, 60, 44))).collect()
}

fn fuse(maps: &[DepthMap], method: FusionMethod, min_views: u32) -> FilteredMap {
    let options = FilterOptions { method, min_views, ..FilterOptions::default() };
    filter(&maps[0], &maps[1..].iter().collect::<Vec<_>>(), &options)
}

/// The pixels of a block in the middle of a map of 60 x 44.
fn block() -> impl Iterator<Item = (usize, usize)> {
    (18..26).flat_map(|y| (25..35).map(move |x| (x, y)))
}

fn scale_block(map: &mut DepthMap, factor: f32) {
    let width = map.width();
    block().for_each(|(x, y)| map.depth.values_mut()[y * width + x] *= factor);
}

#[test]
fn a_wrong_depth_is_replaced_by_what_the_others_see() {
    for method in METHODS {
        // Too near: the others see through it. Too far: the others' surface hides it.
        for factor in [0.8, 1.2] {
            let truth = maps(PLANE);
            let mut maps = truth.clone();
            scale_block(&mut maps[0], factor);
            // Of equally confident depths the reference's own comes first.
            block().for_each(|(x, y)| set_confidence(&mut maps[0], x, y, 0.9));
            let fused = fuse(&maps, method, 3);
            for (x, y) in block() {
                let (depth, truth) = (fused.depth.at(x, y), truth[0].depth.at(x, y));
                assert!((depth - truth).abs() < 2e-3 * truth, "{method:?} {factor}: {depth} for {truth}");
                assert_eq!(fused.views.at(x, y), 4, "the reference does not agree");
                let (mean, own) = (fused.color.at(x, y), maps[0].rgb(x, y));
                assert!(mean.iter().zip(own).all(|(a, b)| a.abs_diff(b) <= 3), "{mean:?} for {own:?}");
            }
        }
    }
}

#[test]
fn a_floating_depth_of_one_neighbour_is_harmless() {
    for method in METHODS {
        let truth = maps(PLANE);
        let mut maps = truth.clone();
        scale_block(&mut maps[2], 0.7);
        let fused = fuse(&maps, method, 3);
        for (x, y) in block() {
            let (depth, truth) = (fused.depth.at(x, y), truth[0].depth.at(x, y));
            assert!((depth - truth).abs() < 2e-3 * truth, "{method:?}: {depth} for {truth}");
        }
    }
}

#[test]
fn a_doubtful_pixel_gets_the_depth_of_its_neighbours() {
    for method in METHODS {
        let truth = maps(PLANE);
        let mut maps = truth.clone();
        block().for_each(|(x, y)| set_confidence(&mut maps[0], x, y, 0.2));
        let fused = fuse(&maps, method, 3);
        for (x, y) in block() {
            let (depth, truth) = (fused.depth.at(x, y), truth[0].depth.at(x, y));
            assert!((depth - truth).abs() < 2e-3 * truth, "{method:?}: {depth} for {truth}");
        }
    }
}

#[test]
fn two_surfaces_are_kept_apart() {
    for method in METHODS {
        let maps = maps(Surface::BallBeforePlane);
        let fused = fuse(&maps, method, 2);
        let (mut kept, mut wrong) = (0, 0);
        for y in 0..44 {
            for x in 0..60 {
                let (depth, truth) = (fused.depth.at(x, y), maps[0].depth.at(x, y));
                kept += usize::from(depth > 0.0);
                wrong += usize::from(depth > 0.0 && (depth - truth).abs() > 0.02 * truth);
            }
        }
        // Pixels on the ball's edge may go either way.
        assert!(kept > 2500 && wrong < 50, "{method:?}: {wrong} of {kept}");
    }
}

/// One pixel, looked at by a reference and neighbours that are all in the same place: a candidate is
/// seen through by whoever sees something behind it.
fn choose(depths: &[(f32, f32)], method: FusionMethod) -> Option<f32> {
    let map = |(depth, confidence): &(f32, f32)| {
        let camera = camera_at(0.0, 0.0, 1, 1);
        let raster = |value| Raster::filled(1, 1, value);
        DepthMap::new(camera, raster(*depth), raster(*confidence), Raster::filled(1, 1, [0; 3])).expect("1x1")
    };
    let maps: Vec<DepthMap> = depths.iter().map(map).collect();
    let neighbours: Vec<Neighbour<'_>> =
        maps[1..].iter().map(|map| Neighbour::new(&maps[0].camera, map)).collect();
    let options = FilterOptions { method, min_confidence: 0.5, ..FilterOptions::default() };
    let mut row = HypothesisRow::default();
    Candidates::new(&maps[0], &neighbours, &options, Level::detect()).choose(
        0,
        &mut Scratch::default(),
        &mut row,
    );
    row.blocks().next().map(|block| block.depths[0])
}

#[test]
fn the_nearest_stable_depth_is_chosen() {
    let stable = |depths: &[f32]| {
        let depths: Vec<(f32, f32)> = depths.iter().map(|depth| (*depth, 1.0)).collect();
        choose(&depths, FusionMethod::Visibility)
    };
    assert_eq!(stable(&[2.0]), Some(2.0));
    // One nearer, one farther: the middle is hidden by one and seen through by one.
    assert_eq!(stable(&[2.0, 1.0, 3.0]), Some(2.0));
    // With two views that see behind 1 and none before it, 2 is the nearest stable one.
    assert_eq!(stable(&[1.0, 2.0, 2.0]), Some(2.0));
    assert_eq!(stable(&[1.0, 1.0, 2.0, 3.0]), Some(2.0));
    // Those within the tolerance are averaged and speak neither for nor against each other.
    assert_eq!(stable(&[2.0, 2.0078125, 2.0]).map(|depth| (depth * 384.0).round()), Some(769.0));
    // Nothing to choose from.
    assert_eq!(stable(&[0.0, 0.0]), None);
}

#[test]
fn the_most_confident_depth_must_outweigh_its_opponents() {
    let by_confidence = |depths: &[(f32, f32)]| {
        choose(depths, FusionMethod::VisibilityConfidence).map(|depth| (depth * 1e3).round() / 1e3)
    };
    assert_eq!(by_confidence(&[(2.0, 0.6)]), Some(2.0));
    assert_eq!(by_confidence(&[(2.0, 0.6), (3.0, 0.9)]), None);
    assert_eq!(by_confidence(&[(3.0, 0.7), (3.0, 0.75), (2.0, 0.6)]), Some(3.0));
    assert_eq!(by_confidence(&[(2.0, 0.9), (2.0, 0.6), (3.0, 0.7)]), Some(2.0));
    assert_eq!(by_confidence(&[(2.0, 0.9), (3.0, 0.6)]), None);
}
