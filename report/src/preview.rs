//! One picture per view: image, depth, confidence and what was kept, side by side.

use planesweep_scene::{DepthMap, DepthRange, Raster};
use thiserror::Error;

use crate::colormap::{confidence_color, depth_color};
use crate::font::{GLYPH_HEIGHT, text_width};
use crate::picture::{draw_text, set};

/// How previews are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PreviewOptions {
    /// Whether colours follow inverse depth instead of depth.
    pub inverse_depth: bool,
    /// Maps are enlarged by a whole number until they have this many columns, or reduced by leaving
    /// pixels out until they have less than twice as many.
    pub panel_width: usize,
}

impl Default for PreviewOptions {
    fn default() -> Self {
        Self { inverse_depth: false, panel_width: 320 }
    }
}

/// Why there is no preview.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum PreviewError {
    /// The mask belongs to another map.
    #[error("the mask is {got_width}x{got_height}, its depth map {width}x{height}")]
    MaskSize {
        /// Columns of the mask.
        got_width: usize,
        /// Rows of the mask.
        got_height: usize,
        /// Columns of the depth map.
        width: usize,
        /// Rows of the depth map.
        height: usize,
    },
}

const BACKGROUND: [u8; 3] = [22, 24, 29];
const INK: [u8; 3] = [222, 225, 230];
/// Pixels without depth and pixels that were dropped.
const NOTHING: [u8; 3] = [52, 54, 60];
const GAP: usize = 8;
const TEXT_SCALE: usize = 2;
const TITLE_HEIGHT: usize = GLYPH_HEIGHT * TEXT_SCALE + 2 * GAP;
const BAR_HEIGHT: usize = 10;
const FOOT_HEIGHT: usize = BAR_HEIGHT + GLYPH_HEIGHT * TEXT_SCALE + 3 * GAP;
/// Labels under a scale bar.
const TICKS: usize = 3;
/// Depths outside these shares of the valid ones are clamped, so that few outliers don't use up the
/// colours.
const LOW_SHARE: f64 = 0.02;
const HIGH_SHARE: f64 = 0.98;

/// Draws image, depth with its scale, confidence with its scale, and the image where `mask` keeps it.
///
/// Near depths are light, far ones dark. `range` is used where the map holds no depth at all.
pub fn draw_preview(
    map: &DepthMap,
    mask: &Raster<bool>,
    range: &DepthRange,
    options: &PreviewOptions,
) -> Result<Raster<[u8; 3]>, PreviewError> {
    let (width, height) = (map.width(), map.height());
    if (mask.width(), mask.height()) != (width, height) {
        let (got_width, got_height) = (mask.width(), mask.height());
        return Err(PreviewError::MaskSize { got_width, got_height, width, height });
    }
    let scale = DepthScale::of(map, range, options.inverse_depth);
    let kept = mask.values().iter().filter(|kept| **kept).count();
    let percent = 100.0 * kept as f64 / mask.values().len() as f64;

    let zoom = Zoom::towards(width, options.panel_width);
    let (panel_width, panel_height) = (zoom.apply(width), zoom.apply(height));
    let mut sheet =
        Raster::filled(4 * panel_width + 5 * GAP, TITLE_HEIGHT + panel_height + FOOT_HEIGHT, BACKGROUND);
    let left = |panel: usize| GAP + panel * (panel_width + GAP);
    let titles = ["IMAGE", "DEPTH", "CONFIDENCE", &format!("KEPT {percent:.1}%")];
    for (panel, title) in titles.into_iter().enumerate() {
        draw_text(&mut sheet, [left(panel), GAP], TEXT_SCALE, INK, title);
    }
    for y in 0..panel_height {
        for x in 0..panel_width {
            let (u, v) = (zoom.source(x), zoom.source(y));
            let color = map.rgb(u, v);
            let pixels = [
                color,
                scale.color(map.depth.at(u, v)).unwrap_or(NOTHING),
                confidence_color(map.confidence.at(u, v)),
                if mask.at(u, v) { color } else { NOTHING },
            ];
            for (panel, pixel) in pixels.into_iter().enumerate() {
                set(&mut sheet, left(panel) + x, TITLE_HEIGHT + y, pixel);
            }
        }
    }
    let top = TITLE_HEIGHT + panel_height + GAP;
    draw_bar(&mut sheet, [left(1), top], panel_width, |t| (depth_color(1.0 - t), label(scale.depth_at(t))));
    draw_bar(&mut sheet, [left(2), top], panel_width, |t| (confidence_color(t), format!("{t:.2}")));
    Ok(sheet)
}

/// A bar of colours from left (0) to right (1) with labels under it.
fn draw_bar(
    sheet: &mut Raster<[u8; 3]>,
    [left, top]: [usize; 2],
    width: usize,
    at: impl Fn(f32) -> ([u8; 3], String),
) {
    for x in 0..width {
        let (color, _) = at(x as f32 / (width - 1).max(1) as f32);
        for y in 0..BAR_HEIGHT {
            set(sheet, left + x, top + y, color);
        }
    }
    for tick in 0..TICKS {
        let t = tick as f32 / (TICKS - 1) as f32;
        let (_, text) = at(t);
        let text_width = text_width(&text, TEXT_SCALE);
        let x = (t * width.saturating_sub(1) as f32) as usize;
        let from = x.saturating_sub(text_width / 2).min(width.saturating_sub(text_width));
        for y in BAR_HEIGHT..BAR_HEIGHT + 4 {
            set(sheet, left + x, top + y, INK);
        }
        draw_text(sheet, [left + from, top + BAR_HEIGHT + GAP], TEXT_SCALE, INK, &text);
    }
}

/// From depth to a place on the colour map: near depths at the light end.
struct DepthScale {
    near: f32,
    far: f32,
    inverse: bool,
}

impl DepthScale {
    fn of(map: &DepthMap, range: &DepthRange, inverse: bool) -> Self {
        let mut valid: Vec<f32> = map.depth.values().iter().copied().filter(|d| *d > 0.0).collect();
        let mut share = |share: f64| {
            let index = (share * valid.len().saturating_sub(1) as f64).round() as usize;
            (!valid.is_empty()).then(|| *valid.select_nth_unstable_by(index, f32::total_cmp).1)
        };
        let near = share(LOW_SHARE).unwrap_or(range.min as f32);
        let far = share(HIGH_SHARE).unwrap_or(range.max as f32);
        Self { near, far, inverse }
    }

    /// The depth at a place on the scale bar, near at the left.
    fn depth_at(&self, t: f32) -> f32 {
        if self.inverse {
            1.0 / (1.0 / self.near + t * (1.0 / self.far - 1.0 / self.near))
        } else {
            self.near + t * (self.far - self.near)
        }
    }

    fn color(&self, depth: f32) -> Option<[u8; 3]> {
        let place = if self.inverse {
            (1.0 / depth - 1.0 / self.near) / (1.0 / self.far - 1.0 / self.near)
        } else {
            (depth - self.near) / (self.far - self.near)
        };
        (depth > 0.0).then(|| depth_color(1.0 - place))
    }
}

/// Three significant digits, without an exponent where four or five places do.
fn label(value: f32) -> String {
    match value.abs() {
        v if !(0.001..100_000.0).contains(&v) && v > 0.0 => format!("{value:.1e}"),
        v if v >= 100.0 || v == 0.0 => format!("{value:.0}"),
        v if v >= 10.0 => format!("{value:.1}"),
        v if v >= 0.1 => format!("{value:.2}"),
        _ => format!("{value:.4}"),
    }
}

/// A whole-number change of size.
enum Zoom {
    Enlarge(usize),
    Reduce(usize),
}

impl Zoom {
    fn towards(width: usize, wanted: usize) -> Self {
        if width < wanted {
            Self::Enlarge(wanted.div_ceil(width.max(1)))
        } else {
            Self::Reduce((width / wanted.max(1)).max(1))
        }
    }

    fn apply(&self, length: usize) -> usize {
        match self {
            Self::Enlarge(factor) => length * factor,
            Self::Reduce(factor) => length.div_ceil(*factor),
        }
    }

    fn source(&self, position: usize) -> usize {
        match self {
            Self::Enlarge(factor) => position / factor,
            Self::Reduce(factor) => position * factor,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Camera, Intrinsics, Pose};

    use super::*;

    fn map(width: usize, height: usize, depth: impl FnMut(usize, usize) -> f32) -> DepthMap {
        let intrinsics = Intrinsics {
            width: width as u32,
            height: height as u32,
            fx: 50.0,
            fy: 50.0,
            skew: 0.0,
            cx: 0.0,
            cy: 0.0,
        };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let depth = Raster::from_fn(width, height, depth);
        let confidence = Raster::from_fn(width, height, |x, _| x as f32 / width as f32);
        let color = Raster::filled(width, height, [200, 100, 50]);
        DepthMap::new(Camera { intrinsics, pose }, depth, confidence, color).expect("sizes agree")
    }

    const RANGE: DepthRange = DepthRange { min: 1.0, max: 9.0, count: None };

    fn draw(map: &DepthMap, mask: &Raster<bool>) -> Raster<[u8; 3]> {
        draw_preview(map, mask, &RANGE, &PreviewOptions::default()).expect("drawn")
    }

    #[test]
    fn panels_show_their_maps() {
        let map = map(80, 60, |x, y| if y < 30 { 0.0 } else { 2.0 + x as f32 * 0.1 });
        let mask = Raster::from_fn(80, 60, |x, _| x < 40);
        let sheet = draw(&map, &mask);
        assert_eq!((sheet.width(), sheet.height()), (4 * 320 + 5 * GAP, TITLE_HEIGHT + 240 + FOOT_HEIGHT));
        let at = |panel: usize, x: usize, y: usize| sheet.at(GAP + panel * (320 + GAP) + x, TITLE_HEIGHT + y);
        assert_eq!(at(0, 5, 5), [200, 100, 50]);
        assert_eq!(at(1, 5, 5), NOTHING);
        assert_eq!(at(1, 0, 200), depth_color(1.0), "near is light");
        assert_eq!(at(1, 319, 200), depth_color(0.0), "far is dark");
        assert_eq!((at(3, 150, 5), at(3, 170, 5)), ([200, 100, 50], NOTHING));
        let foot = TITLE_HEIGHT + 240 + GAP + 3;
        assert_eq!(sheet.at(GAP + 320 + GAP, foot), depth_color(1.0), "the bar starts at the left");
    }

    #[test]
    fn large_maps_shrink_and_tiny_or_empty_ones_are_drawn() {
        let large = map(1301, 40, |_, _| 3.0);
        assert_eq!(draw(&large, &Raster::filled(1301, 40, true)).width(), 4 * 326 + 5 * GAP);
        let empty = map(1, 1, |_, _| 0.0);
        assert_eq!(draw(&empty, &Raster::filled(1, 1, false)).width(), 4 * 320 + 5 * GAP);
    }

    #[test]
    fn a_mask_of_another_size_is_refused() {
        let error = draw_preview(
            &map(4, 3, |_, _| 1.0),
            &Raster::filled(3, 4, true),
            &RANGE,
            &PreviewOptions::default(),
        )
        .expect_err("sizes differ");
        assert_eq!(error.to_string(), "the mask is 3x4, its depth map 4x3");
    }

    #[test]
    fn inverse_scales_meet_their_ends() {
        let scale = DepthScale { near: 2.0, far: 8.0, inverse: true };
        assert!((scale.depth_at(0.0) - 2.0).abs() < 1e-6 && (scale.depth_at(1.0) - 8.0).abs() < 1e-5);
        assert!((scale.depth_at(0.5) - 3.2).abs() < 1e-5);
        assert_eq!(scale.color(3.2), Some(depth_color(0.5)));
    }

    #[test]
    fn labels_are_short() {
        let labels = [0.0, 0.00012, 0.0123, 0.5, 12.34, 431.9, 1.5e6].map(label);
        assert_eq!(labels, ["0", "1.2e-4", "0.0123", "0.50", "12.3", "432", "1.5e6"]);
    }
}
