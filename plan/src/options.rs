//! What the user may choose of a plan.

use planesweep_fusion::FilterOptions;
use serde::{Deserialize, Serialize};

/// Fewest depth hypotheses that are chosen without being asked for.
pub const MIN_DEPTHS: u32 = 64;
/// Most depth hypotheses that are chosen without being asked for.
pub const MAX_DEPTHS: u32 = 512;

/// How the spacing of depth hypotheses is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SamplingChoice {
    /// Inverse where the far end is more than three times as far as the near end, else uniform.
    #[default]
    Auto,
    /// Equal steps of depth.
    Uniform,
    /// Equal steps of inverse depth.
    Inverse,
}

/// The choices that shape a plan; all of them change the result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanOptions {
    /// Images per inference, the reference included (the paper's N); at least 2.
    pub views: u32,
    /// Best source views that a depth map is checked against. The graph is made symmetric, so a view
    /// may end with more.
    pub fusion_views: u32,
    /// Longest side of the working image, in pixels; smaller images are not enlarged.
    pub max_size: Option<u32>,
    /// Number of depth hypotheses; by default the scene's files say, else the resolution does.
    pub depths: Option<u32>,
    /// Spacing of the hypotheses.
    pub sampling: SamplingChoice,
    /// Depth range of every view in scene units, nearest and farthest; by default the scene's files
    /// or its sparse points say.
    pub depth_range: Option<(f64, f64)>,
    /// Rows of the working image that one job infers, at least; by default a view is one job. The halo that a
    /// band computes besides is about 120 rows on either side, so fewer than 512 rows waste work. Changes no
    /// bit of the result.
    pub band_rows: Option<u32>,
    /// How depth maps are checked against each other.
    pub filter: FilterOptions,
    /// Whether a surface that several views see is emitted by one of them only.
    #[serde(default)]
    pub once_per_surface: bool,
    /// Whether depth maps are upsampled to the resolution of the working images before they are fused.
    #[serde(default)]
    pub full_resolution: bool,
}

impl Default for PlanOptions {
    fn default() -> Self {
        Self {
            views: 5,
            fusion_views: 10,
            max_size: None,
            depths: None,
            sampling: SamplingChoice::Auto,
            depth_range: None,
            band_rows: None,
            filter: FilterOptions::default(),
            once_per_surface: true,
            full_resolution: false,
        }
    }
}
