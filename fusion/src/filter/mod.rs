//! One reference view against its neighbours: both criteria, and the mean over the views that agree.

mod unwritten;

use planesweep_scene::{Camera, DepthMap, Raster};
use rayon::prelude::*;

use crate::funnel::Funnel;
use crate::geometric::{Neighbour, assert_rasters_match};
use crate::hypotheses::HypothesisRow;
use crate::kernel::{self, Input, Level, OutputRow, filter_row};
use crate::options::{FilterOptions, FusionMethod};
use crate::photometric::confident_depths;
use crate::visibility::{self, Candidates};
use unwritten::Unwritten;

/// Neighbours whose agreement [`FilteredMap::agreeing`] can record.
pub const MAX_RECORDED: usize = u64::BITS as usize;

/// What the filter left of a depth map; all rasters have the size of its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct FilteredMap {
    /// The camera of the depth map.
    pub camera: Camera,
    /// Mean depth of the views that agree (z, scene units); 0 where the pixel was dropped.
    pub depth: Raster<f32>,
    /// Mean red, green, blue and, in 255ths, confidence of the views that agree; zeros where the pixel was dropped.
    pub color: Raster<[u8; 4]>,
    /// How many views agree, the reference included, 255 meaning that or more; counted for dropped
    /// pixels too, 0 where there is nothing to agree with.
    pub views: Raster<u8>,
    /// Which neighbours agree: bit k is the one at index k, as far as there are bits; 0 where the
    /// pixel was dropped.
    pub agreeing: Raster<u64>,
    /// Whether the pixel owns its surface: no view that agrees and is confident, in 255ths, sees it with a
    /// smaller footprint. False where the pixel was dropped.
    pub owns: Raster<bool>,
    /// How many pixels each step left; `emitted` is 0 yet.
    pub funnel: Funnel,
}

/// Filters a depth map against those of its neighbours, by the method of the options (paper, section
/// 4.2; DESIGN section 6).
///
/// A *hypothesis* is tested for each pixel: with [`FusionMethod::Consistency`] and
/// [`FusionMethod::Dynamic`] the pixel's own depth, if its confidence is at least
/// [`FilterOptions::min_confidence`]; with the visibility methods one of the confident depths of all views
/// that lie along the pixel's line of sight, so that a pixel without a depth may get one.
///
/// A pixel is kept when at least [`FilterOptions::min_views`] views, the reference included, agree
/// with the hypothesis. A neighbour agrees when its depth at the projection of the hypothesis, projected
/// back, comes closer to the pixel than [`FilterOptions::max_reprojection_px`] and closer to its depth
/// than [`FilterOptions::max_relative_depth`]. The neighbours' confidence plays no part in that, as in
/// the common scripts. The maps may be of different sizes.
///
/// Rows are computed in parallel; the result has the same bits for any number of threads.
///
/// # Panics
/// When the rasters of a map differ in size, which [`DepthMap::new`] refuses, or it has 2^29 columns or more.
pub fn filter(reference: &DepthMap, neighbours: &[&DepthMap], options: &FilterOptions) -> FilteredMap {
    filter_with(Level::detect(), reference, neighbours, options)
}

/// The same with the instructions of `level`.
fn filter_with(
    level: Level,
    reference: &DepthMap,
    neighbours: &[&DepthMap],
    options: &FilterOptions,
) -> FilteredMap {
    assert_rasters_match(reference);
    let (width, height) = (reference.width(), reference.height());
    let neighbours: Vec<_> = neighbours.iter().map(|map| Neighbour::new(&reference.camera, map)).collect();
    let candidates = match options.method {
        FusionMethod::Consistency | FusionMethod::Dynamic => None,
        FusionMethod::Visibility | FusionMethod::VisibilityConfidence => {
            Some(Candidates::new(reference, &neighbours, options, level))
        }
    };
    let input = Input { reference, neighbours: &neighbours, options, level };
    let mut depth = Unwritten::new(width, height);
    let mut color = Unwritten::new(width, height);
    let mut views = Unwritten::new(width, height);
    let mut agreeing = Unwritten::new(width, height);
    let mut owns = Unwritten::new(width, height);
    let rows = depth.rows().zip(color.rows()).zip(views.rows()).zip(agreeing.rows()).zip(owns.rows());
    let funnel = rows
        .enumerate()
        .map_init(RowFilter::default, |row, (y, ((((depth, color), views), agreeing), owns))| {
            let mut out = OutputRow { depth, color, views, agreeing, owns };
            row.run(&input, candidates.as_ref(), y, &mut out)
        })
        .sum();
    // SAFETY: the loop took every row of each.
    #[allow(
        unsafe_code,
        reason = "clearing all of the result first, on one thread, would take a tenth of the time"
    )]
    unsafe {
        FilteredMap {
            camera: reference.camera,
            depth: depth.written(),
            color: color.written(),
            views: views.written(),
            agreeing: agreeing.written(),
            owns: owns.written(),
            funnel,
        }
    }
}

/// The filter of one row, with the memory it uses again for the next.
#[derive(Default)]
struct RowFilter {
    hypotheses: HypothesisRow,
    visibility: visibility::Scratch,
    kernel: kernel::Scratch,
}

impl RowFilter {
    /// Filters row `y`; with the visibility methods there are `candidates`.
    fn run(
        &mut self,
        input: &Input<'_>,
        candidates: Option<&Candidates<'_>>,
        y: usize,
        out: &mut OutputRow<'_>,
    ) -> Funnel {
        let Input { reference, options, level, .. } = *input;
        let (with_depth, photometric) = if let Some(candidates) = candidates {
            let counts = candidates.choose(y, &mut self.visibility, &mut self.hypotheses);
            (counts.with_depth, counts.photometric)
        } else {
            let with_depth =
                confident_depths(level, reference, y, options.min_confidence, &mut self.hypotheses);
            (with_depth, self.hypotheses.len())
        };
        let geometric = filter_row(input, y, &self.hypotheses, &mut self.kernel, out);
        Funnel {
            pixels: reference.width() as u64,
            with_depth: with_depth as u64,
            photometric: photometric as u64,
            visible: self.hypotheses.len() as u64,
            geometric: geometric as u64,
            emitted: 0,
        }
    }
}

#[cfg(test)]
mod tests;
