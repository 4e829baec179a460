//! Fusion of more than fits into memory. The large ones are for `make slow`.

use std::fs::{self, File};
use std::io::Write;
use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, Scene, SourceScore, View, ViewId, write_mvsnet,
};
use planesweep_tests::Running;

const WIDTH: u32 = 480;
const HEIGHT: u32 = 264;

/// A row of cameras along the wall z = 5, each `step` pixels of the wall from the next, and their exact depth maps of
/// 480 x 264 in the MVSNet layout. All views share one photograph and one depth map.
fn wall(folder: &Path, views: u32, step: f64) {
    let (images, maps) = (folder.join("images"), folder.join("depth_est"));
    fs::create_dir_all(&images).expect("made");
    fs::create_dir_all(&maps).expect("made");
    let photograph = folder.join("photograph.png");
    image::RgbImage::from_fn(WIDTH, HEIGHT, |x, y| image::Rgb([x as u8, y as u8, 9]))
        .save(&photograph)
        .expect("saved");
    let map = folder.join("map.pfm");
    let mut file = File::create(&map).expect("made");
    write!(file, "Pf\n{WIDTH} {HEIGHT}\n-1\n").expect("written");
    file.write_all(&5.0_f32.to_le_bytes().repeat((WIDTH * HEIGHT) as usize)).expect("written");
    let intrinsics =
        Intrinsics { width: WIDTH, height: HEIGHT, fx: 400.0, fy: 400.0, skew: 0.0, cx: 239.5, cy: 131.5 };
    let mut scene = Scene::default();
    for k in 0..views {
        let name = format!("{k:08}.png");
        fs::hard_link(&photograph, images.join(&name)).expect("linked");
        fs::hard_link(&map, maps.join(format!("{k:08}.pfm"))).expect("linked");
        let translation = Vector3::new(-step / 80.0 * f64::from(k), 0.0, 0.0);
        let pose = Pose { rotation: Matrix3::identity(), translation };
        let view = View {
            id: ViewId(k),
            image: images.join(&name),
            name,
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: Some(DepthRange { min: 4.0, max: 6.0, count: Some(16) }),
        };
        scene.views.insert(view.id, view);
        let near = (k.saturating_sub(5)..(k + 6).min(views)).filter(|other| *other != k);
        let scored = near
            .map(|other| SourceScore { view: ViewId(other), score: 100.0 - f64::from(other.abs_diff(k)) });
        scene.pairs.insert(ViewId(k), scored.collect());
    }
    write_mvsnet(&scene, folder).expect("written");
}

/// Fuses the wall within a budget; returns how many points it has, and the most memory that the process held, in MiB.
fn fuse(folder: &Path, views: u32, step: f64, memory_mib: u64) -> (u64, u64) {
    wall(folder, views, step);
    let text = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let (dir, out, memory) = (text(folder), text(&folder.join("cloud.ply")), format!("{memory_mib}M"));
    let given = ["fuse", &dir, "-o", &out, "--memory", &memory, "--json"];
    let mut running = Running::start(given);
    let mut peak_kib = 0;
    while running.is_running() {
        // It only grows, and is gone with the process.
        let status = fs::read_to_string(format!("/proc/{}/status", running.pid())).unwrap_or_default();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.trim().trim_end_matches(" kB").parse().ok());
        peak_kib = peak_kib.max(kib.unwrap_or(0));
        sleep(Duration::from_millis(20));
    }
    let value = running.wait().expect_code(0).json();
    let points = value["points"].as_u64().expect("a number");
    let bytes = fs::metadata(folder.join("cloud.ply")).expect("a cloud").len();
    assert!(bytes > 27 * points, "{bytes} bytes of {points} points");
    eprintln!(
        "{views} views, {points} points, {} MiB of {memory_mib}, {} s",
        peak_kib / 1024,
        value["seconds"]
    );
    assert!(peak_kib > 0, "the process was never seen");
    (points, peak_kib / 1024)
}

#[test]
fn memory_stays_within_the_budget() {
    let folder = tempfile::tempdir().expect("a folder");
    // Maps and filtered maps of all views need 120 times 3.5 MiB.
    let (points, peak) = fuse(folder.path(), 120, 80.0, 224);
    assert!(peak <= 224, "{peak} MiB");
    // Each view adds 80 columns of 264 pixels to the wall.
    assert!((2_000_000..3_500_000).contains(&points), "{points}");
}

#[test]
#[ignore = "slow: minutes, and 6 GB of disk; run by `make slow`"]
fn two_thousand_maps_stay_within_512_mib() {
    let folder = tempfile::tempdir().expect("a folder");
    let (points, peak) = fuse(folder.path(), 2000, 80.0, 512);
    assert!(peak <= 512, "{peak} MiB");
    assert!(points > 40_000_000, "{points}");
}

#[test]
#[ignore = "slow: minutes, and 6 GB of disk; run by `make slow`"]
fn a_cloud_of_a_hundred_million_points_is_streamed() {
    let folder = tempfile::tempdir().expect("a folder");
    // Sixty views see a place, and only five on either side are asked whether they emit it.
    let (points, peak) = fuse(folder.path(), 1100, 8.0, 256);
    assert!(points > 100_000_000, "{points}");
    assert!(peak <= 256, "{peak} MiB");
}
