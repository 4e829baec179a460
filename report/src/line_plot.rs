//! Numbers over a number, as a picture.

use planesweep_scene::Raster;

use crate::font::{GLYPH_HEIGHT, text_width};
use crate::picture::{draw_text, set, shrunk};

/// Lines that share their axes. Letters come out as capitals.
#[derive(Clone, Debug, Default)]
pub struct LinePlot<'a> {
    /// What is shown.
    pub title: &'a str,
    /// What the horizontal axis measures.
    pub x_label: &'a str,
    /// What the vertical axis measures.
    pub y_label: &'a str,
    /// The lines; the axes hold all of their finite points, and 0.
    pub lines: &'a [Line<'a>],
    /// A place on the horizontal axis to mark.
    pub mark: Option<f64>,
}

/// One line.
#[derive(Clone, Debug)]
pub struct Line<'a> {
    /// Its name, for the legend.
    pub name: &'a str,
    /// Its points from left to right; where one is not finite, the line has a gap.
    pub points: &'a [(f64, f64)],
}

/// Size of the picture, and of the margins that hold the numbers, in pixels.
const WIDTH: usize = 720;
const HEIGHT: usize = 440;
const LEFT: usize = 92;
const RIGHT: usize = 24;
const TOP: usize = 56;
const BOTTOM: usize = 64;
/// Lines are drawn this much larger, then shrunk, so that their edges are smooth.
const FINER: usize = 3;
const TEXT_SCALE: usize = 2;
/// Ticks that an axis has about.
const TICKS: f64 = 5.0;

const PAPER: [u8; 3] = [255; 3];
const INK: [u8; 3] = [51; 3];
const GRID: [u8; 3] = [224; 3];
const MARK: [u8; 3] = [150; 3];
/// Colours that stay apart for most people who see red and green alike.
const COLORS: [[u8; 3]; 6] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233]];

/// The colour of the line at this place.
fn color(index: usize) -> [u8; 3] {
    COLORS[index % COLORS.len()]
}

/// Draws a plot.
pub fn draw_lines(plot: &LinePlot<'_>) -> Raster<[u8; 3]> {
    let points =
        || plot.lines.iter().flat_map(|line| line.points).filter(|p| p.0.is_finite() && p.1.is_finite());
    let x_axis = Axis::over(points().map(|p| p.0));
    let y_axis = Axis::over(points().map(|p| p.1));
    let x = |value: f64| LEFT as f64 + x_axis.share(value) * (WIDTH - LEFT - RIGHT) as f64;
    let y = |value: f64| (HEIGHT - BOTTOM) as f64 - y_axis.share(value) * (HEIGHT - TOP - BOTTOM) as f64;
    let (left, right) = (LEFT as f64, (WIDTH - RIGHT) as f64);
    let (top, bottom) = (TOP as f64, (HEIGHT - BOTTOM) as f64);

    let mut large = Raster::filled(WIDTH * FINER, HEIGHT * FINER, PAPER);
    for tick in x_axis.ticks() {
        segment(&mut large, (x(tick), top), (x(tick), bottom), 1, GRID);
    }
    for tick in y_axis.ticks() {
        segment(&mut large, (left, y(tick)), (right, y(tick)), 1, GRID);
    }
    if let Some(mark) = plot.mark.filter(|mark| (0.0..=1.0).contains(&x_axis.share(*mark))) {
        segment(&mut large, (x(mark), top), (x(mark), bottom), 5, MARK);
    }
    segment(&mut large, (left, top), (left, bottom), 2, INK);
    segment(&mut large, (left, bottom), (right, bottom), 2, INK);
    for (index, line) in plot.lines.iter().enumerate() {
        for pair in line.points.windows(2) {
            let ends = [pair[0], pair[1]].map(|(a, b)| (x(a), y(b)));
            if ends.iter().all(|end| end.0.is_finite() && end.1.is_finite()) {
                segment(&mut large, ends[0], ends[1], 5, color(index));
            }
        }
    }
    let mut picture = shrunk(&large, FINER);

    for tick in x_axis.ticks() {
        let label = x_axis.label(tick);
        let start = (x(tick) as usize).saturating_sub(text_width(&label, TEXT_SCALE) / 2);
        draw_text(&mut picture, [start, HEIGHT - BOTTOM + 10], TEXT_SCALE, INK, &label);
    }
    for tick in y_axis.ticks() {
        let label = y_axis.label(tick);
        let start = (LEFT - 10).saturating_sub(text_width(&label, TEXT_SCALE));
        draw_text(
            &mut picture,
            [start, y(tick) as usize - GLYPH_HEIGHT * TEXT_SCALE / 2],
            TEXT_SCALE,
            INK,
            &label,
        );
    }
    draw_text(&mut picture, [8, 8], TEXT_SCALE, INK, plot.title);
    draw_text(&mut picture, [8, 32], TEXT_SCALE, INK, plot.y_label);
    let start = (WIDTH - RIGHT).saturating_sub(text_width(plot.x_label, TEXT_SCALE));
    draw_text(&mut picture, [start, HEIGHT - 26], TEXT_SCALE, INK, plot.x_label);
    let mut end = WIDTH - RIGHT;
    for (index, line) in plot.lines.iter().enumerate().rev() {
        end = end.saturating_sub(text_width(line.name, TEXT_SCALE));
        draw_text(&mut picture, [end, 32], TEXT_SCALE, color(index), line.name);
        end = end.saturating_sub(24);
    }
    picture
}

/// From the least to the largest number, and 0, in steps that are 1, 2 or 5 times a power of ten.
struct Axis {
    /// Its ends, in steps.
    first: i64,
    last: i64,
    step: f64,
}

impl Axis {
    fn over(values: impl Iterator<Item = f64>) -> Self {
        let (least, largest) =
            values.fold((0.0_f64, 0.0_f64), |(least, largest), value| (least.min(value), largest.max(value)));
        let rough = (largest - least) / TICKS;
        if !(rough.is_normal() && rough.is_finite()) {
            return Self { first: 0, last: 1, step: 1.0 };
        }
        let power = 10_f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power).into_iter().find(|step| *step >= rough);
        let step = step.unwrap_or(rough);
        // A value that is a whole number of steps, but for rounding, needs no further one.
        Self {
            first: (least / step + 1e-9).floor() as i64,
            last: (largest / step - 1e-9).ceil() as i64,
            step,
        }
    }

    /// Where a value is between the ends: 0 to 1.
    fn share(&self, value: f64) -> f64 {
        (value / self.step - self.first as f64) / (self.last - self.first) as f64
    }

    fn ticks(&self) -> impl Iterator<Item = f64> {
        (self.first..=self.last).map(|tick| tick as f64 * self.step)
    }

    /// A tick with the digits that its step needs.
    fn label(&self, tick: f64) -> String {
        let digits = (-self.step.log10().floor()).clamp(0.0, 9.0) as usize;
        format!("{tick:.digits$}")
    }
}

/// Draws a straight line between two points of the final picture, `width` fine pixels wide.
fn segment(large: &mut Raster<[u8; 3]>, from: (f64, f64), to: (f64, f64), width: usize, color: [u8; 3]) {
    let fine = |end: (f64, f64)| (end.0 * FINER as f64, end.1 * FINER as f64);
    let (from, to) = (fine(from), fine(to));
    let steps = (to.0 - from.0).abs().max((to.1 - from.1).abs()).ceil().max(1.0) as usize;
    for step in 0..=steps {
        let t = step as f64 / steps as f64;
        let (x, y) = (from.0 + t * (to.0 - from.0), from.1 + t * (to.1 - from.1));
        let corner = |centre: f64| (centre - (width - 1) as f64 / 2.0).round().max(0.0) as usize;
        for (dx, dy) in (0..width).flat_map(|dy| (0..width).map(move |dx| (dx, dy))) {
            set(large, corner(x) + dx, corner(y) + dy, color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_ends_at_round_numbers() {
        let axis = |values: &[f64]| Axis::over(values.iter().copied());
        let unit = axis(&[0.3, 1.0]);
        assert_eq!((unit.first, unit.last, unit.label(0.6)), (0, 5, "0.6".to_owned()));
        let wide = axis(&[-3.0, 147.0]);
        assert_eq!((wide.first, wide.last, wide.step, wide.label(100.0)), (-1, 3, 50.0, "100".to_owned()));
        let fine = axis(&[0.004]);
        assert_eq!((fine.last, fine.label(0.001)), (4, "0.001".to_owned()));
        assert_eq!(axis(&[]).ticks().collect::<Vec<_>>(), [0.0, 1.0]);
    }

    #[test]
    fn a_line_goes_through_its_points_and_no_number_panics() {
        let rising = [(0.0, 0.0), (1.0, 1.0)];
        let odd = [(f64::NAN, 1.0), (0.5, f64::INFINITY), (0.2, 0.1)];
        let lines = [Line { name: "a", points: &rising }, Line { name: "b", points: &odd }];
        let picture = draw_lines(&LinePlot { lines: &lines, mark: Some(0.25), ..LinePlot::default() });
        let middle = (LEFT + (WIDTH - LEFT - RIGHT) / 2, TOP + (HEIGHT - TOP - BOTTOM) / 2);
        assert_eq!(picture.at(middle.0, middle.1), COLORS[0]);
        let marked = (LEFT + (WIDTH - LEFT - RIGHT) / 4, TOP + 7);
        assert_eq!(picture.at(marked.0, marked.1), MARK);
        let empty = draw_lines(&LinePlot::default());
        assert_eq!((empty.width(), empty.height()), (WIDTH, HEIGHT));
    }
}
