//! What has no public reference: 2 and 5 views, inverse sampling, the mean metric, refinement. The values
//! come from `tests/golden/make_golden.py`, in f64, with the same seeded weights and images.
//!
//! In f64 two orders of the same arithmetic differ by rounding alone: at most 5e-14 was seen after all
//! layers, at values of 1 to 10. A tolerance of 1e-12 has room for another processor and for no other formula. In
//! f32, with at most 2e-5 seen, 1e-4 is the same room.

use nalgebra::Matrix3x4;
use planesweep_scene::{DepthHypotheses, Raster, Sampling};
use tch::{Device, Kind, Tensor};

use super::{error_quantiles, values};
use crate::input::InputImage;
use crate::network::{FeatureView, Network};
use crate::weights::uniform;
use crate::{CostMetric, Refinement, Weights, WeightsMetadata};

/// Sizes of the images, the reference's first; no two of the last three are the same.
const SIZES: [(usize, usize); 5] = [(96, 64), (96, 64), (64, 96), (128, 64), (64, 64)];

struct Case {
    name: &'static str,
    views: usize,
    sampling: Sampling,
    metric: CostMetric,
    refinement: Refinement,
    seed: u64,
}

impl Case {
    fn golden(&self, what: &str) -> Vec<f64> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/golden.safetensors");
        let tensors = Tensor::read_safetensors(path).expect("the golden values");
        let name = format!("{}.{what}", self.name);
        values(&tensors.iter().find(|(key, _)| *key == name).expect("a golden tensor").1)
    }

    fn image(&self, view: usize) -> InputImage {
        let (width, height) = SIZES[view];
        let mut state = self.seed + 100 + view as u64;
        let planes: Vec<u8> = (0..3 * width * height).map(|_| (256.0 * uniform(&mut state)) as u8).collect();
        let pixels = Raster::from_fn(width, height, |x, y| {
            [0, 1, 2].map(|channel| planes[(channel * height + y) * width + x])
        });
        InputImage::new(&pixels, self.normalization())
    }

    fn normalization(&self) -> crate::Normalization {
        WeightsMetadata::untrained(self.refinement).normalization
    }

    /// Compares logits, depth and confidence, all of magnitude 1 to 10.
    fn check(&self, kind: Kind, tolerance: f64) {
        let _guard = tch::no_grad_guard();
        let metadata = WeightsMetadata { metric: self.metric, ..WeightsMetadata::untrained(self.refinement) };
        let weights = Weights::seeded(metadata, self.seed);
        let network = Network::new(&weights, (kind, Device::Cpu)).expect("a network");
        let hypotheses = DepthHypotheses::new(self.sampling, 2.0, 6.0, 16).expect("a valid range");
        let projections = self.golden("projections");
        let mut images = Vec::new();
        let mut views = Vec::new();
        for (view, projection) in projections.chunks_exact(12).enumerate() {
            let InputImage { width, height, planes } = self.image(view);
            images.push(network.image(&planes, width, height).expect("an image"));
            let features = network.features(&images[view]).expect("features");
            views.push(FeatureView { features, projection: Matrix3x4::from_row_slice(projection) });
        }
        assert_eq!(views.len(), self.views);
        let volume = network.cost(&views[0], &views[1..], &hypotheses.depths()).expect("a cost volume");
        let logits = network.logits(volume).expect("logits");
        let inference =
            network.regress(logits.shallow_clone(), &hypotheses, &images[0], 4).expect("a depth map");
        for (what, ours) in
            [("logits", &logits), ("depth", &inference.depth), ("confidence", &inference.confidence)]
        {
            let [_, _, _, error] = error_quantiles(&values(ours), &self.golden(what));
            eprintln!("{} {what} {kind:?}: error {error:.1e}", self.name);
            assert!(error < tolerance, "{} {what}: off by {error:e}", self.name);
        }
    }
}

/// One test per case: exact in f64, near in f32.
macro_rules! cases {
    ($($name:ident: $views:expr, $sampling:ident, $metric:ident, $refinement:ident, $seed:expr;)*) => {
        $(#[test]
        fn $name() {
            let case = Case {
                name: stringify!($name),
                views: $views,
                sampling: Sampling::$sampling,
                metric: CostMetric::$metric,
                refinement: Refinement::$refinement,
                seed: $seed,
            };
            case.check(Kind::Double, 1e-12);
            case.check(Kind::Float, 1e-4);
        })*
    };
}

cases! {
    views2_uniform: 2, Uniform, Variance, None, 11;
    views5_inverse: 5, Inverse, Variance, None, 12;
    views3_mean: 3, Uniform, Mean, None, 13;
    views3_refined_paper: 3, Uniform, Variance, Paper, 14;
    views2_refined_bn_relu_inverse: 2, Inverse, Variance, WithBnRelu, 15;
}
