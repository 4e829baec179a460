//! Every kernel against its plain twin: the same sums, written as in the paper, in f64.
//!
//! The levels with fused multiply-add must also agree with each other to the bit.

use std::sync::Arc;

use nalgebra::{Matrix3, Matrix3x4, Vector3};
use proptest::prelude::*;

use super::cost::{CHANNELS, CostInput, CostScratch, FeatureMap, PixelSweep};
use super::normalize;
use super::regress::{RegressionLayer, RegressionScratch};
use super::simd::{LANES, Level};
use super::slab::{Shape, Slab};
use super::strided::StridedLayer;
use super::transposed::TransposedLayer;

use super::winograd::{Target, WinogradLayer};
use super::winograd_gradient::{ProductScratch, WinogradProducts, taps};
use super::winograd_volume::{VolumeScratch, pair_of_rows};
use crate::CostMetric;
use crate::weights::uniform;

fn random_slab(shape: Shape, seed: u64) -> Slab {
    let mut slab = Slab::zeroed(shape);
    let mut state = seed;
    for column in 0..shape.columns {
        for channel in 0..shape.channels {
            slab.channel_mut(column, channel).fill_with(|| (2.0 * uniform(&mut state) - 1.0) as f32);
        }
    }
    slab
}

fn random(count: usize, seed: u64) -> Vec<f64> {
    let mut state = seed;
    (0..count).map(|_| f64::from((uniform(&mut state) - 0.5) as f32)).collect()
}

/// A value of a slab, zero outside.
fn at(slab: &Slab, column: isize, channel: usize, i: isize) -> f64 {
    let Shape { columns, length, .. } = slab.shape();
    let inside = (0..columns as isize).contains(&column) && (0..length as isize).contains(&i);
    if inside { f64::from(slab.channel(column as usize, channel)[i as usize]) } else { 0.0 }
}

/// Runs at every level: bits of fused levels are equal, and all are near the twin, relative to the sum of
/// magnitudes.
fn check(run: impl Fn(Level) -> Slab, twin: impl Fn(usize, usize, isize) -> (f64, f64)) {
    let results: Vec<(Level, Slab)> =
        Level::available().into_iter().map(|level| (level, run(level))).collect();
    for (level, slab) in &results {
        let Shape { columns, channels, length } = slab.shape();
        for column in 0..columns {
            for channel in 0..channels {
                for i in 0..length as isize {
                    let (value, magnitude) = twin(column, channel, i);
                    let ours = at(slab, column as isize, channel, i);
                    let error = (ours - value).abs();
                    assert!(
                        error <= 1e-6 * magnitude.max(1e-3),
                        "{level:?} ({column}, {channel}, {i}): {ours}, not {value}"
                    );
                }
            }
        }
        assert_zeros(slab);
    }
    for pair in results[1..].windows(2) {
        assert_eq!(bits(&pair[0].1), bits(&pair[1].1));
    }
}

fn bits(slab: &Slab) -> Vec<u32> {
    let Shape { columns, channels, .. } = slab.shape();
    let channels = (0..columns).flat_map(|x| (0..channels).map(move |c| (x, c)));
    channels.flat_map(|(x, c)| slab.channel(x, c)).map(|value| value.to_bits()).collect()
}

/// What is stored beyond the length, and around the channels, is zero.
fn assert_zeros(slab: &Slab) {
    let mut copy = Slab::zeroed(slab.shape());
    let Shape { columns, channels, .. } = slab.shape();
    for x in 0..columns {
        for c in 0..channels {
            copy.channel_mut(x, c).copy_from_slice(slab.channel(x, c));
        }
    }
    assert!(copy.all() == slab.all(), "values around the channels were changed");
}

/// Adds products, and their magnitudes.
fn sum(terms: impl Iterator<Item = f64>) -> (f64, f64) {
    terms.fold((0.0, 0.0), |(sum, magnitude), term| (sum + term, magnitude + term.abs()))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, ..ProptestConfig::default() })]

    #[test]
    fn winograd_is_the_convolution(
        length in 1_usize..200, inputs in 1_usize..20, outputs in 1_usize..20, rows in 1_usize..4,
        columns in 3_usize..5, relu: bool, seed: u64,
    ) {
        let shape = Shape { columns, channels: inputs, length };
        let input: Vec<_> = (0..rows).map(|i| Arc::new(random_slab(shape, seed ^ i as u64))).collect();
        let weights = random(outputs * inputs * 27, seed ^ 0x77);
        let bias = random(outputs, seed ^ 0x78);
        let kernel = |o, c, tap, x, k| weights[(((o * inputs + c) * 3 + tap) * 3 + x) * 3 + k];
        // The output row in the middle of the input rows.
        let run = |level| {
            let layer = WinogradLayer::new(level, [inputs, outputs, 3], kernel, &bias, relu);
            let mut output = Slab::zeroed(Shape { channels: layer.outputs, ..shape });
            let mut scratch = layer.scratch();
            let pairs = 2 * output.shape().column();
            for (pair, target) in output.columns_mut().chunks_mut(pairs).enumerate() {
                for (tap, row) in input.iter().enumerate() {
                    let from = row.four_columns(2 * pair);
                    let target = Target { columns: &mut *target, tap, first: tap == 0, last: tap + 1 == rows };
                    layer.accumulate(from, &mut [target], &mut scratch);
                }
            }
            output
        };
        // The first input row meets this row of the kernel.
        let twin = |first: usize, x: usize, o: usize, i: isize| {
            if o >= outputs {
                return (0.0, 0.0);
            }
            let terms = (0..inputs).flat_map(|c| (0..rows * 9).map(move |t| (c, t / 9, t / 3 % 3, t % 3)));
            let (value, magnitude) = sum(terms.map(|(c, tap, column, k)| {
                let (column_at, i) = ((x + column) as isize - 1, i + k as isize - 1);
                kernel(o, c, first + tap, column, k) * at(&input[tap], column_at, c, i)
            }));
            let value = value + bias[o];
            (if relu { value.max(0.0) } else { value }, magnitude + 1.0)
        };
        check(run, |x, o, i| twin(0, x, o, i));
        // In a volume, rows before or after these may be missing.
        for first in 0..2 {
            if rows + first == 1 || rows + first == 4 {
                continue;
            }
            let whole = |level| {
                let layer = WinogradLayer::new(level, [inputs, outputs, 3], kernel, &bias, relu);
                let mut output = Slab::zeroed(Shape { channels: layer.outputs, ..shape });
                let mut scratch = VolumeScratch::new(&layer, shape);
                let pairs = 2 * output.shape().column();
                let row = 1 - first..2 - first;
                for (pair, columns) in output.columns_mut().chunks_mut(pairs).enumerate() {
                    pair_of_rows(&layer, &input, row.clone(), pair, &mut [columns], &mut scratch);
                }
                output
            };
            check(whole, |x, o, i| twin(first, x, o, i));
        }
    }

    #[test]
    fn rows_of_a_volume_are_the_convolution(
        length in 1_usize..120, inputs in 1_usize..6, outputs in 1_usize..20, height in 1_usize..9,
        columns in 1_usize..4, [begin, count] in [0_usize..8, 1_usize..9], seed: u64,
    ) {
        let shape = Shape { columns, channels: inputs, length };
        let input: Vec<_> = (0..height).map(|i| Arc::new(random_slab(shape, seed ^ i as u64))).collect();
        let weights = random(outputs * inputs * 27, seed ^ 0x77);
        let kernel = |o, c, tap, x, k| weights[(((o * inputs + c) * 3 + tap) * 3 + x) * 3 + k];
        let begin = begin % height;
        let rows = begin..(begin + count).min(height);
        let all_rows = |level| {
            let layer = WinogradLayer::new(level, [inputs, outputs, 3], kernel, &[], false);
            let shape = Shape { channels: layer.outputs, ..shape };
            let mut output: Vec<_> = rows.clone().map(|_| Slab::zeroed(shape)).collect();
            let mut scratch = VolumeScratch::new(&layer, input[0].shape());
            for pair in 0..columns.div_ceil(2) {
                let columns = |slab| Slab::columns_mut(slab).chunks_mut(2 * shape.column()).nth(pair);
                let mut columns: Vec<_> = output.iter_mut().filter_map(columns).collect();
                pair_of_rows(&layer, &input, rows.clone(), pair, &mut columns, &mut scratch);
            }
            output
        };
        for (row, y) in rows.clone().enumerate() {
            check(|level| all_rows(level).swap_remove(row), |x, o, i| {
                if o >= outputs {
                    return (0.0, 0.0);
                }
                let taps = (0..inputs).flat_map(|c| (0..27).map(move |t| (c, t / 9, t / 3 % 3, t % 3)));
                let (value, magnitude) = sum(taps.filter_map(|(c, tap, column, k)| {
                    let from = input.get((y + tap).checked_sub(1)?)?;
                    let (x, i) = ((x + column) as isize - 1, i + k as isize - 1);
                    Some(kernel(o, c, tap, column, k) * at(from, x, c, i))
                }));
                (value, magnitude + 1.0)
            });
        }
    }

    #[test]
    fn strided_is_the_convolution(
        length in 1_usize..150, inputs in 1_usize..10, five: bool, taps in 1_usize..6, seed: u64,
    ) {
        let (outputs, size) = (16, if five { 5 } else { 3 });
        let input = random_slab(Shape { columns: taps, channels: inputs, length }, seed);
        let weights = random(outputs * inputs * taps * size, seed ^ 0x77);
        let bias = random(outputs, seed ^ 0x78);
        let kernel = |o, c, tap, k| weights[((o * inputs + c) * taps + tap) * size + k];
        let run = |level| {
            let layer = StridedLayer::new(level, [inputs, outputs, taps, size], kernel, &bias, true);
            let shape = Shape { columns: 1, channels: outputs, length: length.div_ceil(2) };
            let mut output = Slab::zeroed(shape);
            let columns: Vec<_> = (0..taps).map(|tap| (input.column(tap as isize), tap)).collect();
            layer.apply(&columns, output.columns_mut());
            output
        };
        check(run, |_, o, i| {
            let terms = (0..inputs).flat_map(|c| (0..taps * size).map(move |t| (c, t / size, t % size)));
            let (value, magnitude) = sum(terms.map(|(c, tap, k)| {
                let i = 2 * i + k as isize - (size / 2) as isize;
                kernel(o, c, tap, k) * at(&input, tap as isize, c, i)
            }));
            ((value + bias[o]).max(0.0), magnitude + 1.0)
        });
    }

    #[test]
    fn transposed_is_the_convolution_transposed(
        length in 1_usize..200, inputs in 1_usize..10, taps in proptest::sample::subsequence((0..9).collect::<Vec<_>>(), 1..5),
        five: bool, plain: bool, seed: u64,
    ) {
        let size = if five { 5 } else { 3 };
        let outputs = 8;
        let half = length.div_ceil(2);
        let input = random_slab(Shape { columns: taps.len(), channels: inputs, length: half }, seed);
        let skip = random_slab(Shape { columns: 1, channels: outputs, length }, seed ^ 5);
        let weights = random(outputs * inputs * 9 * size, seed ^ 0x77);
        let bias = random(outputs, seed ^ 0x78);
        let kernel = |o, c, tap, k| weights[((o * inputs + c) * 9 + tap) * size + k];
        let run = |level| {
            let layer = TransposedLayer::new(level, [inputs, outputs, 9, size], kernel, &bias, !plain);
            let mut output = Slab::zeroed(skip.shape());
            let columns = (0..).zip(&taps).map(|(i, tap)| (input.column(i), *tap));
            let skip = (!plain).then(|| skip.column(0));
            layer.apply(&columns.collect::<Vec<_>>(), skip, length, output.columns_mut());
            output
        };
        check(run, |_, o, i| {
            // Input j reaches output 2j - size / 2 + k.
            let half = size as isize / 2;
            let reach = (0..size as isize).filter(|k| (i + half - k) % 2 == 0);
            let reach: Vec<_> = reach.map(|k| (k as usize, (i + half - k) / 2)).collect();
            let terms = taps.iter().enumerate().flat_map(|(column, tap)| {
                (0..inputs).flat_map(move |c| [(column, *tap, c)])
            });
            let (value, magnitude) = sum(terms.flat_map(|(column, tap, c)| {
                let (input, kernel) = (&input, &kernel);
                reach.iter().map(move |(k, j)| {
                    kernel(o, c, tap, *k) * at(input, column as isize, c, *j)
                })
            }));
            let value = value + bias[o];
            (if plain { value } else { value.max(0.0) + at(&skip, 0, o, i) }, magnitude + 2.0)
        });
    }

    #[test]
    fn products_make_the_gradient_of_the_kernel(
        slabs in 1_usize..4, columns in 1_usize..7, length in 1_usize..100, inputs in 1_usize..4, volume: bool,
        seed: u64,
    ) {
        let (inputs, outputs, rows) = (inputs * LANES, 8, if volume { 3 } else { 1 });
        let stack = |channels, seed| -> Vec<_> {
            let shape = Shape { columns, channels, length };
            (0..slabs as u64).map(|slab| Arc::new(random_slab(shape, seed ^ (slab << 8)))).collect()
        };
        let (input, gradient) = (stack(inputs, seed), stack(outputs, seed ^ 1));
        let products = WinogradProducts { input: &input, gradient: &gradient, rows };
        let (o, c) = (seed as usize % outputs, seed as usize / 8 % inputs);
        let mut scratch = ProductScratch::default();
        let mut results = Vec::new();
        for level in Level::available() {
            let (half, end) = (products.vectors() / 2, products.vectors());
            let parts = [0..half, half..end].map(|vectors| products.sums(level, vectors, &mut scratch));
            for row in 0..rows {
                let taps = taps(&std::array::from_fn(|product| {
                    let at = (((product * rows + row) * inputs + c / LANES * LANES) * outputs) / LANES + o;
                    parts.iter().map(|sums| f64::from(sums[at * LANES + c % LANES])).sum()
                }));
                for (column, k) in (0..9).map(|tap| (tap / 3, tap % 3)) {
                    let places = (0..slabs).flat_map(|y| (0..columns).map(move |x| (y, x)));
                    let places = places.flat_map(|(y, x)| (0..length as isize).map(move |i| (y, x, i)));
                    let (value, magnitude) = sum(places.map(|(y, x, i)| {
                        let row = y as isize + if volume { row as isize - 1 } else { 0 };
                        let Some(slab) = usize::try_from(row).ok().and_then(|row| input.get(row)) else {
                            return 0.0;
                        };
                        let (x_at, i_at) = ((x + column) as isize - 1, i + k as isize - 1);
                        at(&gradient[y], x as isize, o, i) * at(slab, x_at, c, i_at)
                    }));
                    prop_assert!((taps[column][k] - value).abs() <= 4e-6 * (magnitude + 1.0));
                }
            }
            results.push(parts);
        }
        for pair in results[1..].windows(2) {
            prop_assert_eq!(&pair[0], &pair[1]);
        }
    }

    #[test]
    fn normalisation_and_its_gradient_are_the_formulas(
        columns in 1_usize..4, first in 0_usize..2, channels in 1_usize..9, length in 1_usize..70, skip: bool,
        seed: u64,
    ) {
        // On a grid, so that no rounding decides what ReLU lets through.
        let gridded = |channels, seed| {
            let mut slab = random_slab(Shape { columns: first + columns, channels, length }, seed);
            for (x, channel) in (0..first + columns).flat_map(|x| (0..channels).map(move |channel| (x, channel))) {
                slab.channel_mut(x, channel).iter_mut().for_each(|value| *value = (64.0 * *value).round() / 64.0);
            }
            slab
        };
        let (z, output) = (gridded(channels, seed), gridded(channels + 1, seed ^ 1));
        let (shape, part) = (Shape { columns, channels, length }, first..first + columns);
        let affine: Vec<_> = (0..channels).map(|c| [0.5 * c as f32 - 1.25, 0.25 - 0.125 * c as f32]).collect();
        let slopes: Vec<_> = (0..channels).map(|c| [0.5 + c as f32, 0.25 * c as f32, 0.75]).collect();
        let v = |x: usize, c: usize, i: isize| {
            f64::from(affine[c][0]) * at(&z, (first + x) as isize, c, i) + f64::from(affine[c][1])
        };
        let more = skip.then(|| gridded(channels, seed ^ 2));
        let apply = |level| {
            let mut result = Slab::zeroed(shape);
            let more = more.as_ref().map(|more| more.columns(part.clone()));
            normalize::apply(level, z.columns(part.clone()), more, &affine, result.columns_mut());
            result
        };
        check(apply, |x, c, i| (v(x, c, i).max(0.0) + more.as_ref().map_or(0.0, |more| at(more, (first + x) as isize, c, i)), 1.0));
        let passed = |x: usize, c: usize, i: isize| if v(x, c, i) > 0.0 { at(&output, (first + x) as isize, c, i) } else { 0.0 };
        let gradient = |level| {
            let mut result = Slab::zeroed(shape);
            let (z, output) = (z.columns(part.clone()), output.columns(part.clone()));
            normalize::gradient(level, z, output, &affine, &slopes, result.columns_mut());
            result
        };
        check(gradient, |x, c, i| {
            let [a, b, offset] = slopes[c].map(f64::from);
            (a * passed(x, c, i) + b * at(&z, (first + x) as isize, c, i) + offset, 10.0)
        });
        for level in Level::available() {
            let (all, of_output) = (z.columns(part.clone()), output.columns(part.clone()));
            let sums = normalize::gradient_sums(level, all, of_output, &affine);
            let moments = normalize::moments(level, all, channels);
            for c in 0..channels {
                let places = || (0..columns).flat_map(|x| (0..length as isize).map(move |i| (x, i)));
                let total = |term: &dyn Fn(f64, f64) -> f64| {
                    places().map(|(x, i)| term(passed(x, c, i), at(&z, (first + x) as isize, c, i))).sum::<f64>()
                };
                prop_assert!((sums[c][0] - total(&|g, _| g)).abs() < 1e-4);
                prop_assert!((sums[c][1] - total(&|g, z| g * z)).abs() < 1e-4);
                prop_assert!((moments[c][0] - total(&|_, z| z)).abs() < 1e-4);
                prop_assert!((moments[c][1] - total(&|_, z| z * z)).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn cost_is_the_variance_of_bilinear_samples(
        depths in 1_usize..80, views in 1_usize..5, mean: bool, behind: bool, seed: u64,
    ) {
        let size = |view: usize| Shape { columns: 7 + view, channels: CHANNELS, length: 12 - view };
        let slabs: Vec<_> = (0..=views).map(|view| random_slab(size(view), seed ^ view as u64)).collect();
        let maps: Vec<_> = slabs.iter().map(FeatureMap::new).collect();
        let projections: Vec<_> = (0..=views as u64).map(|view| projection(seed ^ view, behind && view > 0)).collect();
        let inverse_depths: Vec<f64> = (0..depths).map(|i| 1.0 / (1.0 + 0.1 * i as f64)).collect();
        let sweep = |source| PixelSweep::new(&projections[0], source).expect("an invertible camera");
        let metric = if mean { CostMetric::Mean } else { CostMetric::Variance };
        let input = CostInput {
            reference: &maps[0],
            sources: maps[1..].iter().zip(&projections[1..]).map(|(map, source)| (map, sweep(source))).collect(),
            inverse_depths: inverse_depths.clone(),
            metric,
        };
        let (x, y) = (seed as usize % 12, seed as usize / 12 % 7);
        let run = |level| {
            let mut output = Slab::zeroed(Shape { columns: 1, channels: CHANNELS, length: depths });
            input.column(level, x, y, output.columns_mut(), &mut CostScratch::default());
            output
        };
        check(run, |_, channel, i| {
            let inverse = projections[0].fixed_view::<3, 3>(0, 0).try_inverse().expect("it has one");
            let depth = 1.0 / inverse_depths[i as usize];
            let pixel = Vector3::new(x as f64, y as f64, 1.0);
            let point = inverse * (pixel * depth - projections[0].column(3));
            let mut values = vec![at(&slabs[0], y as isize, channel, x as isize)];
            for (slab, projection) in slabs[1..].iter().zip(&projections[1..]) {
                let seen = projection * point.push(1.0);
                let (u, v) = (seen.x / seen.z, seen.y / seen.z);
                values.push(if seen.z > 0.0 { bilinear(slab, channel, u, v) } else { 0.0 });
            }
            let count = values.len() as f64;
            let average = values.iter().sum::<f64>() / count;
            let variance = values.iter().map(|v| (v - average).powi(2)).sum::<f64>() / count;
            (if mean { average } else { variance }, 1.0)
        });
    }

    #[test]
    fn regression_is_the_expectation(length in 2_usize..150, rows in 1_usize..4, seed: u64) {
        let shape = Shape { columns: 4, channels: 8, length };
        let input: Vec<_> = (0..rows).map(|row| random_slab(shape, seed ^ row as u64)).collect();
        let weights: Vec<f64> = random(216, seed ^ 0x77).iter().map(|w| 3.0 * w).collect();
        let kernel = |c, y, x, k| weights[((c * 3 + y) * 3 + x) * 3 + k];
        let mut results = Vec::new();
        for level in Level::available() {
            let layer = RegressionLayer::new(level, kernel, 0.25);
            let taps = input.iter().zip(0..).map(|(row, tap)| ([0, 1, 2, 3].map(|x| row.column(x)), tap));
            let mut scratch = RegressionScratch::new(shape.padded());
            results.push(layer.apply(&taps.collect::<Vec<_>>(), 4, &mut scratch));
        }
        for (i, regressed) in results.iter().flat_map(|pair| pair.iter().enumerate()) {
            let logit = |j: usize| -> f64 {
                let taps = (0..rows * 72).map(|t| (t / 72, t / 9 % 8, t / 3 % 3, t % 3));
                taps.map(|(y, c, x, k)| {
                    kernel(c, y, x, k) * at(&input[y], (i + x) as isize, c, (j + k) as isize - 1)
                }).sum()
            };
            let exponentials: Vec<f64> = (0..length).map(|j| logit(j).exp()).collect();
            let total: f64 = exponentials.iter().sum();
            let index = exponentials.iter().zip(0..).map(|(e, j)| e * f64::from(j)).sum::<f64>() / total;
            prop_assert!((regressed.index - index).abs() < 1e-5 * length as f64, "{regressed:?} {index}");
            if (index - index.round()).abs() > 1e-3 {
                let first = index.floor() as usize;
                let around = first.saturating_sub(1)..(first + 3).min(length);
                let confidence = exponentials[around].iter().sum::<f64>() / total;
                prop_assert!((f64::from(regressed.confidence) - confidence).abs() < 1e-5);
            }
        }
        for pair in results[1..].windows(2) {
            prop_assert_eq!(pair[0], pair[1]);
        }
    }
}

/// A camera near the origin that looks along z, or back along it.
fn projection(seed: u64, behind: bool) -> Matrix3x4<f64> {
    let r = random(6, seed);
    let k = Matrix3::new(9.0, 0.3, 5.5 + r[0], 0.0, 10.0, 3.5 + r[1], 0.0, 0.0, 1.0);
    let turn = nalgebra::Rotation3::from_euler_angles(0.1 * r[2], 0.1 * r[3], if behind { 3.0 } else { 0.1 });
    let flip =
        if behind { Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)) } else { Matrix3::identity() };
    let rotation = k * flip * turn.matrix();
    let offset = k * Vector3::new(r[4], r[5], 0.2 * r[0]);
    Matrix3x4::from_columns(&[
        rotation.column(0).into_owned(),
        rotation.column(1).into_owned(),
        rotation.column(2).into_owned(),
        offset,
    ])
}

fn bilinear(slab: &Slab, channel: usize, u: f64, v: f64) -> f64 {
    let (left, top) = (u.floor(), v.floor());
    let corner = |x: f64, y: f64| at(slab, (top + y) as isize, channel, (left + x) as isize);
    let (u, v) = (u - left, v - top);
    (corner(0.0, 0.0) * (1.0 - u) + corner(1.0, 0.0) * u) * (1.0 - v)
        + (corner(0.0, 1.0) * (1.0 - u) + corner(1.0, 1.0) * u) * v
}
