//! Scenes and weights that are damaged or hostile: the program names what is wrong, and does what can be done.

use std::fs;
use std::path::Path;

use image::{ColorType, ImageEncoder, RgbImage, codecs::jpeg::JpegEncoder};
use planesweep_tests::{Bench, Finished, courtyard, plane, run};

const ANALYTIC: [&str; 4] = ["--device", "analytic", "--workers", "1"];

fn of_plane(views: u32) -> Bench {
    Bench::new(|folder| drop(plane(folder, views)))
}

/// Replaces the image of a view.
fn replace_image(bench: &Bench, stem: &str, extension: &str, bytes: &[u8]) {
    fs::remove_file(bench.path(&format!("scene/images/{stem}.png"))).expect("it was there");
    fs::write(bench.path(&format!("scene/images/{stem}.{extension}")), bytes).expect("written");
}

fn jpeg(width: u32, height: u32) -> Vec<u8> {
    let image = RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * y) as u8, x as u8, y as u8]));
    let mut bytes = Vec::new();
    JpegEncoder::new(&mut bytes).write_image(&image, width, height, ColorType::Rgb8.into()).expect("encoded");
    bytes
}

/// The views that a run left out, each with the reason.
fn skipped(run: &Finished) -> Vec<(String, String)> {
    let value = run.json();
    let views = value["skipped"].as_array().expect("a list").clone();
    let text = |value: &serde_json::Value| value.as_str().expect("text").to_owned();
    views.iter().map(|view| (text(&view["view"]), text(&view["reason"]))).collect()
}

#[test]
fn a_truncated_photograph_is_left_out_and_named() {
    let bench = of_plane(5);
    let bytes = jpeg(160, 128);
    replace_image(&bench, "00000002", "jpg", &bytes[..bytes.len() / 2]);
    let run = bench.reconstruct("out", &ANALYTIC).expect_code(3);
    let left_out = skipped(&run);
    assert_eq!(left_out.len(), 1, "{left_out:?}");
    assert_eq!(left_out[0].0, "00000002.jpg");
    assert!(left_out[0].1.contains("truncated"), "{left_out:?}");
    // Neither a reference nor a source.
    let record: serde_json::Value = serde_json::from_slice(&bench.read("out/run.json")).expect("JSON");
    let views = record["views"].as_array().expect("a list");
    assert_eq!(views.len(), 4);
    for view in views {
        let sources = view["sources"].as_array().expect("a list");
        assert!(!sources.is_empty() && sources.iter().all(|id| id != 2), "{view}");
    }
}

#[test]
fn a_header_of_ten_gigabytes_is_refused_before_memory_is_taken() {
    let bench = of_plane(4);
    let mut bytes = jpeg(16, 16);
    let frame = bytes.windows(2).position(|marker| marker == [0xff, 0xc0]).expect("a baseline frame");
    // Marker, length and precision, then rows and columns.
    bytes[frame + 5..frame + 9].copy_from_slice(&[0xea, 0x60, 0xea, 0x60]);
    replace_image(&bench, "00000001", "jpg", &bytes);
    let run = run(["inspect", &bench.scene(), "--json"]).expect_code(3);
    let left_out = skipped(&run);
    assert_eq!(left_out.len(), 1, "{left_out:?}");
    assert_eq!(left_out[0].0, "00000001.jpg");
    assert!(left_out[0].1.contains("60000x60000"), "{left_out:?}");
}

#[test]
fn an_impossible_pose_is_refused_with_view_and_field_or_left_out() {
    let bench = of_plane(4);
    let path = bench.path("scene/cams/00000003_cam.txt");
    let text = fs::read_to_string(&path).expect("a camera");
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let (rotation, _) = lines[1].rsplit_once(' ').expect("four numbers");
    lines[1] = format!("{rotation} NaN");
    fs::write(&path, lines.join("\n")).expect("written");

    let refused = bench.reconstruct("out", &ANALYTIC).expect_code(1);
    for part in ["00000003", "translation", "--skip-bad-views"] {
        assert!(refused.stderr.contains(part), "{part}: {}", refused.stderr);
    }
    let more: Vec<&str> = ANALYTIC.into_iter().chain(["--skip-bad-views"]).collect();
    let left_out = skipped(&bench.reconstruct("out", &more).expect_code(3));
    assert_eq!(left_out.len(), 1, "{left_out:?}");
    assert!(left_out[0].0.contains("00000003") && left_out[0].1.contains("translation"), "{left_out:?}");
}

#[test]
fn a_view_that_sees_something_else_is_isolated() {
    let bench = of_plane(5);
    // It looks the other way, so its frustum meets no other.
    let path = bench.path("scene/cams/00000004_cam.txt");
    let text = fs::read_to_string(&path).expect("a camera");
    let turned = "extrinsic\n-1 0 0 900\n0 1 0 900\n0 0 -1 -900\n0 0 0 1\n";
    let (_, intrinsic) = text.split_once("\n\n").expect("two blocks");
    fs::write(&path, format!("{turned}\n{intrinsic}")).expect("written");
    let left_out = skipped(&bench.reconstruct("out", &ANALYTIC).expect_code(3));
    assert_eq!(left_out.len(), 1, "{left_out:?}");
    assert_eq!(left_out[0].0, "00000004.png");
}

#[test]
fn weights_that_are_none_are_refused_by_name_and_run_no_code() {
    let bench = of_plane(3);
    let good = fs::read(bench.weights()).expect("weights");
    let canary = bench.path("canary");
    // What pickle.dumps gives of an object whose __reduce__ returns (os.system, ("touch canary",)).
    let code = format!("cos\nsystem\n(S'touch {canary}'\ntR.");
    let cases: [(&str, Vec<u8>); 4] = [
        ("text.safetensors", b"no weights at all".to_vec()),
        ("truncated.safetensors", good[..good.len() / 2].to_vec()),
        ("huge.safetensors", [u64::MAX.to_le_bytes().as_slice(), b"{}"].concat()),
        ("code.ckpt", code.into_bytes()),
    ];
    for (name, bytes) in cases {
        let file = bench.path(name);
        fs::write(&file, bytes).expect("written");
        let (scene, out) = (bench.scene(), bench.path("out"));
        let used = run(["reconstruct", &scene, "-o", &out, "--weights", &file, "--json"]).expect_code(1);
        assert!(used.json()["error"].as_str().is_some_and(|e| e.contains(name)), "{name}: {}", used.stdout);
        let imported = bench.path("imported.safetensors");
        let import = run(["weights", "import", &file, "-o", &imported]).expect_code(1);
        assert!(import.stderr.contains(name), "{name}: {}", import.stderr);
        assert!(!Path::new(&imported).exists() && !Path::new(&canary).exists(), "{name}");
    }
}

#[test]
fn an_empty_cloud_names_the_step_that_emptied_it() {
    let bench = of_plane(4);
    // The plane is at 5, the network may only look further.
    let beyond: Vec<&str> = ANALYTIC.into_iter().chain(["--depth-range", "7,9"]).collect();
    let nothing = bench.reconstruct("beyond", &beyond).expect_code(1);
    assert!(nothing.stderr.contains("there is no cloud"), "{}", nothing.stderr);
    // Four views, and five must agree.
    let strict: Vec<&str> = ANALYTIC.into_iter().chain(["--min-views", "5"]).collect();
    let disagreeing = bench.reconstruct("strict", &strict).expect_code(1);
    assert!(disagreeing.stderr.contains("geometric"), "{}", disagreeing.stderr);
    for out in ["beyond", "strict"] {
        assert!(!Path::new(&bench.path(&format!("{out}/cloud.ply"))).exists());
        // What there is can be looked at.
        assert!(Path::new(&bench.path(&format!("{out}/preview/00000000.png"))).exists());
    }
}

#[test]
fn names_that_lead_out_of_the_scene_are_refused() {
    let bench = Bench::new(|folder| courtyard(folder, 4, 64, 64));
    fs::copy(bench.path("scene/images/00000001.png"), bench.path("scene/secret1.p")).expect("copied");
    let model = bench.path("scene/sparse/images.bin");
    let mut bytes = fs::read(&model).expect("a model");
    let (old, new) = (b"00000001.png", b"../secret1.p");
    let at = bytes.windows(old.len()).position(|window| window == old).expect("the name");
    bytes[at..at + new.len()].copy_from_slice(new);
    fs::write(&model, bytes).expect("written");
    let refused = bench.reconstruct("out", &ANALYTIC).expect_code(1);
    assert!(refused.stderr.contains("../secret1.p"), "{}", refused.stderr);
    let inspect = ["inspect", &bench.scene(), "--json", "--skip-bad-views"];
    let left_out = skipped(&run(inspect).expect_code(3));
    assert_eq!(left_out.len(), 1, "{left_out:?}");
    assert_eq!(left_out[0].0, "../secret1.p");
}

#[test]
fn two_views_are_enough() {
    let bench = of_plane(2);
    let more: Vec<&str> = ANALYTIC.into_iter().chain(["--views", "5"]).collect();
    let _ = bench.reconstruct("out", &more).expect_code(0);
    let record: serde_json::Value = serde_json::from_slice(&bench.read("out/run.json")).expect("JSON");
    let sources = record["views"].as_array().expect("a list").iter().map(|view| view["sources"].clone());
    assert_eq!(sources.collect::<Vec<_>>(), [serde_json::json!([1]), serde_json::json!([0])]);
}

#[test]
fn what_makes_a_scene_never_writes_into_one() {
    let bench = of_plane(3);
    let (scene, mesh, samples) = (bench.scene(), bench.path("mesh.obj"), bench.path("samples"));
    let refused = |command: &[&str], folder: &str| {
        let refused = run(command).expect_code(2);
        assert!(refused.stderr.contains(&format!("{folder} is not empty")), "{}", refused.stderr);
    };
    let files =
        || ["images/00000000.png", "cams/00000000_cam.txt"].map(|name| bench.read(&format!("scene/{name}")));
    let before = files();
    refused(&["convert", &scene, &scene, "--to", "mvsnet"], &scene);
    refused(&["synth", &scene], &scene);
    refused(&["render-depth", &mesh, &scene, &scene], &scene);
    assert!(files() == before && !Path::new(&bench.path("scene/sparse")).exists());
    // Samples of other seeds may join.
    let sample = |seed: &'static str| {
        [
            "synth",
            &samples,
            "--training",
            "2",
            "--views",
            "2",
            "--width",
            "32",
            "--height",
            "32",
            "--seed",
            seed,
        ]
    };
    for seed in ["1", "3"] {
        let _ = run(sample(seed)).expect_code(0);
    }
    refused(&sample("4"), &format!("{samples}/00000004"));
    assert!(!Path::new(&format!("{samples}/00000005")).exists());
}

#[test]
fn usage_errors_name_what_is_expected_and_leave_nothing() {
    let bench = of_plane(3);
    let (scene, out) = (bench.scene(), bench.path("none-out"));
    let refused = |command: &[&str], code: i32, expected: &str| {
        let refused = run(command).expect_code(code);
        assert!(refused.stderr.contains(expected), "{}", refused.stderr);
    };
    refused(
        &["reconstruct", &scene, "-o", &out, "--device", "gpu"],
        2,
        "none of cpu, torch, cuda and cuda:N",
    );
    refused(&["reconstruct", &scene, "-o", &scene], 2, "over the scene");
    refused(&["submit", &scene, "--coordinator", "http://127.0.0.1:9"], 2, "--detach");
    refused(&["status", "--coordinator", "foo"], 2, "http://10.0.0.1:7070");
    refused(&["reconstruct", &bench.path("none"), "-o", &out], 1, "cannot find the scene");
    assert!(!Path::new(&out).exists());
}

#[test]
fn masks_that_belong_to_no_view_are_warned_of() {
    let bench = of_plane(4);
    let masks = bench.path("masks");
    fs::create_dir_all(&masks).expect("made");
    fs::write(format!("{masks}/foo.png"), b"").expect("written");
    let more: Vec<&str> = ANALYTIC.into_iter().chain(["--masks", &masks]).collect();
    let out = bench.path("out");
    let warned = bench.reconstruct("out", &more).expect_code(0);
    let cloud = bench.path("again.ply");
    let fuse = ["fuse", &out, "-o", &cloud, "--min-views", "1", "--min-confidence", "0", "--masks", &masks];
    for run in [warned, run(fuse).expect_code(0)] {
        assert!(
            run.stderr.contains("no view has a mask in") && run.stderr.contains(&masks),
            "{}",
            run.stderr
        );
    }
}

#[test]
fn a_scene_without_a_usable_view_says_why() {
    let bench = Bench::new(|folder| courtyard(folder, 5, 64, 64));
    let images = bench.path("scene/images");
    fs::remove_dir_all(&images).expect("it was there");
    fs::create_dir_all(&images).expect("made");
    let refused = run(["inspect", &bench.scene()]).expect_code(1);
    for part in ["found no usable view", "00000000.png: ", "and 2 more"] {
        assert!(refused.stderr.contains(part), "{part}: {}", refused.stderr);
    }
}

#[test]
fn a_damaged_depth_map_is_left_out_of_what_is_measured() {
    let bench = Bench::new(|folder| courtyard(folder, 8, 96, 96));
    let _ = bench.reconstruct("out", &ANALYTIC).expect_code(0);
    let (out, truth) = (bench.path("out"), bench.path("scene/depth_gt"));
    let map = |view: u32| bench.path(&format!("out/depth/{view:08}.pfm"));
    fs::write(map(3), b"Pf").expect("written");
    let commands = [
        vec!["evaluate", "depth", &out, &truth],
        vec!["evaluate", "consistency", &out],
        vec!["evaluate", "photometric", &out],
    ];
    for command in &commands {
        let measured = run([command.as_slice(), &["--json"]].concat()).expect_code(3).json();
        let views =
            [&measured["views"], &measured["mean"]["views"]].into_iter().find_map(serde_json::Value::as_u64);
        assert_eq!(views, Some(7), "{command:?}");
        let skipped = measured["skipped"].as_object().expect("reasons by view");
        assert_eq!(skipped.keys().collect::<Vec<_>>(), ["00000003.png"], "{command:?}");
        let printed = run(command).expect_code(3).stdout;
        assert!(printed.contains("skipped: 00000003.png: ") && printed.contains(&map(3)), "{printed}");
    }
    for view in 0..8 {
        fs::write(map(view), b"Pf").expect("written");
    }
    for command in &commands {
        let refused = run(command).expect_code(1).stderr;
        assert!(refused.contains(&map(0)) && refused.contains("and 5 more"), "{refused}");
    }
}

#[test]
fn usage_errors_are_json_for_programs() {
    for (arguments, named) in [
        (vec!["--json", "inspect"], "SCENE"),
        (vec!["inspect", "scene", "--no-such-option", "--json"], "--no-such-option"),
    ] {
        let refused = run(&arguments).expect_code(2);
        assert!(
            refused.json()["error"].as_str().is_some_and(|error| error.contains(named)),
            "{}",
            refused.stdout
        );
        assert!(refused.stderr.contains("Usage: "), "{}", refused.stderr);
    }
    assert!(run(["inspect"]).expect_code(2).stdout.is_empty());
    assert!(run(["--json", "--help"]).expect_code(0).stdout.contains("Usage: "));
}

#[test]
fn truth_that_is_not_there_is_named() {
    let bench = of_plane(4);
    let _ = bench.reconstruct("out", &ANALYTIC).expect_code(0);
    let nowhere = bench.path("nowhere");
    let refused = run(["evaluate", "depth", &bench.path("out"), &nowhere]).expect_code(1);
    assert!(refused.stderr.contains(&format!("cannot find the folder {nowhere}")), "{}", refused.stderr);
}

#[test]
fn weights_are_described_by_the_names_of_the_options() {
    let bench = of_plane(3);
    let described = run(["weights", "inspect", &bench.weights()]).expect_code(0).stdout;
    let value = run(["weights", "inspect", &bench.weights(), "--json"]).expect_code(0).json();
    for field in ["normalization", "refinement", "metric"] {
        let name = value["metadata"][field].as_str().expect("a name");
        assert!(
            described.lines().any(|line| line.split_whitespace().last() == Some(name)),
            "{name}: {described}"
        );
    }
}

#[test]
fn a_scene_below_is_named() {
    let bench = of_plane(3);
    let above = bench.path("");
    let refused = run(["inspect", &above]).expect_code(1);
    assert!(refused.stderr.contains(&format!("there is one in {}", bench.scene())), "{}", refused.stderr);
}

#[test]
fn maps_whose_photographs_are_gone_are_named_with_the_reason() {
    let bench = of_plane(4);
    let _ = bench.reconstruct("out", &ANALYTIC).expect_code(0);
    fs::remove_dir_all(bench.path("scene/images")).expect("it was there");
    let refused = run(["fuse", &bench.path("out"), "-o", &bench.path("again.ply")]).expect_code(1);
    for part in ["no view of", "could be read", "00000000.png: could not read image", "and 1 more"] {
        assert!(refused.stderr.contains(part), "{part}: {}", refused.stderr);
    }
}
