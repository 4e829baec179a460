//! The network from images to depth, plain: every stage on the whole volume.

use nalgebra::Matrix3x4;
use planesweep_scene::DepthHypotheses;
use tch::{Device, Kind, TchError, Tensor};

use crate::cost_volume::{cost_volume, cost_volume_at_once};
use crate::depth;
use crate::features::FeatureNet;
use crate::refine::RefinementNet;
use crate::regularize::CostRegularization;
use crate::warp::PlaneSweep;
use crate::{CostMetric, Weights};

/// Which step of the network libtorch failed in.
#[derive(Debug)]
pub(crate) enum StepError {
    SingularCamera,
    Library { doing: &'static str, source: TchError },
}

trait Doing<T> {
    fn doing(self, doing: &'static str) -> Result<T, StepError>;
}

impl<T> Doing<T> for Result<T, TchError> {
    fn doing(self, doing: &'static str) -> Result<T, StepError> {
        self.map_err(|source| StepError::Library { doing, source })
    }
}

/// The features of one view with the camera they belong to.
#[derive(Debug)]
pub(crate) struct FeatureView {
    /// `[1, 32, H, W]`.
    pub(crate) features: Tensor,
    /// `K [R | t]` of the feature map: `K` of the image with its first two rows divided by four.
    pub(crate) projection: Matrix3x4<f64>,
}

/// What the network says about a reference view; all maps have the size of its features.
#[derive(Debug)]
pub(crate) struct Inference {
    /// `[D, H, W]`.
    pub(crate) probability: Tensor,
    /// Scene units, `[H, W]`, f64.
    pub(crate) depth: Tensor,
    /// `[H, W]`.
    pub(crate) confidence: Tensor,
}

/// MVSNet. Its element type is f32 in use and f64 where errors are measured against it.
#[derive(Debug)]
pub(crate) struct Network {
    options: (Kind, Device),
    features: FeatureNet,
    metric: CostMetric,
    at_once: bool,
    regularization: CostRegularization,
    refinement: Option<RefinementNet>,
}

impl Network {
    pub(crate) fn new(weights: &Weights, options: (Kind, Device)) -> Result<Self, TchError> {
        Ok(Self {
            options,
            features: FeatureNet::new(weights, options)?,
            metric: weights.metadata().metric,
            at_once: false,
            regularization: CostRegularization::new(weights, options)?,
            refinement: RefinementNet::new(weights, options)?,
        })
    }

    /// Builds cost volumes as the public implementations do, all planes at once.
    pub(crate) fn building_at_once(self) -> Self {
        Self { at_once: true, ..self }
    }

    /// An image as a tensor `[1, 3, H, W]`; both sizes are multiples of 32.
    pub(crate) fn image(&self, planes: &[f32], width: usize, height: usize) -> Result<Tensor, StepError> {
        let upload = || {
            let image = Tensor::f_from_slice(planes)?.f_view([1, 3, height as i64, width as i64])?;
            image.f_to_kind(self.options.0)?.f_to_device(self.options.1)
        };
        upload().doing("uploading an image")
    }

    /// Features of an image; the same whichever view it serves.
    pub(crate) fn features(&self, image: &Tensor) -> Result<Tensor, StepError> {
        self.features.apply(image).doing("extracting features")
    }

    /// The cost volume `[1, 32, D, H, W]` at these depths.
    pub(crate) fn cost(
        &self,
        reference: &FeatureView,
        sources: &[FeatureView],
        depths: &[f64],
    ) -> Result<Tensor, StepError> {
        let size = |view: &FeatureView| {
            let size = view.features.size();
            (size[3] as usize, size[2] as usize)
        };
        let mut swept = Vec::with_capacity(sources.len());
        for source in sources {
            let sweep = PlaneSweep::new(
                &reference.projection,
                size(reference),
                &source.projection,
                size(source),
                self.options.1,
            );
            let sweep = sweep.ok_or(StepError::SingularCamera)?.doing("preparing the warp")?;
            swept.push((&source.features, sweep));
        }
        let build = if self.at_once { cost_volume_at_once } else { cost_volume };
        build(&reference.features, &swept, depths, self.metric).doing("building the cost volume")
    }

    /// The logits `[D, H, W]` of a cost volume, which is freed on the way.
    pub(crate) fn logits(&self, volume: Tensor) -> Result<Tensor, StepError> {
        self.regularization.apply(volume).doing("regularising the cost volume")
    }

    /// Depth and confidence, refined with the reference's image when the weights have a refinement network.
    pub(crate) fn regress(
        &self,
        logits: Tensor,
        hypotheses: &DepthHypotheses,
        image: &Tensor,
        window: u32,
    ) -> Result<Inference, StepError> {
        let regress = || {
            let probability = depth::probability(&logits)?;
            drop(logits);
            let index = depth::expected_index(&probability)?;
            let confidence = depth::confidence(&probability, &index, window)?;
            Ok((probability, index, confidence))
        };
        let (probability, index, confidence) = regress().doing("regressing depth")?;
        let refine = || {
            let Some(network) = &self.refinement else { return depth::depth_at(&index, hypotheses) };
            // Indices are linear in depth (in inverse depth when sampled so), so they scale to [0, 1].
            let steps = f64::from(hypotheses.count() - 1);
            let refined = network.apply(&index.f_div_scalar(steps)?, image)?;
            depth::depth_at(&refined.f_mul_scalar(steps)?, hypotheses)
        };
        let depth = refine().doing("refining depth")?;
        Ok(Inference { probability, depth, confidence })
    }
}
