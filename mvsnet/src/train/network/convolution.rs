//! Convolutions forward, and what the gradient of their output says of input and kernel.

use std::ops::Range;
use std::sync::Arc;

use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::WeightTensor;
use crate::bands::{Row, taps};
use crate::kernels::regress::RegressionLayer;
use crate::kernels::slab::{Shape, Slab};
use crate::kernels::strided::StridedLayer;
use crate::kernels::transposed::TransposedLayer;
use crate::kernels::winograd::{Target, WinogradLayer};
use crate::kernels::winograd_volume::{VolumeScratch, pair_of_rows};

/// Pairs of columns that are too few to keep threads busy.
const FEW_PAIRS: usize = 16;

/// What a layer does with sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sizes {
    /// Keeps them; kernels of size 3.
    Same,
    /// Halves them; kernels of size 3 in volumes, 5 in images.
    Halved,
    /// Doubles them; kernels of size 3, of volumes.
    Doubled,
}

/// A convolution of images or volumes with its kernel.
#[derive(Debug)]
pub(super) struct Convolution<'a> {
    pub(super) sizes: Sizes,
    pub(super) volume: bool,
    pub(super) kernel: &'a WeightTensor,
    bias: Vec<f64>,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Size of the kernel along each axis.
    pub(super) size: usize,
}

impl<'a> Convolution<'a> {
    pub(super) fn new(sizes: Sizes, kernel: &'a WeightTensor, bias: Option<&WeightTensor>) -> Self {
        let shape = &kernel.shape;
        let (outputs, inputs) =
            if sizes == Sizes::Doubled { (shape[1], shape[0]) } else { (shape[0], shape[1]) };
        let bias = bias.map_or_else(
            || vec![0.0; outputs],
            |bias| bias.values.iter().map(|value| f64::from(*value)).collect(),
        );
        Self { sizes, volume: shape.len() == 5, kernel, bias, inputs, outputs, size: shape[2] }
    }

    /// The kernel's value: output, input, row (of volumes), column, place along the contiguous axis.
    fn weight(&self, output: usize, input: usize, row: usize, column: usize, k: usize) -> f64 {
        f64::from(self.kernel.values[self.index(output, input, row, column, k)])
    }

    pub(super) fn index(&self, output: usize, input: usize, row: usize, column: usize, k: usize) -> usize {
        let pair = if self.sizes == Sizes::Doubled {
            input * self.outputs + output
        } else {
            output * self.inputs + input
        };
        if self.volume {
            // Kernels have depth first, rows of a volume are y, columns x, and depth is contiguous.
            pair * 27 + k * 9 + row * 3 + column
        } else {
            (pair * self.size + column) * self.size + k
        }
    }

    /// Rows of the kernel: one for images, whose columns are the rows.
    pub(super) fn rows(&self) -> usize {
        if self.volume { 3 } else { 1 }
    }

    /// The shape of the output of an input, without the number of slabs.
    fn output_shape(&self, from: Shape) -> Shape {
        let channels = self.outputs;
        match self.sizes {
            Sizes::Same => Shape { channels: channels.next_multiple_of(8), ..from },
            Sizes::Halved => Shape { columns: from.columns / 2, channels, length: from.length.div_ceil(2) },
            Sizes::Doubled => Shape { columns: from.columns * 2, channels, length: from.length * 2 },
        }
    }

    pub(super) fn forward(&self, tools: &Tools, input: &Stack) -> Stack {
        match self.sizes {
            Sizes::Same => same(tools, &self.plain(tools), input, self.volume),
            Sizes::Halved => {
                let kernel = |o, i, tap, k| self.weight(o, i, tap / 3, tap % 3, k);
                let image_kernel = |o, i, tap, k| self.weight(o, i, 0, tap, k);
                let (sizes, level) = ([self.inputs, self.outputs, self.taps(), self.size], tools.level);
                let layer = if self.volume {
                    StridedLayer::new(level, sizes, kernel, &self.bias, false)
                } else {
                    StridedLayer::new(level, sizes, image_kernel, &self.bias, false)
                };
                halved(tools, &layer, input, self.output_shape(input.shape), self.volume)
            }
            Sizes::Doubled => {
                let kernel = |o, i, tap, k| self.weight(o, i, tap / 3, tap % 3, k);
                let sizes = [self.inputs, self.outputs, 9, 3];
                let layer = TransposedLayer::new(tools.level, sizes, kernel, &self.bias, false);
                doubled(tools, &layer, input, None, self.output_shape(input.shape), true)
            }
        }
    }

    /// The output of a volume whose rows are made when they are needed, a few at a time, and those rows.
    ///
    /// Only for layers that keep sizes.
    pub(super) fn forward_by_bands(
        &self,
        tools: &Tools,
        height: usize,
        band: usize,
        rows: impl Fn(Range<usize>) -> Vec<Row>,
    ) -> (Stack, Stack) {
        let layer = self.plain(tools);
        let (mut input, mut output) = (Vec::with_capacity(height), Vec::with_capacity(height));
        for begin in (0..height).step_by(band) {
            let end = (begin + band).min(height);
            input.extend(rows(begin..end));
            // The last row needs the next one.
            let complete = if end == height { end } else { end - 1 };
            output.extend(volume_rows(tools, &layer, &input, output.len()..complete));
        }
        (Stack::new(input), Stack::new(output))
    }

    /// Hands out the gradient of the input, a few rows at a time.
    ///
    /// Only for layers of volumes that keep sizes.
    pub(super) fn input_gradient_by_bands(
        &self,
        tools: &Tools,
        gradient: &Stack,
        band: usize,
        mut take: impl FnMut(&[Row]),
    ) {
        let layer = self.mirrored(tools, gradient.shape);
        let height = gradient.slabs.len();
        for begin in (0..height).step_by(band) {
            take(&volume_rows(tools, &layer, &gradient.slabs, begin..(begin + band).min(height)));
        }
    }

    /// The kernels of a layer that keeps sizes.
    fn plain(&self, tools: &Tools) -> WinogradLayer {
        let kernel = |o, i, row, column, k| self.weight(o, i, row, column, k);
        WinogradLayer::new(tools.level, [self.inputs, self.outputs, self.rows()], kernel, &self.bias, false)
    }

    /// The kernel of the last layer of the regularisation, with its bias.
    pub(super) fn regression(&self, tools: &Tools) -> RegressionLayer {
        let kernel = |input, row, column, k| self.weight(0, input, row, column, k);
        RegressionLayer::new(tools.level, kernel, self.bias[0])
    }

    /// The kernels of its way back, from a gradient of this shape.
    fn mirrored(&self, tools: &Tools, gradient: Shape) -> WinogradLayer {
        let last = self.size - 1;
        let kernel = |i, o, row, column, k| {
            if o >= self.outputs {
                return 0.0;
            }
            let row = if self.volume { last - row } else { 0 };
            self.weight(o, i, row, last - column, last - k)
        };
        let sizes = [gradient.channels, self.inputs, self.rows()];
        WinogradLayer::new(tools.level, sizes, kernel, &vec![0.0; self.inputs], false)
    }

    fn taps(&self) -> usize {
        if self.volume { 9 } else { self.size }
    }

    /// The gradient of the input, of shape `to`, with `more` added, which it gets from elsewhere.
    pub(super) fn input_gradient(
        &self,
        tools: &Tools,
        gradient: &Stack,
        to: Shape,
        more: Option<&Stack>,
    ) -> Stack {
        match self.sizes {
            Sizes::Same => {
                let mut result = same(tools, &self.mirrored(tools, gradient.shape), gradient, self.volume);
                if let Some(more) = more {
                    add(&mut result, more);
                }
                result
            }
            Sizes::Halved => {
                let kernel = |i, o, tap, k| self.weight(o, i, tap / 3, tap % 3, k);
                let image_kernel = |i, o, tap, k| self.weight(o, i, 0, tap, k);
                let (sizes, level) = ([self.outputs, self.inputs, self.taps(), self.size], tools.level);
                let bias = vec![0.0; self.inputs];
                let layer = if self.volume {
                    TransposedLayer::new(level, sizes, kernel, &bias, false)
                } else {
                    TransposedLayer::new(level, sizes, image_kernel, &bias, false)
                };
                doubled(tools, &layer, gradient, more, to, self.volume)
            }
            Sizes::Doubled => {
                let kernel = |i, o, tap, k| self.weight(o, i, tap / 3, tap % 3, k);
                let bias = vec![0.0; self.inputs];
                let sizes = [self.outputs, self.inputs, 9, 3];
                let layer = StridedLayer::new(tools.level, sizes, kernel, &bias, false);
                halved(tools, &layer, gradient, to, true)
            }
        }
    }
}

/// The gradient of biases: sums over everything else.
pub(super) fn bias_gradient(gradient: &Stack, outputs: usize) -> WeightTensor {
    let per_slab: Vec<Vec<f64>> = gradient
        .slabs
        .par_iter()
        .map(|slab| {
            let channel = |channel| {
                let columns = 0..gradient.shape.columns;
                columns.map(|x| slab.channel(x, channel).iter().map(|v| f64::from(*v)).sum::<f64>()).sum()
            };
            (0..outputs).map(channel).collect()
        })
        .collect();
    let total = |channel: usize| per_slab.iter().map(|sums| sums[channel]).sum::<f64>() as f32;
    WeightTensor { shape: vec![outputs], values: (0..outputs).map(total).collect() }
}

fn add(to: &mut Stack, more: &Stack) {
    let more = &more.slabs;
    to.slabs_mut().enumerate().for_each(|(i, slab)| {
        let shape = slab.shape();
        for x in 0..shape.columns {
            for channel in 0..shape.channels {
                let from = more[i].channel(x, channel);
                slab.channel_mut(x, channel).iter_mut().zip(from).for_each(|(to, from)| *to += from);
            }
        }
    });
}

fn same(tools: &Tools, layer: &WinogradLayer, input: &Stack, volume: bool) -> Stack {
    if volume {
        return Stack::new(volume_rows(tools, layer, &input.slabs, 0..input.slabs.len()));
    }
    let shape = Shape { channels: layer.outputs, ..input.shape };
    Stack::compute(tools, input.slabs.len(), shape, |i, slab| {
        let input = &input.slabs[i];
        let pairs = slab.columns_mut().par_chunks_mut(2 * shape.column()).enumerate();
        pairs.with_min_len(2).for_each_init(
            || layer.scratch(),
            |scratch, (pair, columns)| {
                let input = input.four_columns(2 * pair);
                layer.accumulate(input, &mut [Target { columns, tap: 0, first: true, last: true }], scratch);
            },
        );
    })
}

/// Some output rows of a layer of a volume that keeps sizes.
fn volume_rows(tools: &Tools, layer: &WinogradLayer, input: &[Row], rows: Range<usize>) -> Vec<Row> {
    let from = input[0].shape();
    let shape = Shape { channels: layer.outputs, ..from };
    let mut slabs: Vec<Slab> = rows.clone().map(|_| tools.pool.take(shape)).collect();
    let pairs = shape.columns.div_ceil(2);
    // Tasks are many, and their rows as many as that allows: the first one costs as much again.
    let height = if pairs >= FEW_PAIRS { rows.len() } else { rows.len().div_ceil(2) };
    let mut tasks = Vec::new();
    for (band, slabs) in slabs.chunks_mut(height.max(1)).enumerate() {
        let begin = rows.start + band * height;
        let band = begin..begin + slabs.len();
        let mut outputs: Vec<Vec<&mut [f32]>> = (0..pairs).map(|_| Vec::with_capacity(slabs.len())).collect();
        for slab in slabs {
            let columns = slab.columns_mut().chunks_mut(2 * shape.column());
            outputs.iter_mut().zip(columns).for_each(|(pair, columns)| pair.push(columns));
        }
        tasks.extend(outputs.into_iter().enumerate().map(|(pair, output)| (band.clone(), pair, output)));
    }
    tasks.into_par_iter().for_each_init(
        || VolumeScratch::new(layer, from),
        |scratch, (rows, pair, mut output)| pair_of_rows(layer, input, rows, pair, &mut output, scratch),
    );
    slabs.into_iter().map(Arc::new).collect()
}

fn halved(tools: &Tools, layer: &StridedLayer, input: &Stack, to: Shape, volume: bool) -> Stack {
    let count = if volume { input.slabs.len() / 2 } else { input.slabs.len() };
    let (rows, size) = if volume { (3, 3) } else { (1, 5) };
    Stack::compute_columns(tools, count, to, |i, x, output| {
        let mut columns = Vec::with_capacity(9);
        for row in 0..rows {
            let slab = if volume { (2 * i + row).checked_sub(1) } else { Some(i) };
            let Some(slab) = slab.and_then(|slab| input.slabs.get(slab)) else { continue };
            for column in 0..size {
                let at = (2 * x + column) as isize - size as isize / 2;
                if (0..input.shape.columns as isize).contains(&at) {
                    columns.push((slab.column(at), size * row + column));
                }
            }
        }
        layer.apply(&columns, output);
    })
}

fn doubled(
    tools: &Tools,
    layer: &TransposedLayer,
    input: &Stack,
    more: Option<&Stack>,
    to: Shape,
    volume: bool,
) -> Stack {
    let count = if volume { 2 * input.slabs.len() } else { input.slabs.len() };
    Stack::compute_columns(tools, count, to, |i, x, output| {
        let mut columns = Vec::with_capacity(4);
        if volume {
            for (slab, row) in taps(i, input.slabs.len()) {
                let slab = &input.slabs[slab];
                columns.extend(
                    taps(x, input.shape.columns)
                        .map(|(x, column)| (slab.column(x as isize), 3 * row + column)),
                );
            }
        } else {
            // Output 2j + k - 2 gets input j at tap k.
            for tap in (x % 2..5).step_by(2) {
                let at = (x as isize + 2 - tap as isize) / 2;
                if (0..input.shape.columns as isize).contains(&at) {
                    columns.push((input.slabs[i].column(at), tap));
                }
            }
        }
        let skip = more.map(|more| more.slabs[i].column(x as isize));
        layer.apply(&columns, skip, to.length, output);
    })
}
