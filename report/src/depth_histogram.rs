//! Where a view's sparse points lie in depth, and the range that it gets, as a part of a page.

use std::fmt::Write;

/// Size of the drawing, in pixels.
const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 72.0;
/// Bars across the drawing.
const BARS: usize = 65;
/// The range takes the middle of the drawing; this share of its extent lies on either side of it.
const BESIDE: f64 = 0.25;

/// Draws a histogram of `depths` (z, scene units) as SVG with a caption, for a page to hold, over the range from `near` to
/// `far`, which is shaded, and what lies close beside it; points beyond the drawing are counted in words.
pub fn plot_depth_histogram(depths: &[f64], near: f64, far: f64) -> String {
    let extent = (far - near).max(1e-9 * far.abs()).max(f64::MIN_POSITIVE);
    let (start, end) = (near - BESIDE * extent, far + BESIDE * extent);
    let x = |depth: f64| WIDTH * (depth - start) / (end - start);
    let mut counts = [0_usize; BARS];
    let (mut nearer, mut farther) = (0, 0);
    for depth in depths {
        let at = (depth - start) / (end - start) * BARS as f64;
        if at < 0.0 {
            nearer += 1;
        } else if at >= BARS as f64 {
            farther += 1;
        } else {
            counts[at as usize] += 1;
        }
    }
    let highest = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
    let bar = WIDTH / BARS as f64;
    let bars = counts.iter().enumerate().filter(|(_, count)| **count > 0);
    let bars = bars.fold(String::new(), |mut bars, (k, count)| {
        let height = (HEIGHT - 4.0) * *count as f64 / highest;
        let _ = write!(bars, "M{:.1} {HEIGHT}v{:.1}h{:.1}v{height:.1}z", k as f64 * bar, -height, bar - 1.0);
        bars
    });
    let beyond = match (nearer, farther) {
        (0, 0) => String::new(),
        (nearer, farther) => format!("; {nearer} of them are nearer, {farther} farther than drawn"),
    };
    let (left, right, below, total) = (x(near), x(far), HEIGHT + 14.0, HEIGHT + 18.0);
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {total}\" role=\"img\">\
         <title>sparse points by depth, and the depth range</title>\
         <rect class=\"track\" x=\"{left:.1}\" width=\"{range:.1}\" height=\"{HEIGHT}\"/>\
         <path class=\"bar\" d=\"{bars}\"/><path d=\"M0 {HEIGHT}H{WIDTH}\" stroke=\"#999\"/>\
         <text x=\"{left:.1}\" y=\"{below}\">{near:.4}</text>\
         <text x=\"{right:.1}\" y=\"{below}\" text-anchor=\"end\">{far:.4}</text>\
         </svg>\n<p class=\"soft\">{points} sparse points by depth; the depth range is shaded{beyond}</p>\n",
        range = right - left,
        points = depths.len(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_stand_at_their_depth_and_those_beyond_are_counted() {
        let svg = plot_depth_histogram(&[5.0, 5.0, 9.9, -40.0, 0.1, 80.0], 4.0, 10.0);
        // Two bars: the one of two points has the full height.
        assert_eq!(svg.matches('M').count(), 3, "{svg}");
        assert!(svg.contains("v-68.0") && svg.contains("v-34.0"), "{svg}");
        assert!(svg.contains("6 sparse points") && svg.contains("2 of them are nearer, 1 farther"), "{svg}");
        assert!(svg.contains("4.0000") && svg.contains("10.0000"));
    }

    #[test]
    fn no_points_and_no_extent_make_an_empty_plot() {
        let svg = plot_depth_histogram(&[], 2.0, 2.0);
        assert!(!svg.contains("NaN") && !svg.contains("inf") && !svg.contains("of them"), "{svg}");
    }
}
