//! Curves over the steps of a training run, as a picture.

use planesweep_scene::Raster;

use crate::font::{GLYPH_HEIGHT, text_width};
use crate::picture::{draw_text, set};

/// Size of the drawing area, and of the margins around it, in pixels.
const WIDTH: usize = 800;
const HEIGHT: usize = 400;
const LEFT: usize = 80;
const TOP: usize = 36;
const RIGHT: usize = 24;
const BOTTOM: usize = 40;
const SCALE: usize = 2;

const INK: [u8; 3] = [60, 60, 60];
const GRID: [u8; 3] = [225, 225, 225];
const COLORS: [[u8; 3]; 6] =
    [[45, 109, 223], [192, 57, 43], [39, 148, 84], [200, 130, 20], [125, 70, 180], [90, 90, 90]];

/// A curve with its name.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// What it shows.
    pub name: String,
    /// (step, value), by step. Values that are no numbers are left out.
    pub points: Vec<(u64, f64)>,
}

/// Draws curves over their steps in one frame, from zero to `most`, or to the greatest value.
pub fn plot_curves(title: &str, curves: &[Curve], most: Option<f64>) -> Raster<[u8; 3]> {
    let mut picture = Raster::filled(LEFT + WIDTH + RIGHT, TOP + HEIGHT + BOTTOM, [255; 3]);
    let points = || curves.iter().flat_map(|curve| &curve.points).filter(|(_, value)| value.is_finite());
    let last = points().map(|(step, _)| *step).max().unwrap_or(0).max(1);
    let greatest = points().map(|(_, value)| *value).fold(0.0, f64::max);
    let most = most.unwrap_or(if greatest > 0.0 { greatest } else { 1.0 });
    let x = |step: u64| LEFT as f64 + WIDTH as f64 * step as f64 / last as f64;
    let y = |value: f64| TOP as f64 + HEIGHT as f64 * (1.0 - (value / most).clamp(0.0, 1.0));
    for quarter in 0..=4_u32 {
        let value = most * f64::from(quarter) / 4.0;
        let row = y(value) as usize;
        line(&mut picture, [LEFT as f64, row as f64], [(LEFT + WIDTH) as f64, row as f64], GRID, 1);
        let text = if most < 10.0 { format!("{value:.2}") } else { format!("{value:.1}") };
        let left = LEFT.saturating_sub(text_width(&text, SCALE) + 8);
        draw_text(&mut picture, [left, row.saturating_sub(GLYPH_HEIGHT)], SCALE, INK, &text);
        let step = last * u64::from(quarter) / 4;
        let text = step.to_string();
        let middle = (x(step) as usize).saturating_sub(text_width(&text, SCALE) / 2);
        draw_text(&mut picture, [middle, TOP + HEIGHT + 10], SCALE, INK, &text);
    }
    draw_text(&mut picture, [LEFT, 10], SCALE, INK, title);
    let mut end = LEFT + WIDTH;
    for (curve, color) in colored(curves).rev() {
        end = end.saturating_sub(text_width(&curve.name, SCALE) + 16);
        draw_text(&mut picture, [end, 10], SCALE, color, &curve.name);
    }
    for (curve, color) in colored(curves) {
        let finite: Vec<_> = curve.points.iter().filter(|(_, value)| value.is_finite()).collect();
        for pair in finite.windows(2) {
            let [(a, from), (b, to)] = [*pair[0], *pair[1]];
            line(&mut picture, [x(a), y(from)], [x(b), y(to)], color, 2);
        }
    }
    picture
}

/// Curves with their colours.
fn colored(curves: &[Curve]) -> impl DoubleEndedIterator<Item = (&Curve, [u8; 3])> {
    curves.iter().enumerate().map(|(i, curve)| (curve, COLORS[i % COLORS.len()]))
}

/// A line as wide as `thickness` pixels.
fn line(picture: &mut Raster<[u8; 3]>, from: [f64; 2], to: [f64; 2], color: [u8; 3], thickness: usize) {
    let length = (to[0] - from[0]).abs().max((to[1] - from[1]).abs()).ceil().max(1.0);
    for i in 0..=length as usize {
        let t = i as f64 / length;
        let [x, y] = [0, 1].map(|axis| (from[axis] + t * (to[axis] - from[axis])).round() as usize);
        for (dx, dy) in (0..thickness).flat_map(|dy| (0..thickness).map(move |dx| (dx, dy))) {
            set(picture, x + dx, y + dy, color);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(points: &[(u64, f64)]) -> Curve {
        Curve { name: "A".to_owned(), points: points.to_vec() }
    }

    #[test]
    fn curves_reach_their_points() {
        let picture = plot_curves("LOSS", &[curve(&[(0, 0.0), (50, 2.0), (100, 1.0)])], None);
        let at = |x: usize, y: usize| picture.at(LEFT + x, TOP + y);
        assert_eq!(at(WIDTH / 2, 0), COLORS[0]);
        assert_eq!(at(0, HEIGHT), COLORS[0]);
        assert_eq!(at(WIDTH, HEIGHT / 2), COLORS[0]);
        assert_eq!(at(10, 10), [255; 3]);
    }

    #[test]
    fn nothing_and_what_is_no_number_make_an_empty_frame() {
        let empty = plot_curves("A", &[curve(&[])], None);
        assert_eq!(plot_curves("A", &[curve(&[(0, f64::NAN)])], None), empty);
    }
}
