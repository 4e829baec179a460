//! Small versions of what `examples/scale.rs` measures at full size.

#[path = "colmap2mvsnet/mod.rs"]
mod colmap2mvsnet;
#[path = "generated/mod.rs"]
mod generated;

use std::collections::BTreeMap;
use std::path::PathBuf;

use planesweep_plan::{BlobKey, PlanOptions, jobs, plan, rank_sources};
use planesweep_scene::{ReadOptions, Scene, read_scene};

use generated::Flight;

fn flight(side: u32, points_per_block: u64) -> Scene {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let flight = Flight { side, points_per_block };
    flight.write(folder.path()).expect("written");
    let scene = read_scene(folder.path(), &ReadOptions::default()).expect("read");
    assert_eq!((scene.views.len() as u64, scene.points.len() as u64), (flight.views(), flight.points()));
    let observations: usize = scene.points.iter().map(|(_, track)| track.len()).sum();
    assert_eq!(observations as u64, flight.observations());
    for (position, track) in scene.points.iter() {
        for id in track {
            let (pixel, depth) = scene.views[id].camera.project(position).expect("below the camera");
            assert!((-0.5..63.5).contains(&pixel.x) && (-0.5..47.5).contains(&pixel.y), "{pixel}");
            assert!((7.4..8.6).contains(&depth));
        }
    }
    scene
}

#[test]
fn a_generated_flight_is_planned_to_the_last_view() {
    let scene = flight(12, 40);
    let plan = plan(&scene, &PlanOptions::default());
    assert_eq!((plan.views.len(), plan.skipped.len()), (144, 0));
    assert!(plan.views.iter().all(|view| view.sources.len() == 4 && view.neighbours.len() >= 8));
    let hashes: BTreeMap<_, _> =
        scene.views.values().map(|view| (view.id, BlobKey::of(view.name.as_bytes()))).collect();
    let jobs = jobs(&scene, &plan, &hashes, BlobKey::of(b"weights")).expect("all views are known");
    assert_eq!(jobs.len(), 3 * 144 + 1);
}

/// Scores agree to rounding; where two sources differ by less than that, either may stand first.
fn assert_same_ranking(scene: &Scene) {
    let ours = rank_sources(scene, &scene.undistorted_cameras(), &BTreeMap::new());
    for (view, theirs) in colmap2mvsnet::rank(scene) {
        for ((source, score), ours) in theirs.iter().zip(&ours[&view]).take_while(|((_, s), _)| *s > 0.0) {
            assert!((ours.score - score).abs() <= 1e-6 * score, "{view}: {score} {ours:?}");
            let tied = theirs.iter().filter(|(_, s)| (s - score).abs() <= 1e-6 * score).count() > 1;
            assert!(tied || ours.view == *source, "{view}: {source} {score} {ours:?}");
        }
    }
}

#[test]
fn view_selection_ranks_as_colmap2mvsnet_does() {
    assert_same_ranking(&flight(6, 30));
    let data = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/colmap"));
    for name in ["sceaux", "bartoszek/dense/0"] {
        let folder = data.join(name);
        if folder.is_dir() {
            assert_same_ranking(&read_scene(&folder, &ReadOptions::default()).expect("a good scene"));
        } else {
            eprintln!("SKIPPED view_selection_ranks_as_colmap2mvsnet_does: colmap/{name} is not there");
        }
    }
}
