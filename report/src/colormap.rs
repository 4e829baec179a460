//! Colours for numbers, made along paths in the OKLab space, so that equal steps of the number look
//! like equal steps, and rising numbers always get lighter, also in grey.

use std::f32::consts::TAU;
use std::sync::LazyLock;

const STEPS: usize = 256;

/// The colour of a depth: `t` is 0 (dark violet) to 1 (light yellow); outside it is clamped.
pub fn depth_color(t: f32) -> [u8; 3] {
    static TABLE: LazyLock<[[u8; 3]; STEPS]> = LazyLock::new(|| table(violet_to_yellow));
    lookup(&TABLE, t)
}

/// The grey of a confidence: `t` is 0 (near black) to 1 (near white); outside it is clamped.
pub fn confidence_color(t: f32) -> [u8; 3] {
    static TABLE: LazyLock<[[u8; 3]; STEPS]> = LazyLock::new(|| table(|t| [0.18 + 0.78 * t, 0.0, 0.0]));
    lookup(&TABLE, t)
}

/// The colour of an error: `t` is 0 (white) over orange to 1 (dark red); outside it is clamped.
pub fn error_color(t: f32) -> [u8; 3] {
    static TABLE: LazyLock<[[u8; 3]; STEPS]> = LazyLock::new(|| table(white_to_red));
    lookup(&TABLE, t)
}

/// Lightness falls evenly while the colour gets stronger and turns from yellow to red.
fn white_to_red(t: f32) -> [f32; 3] {
    let lightness = 0.99 - 0.62 * t;
    let hue = (90.0 - 62.0 * t) / 360.0 * TAU;
    let chroma = 0.16 * (1.0 - (1.0 - t).powi(3));
    [lightness, chroma * hue.cos(), chroma * hue.sin()]
}

/// Lightness rises evenly while the hue turns from violet over blue and green to yellow; chroma is
/// least in the teal, where sRGB reaches least far.
fn violet_to_yellow(t: f32) -> [f32; 3] {
    let lightness = 0.22 + 0.70 * t;
    let hue = (315.0 - 212.0 * t) / 360.0 * TAU;
    let chroma = 0.11 + 0.09 * (2.0 * t - 1.0).powi(2) - 0.06 * (1.0 - t).powi(6);
    [lightness, chroma * hue.cos(), chroma * hue.sin()]
}

fn table(path: impl Fn(f32) -> [f32; 3]) -> [[u8; 3]; STEPS] {
    std::array::from_fn(|i| oklab_to_srgb(path(i as f32 / (STEPS - 1) as f32)))
}

fn lookup(table: &[[u8; 3]; STEPS], t: f32) -> [u8; 3] {
    // A cast takes NaN to 0.
    table[(t.clamp(0.0, 1.0) * (STEPS - 1) as f32).round() as usize]
}

/// From OKLab (Ottosson 2020: lightness, green to red, blue to yellow) to sRGB bytes. Outside the
/// gamut the chroma shrinks until the colour fits, so lightness and hue stay.
fn oklab_to_srgb([lightness, a, b]: [f32; 3]) -> [u8; 3] {
    let mut keep = 1.0;
    loop {
        let linear = oklab_to_linear([lightness, a * keep, b * keep]);
        if keep <= 0.0 || linear.iter().all(|v| (-1e-4..=1.0001).contains(v)) {
            return linear.map(|v| (encode_srgb(v.clamp(0.0, 1.0)) * 255.0 + 0.5) as u8);
        }
        keep -= 0.01;
    }
}

/// The inverse of OKLab's definition: cone responses are cubes of its rotated axes.
fn oklab_to_linear([lightness, a, b]: [f32; 3]) -> [f32; 3] {
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_4 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
}

fn encode_srgb(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CIE L*, from another definition of lightness than the one the maps are made with.
    fn lightness(color: [u8; 3]) -> f32 {
        let [r, g, b] = color.map(|c| {
            let c = f32::from(c) / 255.0;
            if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
        });
        let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
        if y > 0.008_856 { 116.0 * y.cbrt() - 16.0 } else { 903.3 * y }
    }

    #[test]
    fn lightness_rises_all_the_way() {
        for map in [depth_color, confidence_color, |t: f32| error_color(1.0 - t)] {
            let values: Vec<f32> = (0..=32).map(|i| lightness(map(i as f32 / 32.0))).collect();
            for pair in values.windows(2) {
                let step = pair[1] - pair[0];
                assert!((0.5..6.0).contains(&step), "a step of {step} in {values:?}");
            }
        }
    }

    #[test]
    fn ends_are_clamped_and_greys_are_grey() {
        assert_eq!(depth_color(-3.0), depth_color(0.0));
        assert_eq!(depth_color(7.0), depth_color(1.0));
        let [r, g, b] = confidence_color(0.5);
        assert!(r.abs_diff(g) <= 1 && g.abs_diff(b) <= 1);
        let [r, g, b] = oklab_to_srgb([1.0, 0.0, 0.0]);
        assert!(r >= 254 && g >= 254 && b >= 254, "white is {r} {g} {b}");
    }
}
