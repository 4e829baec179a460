//! Masks and full resolution, on the whole way from photographs to a cloud.

use std::fs;

use image::Luma;
use planesweep_fusion::read_ply;
use planesweep_scene::{
    Camera, DepthMap, Intrinsics, Raster, WorkingImage, read_depth_pfm, read_image, read_scene,
};
use planesweep_tests::{Bench, courtyard, plane, run};

const EXACT: [&str; 4] = ["--device", "analytic", "--min-views", "2"];

#[test]
fn masked_pixels_are_left_out() {
    let bench = Bench::new(|folder| drop(plane(folder, 4)));
    let open = bench.reconstruct("out", &EXACT).expect_code(0).json();
    // The left half of the first view.
    let masks = bench.path("masks");
    fs::create_dir_all(&masks).expect("made");
    let half = image::GrayImage::from_fn(160, 128, |x, _| Luma([if x < 80 { 0 } else { 255 }]));
    half.save(format!("{masks}/00000000.png")).expect("saved");
    let masked = ["--masks", &masks];
    let value = bench.reconstruct("out", &[&EXACT[..], &masked].concat()).expect_code(0).json();
    assert!(value["points"].as_u64() < open["points"].as_u64(), "{} {}", value["points"], open["points"]);
    let depth = read_depth_pfm(bench.path("out/depth/00000000.pfm").as_ref()).expect("a map");
    for x in 0..40 {
        assert_eq!(depth.at(x, 16) > 0.0, x >= 20, "column {x}");
    }
    let whole = read_depth_pfm(bench.path("out/depth/00000001.pfm").as_ref()).expect("a map");
    assert!(whole.values().iter().all(|depth| *depth > 0.0));
    let again = run([
        "fuse",
        &bench.path("out"),
        "-o",
        &bench.path("again.ply"),
        "--min-views",
        "2",
        "--min-confidence",
        "0",
    ]);
    let _ = again.expect_code(0);
    assert!(bench.read("again.ply") == bench.read("out/cloud.ply"));
}

#[test]
fn full_resolution_gives_a_point_for_each_pixel_of_the_photograph() {
    let bench = Bench::new(|folder| drop(plane(folder, 4)));
    let coarse = bench.reconstruct("coarse", &EXACT).expect_code(0).json();
    let full = [&EXACT[..], &["--full-resolution"]].concat();
    let fine = bench.reconstruct("fine", &full).expect_code(0).json();
    let (coarse, fine) = (coarse["points"].as_u64(), fine["points"].as_u64());
    assert!(fine.expect("a number") > 14 * coarse.expect("a number"), "{fine:?} for {coarse:?}");
    for point in read_ply(bench.path("fine/cloud.ply").as_ref()).expect("a cloud") {
        assert!((point.position[2] - 5.0).abs() < 0.06, "{:?}", point.position);
    }
    let depth = read_depth_pfm(bench.path("fine/depth/00000000.pfm").as_ref()).expect("a map");
    assert_eq!((depth.width(), depth.height()), (160, 128));
    // Again from the result, and from the coarse one.
    let common = ["--min-views", "2", "--min-confidence", "0"];
    let again = |folder: &str, more: &[&str]| {
        let (folder, out) = (bench.path(folder), bench.path("again.ply"));
        let given = ["fuse", &folder, "-o", &out, "--json"];
        let _ = run(given.iter().chain(&common).chain(more)).expect_code(0);
        bench.read("again.ply")
    };
    assert!(again("fine", &[]) == bench.read("fine/cloud.ply"));
    assert!(again("coarse", &["--full-resolution"]) == bench.read("fine/cloud.ply"));
}

/// Of a map of a quarter of the photograph: the share of pixels whose depth is neither that of the truth nor, within
/// four pixels, that of another surface; and the share that is not that of the truth.
fn flying_and_wrong(full: &Raster<f32>, truth: &Raster<f32>) -> (f64, f64) {
    let alike = |a: f32, b: f32| (a - b).abs() < 0.01 * b;
    let (mut flying, mut wrong, mut all) = (0, 0, 0);
    for y in 4..truth.height() - 8 {
        for x in 4..truth.width() - 8 {
            let (depth, true_depth) = (full.at(x, y), truth.at(x, y));
            if depth == 0.0 || true_depth == 0.0 {
                continue;
            }
            all += 1;
            let is_wrong = !alike(depth, true_depth);
            wrong += usize::from(is_wrong);
            let near = (y - 4..=y + 4).flat_map(|y| (x - 4..=x + 4).map(move |x| truth.at(x, y)));
            flying += usize::from(is_wrong && !near.into_iter().any(|other| alike(depth, other)));
        }
    }
    (flying as f64 / all as f64, wrong as f64 / all as f64)
}

#[test]
fn upsampled_edges_do_not_smear() {
    let folder = tempfile::tempdir().expect("a folder");
    courtyard(folder.path(), 2, 320, 240);
    let scene = read_scene(folder.path(), &planesweep_scene::ReadOptions::default()).expect("a scene");
    let view = scene.views.values().next().expect("a view");
    let truth = read_depth_pfm(&folder.path().join("depth_gt").join(&view.name).with_extension("pfm"))
        .expect("truth");
    let image = WorkingImage { camera: view.camera, pixels: read_image(&view.image).expect("a photograph") };
    let k: Intrinsics = view.camera.intrinsics.quartered();
    let (width, height) = (k.width as usize, k.height as usize);
    let depth = Raster::from_fn(width, height, |x, y| truth.at(4 * x, 4 * y));
    let camera = Camera { intrinsics: k, pose: view.camera.pose };
    let confidence = Raster::filled(width, height, 1.0);
    let map = DepthMap::new(camera, depth, confidence, image.map_colors(width, height)).expect("sizes agree");
    let full = map.upsampled(&image);
    let bilinear = Raster::from_fn(truth.width(), truth.height(), |x, y| {
        let (u, v) = (x as f32 / 4.0, y as f32 / 4.0);
        let (x, y) = ((u as usize).min(width - 2), (v as usize).min(height - 2));
        let (fx, fy) = (u - x as f32, v - y as f32);
        let row = |y| (1.0 - fx) * map.depth.at(x, y) + fx * map.depth.at(x + 1, y);
        (1.0 - fy) * row(y) + fy * row(y + 1)
    });
    let (joint, plain) = (flying_and_wrong(&full.depth, &truth), flying_and_wrong(&bilinear, &truth));
    eprintln!("flying and wrong, joint: {joint:?}, bilinear: {plain:?}");
    assert!(joint.0 < 0.05 * plain.0, "{joint:?} {plain:?}");
    // A pixel at an edge is on one of the two surfaces, not always on the right one.
    assert!(joint.1 < 1.25 * plain.1, "{joint:?} {plain:?}");
}
