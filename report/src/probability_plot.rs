//! The probability over depth at one pixel (paper, figure 3c), as a picture for browsers.

use std::fmt::Write;

/// Size of the drawing area, and of the margin around it, in pixels.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 280.0;
const MARGIN: f64 = 48.0;

/// Draws `probability` over `depths` (both nearest first, of equal length) as SVG, with a line at
/// `estimate`, the depth that was regressed; all in scene units.
pub fn plot_probability(depths: &[f64], probability: &[f32], estimate: f64) -> String {
    let (near, far) = (depths.first().copied().unwrap_or(0.0), depths.last().copied().unwrap_or(1.0));
    let highest = probability.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let x = |depth: f64| MARGIN + WIDTH * (depth - near) / (far - near).max(f64::MIN_POSITIVE);
    let y = |value: f32| MARGIN + HEIGHT * (1.0 - f64::from(value / highest));
    let points = depths.iter().zip(probability).fold(String::new(), |mut points, (depth, value)| {
        let _ = write!(points, "{:.1},{:.1} ", x(*depth), y(*value));
        points
    });
    let (width, height, bottom) = (WIDTH + 2.0 * MARGIN, HEIGHT + 2.0 * MARGIN, MARGIN + HEIGHT);
    let label = |x: f64, y: f64, anchor: &str, text: &str| {
        format!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>\n")
    };
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         font-family=\"sans-serif\" font-size=\"13\" fill=\"#333\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <path d=\"M{MARGIN} {MARGIN}V{bottom}H{right}\" fill=\"none\" stroke=\"#999\"/>\n\
         <path d=\"M{at:.1} {MARGIN}V{bottom}\" stroke=\"#c0392b\" stroke-dasharray=\"4 3\"/>\n\
         <polyline points=\"{points}\" fill=\"none\" stroke=\"#2d6cdf\" stroke-width=\"1.5\"/>\n{labels}</svg>\n",
        right = MARGIN + WIDTH,
        at = x(estimate),
        labels = [
            label(MARGIN, bottom + 18.0, "start", &format!("{near:.4}")),
            label(MARGIN + WIDTH, bottom + 18.0, "end", &format!("{far:.4}")),
            label(x(estimate), MARGIN - 10.0, "middle", &format!("estimate {estimate:.4}")),
            label(MARGIN - 6.0, MARGIN + 4.0, "end", &format!("{highest:.3}")),
            label(width / 2.0, bottom + 36.0, "middle", "depth"),
        ]
        .concat(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_hypothesis_is_a_point_and_the_peak_touches_the_top() {
        let svg = plot_probability(&[1.0, 2.0, 3.0], &[0.1, 0.8, 0.1], 2.0);
        assert!(svg.contains("48.0,293.0 368.0,48.0 688.0,293.0"), "{svg}");
        assert!(svg.contains("estimate 2.0000") && svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
    }

    #[test]
    fn no_values_make_an_empty_plot() {
        let svg = plot_probability(&[], &[], 0.0);
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
