//! Procedural surface colours. Each material is a pattern (what the eye names: bricks, planks) under
//! grain, noise of many wavelengths, so that image patches are distinct from near and far.

use crate::noise::{Cell, cells, gradient_noise, hash, lerp, mix, octaves, smoothstep, unit};

/// Linear RGB, 0 to 1.
pub type Rgb = [f32; 3];

/// Where on a surface.
#[derive(Clone, Copy, Debug)]
pub struct Spot {
    /// In the body's frame, scene units.
    pub local: [f32; 3],
    /// Along the surface, scene units.
    pub along: [f32; 2],
}

/// What a surface looks like.
#[derive(Clone, Debug)]
pub struct Material {
    /// The coarse structure.
    pub pattern: Pattern,
    /// The period of the pattern, in scene units.
    pub scale: f32,
    /// Two main colours and that of joints, lines and dots.
    pub palette: [Rgb; 3],
    /// The relative height of the grain; 0 gives a clean surface.
    pub grain: f32,
    /// The weight of the highlight, 0 for matt.
    pub gloss: f32,
    /// Tells apart two bodies of one material.
    pub seed: u32,
}

/// The coarse structure of a material. Patterns "along" are laid on the surface, "solid" ones fill
/// space.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pattern {
    /// Courses of bricks with joints, along.
    Bricks,
    /// Rounded stones with joints, along.
    Cobbles,
    /// Boards with grain lines, along.
    Planks,
    /// Squares of two colours, along.
    Checker,
    /// Wavy bands, along.
    Stripes,
    /// Dots of several sizes, along.
    Speckle,
    /// Folded veins, solid.
    Marble,
    /// Blotches, solid.
    Rock,
}

/// The wavelength at which grain starts and the number of octaves below it: 0.4 down to 0.003.
const GRAIN_WAVELENGTH: f32 = 0.4;
const GRAIN_OCTAVES: u32 = 8;
/// How much of an octave's height the next finer one keeps: nearly all, for fine contrast.
const GRAIN_PERSISTENCE: f32 = 0.85;

impl Material {
    /// The share of light the surface throws back at a spot.
    pub fn albedo(&self, spot: &Spot) -> Rgb {
        let base = self.pattern_color(spot);
        let point = spot.local.map(|v| v / GRAIN_WAVELENGTH);
        let grain = octaves(point, GRAIN_OCTAVES, GRAIN_PERSISTENCE, self.seed ^ 0x6772);
        let factor = (1.0 + self.grain * grain).clamp(0.25, 1.9);
        base.map(|c| (c * factor).clamp(0.01, 0.95))
    }

    /// The pattern without grain.
    pub fn pattern_color(&self, spot: &Spot) -> Rgb {
        let [first, second, third] = self.palette;
        let [u, v] = spot.along.map(|c| c / self.scale);
        let solid = spot.local.map(|c| c / self.scale);
        match self.pattern {
            Pattern::Bricks => {
                let course = (v * 3.0).floor();
                let u = u + if course as i32 & 1 == 0 { 0.0 } else { 0.5 };
                let id = hash(u.floor() as i32, course as i32, 0, self.seed);
                let (fu, fv) = (u - u.floor(), v * 3.0 - course);
                // Distance to the joint in periods; a course is a third of one.
                let edge = fu.min(1.0 - fu).min(fv.min(1.0 - fv) / 3.0);
                let ragged = edge + 0.012 * gradient_noise(solid.map(|c| c * 14.0), self.seed);
                stone(self.palette, id, smoothstep(0.015, 0.04, ragged))
            }
            Pattern::Cobbles => {
                let Cell { nearest, second, id } = cells(u, v, 0.75, self.seed);
                let face = smoothstep(0.04, 0.16, second - nearest);
                let round = 1.0 - 0.35 * nearest * nearest;
                stone(self.palette, id, face).map(|c| c * round)
            }
            Pattern::Planks => {
                let board = v.floor();
                let id = hash(board as i32, 0, 0, self.seed);
                let edge = (v - board).min(1.0 - (v - board));
                let stretched = [u * 0.6 + 37.0 * unit(id), v * 7.0, unit(mix(id)) * 9.0];
                let rings = octaves(stretched, 3, 0.6, self.seed);
                let wood = blend(first, second, (0.5 + 0.7 * rings + 0.5 * (unit(id) - 0.5)).clamp(0.0, 1.0));
                blend(third, wood, smoothstep(0.01, 0.05, edge))
            }
            Pattern::Checker => {
                let (iu, iv) = (u.floor() as i32, v.floor() as i32);
                let tint = 0.75 + 0.5 * unit(hash(iu, iv, 0, self.seed));
                let color = if (iu + iv) & 1 == 0 { first } else { second };
                color.map(|c| c * tint)
            }
            Pattern::Stripes => {
                let wave = 0.35 * gradient_noise([u, v, 0.5], self.seed);
                let t = v + wave;
                let id = hash(t.floor() as i32, 0, 0, self.seed);
                let color = blend(first, second, unit(id));
                let line = (t - t.floor()).min(1.0 - (t - t.floor()));
                blend(third, color, smoothstep(0.05, 0.1, line))
            }
            Pattern::Speckle => {
                let large = cells(u, v, 1.0, self.seed);
                let small = cells(u * 3.1, v * 3.1, 1.0, self.seed ^ 1);
                let dot = |cell: &Cell| {
                    let radius = 0.12 + 0.3 * unit(mix(cell.id));
                    1.0 - smoothstep(radius - 0.05, radius, cell.nearest)
                };
                let tint = 0.5 + unit(mix(small.id ^ 9));
                let fine = blend(first, third.map(|c| c * tint), dot(&small));
                blend(fine, blend(second, third, unit(large.id)), dot(&large))
            }
            Pattern::Marble => {
                let folds = octaves(solid, 4, 0.55, self.seed);
                let veins = (solid[0] * 2.0 + solid[2] * 3.1 + 4.0 * folds).sin().abs();
                let body = blend(first, second, (0.5 + 0.6 * folds).clamp(0.0, 1.0));
                blend(third, body, smoothstep(0.0, 0.3, veins))
            }
            Pattern::Rock => {
                let blotches = octaves(solid, 5, 0.65, self.seed);
                let lichen = smoothstep(0.25, 0.4, gradient_noise(solid.map(|c| c * 2.3), self.seed ^ 5));
                blend(blend(first, second, (0.5 + 0.7 * blotches).clamp(0.0, 1.0)), third, 0.7 * lichen)
            }
        }
    }
}

/// A stone of its own tint where `face` is 1, the joint where it is 0.
fn stone([first, second, joint]: [Rgb; 3], id: u32, face: f32) -> Rgb {
    let tint = 0.7 + 0.6 * unit(mix(id ^ 3));
    blend(joint, blend(first, second, unit(mix(id))).map(|c| c * tint), face)
}

fn blend(a: Rgb, b: Rgb, t: f32) -> Rgb {
    [lerp(a[0], b[0], t), lerp(a[1], b[1], t), lerp(a[2], b[2], t)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn luminance([r, g, b]: Rgb) -> f32 {
        0.2126 * r + 0.7152 * g + 0.0722 * b
    }

    /// Every pattern must tell neighbouring patches apart at a centimetre and at a decimetre, or
    /// multi-view stereo has nothing to go by.
    #[test]
    fn every_pattern_has_contrast_at_two_scales() {
        for pattern in [
            Pattern::Bricks,
            Pattern::Cobbles,
            Pattern::Planks,
            Pattern::Checker,
            Pattern::Stripes,
            Pattern::Speckle,
            Pattern::Marble,
            Pattern::Rock,
        ] {
            let material = Material {
                pattern,
                scale: 0.2,
                palette: [[0.5, 0.3, 0.2], [0.3, 0.2, 0.15], [0.6, 0.6, 0.55]],
                grain: 0.3,
                gloss: 0.0,
                seed: 11,
            };
            for step in [0.01_f32, 0.1] {
                let at = |i: usize| {
                    let (x, y) = ((i % 40) as f32 * step, (i / 40) as f32 * step);
                    luminance(material.albedo(&Spot { local: [x, y, 0.3], along: [x, y] }))
                };
                let values: Vec<f32> = (0..1600).map(at).collect();
                assert!(values.iter().all(|v| (0.0..=1.0).contains(v)));
                let mean = values.iter().sum::<f32>() / 1600.0;
                let change =
                    values.windows(2).map(|w| (w[1] - w[0]).powi(2)).sum::<f32>() / values.len() as f32;
                let contrast = change.sqrt() / mean;
                assert!(contrast > 0.08, "{pattern:?} at {step}: {contrast}");
            }
        }
    }
}
