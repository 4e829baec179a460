//! The options of the filter.

use planesweep_fusion::{DepthSampling, FilterOptions, FusionMethod};

use super::check::in_range;
use crate::limits::MAX_VIEWS;
use crate::{WireError, wire};

impl From<FilterOptions> for wire::FilterOptions {
    fn from(options: FilterOptions) -> Self {
        let sampling = match options.sampling {
            DepthSampling::Bilinear => wire::DepthSampling::Bilinear,
            DepthSampling::Continuous => wire::DepthSampling::Continuous,
        };
        let method = match options.method {
            FusionMethod::Consistency => wire::FusionMethod::Consistency,
            FusionMethod::Dynamic => wire::FusionMethod::Dynamic,
            FusionMethod::Visibility => wire::FusionMethod::Visibility,
            FusionMethod::VisibilityConfidence => wire::FusionMethod::VisibilityConfidence,
        };
        Self {
            min_confidence: options.min_confidence,
            max_reprojection_px: options.max_reprojection_px,
            max_relative_depth: options.max_relative_depth,
            min_views: options.min_views,
            sampling: sampling.into(),
            method: method.into(),
            network_pixel: options.network_pixel,
        }
    }
}

impl TryFrom<wire::FilterOptions> for FilterOptions {
    type Error = WireError;

    fn try_from(options: wire::FilterOptions) -> Result<Self, WireError> {
        Ok(Self {
            min_confidence: threshold("min_confidence", options.min_confidence)?,
            max_reprojection_px: threshold("max_reprojection_px", options.max_reprojection_px)?,
            max_relative_depth: threshold("max_relative_depth", options.max_relative_depth)?,
            min_views: in_range("min_views", options.min_views, 1, MAX_VIEWS as u32)?,
            sampling: match wire::DepthSampling::try_from(options.sampling) {
                Ok(wire::DepthSampling::Bilinear) => DepthSampling::Bilinear,
                Ok(wire::DepthSampling::Continuous) => DepthSampling::Continuous,
                _ => return Err(WireError::UnknownValue { field: "sampling", value: options.sampling }),
            },
            method: match wire::FusionMethod::try_from(options.method) {
                Ok(wire::FusionMethod::Consistency) => FusionMethod::Consistency,
                Ok(wire::FusionMethod::Dynamic) => FusionMethod::Dynamic,
                Ok(wire::FusionMethod::Visibility) => FusionMethod::Visibility,
                Ok(wire::FusionMethod::VisibilityConfidence) => FusionMethod::VisibilityConfidence,
                _ => return Err(WireError::UnknownValue { field: "method", value: options.method }),
            },
            network_pixel: match options.network_pixel {
                0.0 => 1.0,
                pixel if pixel > 0.0 && pixel.is_finite() => pixel,
                pixel => {
                    let (field, value) = ("network_pixel", pixel.into());
                    return Err(WireError::BadNumber { field, value, expected: "positive" });
                }
            },
        })
    }
}

/// A threshold; it may be infinite, which switches a criterion off.
pub(super) fn threshold(field: &'static str, value: f32) -> Result<f32, WireError> {
    if value >= 0.0 {
        Ok(value)
    } else {
        Err(WireError::BadNumber { field, value: value.into(), expected: "at least 0" })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use proptest::prelude::*;
    use proptest::sample::select;

    use super::*;

    /// Any options that pass.
    pub fn options() -> impl Strategy<Value = FilterOptions> {
        let methods = [
            FusionMethod::Consistency,
            FusionMethod::Dynamic,
            FusionMethod::Visibility,
            FusionMethod::VisibilityConfidence,
        ];
        let method = select(methods.to_vec());
        (method, 0.0..=1.0_f32, 0.01..9.0_f32, 1e-4..0.5_f32, 1..9_u32, any::<bool>()).prop_map(
            |(method, min_confidence, max_reprojection_px, max_relative_depth, min_views, plain)| {
                FilterOptions {
                    method,
                    min_confidence,
                    max_reprojection_px,
                    max_relative_depth,
                    min_views,
                    sampling: if plain { DepthSampling::Bilinear } else { DepthSampling::Continuous },
                    network_pixel: if plain { 1.0 } else { 4.0 },
                }
            },
        )
    }
}
