//! Ours against the plain network in libtorch. Truth is the plain network in f64; our error against it may be
//! at most twice that of the plain network in f32, at the median, 99 %, 99.9 % and the maximum.
//! Confidence jumps where the expected index is an integer, so it is compared at least 0.01 from there.

use std::path::PathBuf;

use nalgebra::Matrix3x4;
use planesweep_scene::{DepthHypotheses, Sampling};
use proptest::prelude::any;
use proptest::sample::select;
use proptest::strategy::{Strategy, ValueTree};
use proptest::test_runner::TestRunner;
use tch::{Device, IndexOp, Kind, Tensor};

use super::*;
use crate::backend::conformance::Images;
use crate::network::{FeatureView, Network};
use crate::{FeatureNetwork, ImportOptions, Refinement, WeightsMetadata, depth};

/// What a network says of some pixels.
#[derive(Default)]
struct Said {
    depth: Vec<f64>,
    confidence: Vec<f64>,
    /// The expected index; the plain network's only.
    index: Vec<f64>,
}

impl Said {
    fn append(&mut self, other: Self) {
        self.depth.extend(other.depth);
        self.confidence.extend(other.confidence);
        self.index.extend(other.index);
    }
}

fn values(tensor: &Tensor) -> Vec<f64> {
    let tensor = tensor.to_kind(Kind::Double).contiguous();
    let mut values = vec![0.0; tensor.numel()];
    tensor.copy_data(&mut values, tensor.numel());
    values
}

/// Absolute errors at the median, 99 %, 99.9 % and the maximum.
fn error_quantiles<'a>(values: impl Iterator<Item = (&'a f64, &'a f64)>) -> [f64; 4] {
    let mut errors: Vec<f64> = values.map(|(value, truth)| (value - truth).abs()).collect();
    errors.sort_by(f64::total_cmp);
    [0.5, 0.99, 0.999, 1.0].map(|share| errors[((errors.len() - 1) as f64 * share) as usize])
}

fn assert_as_exact(what: &str, ours: &Said, plain: &Said, truth: &Said) {
    let steady: Vec<bool> = truth.index.iter().map(|index| (index - index.round()).abs() >= 0.01).collect();
    let depth = |said: &Said| error_quantiles(said.depth.iter().zip(&truth.depth));
    let confidence = |said: &Said| {
        let pairs = said.confidence.iter().zip(&truth.confidence).zip(&steady);
        error_quantiles(pairs.filter_map(|(pair, steady)| steady.then_some(pair)))
    };
    let all = [("depth", depth(ours), depth(plain)), ("confidence", confidence(ours), confidence(plain))];
    for (part, ours, plain) in &all {
        eprintln!(
            "{what}, {part}: errors at the median, 99 %, 99.9 %, maximum: ours {ours:?}, plain {plain:?}"
        );
    }
    for (part, ours, plain) in all {
        for (ours, plain) in ours.iter().zip(plain) {
            assert!(*ours <= 2.0 * plain, "{what}, {part}: {ours:e} is more than twice {plain:e}");
        }
    }
}

/// The plain network, whole images padded as in use, cropped again.
fn plain(weights: &Weights, kind: Kind, images: &Images) -> Said {
    let _guard = tch::no_grad_guard();
    let network = Network::new(weights, (kind, Device::Cpu)).expect("a network");
    let normalization = weights.metadata().normalization;
    let upload = |image: &WorkingImage| {
        let InputImage { width, height, planes } = InputImage::new(&image.pixels, normalization);
        network.image(&planes, width, height).expect("an image")
    };
    let view = |image: &WorkingImage| FeatureView {
        features: network.features(&upload(image)).expect("features"),
        projection: quarter(image).0.projection(),
    };
    let sources: Vec<_> = images.sources.iter().map(view).collect();
    let depths = images.hypotheses.depths();
    let volume = network.cost(&view(&images.reference), &sources, &depths).expect("a cost volume");
    let logits = network.logits(volume).expect("logits");
    let guide = upload(&images.reference);
    let inference = network.regress(logits, &images.hypotheses, &guide, 4).expect("a depth map");
    let index = depth::expected_index(&inference.probability).expect("an expectation");
    let (camera, _) = quarter(&images.reference);
    let (width, height) = (camera.intrinsics.width as i64, camera.intrinsics.height as i64);
    // As both are handed out, in f32.
    let cropped = |map: &Tensor, kind| values(&map.i((..height, ..width)).to_kind(kind));
    let handed = if kind == Kind::Double { Kind::Double } else { Kind::Float };
    Said {
        depth: cropped(&inference.depth, handed),
        confidence: cropped(&inference.confidence, handed),
        index: cropped(&index, Kind::Double),
    }
}

fn ours(weights: &Weights, images: &Images, level: Level, step_rows: usize) -> Said {
    let mut backend = CpuBackend::with_level(weights, 2, None, level).expect("threads");
    backend.step_rows = step_rows;
    let map = images.infer(&mut backend).expect("a depth map");
    let f64s = |values: &[f32]| values.iter().map(|value| f64::from(*value)).collect();
    Said { depth: f64s(map.depth.values()), confidence: f64s(map.confidence.values()), index: Vec::new() }
}

/// Sizes, depth counts, step heights and seeds; all pixels of all cases are judged together.
fn compare(metadata: &WeightsMetadata, sampling: Sampling, level: Level) {
    let (mut all_ours, mut all_plain, mut truth) = <(Said, Said, Said)>::default();
    for (width, height, depths, step_rows, seed) in
        [(96, 64, 16, 3, 1), (150, 70, 27, 8, 2), (64, 190, 48, 5, 3), (33, 47, 9, 1, 4), (20, 25, 5, 2, 5)]
    {
        let weights = Weights::seeded(metadata.clone(), seed);
        let mut images = Images::new(width, height, sampling);
        images.hypotheses = DepthHypotheses::new(sampling, 2.0, 8.0, depths).expect("a valid range");
        all_ours.append(ours(&weights, &images, level, step_rows));
        all_plain.append(plain(&weights, Kind::Float, &images));
        truth.append(plain(&weights, Kind::Double, &images));
    }
    assert_as_exact(&format!("{metadata:?} {sampling:?} {level:?}"), &all_ours, &all_plain, &truth);
}

/// Random sizes, numbers of depths and of views, step heights, weights and refinements; the errors of the pixels of a
/// few cases are judged together, since those of one small image say little about extremes.
#[test]
fn as_exact_for_any_sizes_and_weights() {
    let case = (
        (20_usize..110, 20_usize..110, 2_u32..34),
        (2_usize..6, 1_usize..12, any::<u64>()),
        select(vec![Refinement::None, Refinement::Paper, Refinement::WithBnRelu]),
        select(vec![Sampling::Uniform, Sampling::Inverse]),
        select(Level::available()),
    );
    let mut runner = TestRunner::deterministic();
    for batch in 0..2 {
        let (mut all_ours, mut all_plain, mut truth) = <(Said, Said, Said)>::default();
        for _ in 0..6 {
            let ((width, height, depths), (views, step_rows, seed), refinement, sampling, level) =
                case.new_tree(&mut runner).expect("a case").current();
            let weights = Weights::seeded(WeightsMetadata::untrained(refinement), seed);
            let mut images = Images::new(width, height, sampling);
            for view in images.sources.len()..views - 1 {
                let mut source = images.sources[view % 2].clone();
                source.camera.pose.translation.x += 0.07 * view as f64;
                images.sources.push(source);
            }
            images.sources.truncate(views - 1);
            images.hypotheses = DepthHypotheses::new(sampling, 2.0, 8.0, depths).expect("a valid range");
            all_ours.append(ours(&weights, &images, level, step_rows));
            all_plain.append(plain(&weights, Kind::Float, &images));
            truth.append(plain(&weights, Kind::Double, &images));
        }
        assert_as_exact(&format!("batch {batch}"), &all_ours, &all_plain, &truth);
    }
}

#[test]
fn as_exact_as_the_plain_network() {
    for level in Level::available() {
        compare(&WeightsMetadata::untrained(Refinement::None), Sampling::Uniform, level);
    }
}

#[test]
fn as_exact_with_refinement_and_inverse_sampling() {
    compare(&WeightsMetadata::untrained(Refinement::Paper), Sampling::Inverse, Level::detect());
    compare(&WeightsMetadata::untrained(Refinement::WithBnRelu), Sampling::Uniform, Level::detect());
}

#[test]
fn as_exact_with_the_mean_metric() {
    let metadata =
        WeightsMetadata { metric: CostMetric::Mean, ..WeightsMetadata::untrained(Refinement::None) };
    compare(&metadata, Sampling::Uniform, Level::detect());
}

#[test]
fn as_exact_with_a_single_layer_of_features() {
    for level in Level::available() {
        let metadata = WeightsMetadata {
            features: FeatureNetwork::SingleLayer,
            ..WeightsMetadata::untrained(Refinement::None)
        };
        compare(&metadata, Sampling::Uniform, level);
    }
}

fn data(path: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/")).join(path)
}

/// The public weights on real photographs (640x512, three views, 192 depths).
#[test]
fn as_exact_on_the_golden_case() {
    let checkpoint = data("weights/mvsnet_dtu_d192_xyguo.ckpt");
    let case = data("golden/case_a_640x512_N3_D192.npz");
    if !checkpoint.exists() || !case.exists() {
        eprintln!(
            "SKIPPED as_exact_on_the_golden_case: the golden case of the reference weights is not there"
        );
        return;
    }
    let options = ImportOptions {
        normalization: Normalization::UnitRange,
        metric: CostMetric::Variance,
        spacing_px: None,
        source: "public PyTorch port".to_owned(),
        licence: "none stated".to_owned(),
    };
    let weights = Weights::import(&checkpoint, options).expect("the reference weights");
    let golden = Tensor::read_npz(case).expect("a golden file");
    let tensor = |name: &str| &golden.iter().find(|(key, _)| key == name).expect("a golden tensor").1;
    let (images, depths) = (tensor("imgs"), values(tensor("depth_values")));
    let projections = values(tensor("proj_matrices"));
    let projections: Vec<_> =
        projections.chunks_exact(16).map(|m| Matrix3x4::from_row_slice(&m[..12])).collect();
    let hypotheses = DepthHypotheses::new(Sampling::Uniform, depths[0], depths[191], 192).expect("a range");

    let _guard = tch::no_grad_guard();
    let [plain, truth] = [Kind::Float, Kind::Double].map(|kind| {
        let network = Network::new(&weights, (kind, Device::Cpu)).expect("a network");
        let images: Vec<_> = (0..3).map(|i| images.i((0, i)).unsqueeze(0).to_kind(kind)).collect();
        let views = images.iter().zip(&projections).map(|(image, projection)| FeatureView {
            features: network.features(image).expect("features"),
            projection: *projection,
        });
        let views: Vec<_> = views.collect();
        let volume = network.cost(&views[0], &views[1..], &hypotheses.depths()).expect("a cost volume");
        drop(views);
        let logits = network.logits(volume).expect("logits");
        let inference = network.regress(logits, &hypotheses, &images[0], 4).expect("a depth map");
        let index = depth::expected_index(&inference.probability).expect("an expectation");
        let handed =
            |map: &Tensor| values(&map.to_kind(if kind == Kind::Double { kind } else { Kind::Float }));
        Said {
            depth: handed(&inference.depth),
            confidence: handed(&inference.confidence),
            index: values(&index),
        }
    });

    let backend = CpuBackend::new(&weights, 2, None).expect("threads");
    let maps: Vec<_> = (0..3)
        .map(|i| {
            let planes = values(&images.i((0, i))).into_iter().map(|value| value as f32).collect();
            let image = InputImage { width: 640, height: 512, planes };
            features(&Arc::default(), &backend.features, &image)
        })
        .collect();
    let sweep = |i: usize| PixelSweep::new(&projections[0], &projections[i]).expect("an invertible camera");
    let cost = CostInput {
        reference: &maps[0],
        sources: vec![(&maps[1], sweep(1)), (&maps[2], sweep(2))],
        inverse_depths: hypotheses.depths().iter().map(|depth| 1.0 / depth).collect(),
        metric: CostMetric::Variance,
    };
    let Swept { pixels, .. } = backend.sweep(&cost, 0..128, 4, None);
    let ours = Said {
        depth: pixels.iter().map(|pixel| f64::from(hypotheses.depth_at(pixel.index) as f32)).collect(),
        confidence: pixels.iter().map(|pixel| f64::from(pixel.confidence)).collect(),
        index: Vec::new(),
    };
    assert_as_exact("golden", &ours, &plain, &truth);
}
