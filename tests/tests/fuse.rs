//! `planesweep fuse` alone, on what `reconstruct` left and on folders of other networks.

use std::fs;
use std::path::Path;

use planesweep_tests::{Bench, courtyard, run};

#[test]
fn a_workspace_is_made_anew_but_never_goes_over_a_scene() {
    let bench = Bench::new(|folder| courtyard(folder, 4, 160, 128));
    let _ = bench.reconstruct("out", &[]).expect_code(0);
    let (scene, out) = (bench.scene(), bench.path("out"));
    let fuse = |maps: &str, cloud: &str, workspace: &str| {
        let options = ["--min-confidence", "0", "--min-views", "1"];
        run(["fuse", maps, "-o", cloud, "--workspace", workspace].iter().chain(&options))
    };
    let photograph = bench.read("scene/images/00000000.png");
    // The scene itself, a copy of it, and a dense workspace of COLMAP.
    let [copy, dense, cloud] = ["copy", "dense", "clouds/cloud.ply"].map(|name| bench.path(name));
    let _ = run(["convert", &scene, &copy, "--to", "colmap"]).expect_code(0);
    let _ = run(["convert", &scene, &dense, "--to", "colmap", "--undistort"]).expect_code(0);
    for used in [&scene, &copy, &dense, &out] {
        let refused = fuse(&out, &cloud, used).expect_code(2);
        assert!(refused.stderr.contains("for --workspace"), "{}", refused.stderr);
    }
    assert!(!Path::new(&cloud).exists());
    // The folder that both go to is made, and the same command again is welcome.
    let (workspace, inside) = (bench.path("made/workspace"), bench.path("made/workspace/fused.ply"));
    for _ in 0..2 {
        let _ = fuse(&out, &inside, &workspace).expect_code(0);
    }
    // A workspace that became a scene is no place for what is made of it.
    let reconstruct =
        ["reconstruct", &workspace, "-o", &bench.path("of-workspace"), "--weights", &bench.weights()];
    let easy = ["--min-confidence", "0", "--min-views", "1", "--views", "3", "--depths", "32"];
    let _ = run(reconstruct.iter().chain(&easy)).expect_code(0);
    let refused = fuse(&bench.path("of-workspace"), &cloud, &workspace).expect_code(2);
    assert!(refused.stderr.contains("over the scene"), "{}", refused.stderr);
    assert!(bench.read("scene/images/00000000.png") == photograph);
}

#[test]
fn a_result_is_fused_again_to_the_same_bytes() {
    let bench = Bench::new(|folder| courtyard(folder, 4, 160, 128));
    let _ = bench.reconstruct("out", &[]).expect_code(0);
    let (out, again, options) = (bench.path("out"), bench.path("again.ply"), ["--min-confidence", "0"]);
    let given = |more: &[&str]| {
        let fixed = ["fuse", &out, "-o", &again, "--json"];
        run(fixed.iter().chain(&options).chain(more)).expect_code(0).json()
    };
    let fused = given(&["--min-views", "1"]);
    let first = bench.read("again.ply");
    assert!(first == bench.read("out/cloud.ply"), "fused as it was when it was reconstructed");
    assert!(fused["points"].as_u64() > Some(500), "{fused}");
    assert!(!Path::new(&format!("{again}.parts")).exists(), "the scratch folder is gone");
    // Memory changes nothing.
    let _ = given(&["--min-views", "1", "--memory", "1M"]);
    assert!(bench.read("again.ply") == first);
    let every = given(&["--min-views", "1", "--every-view"]);
    assert!(every["points"].as_u64() >= fused["points"].as_u64());

    // The same maps as a folder of the MVSNet layout: photographs of the size of the maps.
    let folder = bench.path("mvsnet");
    for name in ["depth_est", "confidence", "images"] {
        fs::create_dir_all(format!("{folder}/{name}")).expect("made");
    }
    fs::create_dir_all(format!("{folder}/cams")).expect("made");
    fs::copy(format!("{out}/pair.txt"), format!("{folder}/pair.txt")).expect("copied");
    // COLMAP's ids count from 1, the names of the photographs from 0.
    for id in 1..=4 {
        let name = id - 1;
        let copy = |from: String, to: String| assert!(fs::copy(from, to).expect("copied") > 0);
        copy(format!("{out}/cams/{id:08}_cam.txt"), format!("{folder}/cams/{id:08}_cam.txt"));
        copy(format!("{out}/depth/{name:08}.pfm"), format!("{folder}/depth_est/{id:08}.pfm"));
        copy(format!("{out}/confidence/{name:08}.pfm"), format!("{folder}/confidence/{id:08}.pfm"));
        let image = image::RgbImage::from_pixel(40, 32, image::Rgb([9, 8, 7]));
        image.save(format!("{folder}/images/{id:08}.png")).expect("saved");
    }
    fs::write(format!("{folder}/depth_est/00000002.pfm"), b"Pf\n40 32\n-1\n").expect("written");
    let cloud = bench.path("cloud.laz");
    let fixed = ["fuse", &folder, "-o", &cloud, "--vis", "--min-views", "1", "--json"];
    let broken = run(fixed.iter().chain(&options)).expect_code(3).json();
    assert!(broken["skipped"]["00000002.png"].as_str().is_some(), "{broken}");
    assert_eq!(broken["views"].as_object().map(serde_json::Map::len), Some(3));
    let points = broken["points"].as_u64().expect("a number");
    assert_eq!(bench.read("cloud.laz.vis")[..8], points.to_le_bytes());
}
