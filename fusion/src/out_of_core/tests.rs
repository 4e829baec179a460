use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::analytic::{Surface, camera_at};
use crate::cloud::Point;

const VIEWS: u32 = 9;

fn map(view: ViewId) -> DepthMap {
    Surface::BallBeforePlane.map(camera_at(0.15 * view.0 as f64 - 0.6, 0.1, 40, 30))
}

fn work(scratch: &Path) -> Work {
    let near = |view: u32| (0..VIEWS).filter(move |n| *n != view && n.abs_diff(view) <= 3).map(ViewId);
    Work {
        // Not the order of the ids.
        views: (0..VIEWS).rev().map(|view| (ViewId(view), near(view).collect())).collect(),
        options: FilterOptions { min_views: 2, ..FilterOptions::default() },
        once_per_surface: true,
        memory_bytes: 1 << 30,
        scratch: scratch.to_owned(),
        fingerprint: "test".to_owned(),
    }
}

/// All points, in the order in which they are handed on, and how often maps were read.
fn run(work: &Work, load: &LoadMap<'_>) -> (Vec<(ViewId, Point)>, Fused, usize) {
    let loads = AtomicUsize::new(0);
    let counting = |view| {
        loads.fetch_add(1, Ordering::Relaxed);
        load(view)
    };
    let mut cloud = Vec::new();
    let mut steps = Vec::new();
    let fused = fuse_out_of_core(work, &counting, &mut |done| steps.push(done), &mut |view| {
        cloud.extend(view.points.iter().map(|point| (view.view, *point)));
        Ok(())
    });
    let fused = fused.expect("fused");
    assert!(steps.is_sorted(), "{steps:?}");
    (cloud, fused, loads.into_inner())
}

#[expect(clippy::unnecessary_wraps, reason = "it stands for a loader")]
fn good(view: ViewId) -> Result<DepthMap, LoadError> {
    Ok(map(view))
}

#[test]
fn memory_order_and_resumption_change_nothing() {
    let folder = tempfile::tempdir().expect("a folder");
    let work = work(&folder.path().join("a"));
    let (cloud, fused, loads) = run(&work, &good);
    assert_eq!(loads, VIEWS as usize, "with enough memory each map is read once");
    assert!(cloud.is_sorted_by_key(|(view, _)| *view));
    assert_eq!(fused.funnels.values().map(|funnel| funnel.emitted).sum::<u64>(), cloud.len() as u64);
    let kept: u64 = fused.funnels.values().map(|funnel| funnel.geometric).sum();
    assert!((cloud.len() as u64) * 3 < 2 * kept, "{} of {kept}", cloud.len());

    // Room for four maps only, another order.
    let mut small = Work { memory_bytes: 4 * 40 * 30 * 11, ..work.clone() };
    small.scratch = folder.path().join("b");
    small.views.sort();
    let (same, again, loads) = run(&small, &good);
    assert!(same == cloud && again == fused);
    // Along the views a window of seven maps moves, and each is still read once.
    assert_eq!(loads, VIEWS as usize);

    // Interrupted after some views: only what is missing is done again.
    for view in [2, 5] {
        fs::remove_file(small.scratch.join(format!("{view:08}.filtered"))).expect("removed");
    }
    let (same, again, loads) = run(&small, &good);
    assert!(same == cloud && again.resumed == 7 && loads < 15, "{loads}");

    // Another fingerprint: nothing is taken over.
    small.fingerprint = "other".to_owned();
    let (same, again, _) = run(&small, &good);
    assert!(same == cloud && again.resumed == 0);
}

#[test]
fn a_view_that_cannot_be_read_is_left_out_everywhere_and_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let work = work(&folder.path().join("a"));
    let bad = |view| if view == ViewId(4) { Err("truncated".into()) } else { good(view) };
    let (cloud, fused, _) = run(&work, &bad);
    assert_eq!(fused.skipped, BTreeMap::from([(ViewId(4), "truncated".to_owned())]));
    assert!(cloud.iter().all(|(view, _)| *view != ViewId(4)) && cloud.len() > 1000);
    // Bits stand for the neighbours of the view as it was given, the fourth of view 3 being 4.
    let seen = cloud.iter().filter(|(view, _)| *view == ViewId(3)).fold(0, |all, (_, p)| all | p.seen_by);
    assert_eq!(seen & 0b1000, 0);
    assert_ne!(seen & 0b10000, 0);
    assert!(seen < 1 << 6);
}

#[test]
fn damaged_scratch_files_are_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let work = work(&folder.path().join("a"));
    run(&work, &good);
    fs::write(work.scratch.join("00000003.filtered"), b"PSFILTR3").expect("written");
    let error = fuse_out_of_core(&work, &good, &mut |_| {}, &mut |_| Ok(())).expect_err("damaged");
    assert!(error.to_string().contains("00000003.filtered is damaged"), "{error}");
}
