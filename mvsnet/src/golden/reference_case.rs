//! The public PyTorch port with its weights on real photographs (640x512, three views, 192 depths),
//! fp32. Truth is this network in f64: the error of its f32 form against that may be at most twice the
//! port's own.

use std::path::PathBuf;
use std::sync::OnceLock;

use nalgebra::Matrix3x4;
use planesweep_scene::{DepthHypotheses, Sampling};
use tch::{Device, IndexOp, Kind, Tensor};

use super::{assert_as_exact, values};
use crate::network::{FeatureView, Network};
use crate::{CostMetric, ImportOptions, Normalization, Weights, depth};

fn data(path: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data/")).join(path)
}

/// The tensor of this name in an npz file.
fn golden(file: &str, name: &str) -> Tensor {
    let tensors = Tensor::read_npz(data("golden").join(file)).expect("a golden file");
    tensors.into_iter().find(|(key, _)| key == name).expect("a golden tensor").1
}

const CASE: &str = "case_a_640x512_N3_D192.npz";
const STAGES: &str = "case_a_intermediates.npz";

struct Case {
    network: Network,
    images: Vec<Tensor>,
    projections: Vec<Matrix3x4<f64>>,
    hypotheses: DepthHypotheses,
}

impl Case {
    /// `None`, with a line on stderr, where the data is not there.
    fn load(test: &str, kind: Kind) -> Option<Self> {
        let checkpoint = data("weights/mvsnet_dtu_d192_xyguo.ckpt");
        if !checkpoint.exists() || !data("golden").join(CASE).exists() {
            eprintln!("SKIPPED {test}: the golden case of the reference weights is not there");
            return None;
        }
        let weights = Weights::import(&checkpoint, options()).expect("the reference weights");
        let network = Network::new(&weights, (kind, Device::Cpu)).expect("a network");
        let images = golden(CASE, "imgs").to_kind(kind);
        let projections = values(&golden(CASE, "proj_matrices"));
        let depths = values(&golden(CASE, "depth_values"));
        let hypotheses =
            DepthHypotheses::new(Sampling::Uniform, depths[0], depths[191], 192).expect("a range");
        Some(Self {
            network,
            images: (0..3).map(|view| images.i((0, view)).unsqueeze(0)).collect(),
            projections: projections.chunks_exact(16).map(|m| Matrix3x4::from_row_slice(&m[..12])).collect(),
            hypotheses,
        })
    }

    fn views(&self) -> Vec<FeatureView> {
        let views = self.images.iter().zip(&self.projections);
        views
            .map(|(image, projection)| FeatureView {
                features: self.network.features(image).expect("features"),
                projection: *projection,
            })
            .collect()
    }

    fn cost(&self, depths: &[f64]) -> Tensor {
        let views = self.views();
        self.network.cost(&views[0], &views[1..], depths).expect("a cost volume")
    }
}

fn options() -> ImportOptions {
    ImportOptions {
        normalization: Normalization::UnitRange,
        metric: CostMetric::Variance,
        spacing_px: None,
        source: "public PyTorch port".to_owned(),
        licence: "none stated".to_owned(),
    }
}

/// What the last stages give.
struct Result {
    logits: Vec<f64>,
    index: Vec<f64>,
    depth: Vec<f64>,
    confidence: Vec<f64>,
}

impl Result {
    fn of(case: &Case) -> Self {
        let logits = case.network.logits(case.cost(&case.hypotheses.depths())).expect("logits");
        let inference = case
            .network
            .regress(logits.shallow_clone(), &case.hypotheses, &case.images[0], 4)
            .expect("depth");
        Self {
            logits: values(&logits),
            index: values(&depth::expected_index(&inference.probability).expect("an expectation")),
            depth: values(&inference.depth),
            confidence: values(&inference.confidence),
        }
    }

    /// Ours in f32, and the truth; computed once, for three tests.
    fn both(test: &str) -> Option<&'static (Self, Self)> {
        static BOTH: OnceLock<Option<(Result, Result)>> = OnceLock::new();
        let both = BOTH.get_or_init(|| {
            let _guard = tch::no_grad_guard();
            let float = Case::load(test, Kind::Float)?;
            let double = Case::load(test, Kind::Double)?;
            Some((Self::of(&float), Self::of(&double)))
        });
        both.as_ref()
    }
}

#[test]
fn golden_weights_are_imported_exactly() {
    let Some(_) = Case::load("golden_weights_are_imported_exactly", Kind::Float) else { return };
    let weights = Weights::import(&data("weights/mvsnet_dtu_d192_xyguo.ckpt"), options()).expect("weights");
    let same = Tensor::read_npz(data("weights/mvsnet_dtu_d192_xyguo.npz")).expect("the same tensors");
    let mut compared = 0;
    for (name, tensor) in same.iter().filter(|(name, _)| !name.ends_with("num_batches_tracked")) {
        let ours = &weights.tensors()[name];
        assert_eq!(ours.shape.iter().map(|size| *size as i64).collect::<Vec<_>>(), tensor.size(), "{name}");
        assert!(ours.values.iter().map(|value| f64::from(*value)).eq(values(tensor)), "{name}");
        compared += ours.values.len();
    }
    assert_eq!(compared, 338_129 + 832);
}

#[test]
fn golden_features() {
    let test = "golden_features";
    let (Some(float), Some(double)) = (Case::load(test, Kind::Float), Case::load(test, Kind::Double)) else {
        return;
    };
    let _guard = tch::no_grad_guard();
    let features =
        |case: &Case| case.views().iter().flat_map(|view| values(&view.features)).collect::<Vec<_>>();
    assert_as_exact("features", &features(&float), &values(&golden(STAGES, "features")), &features(&double));
}

#[test]
fn golden_cost_volume() {
    let test = "golden_cost_volume";
    let (Some(float), Some(double)) = (Case::load(test, Kind::Float), Case::load(test, Kind::Double)) else {
        return;
    };
    let _guard = tch::no_grad_guard();
    let depths = [0.0, 95.0, 191.0].map(|index| float.hypotheses.depth_at(index));
    let golden = values(&golden(STAGES, "variance_d0_d95_d191"));
    assert_as_exact("variance", &values(&float.cost(&depths)), &golden, &values(&double.cost(&depths)));
}

#[test]
fn golden_logits() {
    let Some((float, double)) = Result::both("golden_logits") else { return };
    assert_as_exact("logits", &float.logits, &values(&golden(STAGES, "logits")), &double.logits);
}

#[test]
fn golden_depth() {
    let Some((float, double)) = Result::both("golden_depth") else { return };
    assert_as_exact("depth", &float.depth, &values(&golden(CASE, "depth")), &double.depth);
}

#[test]
fn golden_confidence() {
    let Some((float, double)) = Result::both("golden_confidence") else { return };
    let golden = values(&golden(CASE, "photometric_confidence"));
    // The window jumps where the expected index passes an integer.
    let steady = |confidence: &[f64]| -> Vec<f64> {
        let steady = double.index.iter().map(|index| (index - index.round()).abs() >= 0.01);
        confidence.iter().zip(steady).filter_map(|(value, steady)| steady.then_some(*value)).collect()
    };
    let compared = steady(&golden);
    assert!(compared.len() > 18_000, "{} of 20480 pixels are compared", compared.len());
    assert_as_exact("confidence", &steady(&float.confidence), &compared, &steady(&double.confidence));
}
