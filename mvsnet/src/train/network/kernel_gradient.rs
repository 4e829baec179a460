//! Gradients of the kernels of convolutions.

use rayon::prelude::*;

use super::convolution::{Convolution, Sizes};
use super::stack::{Stack, Tools};
use crate::WeightTensor;
use crate::kernels::correlate::{Correlation, OUTPUTS};
use crate::kernels::simd::LANES;
use crate::kernels::slab::Column;
use crate::kernels::winograd::PRODUCTS;
use crate::kernels::winograd_gradient::{self, ProductScratch, WinogradProducts};

/// Parts that a slab is cut into, at most.
const MOST_STRIPS: usize = 24;

impl Convolution<'_> {
    /// The gradient of the kernel.
    pub(super) fn kernel_gradient(&self, tools: &Tools, input: &Stack, gradient: &Stack) -> WeightTensor {
        if self.sizes == Sizes::Same && WinogradProducts::fit(self.inputs, self.outputs) {
            return self.by_winograd(tools, input, gradient);
        }
        // A doubling layer is a halving one with input and output exchanged; a kernel with few outputs is
        // correlated the other way round, which mirrors its taps.
        let exchanged = self.sizes == Sizes::Doubled;
        let mirrored = !exchanged && !self.outputs.is_multiple_of(OUTPUTS);
        let (coarse, fine) = if exchanged || mirrored { (input, gradient) } else { (gradient, input) };
        let stride = if self.sizes == Sizes::Same { 1 } else { 2 };
        let (blocks, others) = if exchanged || mirrored {
            (self.inputs / OUTPUTS, self.outputs)
        } else {
            (self.outputs / OUTPUTS, self.inputs)
        };
        let vectors = coarse.slabs.len() * coarse.shape.columns * coarse.shape.length.div_ceil(16);
        let strips = (vectors / 320).clamp(1, 24);
        let (rows, columns, size) = (self.rows(), self.size, self.size);
        let tasks: Vec<_> =
            (0..strips).flat_map(|strip| (0..blocks).map(move |block| (strip, block))).collect();
        let parts: Vec<Vec<f32>> = tasks
            .par_iter()
            .map(|(strip, block)| {
                let mut all = Vec::with_capacity(rows * columns * fine.shape.channels * OUTPUTS * size);
                for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
                    let pairs = self.pairs(coarse, fine, stride, [row, column], [*strip, strips]);
                    let correlation = Correlation { pairs: &pairs, output: block * OUTPUTS, stride, size };
                    let mut sums = correlation.sums(tools.level);
                    sums.resize(fine.shape.channels * OUTPUTS * size, 0.0);
                    all.extend(sums);
                }
                all
            })
            .collect();
        let mut result =
            WeightTensor { shape: self.kernel.shape.clone(), values: vec![0.0; self.kernel.values.len()] };
        for ((_, block), part) in tasks.iter().zip(&parts) {
            let mut sums = part.iter();
            for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
                for other in 0..fine.shape.channels {
                    for one in 0..OUTPUTS {
                        for k in 0..size {
                            let sum = sums.next().expect("a sum for each tap");
                            if other >= others {
                                continue;
                            }
                            let one = block * OUTPUTS + one;
                            let at = if mirrored {
                                let row = if self.volume { size - 1 - row } else { 0 };
                                self.index(other, one, row, size - 1 - column, size - 1 - k)
                            } else if exchanged {
                                self.index(other, one, row, column, k)
                            } else {
                                self.index(one, other, row, column, k)
                            };
                            result.values[at] += sum;
                        }
                    }
                }
            }
        }
        result
    }

    /// That of a kernel of size 3 and stride 1.
    fn by_winograd(&self, tools: &Tools, input: &Stack, gradient: &Stack) -> WeightTensor {
        let rows = self.rows();
        let products = WinogradProducts { input: &input.slabs, gradient: &gradient.slabs, rows };
        let vectors = products.vectors();
        let strips = vectors.div_ceil(4).next_multiple_of(2).min(MOST_STRIPS).min(vectors);
        let sums = |scratch: &mut ProductScratch, strip: usize| {
            let vectors = strip * vectors / strips..(strip + 1) * vectors / strips;
            products.sums(tools.level, vectors, scratch)
        };
        let parts = (0..strips).into_par_iter().map_init(ProductScratch::default, sums);
        let parts: Vec<Vec<f32>> = parts.collect();
        let mut values = vec![0.0; self.kernel.values.len()];
        let of_output = values.par_chunks_exact_mut(self.index(1, 0, 0, 0, 0));
        of_output.enumerate().for_each(|(output, values)| {
            for (input, row) in (0..self.inputs).flat_map(|input| (0..rows).map(move |row| (input, row))) {
                let mut sums = [0.0; PRODUCTS];
                for (product, sum) in sums.iter_mut().enumerate() {
                    let at = (product * rows + row) * self.inputs / LANES + input / LANES;
                    let at = (at * self.outputs + output) * LANES + input % LANES;
                    *sum = parts.iter().map(|sums| f64::from(sums[at])).sum();
                }
                let taps = winograd_gradient::taps(&sums);
                for (column, k) in (0..3).flat_map(|column| (0..3).map(move |k| (column, k))) {
                    values[self.index(0, input, row, column, k)] = taps[column][k] as f32;
                }
            }
        });
        WeightTensor { shape: self.kernel.shape.clone(), values }
    }

    /// Pairs of columns that meet at a row and column of the kernel, in one of some strips of the coarser stack.
    fn pairs<'s>(
        &self,
        coarse: &'s Stack,
        fine: &'s Stack,
        stride: usize,
        [row, column]: [usize; 2],
        [strip, strips]: [usize; 2],
    ) -> Vec<(Column<'s>, Column<'s>)> {
        let columns = coarse.shape.columns;
        let all = coarse.slabs.len() * columns;
        let reach = (self.size / 2) as isize;
        let mut pairs = Vec::new();
        for at in strip * all / strips..(strip + 1) * all / strips {
            let (slab, x) = (at / columns, at % columns);
            let other = if self.volume { (stride * slab + row) as isize - 1 } else { slab as isize };
            let fine_x = (stride * x + column) as isize - reach;
            if !(0..fine.slabs.len() as isize).contains(&other)
                || !(0..fine.shape.columns as isize).contains(&fine_x)
            {
                continue;
            }
            pairs.push((coarse.slabs[slab].column(x as isize), fine.slabs[other as usize].column(fine_x)));
        }
        pairs
    }
}
