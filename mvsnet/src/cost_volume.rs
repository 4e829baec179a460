//! The cost volume (paper section 3.2, equation 2): how much the warped features of all views differ.

use tch::{TchError, Tensor};

use crate::CostMetric;
use crate::warp::PlaneSweep;

/// Planes warped at a time. Feature volumes of single views exist for these planes only.
const PLANES: usize = 8;

/// The cost volume `[1, channels, depths, height, width]` of reference features and of source features
/// (all `[1, channels, height, width]`) with their sweeps, for depths in scene units.
///
/// The variance over the `N` views is `sum(v^2) / N - (sum(v) / N)^2` from running sums, so any number of
/// views needs the memory of one.
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
    let views = (sources.len() + 1) as f64;
    for (i, depths) in depths.chunks(PLANES).enumerate() {
        let planes = depths.len() as i64;
        let mut sum = reference.f_repeat([planes, 1, 1, 1])?;
        let cost = match metric {
            CostMetric::Mean => {
                for (features, sweep) in sources {
                    let _ = sum.f_add_(&sweep.apply(features, depths)?)?;
                }
                sum.f_div_scalar_(views)?
            }
            CostMetric::Variance => {
                let mut squares = sum.f_square()?;
                for (features, sweep) in sources {
                    let warped = sweep.apply(features, depths)?;
                    let _ = sum.f_add_(&warped)?;
                    let _ = squares.f_addcmul_(&warped, &warped)?;
                }
                let mean = sum.f_div_scalar_(views)?;
                squares.f_div_scalar_(views)?.f_sub_(&mean.f_square()?)?
            }
        };
        volume.f_narrow(2, (i * PLANES) as i64, planes)?.f_copy_(&cost.f_transpose(0, 1)?.f_unsqueeze(0)?)?;
    }
    Ok(volume)
}
