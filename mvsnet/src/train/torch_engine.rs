//! Gradients by libtorch's autograd: the plain network as the paper trains it, on the processor or on CUDA, and
//! the measure for our own kernels.

use std::collections::BTreeMap;

use nalgebra::Matrix3x4;
use tch::{Cuda, Device, Kind, TchError, Tensor};

use super::engine::{
    BatchStatistics, EngineError, Gradient, GradientEngine, GradientOptions, IntervalErrors,
};
use super::parameters::{Tensors, is_statistic};
use super::{Example, LossConfig};
use crate::warp::PlaneSweep;
use crate::{CostMetric, FeatureNetwork, Refinement, WeightTensor, depth};

/// What PyTorch adds to the variance by default.
const EPSILON: f64 = 1e-5;

/// libtorch on one device.
#[derive(Debug)]
pub struct TorchEngine {
    device: Device,
    kind: Kind,
    threads: usize,
}

impl TorchEngine {
    /// On "cpu", "cuda" or "cuda:N".
    pub fn new(device: &str, threads: usize) -> Result<Self, EngineError> {
        let refused = |why: String| EngineError::Device { device: device.to_owned(), why };
        let torch_device = match device.strip_prefix("cuda") {
            None if device == "cpu" => Device::Cpu,
            Some(index) => {
                let index = index.strip_prefix(':').unwrap_or(if index.is_empty() { "0" } else { "?" });
                let index = index.parse::<usize>().map_err(|_| refused("no such name".to_owned()))?;
                let there = Cuda::device_count().max(0) as usize;
                if index >= there {
                    return Err(refused(format!("libtorch sees {there} CUDA devices")));
                }
                Device::Cuda(index)
            }
            None => return Err(refused("no such name".to_owned())),
        };
        Ok(Self { device: torch_device, kind: Kind::Float, threads: threads.max(1) })
    }

    /// In f64, for measuring others.
    #[cfg(test)]
    pub(crate) fn exact() -> Self {
        Self { device: Device::Cpu, kind: Kind::Double, threads: 1 }
    }
}

impl GradientEngine for TorchEngine {
    fn gradient(
        &mut self,
        weights: &Tensors,
        example: &Example,
        options: &GradientOptions,
    ) -> Result<Gradient, EngineError> {
        tch::set_num_threads(self.threads as i32);
        let device = format!("{:?}", self.device);
        self.run(weights, example, options).map_err(|(doing, error)| {
            let message = error.to_string().lines().next().unwrap_or_default().to_owned();
            EngineError::Library { doing, device, message }
        })
    }
}

type Failed = (&'static str, TchError);

impl TorchEngine {
    fn run(
        &self,
        weights: &Tensors,
        example: &Example,
        options: &GradientOptions,
    ) -> Result<Gradient, Failed> {
        let doing = |what: &'static str| move |error| (what, error);
        let mut network = TrainedNetwork::new(weights, options.statistics, (self.kind, self.device))
            .map_err(doing("uploading weights"))?;
        let images = example.images.iter().map(|image| {
            let size = [1, 3, image.height as i64, image.width as i64];
            self.upload(&image.planes, &size)
        });
        let images: Vec<Tensor> = images.collect::<Result<_, _>>().map_err(doing("uploading images"))?;
        let (probability, index) =
            network.index(&images, example, options).map_err(doing("regressing depth"))?;
        let refined =
            network.refined(&index, &images[0], example, options).map_err(doing("refining depth"))?;
        let truth = example.truth.values();
        let truth = self.upload(truth, &[example.truth.height() as i64, example.truth.width() as i64]);
        let truth = truth.map_err(doing("uploading depth"))?;
        let total = || {
            let mut initial = loss(&index, &truth, &options.loss)?;
            if options.loss.absent_weight > 0.0 {
                let absent = absent_loss(&probability, &truth)?.f_mul_scalar(options.loss.absent_weight)?;
                initial = initial.f_add(&absent)?;
            }
            match &refined {
                Some(refined) => initial
                    .f_add(&loss(refined, &truth, &options.loss)?.f_mul_scalar(options.loss.refined_weight)?),
                None => Ok(initial),
            }
        };
        let total = total().map_err(doing("computing the loss"))?;
        total.f_backward().map_err(doing("computing gradients"))?;
        let download = || {
            let errors = |index: &Tensor| {
                Ok::<_, TchError>(IntervalErrors::of(values(index)?, example.truth.values()))
            };
            Ok(Gradient {
                loss: total.f_double_value(&[])?,
                initial: errors(&index)?,
                refined: refined.as_ref().map(errors).transpose()?,
                weights: network.gradients(weights)?,
                statistics: network.statistics()?,
            })
        };
        download().map_err(doing("reading gradients"))
    }

    fn upload(&self, values: &[f32], size: &[i64]) -> Result<Tensor, TchError> {
        Tensor::f_from_slice(values)?.f_view(size)?.f_to_kind(self.kind)?.f_to_device(self.device)
    }
}

/// Mean absolute error over pixels with a truth, in intervals.
fn loss(index: &Tensor, truth: &Tensor, config: &LossConfig) -> Result<Tensor, TchError> {
    let valid = truth.f_isfinite()?;
    let error = index.f_sub(truth)?.f_masked_select(&valid)?.f_abs()?;
    match config.clamp {
        Some(limit) => error.f_clamp_max(limit)?.f_mean(error.kind()),
        None => error.f_mean(error.kind()),
    }
}

/// The divergence of the probabilities from equal ones at pixels whose truth is at no hypothesis, over all pixels.
fn absent_loss(probability: &Tensor, truth: &Tensor) -> Result<Tensor, TchError> {
    let logarithms = probability.f_clamp_min(f64::from(f32::MIN_POSITIVE))?.f_log()?;
    let equal = (probability.size()[0] as f64).ln();
    let divergence = logarithms.f_mean_dim(0, false, logarithms.kind())?.f_neg()?.f_sub_scalar(equal)?;
    let absent = divergence.f_masked_fill(&truth.f_isinf()?.f_logical_not()?, 0.0)?;
    absent.f_mean(absent.kind())
}

/// The network with batch normalisation that can be differentiated.
struct TrainedNetwork {
    tensors: BTreeMap<String, Tensor>,
    statistics: BatchStatistics,
    measured: BTreeMap<String, Tensor>,
}

impl TrainedNetwork {
    fn new(
        weights: &Tensors,
        statistics: BatchStatistics,
        (kind, device): (Kind, Device),
    ) -> Result<Self, TchError> {
        let tensor = |(name, tensor): (&String, &WeightTensor)| {
            let shape: Vec<i64> = tensor.shape.iter().map(|size| *size as i64).collect();
            let values = Tensor::f_from_slice(&tensor.values)?.f_view(shape.as_slice())?;
            let values = values.f_to_kind(kind)?.f_to_device(device)?;
            Ok((name.clone(), values.f_set_requires_grad(!is_statistic(name))?))
        };
        let tensors = weights.iter().map(tensor).collect::<Result<_, TchError>>()?;
        Ok(Self { tensors, statistics, measured: BTreeMap::new() })
    }

    /// The probabilities of the hypotheses, and their expected index, at each pixel.
    fn index(
        &mut self,
        images: &[Tensor],
        example: &Example,
        options: &GradientOptions,
    ) -> Result<(Tensor, Tensor), TchError> {
        // One batch for batch normalisation, when the sizes agree; sources of other sizes make others.
        let features = self.features(&Tensor::f_cat(images, 0)?, options.network.features)?;
        let volume = cost_volume(&features, example, options.network.metric)?;
        let logits = self.regularized(&volume)?;
        let probability = depth::probability(&logits)?;
        let index = depth::expected_index(&probability)?;
        Ok((probability, index))
    }

    fn features(&mut self, images: &Tensor, network: FeatureNetwork) -> Result<Tensor, TchError> {
        if network == FeatureNetwork::SingleLayer {
            return self.convolution(images, "feature.feature", 4);
        }
        let mut x = images.shallow_clone();
        for (i, stride) in [1, 1, 2, 1, 1, 2, 1].into_iter().enumerate() {
            x = self.layer(&x, &format!("feature.conv{i}.conv"), &format!("feature.conv{i}.bn"), stride)?;
        }
        self.convolution(&x, "feature.feature", 1)
    }

    fn regularized(&mut self, volume: &Tensor) -> Result<Tensor, TchError> {
        let name = |i: usize| format!("cost_regularization.conv{i}");
        let mut x = self.layer(volume, &format!("{}.conv", name(0)), &format!("{}.bn", name(0)), 1)?;
        let mut skips = Vec::new();
        for i in [1, 3, 5] {
            skips.push(x.shallow_clone());
            x = self.layer(&x, &format!("{}.conv", name(i)), &format!("{}.bn", name(i)), 2)?;
            x = self.layer(&x, &format!("{}.conv", name(i + 1)), &format!("{}.bn", name(i + 1)), 1)?;
        }
        for i in [7, 9, 11] {
            let skip = skips.pop().expect("one skip for each step down");
            let kernel = &self.tensors[&format!("{}.0.weight", name(i))];
            let output_padding: Vec<i64> =
                skip.size()[2..].iter().zip(&x.size()[2..]).map(|(to, from)| to - (2 * from - 1)).collect();
            let bias = None::<Tensor>;
            let up =
                x.f_convolution(kernel, bias, [2, 2, 2], [1, 1, 1], [1, 1, 1], true, output_padding, 1)?;
            x = self.normalised(&up, &format!("{}.1", name(i)))?.f_relu()?.f_add(&skip)?;
        }
        self.convolution(&x, "cost_regularization.prob", 1)?.f_squeeze_dim(0)?.f_squeeze_dim(0)
    }

    fn refined(
        &mut self,
        index: &Tensor,
        image: &Tensor,
        example: &Example,
        options: &GradientOptions,
    ) -> Result<Option<Tensor>, TchError> {
        if options.network.refinement == Refinement::None {
            return Ok(None);
        }
        let steps = f64::from(example.hypotheses.count() - 1);
        let scaled = index.f_div_scalar(steps)?;
        let guide = image.f_slice(2, None, None, 4)?.f_slice(3, None, None, 4)?;
        let depth = scaled.f_to_kind(image.kind())?.f_unsqueeze(0)?.f_unsqueeze(0)?;
        let mut x = Tensor::f_cat(&[guide, depth], 1)?;
        for i in 1..4 {
            x = self.layer(
                &x,
                &format!("refine_network.conv{i}.conv"),
                &format!("refine_network.conv{i}.bn"),
                1,
            )?;
        }
        let residual = if options.network.refinement == Refinement::WithBnRelu {
            self.layer(&x, "refine_network.res.conv", "refine_network.res.bn", 1)?
        } else {
            self.convolution(&x, "refine_network.res", 1)?
        };
        let residual = residual.f_squeeze_dim(0)?.f_squeeze_dim(0)?;
        Ok(Some(scaled.f_add(&residual)?.f_mul_scalar(steps)?))
    }

    /// Convolution, batch normalisation, ReLU.
    fn layer(
        &mut self,
        input: &Tensor,
        convolution: &str,
        batch_norm: &str,
        stride: i64,
    ) -> Result<Tensor, TchError> {
        let output = self.convolution(input, convolution, stride)?;
        self.normalised(&output, batch_norm)?.f_relu()
    }

    /// A convolution, with its bias where it has one.
    fn convolution(&self, input: &Tensor, name: &str, stride: i64) -> Result<Tensor, TchError> {
        let weight = &self.tensors[&format!("{name}.weight")];
        let bias = self.tensors.get(&format!("{name}.bias"));
        let padding: Vec<i64> = weight.size()[2..].iter().map(|kernel| kernel / 2).collect();
        let (stride, ones, none) =
            (vec![stride; padding.len()], vec![1; padding.len()], vec![0; padding.len()]);
        input.f_convolution(weight, bias, stride, padding, ones, false, none, 1)
    }

    fn normalised(&mut self, input: &Tensor, name: &str) -> Result<Tensor, TchError> {
        let part = |part: &str| self.tensors[&format!("{name}.{part}")].shallow_clone();
        let (weight, bias) = (part("weight"), part("bias"));
        let own = self.statistics == BatchStatistics::Own;
        // With a momentum of one, the running statistics become those of this batch.
        let (mean, variance) = if own {
            (part("running_mean").f_zeros_like()?, part("running_var").f_zeros_like()?)
        } else {
            (part("running_mean"), part("running_var"))
        };
        let output = input.f_batch_norm(
            Some(&weight),
            Some(&bias),
            Some(&mean),
            Some(&variance),
            own,
            1.0,
            EPSILON,
            true,
        )?;
        if own {
            self.measured.insert(format!("{name}.running_mean"), mean);
            self.measured.insert(format!("{name}.running_var"), variance);
        }
        Ok(output)
    }

    fn gradients(&self, weights: &Tensors) -> Result<Tensors, TchError> {
        let trained = weights.iter().filter(|(name, _)| !is_statistic(name));
        let gradient = |(name, like): (&String, &WeightTensor)| {
            let gradient = self.tensors[name].f_grad()?;
            let values = if gradient.defined() { values(&gradient)? } else { vec![0.0; like.values.len()] };
            Ok((name.clone(), WeightTensor { shape: like.shape.clone(), values }))
        };
        trained.map(gradient).collect()
    }

    fn statistics(&self) -> Result<Tensors, TchError> {
        let measured = self.measured.iter().map(|(name, tensor)| {
            let values = values(tensor)?;
            Ok((name.clone(), WeightTensor { shape: vec![values.len()], values }))
        });
        measured.collect()
    }
}

/// The cost volume `[1, channels, depths, height, width]` of features `[views, channels, height, width]`, the
/// reference's first.
fn cost_volume(features: &Tensor, example: &Example, metric: CostMetric) -> Result<Tensor, TchError> {
    let (views, _, height, width) = features.size4()?;
    let depths = example.hypotheses.depths();
    let size = (width as usize, height as usize);
    let mut sum = features.f_narrow(0, 0, 1)?.f_expand([depths.len() as i64, -1, -1, -1], false)?;
    let mut squares = sum.f_square()?;
    for view in 1..views {
        let sweep =
            sweep(&example.projections[0], &example.projections[view as usize], size, features.device())?;
        let warped = sweep.apply(&features.f_narrow(0, view, 1)?, &depths)?;
        sum = sum.f_add(&warped)?;
        if metric == CostMetric::Variance {
            squares = squares.f_add(&warped.f_square()?)?;
        }
    }
    let mean = sum.f_div_scalar(views)?;
    let cost = match metric {
        CostMetric::Mean => mean,
        CostMetric::Variance => squares.f_div_scalar(views)?.f_sub(&mean.f_square()?)?,
    };
    cost.f_transpose(0, 1)?.f_unsqueeze(0)
}

fn sweep(
    reference: &Matrix3x4<f64>,
    source: &Matrix3x4<f64>,
    size: (usize, usize),
    device: Device,
) -> Result<PlaneSweep, TchError> {
    PlaneSweep::new(reference, size, source, size, device).expect("examples have invertible references")
}

/// All values of a tensor as f32, on the host.
fn values(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let tensor = tensor.f_detach()?.f_to_kind(Kind::Float)?.f_to_device(Device::Cpu)?.f_contiguous()?;
    let mut values = vec![0.0; tensor.numel()];
    tensor.f_copy_data(&mut values, tensor.numel())?;
    Ok(values)
}
