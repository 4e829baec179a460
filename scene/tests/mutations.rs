//! Every reader gets files with bytes flipped, cut off, repeated or replaced: it answers, with a scene
//! or an error, and neither panics nor hangs nor takes memory by a count that it did not check.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use nalgebra::{Point3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, ReadOptions, Scene, SourceScore, TargetFormat, View,
    ViewId, decode_image, decode_pfm, image_size, read_scene, write_scene,
};
use proptest::prelude::*;
use proptest::sample::Index;

/// What happens to a file.
#[derive(Clone, Debug)]
enum Mutation {
    /// Bits of a byte flip.
    Flip(Index, u8),
    /// The file ends here.
    Cut(Index),
    /// Bytes of the largest or smallest numbers stand here.
    Overwrite(Index, [u8; 8]),
    /// A part of the file stands at another place, too.
    Repeat(Index, Index, usize),
    /// A word becomes another word.
    Word(Index, &'static str),
}

fn mutation() -> impl Strategy<Value = Mutation> {
    let numbers = prop_oneof![
        Just([0xff; 8]),
        Just([0; 8]),
        Just((1_u64 << 40).to_le_bytes()),
        Just(f64::NAN.to_le_bytes()),
        any::<[u8; 8]>()
    ];
    let words =
        proptest::sample::select(vec!["nan", "-1", "1e999", "4294967296", "", "x", "{", "]", "\"", "../"]);
    prop_oneof![
        3 => (any::<Index>(), 1..=255_u8).prop_map(|(at, bits)| Mutation::Flip(at, bits)),
        1 => any::<Index>().prop_map(Mutation::Cut),
        2 => (any::<Index>(), numbers).prop_map(|(at, bytes)| Mutation::Overwrite(at, bytes)),
        1 => (any::<Index>(), any::<Index>(), 1..200_usize).prop_map(|(a, b, n)| Mutation::Repeat(a, b, n)),
        3 => (any::<Index>(), words).prop_map(|(at, word)| Mutation::Word(at, word)),
    ]
}

fn mutated(bytes: &[u8], mutations: &[Mutation]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for mutation in mutations {
        if bytes.is_empty() {
            break;
        }
        let length = bytes.len();
        match mutation {
            Mutation::Flip(at, bits) => bytes[at.index(length)] ^= bits,
            Mutation::Cut(at) => bytes.truncate(at.index(length)),
            Mutation::Overwrite(at, with) => {
                let at = at.index(length);
                let end = (at + 8).min(length);
                bytes[at..end].copy_from_slice(&with[..end - at]);
            }
            Mutation::Repeat(from, to, count) => {
                let from = from.index(length);
                let part = bytes[from..(from + count).min(length)].to_vec();
                let to = to.index(length);
                bytes.splice(to..to, part);
            }
            Mutation::Word(at, word) => {
                let at = at.index(length);
                let is_space = |b: &u8| b.is_ascii_whitespace() || *b == b',' || *b == b':';
                let start = bytes[..at].iter().rposition(is_space).map_or(0, |k| k + 1);
                let end = bytes[at..].iter().position(is_space).map_or(length, |k| at + k);
                bytes.splice(start..end, word.bytes());
            }
        }
    }
    bytes
}

/// Two views and three points in every format, with the files that describe them.
fn scenes(folder: &Path) -> Vec<(PathBuf, Vec<PathBuf>)> {
    let mut scene = Scene::default();
    for k in 0..2_u32 {
        let image = folder.join(format!("{k}.png"));
        RgbImage::new(16, 12).save(&image).expect("written");
        let intrinsics =
            Intrinsics { width: 16, height: 12, fx: 20.0, fy: 20.0, skew: 0.0, cx: 7.0, cy: 6.0 };
        let centre = Point3::new(k as f64, 0.0, 0.0);
        let pose = Pose::look_at(&centre, &Point3::new(0.5, 0.0, 5.0), &-Vector3::y());
        let (id, name) = (ViewId(k), format!("{k:08}.png"));
        let depth_range = Some(DepthRange { min: 1.0, max: 9.0, count: Some(64) });
        let camera = Camera { intrinsics, pose };
        scene.views.insert(id, View { id, name, image, camera, distortion: Distortion::None, depth_range });
        scene.pairs.insert(id, vec![SourceScore { view: ViewId(1 - k), score: 2.5 }]);
    }
    for k in 0..3 {
        scene.points.push(Point3::new(0.1 * k as f64, 0.0, 5.0), [ViewId(0), ViewId(1)]);
    }
    let mut scenes = Vec::new();
    for (format, files) in [
        (TargetFormat::Colmap, &["sparse/cameras.bin", "sparse/images.bin", "sparse/points3D.bin"][..]),
        (TargetFormat::ColmapText, &["sparse/cameras.txt", "sparse/images.txt", "sparse/points3D.txt"]),
        (TargetFormat::Mvsnet, &["cams/00000000_cam.txt", "pair.txt"]),
        (TargetFormat::OpenMvg, &["sfm_data.json"]),
    ] {
        let out = folder.join(format!("{format:?}"));
        write_scene(&scene, format, false, &out).expect("written");
        scenes.push((out.clone(), files.iter().map(|file| out.join(file)).collect()));
    }
    let mut by_hand = |name: &str, file: &str, bytes: &[u8]| {
        let out = folder.join(name);
        fs::create_dir_all(out.join("images")).expect("made");
        for k in 0..2 {
            fs::copy(folder.join(format!("{k}.png")), out.join(format!("images/{k}.png"))).expect("copied");
        }
        fs::write(out.join("list.txt"), "images/0.png\nimages/1.png\n").expect("written");
        let file = out.join(file);
        fs::write(&file, bytes).expect("written");
        scenes.push((out, vec![file]));
    };
    let pose = "[[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]";
    let transforms = format!(
        "{{\"fl_x\": 20, \"k1\": 0.1, \"w\": 16, \"h\": 12, \"frames\": [{{\"file_path\": \"images/0.png\", \"transform_matrix\": {pose}}}, {{\"file_path\": \"images/1.png\", \"transform_matrix\": {pose}, \"cx\": 8}}]}}"
    );
    by_hand("nerfstudio", "transforms.json", transforms.as_bytes());
    let camera = "20 0.1 0.2\n1 0 0\n0 1 0\n0 0 1\n1 2 3\n";
    let bundle = format!("# Bundle file v0.3\n2 1\n{camera}{camera}1 2 3\n4 5 6\n2 0 1 2 3 1 1 2 3\n");
    by_hand("bundler", "bundle.out", bundle.as_bytes());
    by_hand("openmvs 3", "scene.mvs", &openmvs(3, true));
    by_hand("openmvs 7", "scene.mvs", &openmvs(7, true));
    by_hand("openmvs without sizes", "scene.mvs", &openmvs(3, false));
    scenes
}

/// OpenMVS's file in a version of it; without sizes, intrinsics are in units of the larger side.
fn openmvs(version: u32, has_sizes: bool) -> Vec<u8> {
    let mut bytes = [*b"MVSI", version.to_le_bytes(), [0; 4]].concat();
    let count = |bytes: &mut Vec<u8>, n: u64| bytes.extend(n.to_le_bytes());
    let floats =
        |bytes: &mut Vec<u8>, values: &[f64]| bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    count(&mut bytes, 1);
    count(&mut bytes, 1);
    bytes.push(b'p');
    count(&mut bytes, 1);
    count(&mut bytes, 1);
    bytes.push(b'c');
    if version > 3 {
        count(&mut bytes, 3);
        bytes.extend(b"RGB");
    }
    let (size, unit) = if has_sizes { ([16_u32, 12], 1.0) } else { ([0, 0], 16.0) };
    bytes.extend(size.iter().flat_map(|v| v.to_le_bytes()));
    let matrix = [20.0, 0.0, 8.0, 0.0, 20.0, 6.0].map(|v| v / unit);
    floats(&mut bytes, &[&matrix[..], &[0.0, 0.0, 1.0]].concat());
    floats(&mut bytes, &identity);
    floats(&mut bytes, &[0.0; 3]);
    count(&mut bytes, 2);
    for k in 0..2 {
        floats(&mut bytes, &identity);
        floats(&mut bytes, &[k as f64, 0.0, 0.0]);
    }
    count(&mut bytes, 2);
    for k in 0..2_u32 {
        let name = format!("images/{k}.png");
        count(&mut bytes, name.len() as u64);
        bytes.extend(name.bytes());
        if version > 4 {
            count(&mut bytes, 4);
            bytes.extend(b"mask");
        }
        bytes.extend([0, 0, k, k].iter().flat_map(|v| v.to_le_bytes()));
        if version > 6 {
            bytes.extend([0.5_f32, 1.0, 2.0].iter().flat_map(|v| v.to_le_bytes()));
            count(&mut bytes, 1);
            bytes.extend([1 - k, 1].iter().flat_map(|v| v.to_le_bytes()));
            bytes.extend([1.0_f32, 0.2, 0.9, 7.5].iter().flat_map(|v| v.to_le_bytes()));
        }
    }
    count(&mut bytes, 1);
    bytes.extend([1.0_f32, 2.0, 3.0].iter().flat_map(|v| v.to_le_bytes()));
    count(&mut bytes, 2);
    for k in 0..2_u32 {
        bytes.extend(k.to_le_bytes());
        bytes.extend(1.0_f32.to_le_bytes());
    }
    bytes
}

#[test]
fn openmvs_without_sizes_means_the_same() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scenes = scenes(folder.path());
    let intrinsics = |name: &str| {
        let (scene, _) = scenes.iter().find(|(scene, _)| scene.ends_with(name)).expect("made");
        let read = read_scene(scene, &ReadOptions::default()).expect("whole");
        read.views.values().map(|view| view.camera.intrinsics).collect::<Vec<_>>()
    };
    let stated = intrinsics("openmvs 3");
    assert_eq!((stated[0].width, stated[0].fx, stated[0].cx, stated[0].cy), (16, 20.0, 8.0, 6.0));
    assert_eq!(intrinsics("openmvs without sizes"), stated);
}

#[test]
fn every_reader_answers_to_every_mutation() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scenes = scenes(folder.path());
    for (scene, files) in &scenes {
        let read = read_scene(scene, &ReadOptions::default()).expect("whole");
        assert_eq!(read.views.len(), 2, "{}", scene.display());
        assert!(read.points.iter().all(|(_, track)| track.len() == 2), "{}", scene.display());
        for file in files {
            let whole = fs::read(file).expect("read");
            let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig {
                cases: 400,
                failure_persistence: None,
                ..ProptestConfig::default()
            });
            let mutations = proptest::collection::vec(mutation(), 1..4);
            let result = runner.run(&(mutations, any::<bool>()), |(mutations, skip_bad_views)| {
                fs::write(file, mutated(&whole, &mutations)).expect("written");
                let options = ReadOptions { skip_bad_views, ..ReadOptions::default() };
                match read_scene(scene, &options) {
                    Ok(read) => {
                        prop_assert!(!read.views.is_empty());
                        for view in read.views.values() {
                            prop_assert!(view.camera.intrinsics.checked().is_ok());
                            prop_assert!(view.camera.pose.centre().iter().all(|v| !v.is_nan()));
                        }
                        for (position, track) in read.points.iter() {
                            prop_assert!(position.iter().all(|v| v.is_finite()));
                            prop_assert!(track.iter().all(|id| read.views.contains_key(id)));
                        }
                        read.undistorted_cameras();
                    }
                    Err(error) => prop_assert!(!error.to_string().is_empty()),
                }
                Ok(())
            });
            fs::write(file, &whole).expect("written");
            result.unwrap_or_else(|error| panic!("{}: {error}", file.display()));
        }
    }
}

#[test]
fn decoders_of_pixels_answer_to_every_mutation() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut files = vec![b"Pf\n4 3\n-1.0\n".iter().copied().chain([1; 48]).collect::<Vec<u8>>()];
    for extension in ["png", "jpg", "tif"] {
        let path = folder.path().join(format!("image.{extension}"));
        RgbImage::from_fn(16, 12, |x, y| image::Rgb([x as u8 * 9, y as u8 * 9, 7]))
            .save(&path)
            .expect("written");
        files.push(fs::read(&path).expect("read"));
    }
    let path = folder.path().join("mutated");
    for whole in files {
        let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig {
            cases: 400,
            failure_persistence: None,
            ..ProptestConfig::default()
        });
        let mutations = proptest::collection::vec(mutation(), 1..4);
        let result = runner.run(&mutations, |mutations| {
            let bytes = mutated(&whole, &mutations);
            let _ = decode_pfm(&bytes);
            let _ = decode_image(&path, &bytes);
            fs::write(&path, &bytes).expect("written");
            let _ = image_size(&path);
            Ok(())
        });
        result.unwrap_or_else(|error| panic!("{error}"));
    }
}
