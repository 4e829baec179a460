use nalgebra::{Point2, Point3, Rotation3, Vector3};
use planesweep_scene::Pose;
use proptest::prelude::*;

use super::*;
use crate::analytic::{Surface, camera_at, set_confidence};
use crate::options::DepthSampling;
use crate::surface::emitted_with;

const PLANE: Surface = Surface::Plane { slope: 0.2 };
const METHODS: [FusionMethod; 4] = [
    FusionMethod::Consistency,
    FusionMethod::Dynamic,
    FusionMethod::Visibility,
    FusionMethod::VisibilityConfidence,
];
const PLACES: [(f64, f64); 5] = [(0.0, 0.0), (0.4, 0.0), (-0.4, 0.1), (0.1, 0.4), (0.0, -0.3)];

fn maps(surface: Surface) -> Vec<DepthMap> {
    PLACES.iter().map(|(x, y)| surface.map(camera_at(*x, *y, 60, 44))).collect()
}

fn filter_first(maps: &[DepthMap], options: &FilterOptions) -> FilteredMap {
    filter(&maps[0], &maps[1..].iter().collect::<Vec<_>>(), options)
}

/// Where the pixel's surface point lands in a neighbour, in pixels, and its depth there.
fn project(reference: &DepthMap, x: usize, y: usize, to: &Camera) -> Option<(Point2<f64>, f64)> {
    let depth = reference.depth.at(x, y);
    let point = reference.camera.unproject(&Point2::new(x as f64, y as f64), depth as f64);
    (depth > 0.0).then(|| to.project(&point)).flatten()
}

/// Whether bilinear sampling at a position reads nothing from outside.
fn inside(pixel: &Point2<f64>, map: &DepthMap) -> bool {
    let (right, bottom) = ((map.width() - 1) as f64, (map.height() - 1) as f64);
    pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < right && pixel.y < bottom
}

fn pixels(map: &DepthMap) -> impl Iterator<Item = (usize, usize)> + use<> {
    let width = map.width();
    (0..map.height()).flat_map(move |y| (0..width).map(move |x| (x, y)))
}

#[test]
fn a_plane_is_kept_where_enough_views_see_it() {
    let maps = maps(PLANE);
    let filtered = filter_first(&maps, &FilterOptions::default());
    let mut seen_by_all = 0;
    for (x, y) in pixels(&maps[0]) {
        let sees = |map: &&DepthMap| {
            project(&maps[0], x, y, &map.camera).is_some_and(|(pixel, _)| inside(&pixel, map))
        };
        let views = 1 + maps[1..].iter().filter(sees).count();
        seen_by_all += usize::from(views == 5);
        // Within a pixel outside of the border the weight of a zero may still be harmless.
        let counted = filtered.views.at(x, y) as usize;
        assert!(counted >= views && counted <= 5, "{counted} of {views} at {x}, {y}");
        let (depth, truth) = (filtered.depth.at(x, y), maps[0].depth.at(x, y));
        assert_eq!(depth > 0.0, counted >= 3);
        if views >= 3 && counted == views {
            assert!((depth - truth).abs() < 1e-3 * truth, "{depth} for {truth}");
            let (mean, own) = (filtered.color.at(x, y), maps[0].color.at(x, y));
            assert!(mean.iter().zip(own).all(|(a, b)| a.abs_diff(b) <= 2), "{mean:?} for {own:?}");
        }
    }
    assert!(seen_by_all > 1000);
}

#[test]
fn wrong_depths_are_dropped_where_they_are_and_harmless_elsewhere() {
    let mut maps = maps(PLANE);
    let good = filter_first(&maps, &FilterOptions::default());
    // The reference is wrong in a block, one neighbour everywhere.
    let width = maps[0].width();
    let block = |x: usize, y: usize| (25..35).contains(&x) && (18..26).contains(&y);
    for (i, depth) in maps[0].depth.values_mut().iter_mut().enumerate() {
        if block(i % width, i / width) {
            *depth *= 1.05;
        }
    }
    maps[2].depth.values_mut().iter_mut().for_each(|depth| *depth *= 0.9);
    let filtered = filter_first(&maps, &FilterOptions::default());
    for (x, y) in pixels(&maps[0]) {
        if block(x, y) {
            assert_eq!((filtered.depth.at(x, y), filtered.color.at(x, y)), (0.0, [0; 4]));
        } else if (14..46).contains(&x) && (12..32).contains(&y) {
            assert_eq!(good.views.at(x, y), 5);
            assert_eq!(filtered.views.at(x, y), 4);
            assert!((filtered.depth.at(x, y) - good.depth.at(x, y)).abs() < 1e-3);
        }
    }
}

#[test]
fn what_a_neighbour_does_not_see_it_does_not_confirm() {
    let surface = Surface::BallBeforePlane;
    let maps = maps(surface);
    let mut hidden = 0;
    for neighbour in &maps[1..] {
        let filtered = filter(&maps[0], &[neighbour], &FilterOptions::default());
        for (x, y) in pixels(&maps[0]) {
            let Some((pixel, depth)) = project(&maps[0], x, y, &neighbour.camera) else { continue };
            let seen = surface.depth(&neighbour.camera, &pixel);
            if inside(&pixel, neighbour) && seen < 0.9 * depth {
                hidden += 1;
                assert_eq!(filtered.views.at(x, y), 1, "hidden, yet confirmed at {x}, {y}");
            }
        }
    }
    assert!(hidden > 50, "{hidden} pixels hidden");
}

#[test]
fn a_neighbour_that_looks_away_or_sees_nothing_confirms_nothing() {
    let reference = PLANE.map(camera_at(0.0, 0.0, 20, 16));
    let mut away = reference.clone();
    let centre = away.camera.pose.centre();
    away.camera.pose = Pose::look_at(&centre, &Point3::new(0.0, 0.0, -9.0), &-Vector3::y());
    let mut empty = reference.clone();
    empty.depth = Raster::filled(20, 16, 0.0);
    let filtered = filter(&reference, &[&away, &empty], &FilterOptions::default());
    assert!(filtered.views.values().iter().all(|views| *views == 1));
    let funnel = Funnel { pixels: 320, with_depth: 320, photometric: 320, visible: 320, ..Funnel::default() };
    assert_eq!(filtered.funnel, funnel);
}

#[test]
fn without_a_baseline_every_view_agrees() {
    let reference = PLANE.map(camera_at(0.3, 0.2, 20, 16));
    let filtered = filter(&reference, &[&reference, &reference], &FilterOptions::default());
    for (depth, truth) in filtered.depth.values().iter().zip(reference.depth.values()) {
        assert!((depth - truth).abs() < 1e-5 * truth);
    }
    assert_eq!(filtered.color, reference.color);
    assert_eq!(filtered.funnel.geometric, 320);
}

#[test]
fn continuous_sampling_confirms_beside_holes() {
    let reference = PLANE.map(camera_at(0.0, 0.0, 40, 30));
    let mut holes = PLANE.map(camera_at(0.2, 0.1, 40, 30));
    holes.depth.values_mut().iter_mut().step_by(3).for_each(|depth| *depth = 0.0);
    let with = |sampling| {
        let options = FilterOptions { min_views: 2, sampling, ..FilterOptions::default() };
        filter(&reference, &[&holes], &options).funnel.geometric
    };
    let (plain, continuous) = (with(DepthSampling::Bilinear), with(DepthSampling::Continuous));
    assert!(continuous > 600 && continuous > 3 * plain, "{plain} and {continuous}");
}

/// A noisy map of the plane with holes, doubtful pixels and depths of no surface.
fn noisy_map(camera: Camera, noise: &[(f32, f32)]) -> DepthMap {
    let mut map = PLANE.map(camera);
    let width = map.width();
    for (index, (step, sure)) in (0..map.depth.values().len()).zip(noise.iter().cycle()) {
        set_confidence(&mut map, index % width, index / width, *sure);
        let depth = &mut map.depth.values_mut()[index];
        *depth *= match *step {
            s if s < -0.9 => 0.0,
            s if s > 0.9 => 3.0,
            s => 1.0 + 0.012 * s,
        };
    }
    map
}

prop_compose! {
    fn scene()(
        places in prop::collection::vec((-0.8..0.8_f64, -0.8..0.8_f64), 1..6),
        noise in prop::collection::vec((-1.0..1.0_f32, 0.5..1.0_f32), 1000),
    ) -> Vec<DepthMap> {
        let map = |(k, (x, y)): (usize, &(f64, f64))| {
            noisy_map(camera_at(*x, *y, 36 + 3 * k as u32, 18), &noise[37 * k..])
        };
        places.iter().enumerate().map(map).collect()
    }
}

/// What a view that agrees has for a hypothesis.
struct Agreeing {
    depth: f64,
    color: [u8; 4],
}

/// The criterion in `f64`, word for word: the views that agree, by index; `None` when a threshold is so close that
/// rounding decides.
fn agreeing(
    maps: &[DepthMap],
    x: usize,
    y: usize,
    options: &FilterOptions,
) -> Option<Vec<(usize, Agreeing)>> {
    let d = maps[0].depth.at(x, y) as f64;
    let p = Point2::new(x as f64, y as f64);
    let of = |map: &DepthMap, depth: f64, x: usize, y: usize| Agreeing { depth, color: map.color.at(x, y) };
    let mut views = vec![(0, of(&maps[0], d, x, y))];
    for (index, map) in maps.iter().enumerate().skip(1) {
        let Some((q, _)) = map.camera.project(&maps[0].camera.unproject(&p, d)) else { continue };
        let (x0, y0) = (q.x.floor(), q.y.floor());
        let at = |x: f64, y: f64| {
            let within = x >= 0.0 && y >= 0.0;
            let depth = if within { map.depth.get(x as usize, y as usize) } else { None };
            depth.unwrap_or(0.0) as f64
        };
        let (fx, fy) = (q.x - x0, q.y - y0);
        let sampled = (1.0 - fx) * (1.0 - fy) * at(x0, y0)
            + fx * (1.0 - fy) * at(x0 + 1.0, y0)
            + (1.0 - fx) * fy * at(x0, y0 + 1.0)
            + fx * fy * at(x0 + 1.0, y0 + 1.0);
        if sampled <= 0.0 {
            continue;
        }
        let back = map.camera.unproject(&q, sampled);
        let Some((r, depth)) = maps[0].camera.project(&back) else { continue };
        let (distance, relative) = ((r - p).norm(), (depth - d).abs() / d);
        let (most_px, most) = (options.max_reprojection_px as f64, options.max_relative_depth as f64);
        let nearest = |position: f64, size: usize| (position.round().max(0.0) as usize).min(size - 1);
        let borderline = (distance - most_px).abs() < 1e-3
            || (relative - most).abs() < 1e-5
            || (fx - 0.5).abs() < 1e-3
            || (fy - 0.5).abs() < 1e-3;
        if borderline {
            return None;
        }
        if distance < most_px && relative < most {
            views.push((index, of(map, depth, nearest(q.x, map.width()), nearest(q.y, map.height()))));
        }
    }
    Some(views)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_filter_equals_its_plain_twin(maps in scene(), min_views in 1..5_u32) {
        let options = FilterOptions { min_views, ..FilterOptions::default() };
        let filtered = filter_first(&maps, &options);
        let mut compared = 0;
        let mut confident = 0;
        for (x, y) in pixels(&maps[0]) {
            if maps[0].depth.at(x, y) <= 0.0 || maps[0].confidence.at(x, y) < options.min_confidence {
                prop_assert_eq!((filtered.views.at(x, y), filtered.depth.at(x, y)), (0, 0.0));
                continue;
            }
            confident += 1;
            let Some(views) = agreeing(&maps, x, y, &options) else { continue };
            compared += 1;
            prop_assert_eq!(filtered.views.at(x, y) as usize, views.len());
            let depth = filtered.depth.at(x, y) as f64;
            if views.len() < min_views as usize {
                prop_assert_eq!((depth, filtered.color.at(x, y), filtered.agreeing.at(x, y)), (0.0, [0; 4], 0));
                continue;
            }
            let mean = |of: &dyn Fn(&Agreeing) -> f64| {
                views.iter().map(|(_, view)| of(view)).sum::<f64>() / views.len() as f64
            };
            let mean_depth = mean(&|view| view.depth);
            prop_assert!((depth - mean_depth).abs() < 1e-5 * mean_depth, "{} for {}", depth, mean_depth);
            let depths = || views.iter().map(|(_, view)| view.depth);
            let (least, most) = (depths().fold(f64::INFINITY, f64::min), depths().fold(0.0, f64::max));
            prop_assert!((least * 0.999999..=most * 1.000001).contains(&depth));
            for (channel, value) in filtered.color.at(x, y).into_iter().enumerate() {
                let mean = mean(&|view| view.color[channel].into());
                prop_assert!((value as f64 - mean).abs() <= 0.501, "{} for {}", value, mean);
            }
            let agreeing = views.iter().skip(1).fold(0, |bits, (index, _)| bits | 1 << (index - 1));
            prop_assert_eq!(filtered.agreeing.at(x, y), agreeing);
        }
        prop_assert!(compared * 10 >= confident * 9, "{} of {} compared", compared, confident);
    }

    #[test]
    fn funnels_count_the_pixels(maps in scene(), min_views in 0..5_u32) {
        let options = FilterOptions { min_views, ..FilterOptions::default() };
        let filtered = filter_first(&maps, &options);
        let count = |holds: &dyn Fn(usize, usize) -> bool| {
            pixels(&maps[0]).filter(|(x, y)| holds(*x, *y)).count() as u64
        };
        prop_assert_eq!(filtered.funnel, Funnel {
            pixels: maps[0].depth.values().len() as u64,
            with_depth: count(&|x, y| maps[0].depth.at(x, y) > 0.0),
            photometric: count(&|x, y| filtered.views.at(x, y) > 0),
            visible: count(&|x, y| filtered.views.at(x, y) > 0),
            geometric: count(&|x, y| filtered.depth.at(x, y) > 0.0),
            emitted: 0,
        });
    }

    /// Cameras anywhere, even of no sense: no panic, no NaN.
    #[test]
    fn any_cameras_give_finite_depths(
        numbers in prop::collection::vec(prop_oneof![
            -10.0..10.0_f64,
            Just(0.0),
            Just(1e30),
            Just(-1e-30),
            Just(f64::NAN),
            Just(f64::INFINITY)
        ], 36),
        depths in prop::collection::vec(prop_oneof![0.0..9.0_f32, Just(1e30_f32), Just(1e-30_f32)], 80),
        continuous in any::<bool>(),
        method in prop::sample::select(&METHODS),
    ) {
        let map = |n: &[f64]| {
            let mut map = PLANE.map(camera_at(0.0, 0.0, 10, 8));
            let k = &mut map.camera.intrinsics;
            (k.fx, k.fy, k.skew, k.cx, k.cy) = (n[0], n[1], n[2], n[3], n[4]);
            map.camera.pose.rotation.iter_mut().zip(&n[5..]).for_each(|(r, n)| *r = *n);
            map.camera.pose.translation.iter_mut().zip(&n[14..]).for_each(|(t, n)| *t = *n);
            map.depth.values_mut().copy_from_slice(&depths);
            map
        };
        let sane = PLANE.map(camera_at(0.1, 0.1, 10, 8));
        let (first, second) = (map(&numbers[..18]), map(&numbers[18..]));
        let sampling = if continuous { DepthSampling::Continuous } else { DepthSampling::Bilinear };
        let options = FilterOptions { method, min_views: 1, sampling, ..FilterOptions::default() };
        let options_of_one = FilterOptions { min_views: 1, ..FilterOptions::default() };
        let alone = [&first, &second, &sane].map(|map| filter(map, &[], &options_of_one));
        let emissions = Level::available().into_iter().map(|level| {
            [0, 2].map(|map| emitted_with(level, &alone[map], &[&alone[1], &alone[2 - map]], 0.01))
        });
        let emissions: Vec<_> = emissions.collect();
        prop_assert!(emissions.iter().all(|emitted| *emitted == emissions[0]));
        for (reference, neighbours) in [(&first, [&second, &sane]), (&sane, [&first, &second])] {
            let filtered = filter(reference, &neighbours, &options);
            prop_assert!(filtered.depth.values().iter().all(|d| d.is_finite() && *d >= 0.0));
            for level in Level::available() {
                let other = filter_with(level, reference, &neighbours, &options);
                // Not the cameras, which may not equal themselves.
                prop_assert!(other.depth == filtered.depth && other.color == filtered.color, "{:?}", level);
                prop_assert!(other.owns == filtered.owns && other.views == filtered.views);
                prop_assert!(other.agreeing == filtered.agreeing);
            }
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let noise: Vec<_> = (0..997).map(|i| ((i as f32 * 0.7).sin(), 0.75 + (i as f32).cos() / 4.0)).collect();
    let maps: Vec<_> = PLACES.iter().map(|(x, y)| noisy_map(camera_at(*x, *y, 61, 43), &noise)).collect();
    for method in METHODS {
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| filter_first(&maps, &FilterOptions { method, ..FilterOptions::default() }))
        };
        let one = with(1);
        let Funnel { photometric, geometric, .. } = one.funnel;
        assert!(geometric > 10 && geometric < photometric, "{method:?}: {geometric} of {photometric}");
        assert_eq!(one, with(2));
    }
}

#[test]
fn wider_registers_change_no_bit() {
    let noise: Vec<_> = (0..991).map(|i| ((i as f32 * 0.3).sin(), 0.75 + (i as f32).sin() / 4.0)).collect();
    // Far apart, so that neighbours see parts only; the last ones have rows of no use to vectors.
    let places = PLACES.iter().chain(&[(2.0, 0.3), (-0.3, 1.7)]).zip([61, 61, 33, 80, 61, 61, 2]);
    let mut maps: Vec<_> =
        places.map(|((x, y), width)| noisy_map(camera_at(*x, *y, width, 43), &noise)).collect();
    maps.push(maps[0].clone());
    let empty = maps.last_mut().expect("it was pushed");
    empty.depth = Raster::filled(0, 0, 0.0);
    empty.confidence = Raster::filled(0, 0, 0.0);
    empty.color = Raster::filled(0, 0, [0; 4]);
    maps.extend([(1, 1), (1, 9), (9, 1)].map(|(w, h)| noisy_map(camera_at(0.2, 0.1, w, h), &noise)));
    // Rolled, so that rows of the reference lie across theirs in every way.
    maps.extend([0.05, 0.2, 1.6, 3.1, 4.7].map(|roll| {
        let mut camera = camera_at(0.3, -0.2, 70, 50);
        let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), roll).into_inner();
        camera.pose.rotation = rotation * camera.pose.rotation;
        camera.pose.translation = rotation * camera.pose.translation;
        noisy_map(camera, &noise)
    }));
    let neighbours: Vec<_> = maps[1..].iter().collect();
    for (method, sampling) in METHODS.into_iter().flat_map(|method| {
        [DepthSampling::Bilinear, DepthSampling::Continuous].map(|sampling| (method, sampling))
    }) {
        let options = FilterOptions { method, sampling, min_views: 2, ..FilterOptions::default() };
        let dispatched = filter_first(&maps, &options);
        for level in Level::available() {
            assert!(
                filter_with(level, &maps[0], &neighbours, &options) == dispatched,
                "{level:?}, {method:?}"
            );
        }
        assert!(dispatched.funnel.geometric > 100, "{method:?}");
    }
}

#[test]
fn of_hundreds_of_neighbours_all_are_averaged_and_the_first_are_named() {
    let reference = PLANE.map(camera_at(0.3, 0.2, 40, 30));
    let mut blind = reference.clone();
    blind.depth = Raster::filled(40, 30, 0.0);
    let sees = |k: u32| k % 3 != 1;
    let neighbours: Vec<_> = (0..450).map(|k| if sees(k) { &reference } else { &blind }).collect();
    let named = (0..64).filter(|k| sees(*k)).map(|k| 1 << k).sum();
    for level in Level::available() {
        let filtered = filter_with(level, &reference, &neighbours, &FilterOptions::default());
        assert_eq!(filtered.views, Raster::filled(40, 30, 255), "{level:?}");
        assert_eq!(filtered.agreeing, Raster::filled(40, 30, named), "{level:?}");
        assert_eq!(filtered.color, reference.color, "{level:?}");
    }
}

#[test]
fn maps_about_as_large_as_a_window_change_no_bit() {
    let noise: Vec<_> = (0..991).map(|i| ((i as f32 * 0.3).sin(), 0.75 + (i as f32).sin() / 4.0)).collect();
    let map = |x, (width, height)| noisy_map(camera_at(x, 0.1, width, height), &noise);
    let sizes = [(32, 4), (31, 4), (32, 3), (33, 5), (20, 30), (64, 4)];
    let neighbours: Vec<_> = sizes.into_iter().map(|size| map(0.1, size)).collect();
    let neighbours: Vec<_> = neighbours.iter().collect();
    for (width, min_views) in
        [1, 2, 20, 31, 32, 33, 40].into_iter().flat_map(|width| [(width, 0), (width, 2)])
    {
        let reference = map(0.0, (width, 6));
        let options = FilterOptions { min_views, ..FilterOptions::default() };
        let best = filter(&reference, &neighbours, &options);
        for level in Level::available() {
            let filtered = filter_with(level, &reference, &neighbours, &options);
            assert!(filtered == best, "{level:?}, {width} columns, {min_views} views");
        }
        assert!(best.funnel.geometric > 0 || width < 20);
    }
}

#[test]
#[should_panic(expected = "colours of a map")]
fn a_reference_with_rasters_of_two_sizes_is_refused() {
    let mut map = PLANE.map(camera_at(0.0, 0.0, 40, 8));
    map.color = Raster::filled(0, 8, [0; 4]);
    filter(&map, &[], &FilterOptions { min_views: 1, ..FilterOptions::default() });
}
