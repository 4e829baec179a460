//! The cost volume (paper section 3.2, equation 2): how much the warped features of all views differ.

use tch::{TchError, Tensor};

use crate::CostMetric;
use crate::warp::PlaneSweep;

/// Planes warped at a time. Feature volumes of single views exist for these planes only.
const PLANES: usize = 8;

/// The cost volume `[1, channels, depths, height, width]` of reference features and of source features
/// (all `[1, channels, height, width]`) with their sweeps, for depths in scene units.
pub(crate) fn cost_volume(
    reference: &Tensor,
    sources: &[(&Tensor, PlaneSweep)],
    depths: &[f64],
    metric: CostMetric,
) -> Result<Tensor, TchError> {
    let (_, channels, height, width) = reference.size4()?;
    let options = (reference.kind(), reference.device());
    // Channels innermost: on the CPU, 3D convolution takes half the time and memory with them there.
    let size = [1, depths.len() as i64, height, width, channels];
    let volume = Tensor::f_empty(size, options)?.f_permute([0, 4, 1, 2, 3])?;
    for (i, depths) in depths.chunks(PLANES).enumerate() {
        let planes = depths.len() as i64;
        let reference = reference.f_repeat([planes, 1, 1, 1])?;
        let warped = sources.iter().map(|(features, sweep)| sweep.apply(features, depths));
        let cost = cost(reference, warped, metric)?;
        volume.f_narrow(2, (i * PLANES) as i64, planes)?.f_copy_(&cost.f_transpose(0, 1)?.f_unsqueeze(0)?)?;
    }
    Ok(volume)
}

/// The same as the public implementations make it: each view's features are warped onto all planes before
/// the next view's, and channels are outermost.
pub(crate) fn cost_volume_at_once(
    reference: &Tensor,
    sources: &[(&Tensor, PlaneSweep)],
    depths: &[f64],
    metric: CostMetric,
) -> Result<Tensor, TchError> {
    let reference = reference.f_unsqueeze(2)?.f_repeat([1, 1, depths.len() as i64, 1, 1])?;
    cost(reference, sources.iter().map(|(features, sweep)| sweep.apply_at_once(features, depths)), metric)
}

/// The cost of the reference's features and those warped onto it, all of one shape.
///
/// The variance over the `N` views is `sum(v^2) / N - (sum(v) / N)^2` from running sums, so any number of
/// views needs the memory of one.
fn cost(
    reference: Tensor,
    warped: impl ExactSizeIterator<Item = Result<Tensor, TchError>>,
    metric: CostMetric,
) -> Result<Tensor, TchError> {
    let views = (warped.len() + 1) as f64;
    let mut sum = reference;
    match metric {
        CostMetric::Mean => {
            for features in warped {
                let _ = sum.f_add_(&features?)?;
            }
            sum.f_div_scalar_(views)
        }
        CostMetric::Variance => {
            let mut squares = sum.f_square()?;
            for features in warped {
                let features = features?;
                let _ = sum.f_add_(&features)?;
                let _ = squares.f_addcmul_(&features, &features)?;
            }
            let mut mean = sum.f_div_scalar_(views)?;
            squares.f_div_scalar_(views)?.f_sub_(&mean.f_square_()?)
        }
    }
}
