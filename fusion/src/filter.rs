//! One reference view against its neighbours: both criteria, and the mean over the views that agree.

use planesweep_scene::{Camera, DepthMap, Raster};
use rayon::prelude::*;

use crate::color::ColorMean;
use crate::funnel::Funnel;
use crate::geometric::{Agreement, Neighbour};
use crate::options::FilterOptions;
use crate::photometric::ConfidentRow;

/// What the filter left of a depth map; all rasters have the size of its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct FilteredMap {
    /// The camera of the depth map.
    pub camera: Camera,
    /// Mean depth of the views that agree (z, scene units); 0 where the pixel was dropped.
    pub depth: Raster<f32>,
    /// Mean colour of the views that agree; black where the pixel was dropped.
    pub color: Raster<[u8; 3]>,
    /// How many views agree, the reference included, 255 meaning that or more; counted for dropped
    /// pixels too, 0 where there is no confident depth.
    pub views: Raster<u8>,
    /// How many pixels each step left.
    pub funnel: Funnel,
}

/// Filters a depth map against those of its neighbours (paper, section 4.2).
///
/// A pixel is kept when its confidence is at least [`FilterOptions::min_confidence`] and at least
/// [`FilterOptions::min_views`] views, the reference included, agree with its depth. A neighbour
/// agrees when its depth at the projection of the pixel, projected back, comes closer to the pixel
/// than [`FilterOptions::max_reprojection_px`] and closer to its depth than
/// [`FilterOptions::max_relative_depth`]. The neighbours' confidence plays no part, as in the common
/// scripts. The maps may be of different sizes.
///
/// Rows are computed in parallel; the result has the same bits for any number of threads.
///
/// # Panics
/// When the rasters of a map differ in size, which [`DepthMap::new`] refuses.
pub fn filter(reference: &DepthMap, neighbours: &[&DepthMap], options: &FilterOptions) -> FilteredMap {
    let (width, height) = (reference.width(), reference.height());
    let neighbours: Vec<_> = neighbours.iter().map(|map| Neighbour::new(&reference.camera, map)).collect();
    let mut depth = Raster::filled(width, height, 0.0);
    let mut color = Raster::filled(width, height, [0; 3]);
    let mut views = Raster::filled(width, height, 0);
    let columns = width.max(1); // a chunk of an empty map
    let rows = depth
        .values_mut()
        .par_chunks_exact_mut(columns)
        .zip(color.values_mut().par_chunks_exact_mut(columns))
        .zip(views.values_mut().par_chunks_exact_mut(columns));
    let funnel = rows
        .enumerate()
        .map_init(RowFilter::default, |row, (y, ((depth, color), views))| {
            row.run(reference, &neighbours, options, y, &mut OutputRow { depth, color, views })
        })
        .sum();
    FilteredMap { camera: reference.camera, depth, color, views, funnel }
}

/// A row of each raster of the result, all zeros at first.
struct OutputRow<'a> {
    depth: &'a mut [f32],
    color: &'a mut [[u8; 3]],
    views: &'a mut [u8],
}

/// The filter of one row, with the memory it uses again for the next.
#[derive(Default)]
struct RowFilter {
    confident: ConfidentRow,
    /// By neighbour.
    agreements: Vec<Agreement>,
    /// Sum of the agreeing depths and their number, by confident pixel.
    sums: Vec<f32>,
    counts: Vec<u32>,
    /// The confident pixels that enough views agree with, and their colours.
    kept: Vec<u32>,
    colors: Vec<ColorMean>,
}

impl RowFilter {
    fn run(
        &mut self,
        reference: &DepthMap,
        neighbours: &[Neighbour<'_>],
        options: &FilterOptions,
        y: usize,
        out: &mut OutputRow<'_>,
    ) -> Funnel {
        self.confident.select(reference, y, options.min_confidence);
        self.agreements.resize_with(neighbours.len(), Agreement::default);
        for (neighbour, agreement) in neighbours.iter().zip(&mut self.agreements) {
            neighbour.agreement(&self.confident, y, options, agreement);
        }
        self.add_depths();
        self.keep(options.min_views);
        self.add_colors(reference, neighbours, y);
        self.write(out);
        Funnel {
            pixels: reference.width() as u64,
            with_depth: self.confident.with_depth as u64,
            photometric: self.confident.depths.len() as u64,
            geometric: self.kept.len() as u64,
        }
    }

    fn add_depths(&mut self) {
        self.sums.clone_from(&self.confident.depths);
        self.counts.clear();
        self.counts.resize(self.sums.len(), 1);
        for agreement in &self.agreements {
            for ((sum, count), depth) in self.sums.iter_mut().zip(&mut self.counts).zip(&agreement.depth) {
                *sum += depth;
                *count += u32::from(*depth > 0.0);
            }
        }
    }

    fn keep(&mut self, min_views: u32) {
        self.kept.clear();
        self.kept.extend((0_u32..).zip(&self.counts).filter(|(_, n)| **n >= min_views).map(|(i, _)| i));
    }

    fn add_colors(&mut self, reference: &DepthMap, neighbours: &[Neighbour<'_>], y: usize) {
        let own = reference.color.row(y);
        let columns = &self.confident.columns;
        self.colors.clear();
        self.colors.extend(self.kept.iter().map(|i| ColorMean::new(own[columns[*i as usize] as usize])));
        for (neighbour, Agreement { u, v, depth }) in neighbours.iter().zip(&self.agreements) {
            for (i, color) in self.kept.iter().zip(&mut self.colors) {
                let i = *i as usize;
                if depth[i] > 0.0 {
                    color.add(&neighbour.map.color, u[i], v[i]);
                }
            }
        }
    }

    fn write(&self, out: &mut OutputRow<'_>) {
        for (x, count) in self.confident.columns.iter().zip(&self.counts) {
            out.views[*x as usize] = (*count).min(255) as u8;
        }
        for (i, color) in self.kept.iter().zip(&self.colors) {
            let i = *i as usize;
            let x = self.confident.columns[i] as usize;
            out.depth[x] = self.sums[i] / self.counts[i] as f32;
            out.color[x] = color.color();
        }
    }
}
