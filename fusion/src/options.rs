//! What a pixel must satisfy to become a point.

use serde::{Deserialize, Serialize};

/// How the depth maps are checked against each other, and by which thresholds (paper, section 4.2).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FilterOptions {
    /// What decides whether a depth is kept.
    #[serde(default)]
    pub method: FusionMethod,
    /// Pixels with less confidence are dropped.
    pub min_confidence: f32,
    /// Largest distance between a pixel and its reprojection, exclusive, in pixels of the network's depth map.
    pub max_reprojection_px: f32,
    /// Largest relative difference of the reprojected depth, exclusive.
    pub max_relative_depth: f32,
    /// How many views must agree on a depth, the reference view included. The paper asks for "three
    /// view consistent", 3 here; the public PyTorch port asks for three sources, 4 here.
    pub min_views: u32,
    /// How a neighbour's depth is read between its pixels.
    #[serde(default)]
    pub sampling: DepthSampling,
    /// Width of a pixel of the network's depth map in pixels of the maps at hand, which are wider where they were
    /// upsampled: thresholds in pixels are in those of the network.
    #[serde(default = "one")]
    pub network_pixel: f32,
}

fn one() -> f32 {
    1.0
}

impl Default for FilterOptions {
    fn default() -> Self {
        Self {
            method: FusionMethod::default(),
            min_confidence: 0.8,
            max_reprojection_px: 1.0,
            max_relative_depth: 0.01,
            min_views: 3,
            sampling: DepthSampling::default(),
            network_pixel: one(),
        }
    }
}

/// The thresholds of evaluation scripts that are in common use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preset {
    /// The public PyTorch port of MVSNet: confidence 0.8, three sources within 1 pixel and 1 %.
    MvsNet,
    /// CasMVSNet and those that took its script over: confidence 0.9, five sources within 1 pixel and 1 %.
    CasMvsNet,
    /// D2HC-RMVSNet: confidence 0.3, dynamic consistency of two sources and more.
    Dynamic,
}

impl Preset {
    /// Its thresholds. Scripts count sources, so `min_views` is one more.
    pub fn options(self) -> FilterOptions {
        let (method, min_confidence, min_views) = match self {
            Self::MvsNet => (FusionMethod::Consistency, 0.8, 4),
            Self::CasMvsNet => (FusionMethod::Consistency, 0.9, 6),
            Self::Dynamic => (FusionMethod::Dynamic, 0.3, 3),
        };
        FilterOptions { method, min_confidence, min_views, ..FilterOptions::default() }
    }
}

/// What decides whether a depth is kept, and which.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FusionMethod {
    /// Enough views agree with the reference's own depth (paper, section 4.2).
    #[default]
    Consistency,
    /// As `Consistency`, with thresholds that relax as more views agree: n neighbours within n/4
    /// pixels and n/1300 of the depth, for any n of at least `min_views` - 1 (D2HC-RMVSNet, Yan et al.
    /// 2020). The two thresholds of [`FilterOptions`] play no part.
    Dynamic,
    /// The nearest of all views' depths that not more views see through than agree with it or have
    /// something in front of it; at least `min_views` must agree with it (stability-based fusion,
    /// Merrell et al. 2007).
    Visibility,
    /// The most confident of all views' depths, when the confidence of those that agree outweighs that
    /// of those that contradict it by `min_confidence`; at least `min_views` must agree with it
    /// (confidence-based fusion, Merrell et al. 2007).
    VisibilityConfidence,
}

/// How a depth map is read between its pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthSampling {
    /// Bilinear over the four pixels around, whatever they hold: a missing depth and what lies
    /// outside count as 0, as with OpenCV's `remap` in the common scripts.
    #[default]
    Bilinear,
    /// Bilinear over those of the four pixels that hold a depth and differ from the nearest pixel's
    /// by less than `max_relative_depth`; none where the nearest pixel has no depth.
    Continuous,
}
