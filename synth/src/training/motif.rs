//! Motifs: the coarse structure of surfaces in training scenes, beside those of [`crate::texture`].

use std::sync::Arc;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{log_uniform, pick};
use super::paint::resolved;
use super::photo::Photo;
use crate::noise::{Cell, cells, gradient_noise, hash, lerp, mix, octaves, smoothstep, unit};
use crate::texture::{Material, Pattern, Rgb, Spot};

/// A motif with its colours, laid on a surface or cut from the solid.
#[derive(Clone, Debug)]
pub struct Layer {
    motif: Motif,
    /// The period, in scene units.
    scale: f32,
    /// Turns the motif on the surface: cosine and sine.
    turn: [f32; 2],
    /// Whether it fills space instead of being laid on.
    solid: bool,
    palette: [Rgb; 3],
    mean: Rgb,
    seed: u32,
    /// What the motif [`Motif::Photo`] shows.
    photo: Option<Arc<Photo>>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Motif {
    /// One colour.
    Flat,
    /// One of the demo's patterns.
    Known(Pattern),
    /// From one colour to the other over many periods.
    Gradient,
    /// Soft blotches.
    Clouds { octaves: u32, persistence: f32 },
    /// Sharp crests of folded noise.
    Ridges,
    /// Blotches with hard edges.
    Camouflage,
    /// Cells of one tint each.
    Cells { scatter: f32 },
    /// Dark cracks between cells.
    Crackle,
    /// Equal tiles with joints, the same everywhere.
    Tiles,
    /// Equal dots on a lattice.
    Dots,
    /// Equal straight stripes.
    Bars,
    /// Threads over and under.
    Weave,
    /// Squares of random colours.
    Mosaic,
    /// Lines of marks like words.
    Text,
    /// Rectangles and discs over each other, as on posters and packages.
    Collage,
    /// Circles around one centre per period.
    Rings,
    /// Short strokes of grass or fur.
    Strokes,
    /// A photograph, side by side with its mirror images.
    Photo,
}

impl Layer {
    /// Any motif in any colours, or one of the photographs.
    pub fn random(rng: &mut ChaCha8Rng, texel: f64, photos: &[Arc<Photo>]) -> Self {
        if !photos.is_empty() && rng.random_bool(0.3) {
            let photo = photos[rng.random_range(0..photos.len())].clone();
            return Self::photo(rng, texel, photo);
        }
        let known = [
            Pattern::Bricks,
            Pattern::Cobbles,
            Pattern::Planks,
            Pattern::Checker,
            Pattern::Stripes,
            Pattern::Speckle,
            Pattern::Marble,
            Pattern::Rock,
        ];
        // Noise and collections of things are what most of the world looks like; repetition and
        // flat colours are its hard parts.
        let motif = match rng.random_range(0..40) {
            0..10 => Motif::Known(pick(rng, &known)),
            10..15 => {
                Motif::Clouds { octaves: rng.random_range(2..=6), persistence: rng.random_range(0.4..0.9) }
            }
            15..17 => Motif::Ridges,
            17..19 => Motif::Camouflage,
            19..21 => Motif::Cells { scatter: rng.random_range(0.3..1.0) },
            21..23 => Motif::Crackle,
            23 => Motif::Tiles,
            24 => Motif::Dots,
            25 => Motif::Bars,
            26 => Motif::Weave,
            27..29 => Motif::Mosaic,
            29..32 => Motif::Text,
            32..35 => Motif::Collage,
            35 => Motif::Rings,
            36..38 => Motif::Strokes,
            38 => Motif::Gradient,
            _ => Motif::Flat,
        };
        let scale = log_uniform(rng, 6.0 * texel, 220.0 * texel);
        Self::new(rng, motif, scale)
    }

    fn photo(rng: &mut ChaCha8Rng, texel: f64, photo: Arc<Photo>) -> Self {
        let scale = log_uniform(rng, 60.0 * texel, 500.0 * texel);
        let mut layer = Self::new(rng, Motif::Photo, scale);
        layer.mean = photo.mean();
        layer.photo = Some(photo);
        layer
    }

    /// One colour, a gradient, or clouds so faint that matching has little to go by.
    pub fn plain(rng: &mut ChaCha8Rng, texel: f64) -> Self {
        let motif = match rng.random_range(0..6) {
            0..3 => Motif::Flat,
            3 => Motif::Gradient,
            _ => Motif::Clouds { octaves: rng.random_range(1..=4), persistence: 0.6 },
        };
        let scale = log_uniform(rng, 30.0 * texel, 400.0 * texel);
        let mut layer = Self::new(rng, motif, scale);
        let faint = rng.random_range(0.02..0.25);
        let first = layer.palette[0];
        layer.palette = layer.palette.map(|color| blend(first, color, faint));
        layer.mean = mean(&layer.palette);
        layer
    }

    fn new(rng: &mut ChaCha8Rng, motif: Motif, scale: f64) -> Self {
        let palette = palette(rng);
        let angle: f32 =
            if rng.random_bool(0.6) { 0.0 } else { rng.random_range(0.0..std::f32::consts::TAU) };
        let (sin, cos) = angle.sin_cos();
        let solid = rng.random_bool(0.5);
        Self {
            motif,
            scale: scale as f32,
            turn: [cos, sin],
            solid,
            palette,
            mean: mean(&palette),
            seed: rng.random(),
            photo: None,
        }
    }

    /// The colour at a spot, where a pixel is `footprint` wide.
    pub fn color(&self, spot: &Spot, footprint: f32) -> Rgb {
        if self.motif == Motif::Flat {
            return self.palette[0];
        }
        if let Some(photo) = &self.photo {
            let [a, b] = spot.along.map(|c| c / self.scale);
            let [cos, sin] = self.turn;
            let (u, v) = (a * cos - b * sin, a * sin + b * cos);
            return photo.color(u, v / photo.aspect(), footprint / self.scale, true);
        }
        let visible = resolved(self.scale * self.motif.finest(), footprint);
        if visible <= 0.0 {
            return self.mean;
        }
        blend(self.mean, self.sharp(spot, footprint), visible)
    }

    fn sharp(&self, spot: &Spot, footprint: f32) -> Rgb {
        let [first, second, third] = self.palette;
        let [a, b] = spot.along.map(|c| c / self.scale);
        let [cos, sin] = self.turn;
        let (u, v) = (a * cos - b * sin, a * sin + b * cos);
        // What is solid may also be read off the surface: then it is laid on.
        let point = if self.solid { spot.local.map(|c| c / self.scale) } else { [u, v, 0.37] };
        // Half the width of a pixel in periods: edges are as soft as that.
        let soft = (0.6 * footprint / self.scale).max(1e-4);
        let seed = self.seed;
        match self.motif {
            Motif::Flat | Motif::Photo => first,
            Motif::Known(pattern) => {
                let material =
                    Material { pattern, scale: 1.0, palette: self.palette, grain: 0.0, gloss: 0.0, seed };
                material.pattern_color(&Spot { local: point, along: [u, v] })
            }
            Motif::Gradient => {
                let t =
                    (0.5 + 0.12 * u + 0.4 * gradient_noise([u * 0.1, v * 0.1, 0.5], seed)).clamp(0.0, 1.0);
                blend(first, second, t)
            }
            Motif::Clouds { octaves: count, persistence } => {
                let finest = (self.scale / footprint.max(1e-9)).log2().clamp(1.0, count as f32) as u32;
                let noise = octaves(point, finest, persistence, seed);
                blend(first, second, (0.5 + 0.7 * noise).clamp(0.0, 1.0))
            }
            Motif::Ridges => {
                let folded = 1.0 - octaves(point, 3, 0.5, seed).abs();
                blend(first, blend(second, third, folded), folded.clamp(0.0, 1.0).powi(3))
            }
            Motif::Camouflage => {
                let noise = octaves(point, 3, 0.6, seed);
                let other = octaves(point.map(|c| c * 1.3 + 9.0), 2, 0.6, seed ^ 1);
                let edge = (2.0 * soft).max(0.01);
                let base = blend(first, second, smoothstep(-edge, edge, noise));
                blend(base, third, smoothstep(0.2 - edge, 0.2 + edge, other))
            }
            Motif::Cells { scatter } => {
                let Cell { nearest, second: next, id } = cells(u, v, scatter, seed);
                let tint = 0.5 + unit(mix(id));
                let color = blend(first, second, unit(mix(id ^ 7))).map(|c| c * tint);
                blend(third, color, smoothstep(0.0, 0.02 + soft, next - nearest))
            }
            Motif::Crackle => {
                let Cell { nearest, second: next, .. } = cells(u, v, 0.9, seed);
                let ragged = next - nearest + 0.08 * gradient_noise([u * 5.0, v * 5.0, 0.5], seed);
                let face = blend(first, second, (0.5 + 0.5 * gradient_noise(point, seed)).clamp(0.0, 1.0));
                blend(third, face, smoothstep(0.02, 0.06 + soft, ragged))
            }
            Motif::Tiles => {
                let joint = edge(u).min(edge(v));
                blend(third, first, smoothstep(0.03, 0.04 + soft, joint))
            }
            Motif::Dots => {
                let shifted = u + 0.5 * (v.floor() as i32 & 1) as f32;
                let radius = (shifted - shifted.floor() - 0.5).hypot(v - v.floor() - 0.5);
                blend(second, first, smoothstep(0.3 - soft, 0.3 + soft, radius))
            }
            Motif::Bars => blend(first, second, smoothstep(0.25 - soft, 0.25 + soft, edge(v))),
            Motif::Weave => {
                let over = ((u * 4.0).floor() as i32 + (v * 4.0).floor() as i32) & 1 == 0;
                let across = if over { edge(u * 4.0) } else { edge(v * 4.0) };
                let color = if over { first } else { second };
                color.map(|c| c * (0.45 + 1.1 * across))
            }
            Motif::Mosaic => {
                let id = hash((u * 4.0).floor() as i32, (v * 4.0).floor() as i32, 0, seed);
                let color = self.palette[(mix(id) % 3) as usize];
                color.map(|c| c * (0.4 + 1.2 * unit(id)))
            }
            Motif::Text => blend(first, third, ink(u * 3.0, v * 3.0, seed)),
            Motif::Collage => collage(self.palette, u, v, soft, seed),
            Motif::Rings => {
                let (du, dv) = (u - u.floor() - 0.5, v - v.floor() - 0.5);
                let id = hash(u.floor() as i32, v.floor() as i32, 0, seed);
                let rings = (du.hypot(dv) * (4.0 + 12.0 * unit(id))).sin();
                blend(first, second, smoothstep(-0.4, 0.4, rings))
            }
            Motif::Strokes => {
                let bent = u + 0.3 * gradient_noise([u, v, 0.2], seed);
                let fine = gradient_noise([bent * 9.0, v * 1.6, 0.7], seed ^ 3);
                let finer = gradient_noise([bent * 17.0, v * 3.1, 0.3], seed ^ 4);
                let t = (0.5 + 0.6 * fine + 0.4 * finer).clamp(0.0, 1.0);
                blend(blend(third, first, t), second, (t * t * unit(seed)).clamp(0.0, 1.0))
            }
        }
    }
}

impl Motif {
    /// The finest structure that must be resolved, as a share of the period.
    fn finest(self) -> f32 {
        match self {
            Self::Gradient => 8.0,
            Self::Text => 0.09,
            Self::Weave | Self::Mosaic => 0.25,
            Self::Rings | Self::Strokes => 0.12,
            Self::Known(Pattern::Bricks | Pattern::Speckle) => 0.33,
            Self::Known(_) | Self::Ridges | Self::Camouflage => 0.5,
            _ => 1.0,
        }
    }
}

/// Distance to the nearest integer's line, 0 to 0.5.
fn edge(x: f32) -> f32 {
    let f = x - x.floor();
    f.min(1.0 - f)
}

/// Marks in lines: glyphs of 4 by 5 random bits in cells, with gaps between words and lines, and
/// ragged line ends.
fn ink(u: f32, v: f32, seed: u32) -> f32 {
    let line = v.floor();
    let height = v - line;
    let column = (u * 1.6).floor();
    let within = u * 1.6 - column;
    let (x, y) = ((within * 5.0) as i32, (height * 7.0) as i32);
    let glyph = hash(column as i32, line as i32, 0, seed);
    let word = hash((column / 5.0).floor() as i32, line as i32, 1, seed);
    let empty_line = hash(0, line as i32, 2, seed).is_multiple_of(6);
    if glyph.is_multiple_of(7) || word.is_multiple_of(5) || empty_line || x == 4 || !(1..=5).contains(&y) {
        return 0.0;
    }
    let bit = mix(glyph) >> (x * 5 + y - 1) & 1;
    bit as f32
}

/// Up to three figures per cell, drawn over the neighbours' borders.
fn collage(palette: [Rgb; 3], u: f32, v: f32, soft: f32, seed: u32) -> Rgb {
    let mut color = palette[0];
    let (iu, iv) = (u.floor() as i32, v.floor() as i32);
    for cv in iv - 1..=iv + 1 {
        for cu in iu - 1..=iu + 1 {
            let id = hash(cu, cv, 5, seed);
            let draw = |i: u32| unit(mix(id.wrapping_add(i.wrapping_mul(0x9e37))));
            let (x, y) = (u - cu as f32 - draw(1), v - cv as f32 - draw(2));
            let (w, h) = (0.1 + 0.5 * draw(3), 0.1 + 0.5 * draw(4));
            let inside = match id % 3 {
                0 => w.min(h) - x.hypot(y),
                1 => (w - x.abs()).min(h - y.abs()),
                _ => {
                    // A slanted bar.
                    let s = x * (draw(5) - 0.5) + y * 0.5;
                    (0.06 + 0.1 * draw(6) - s.abs()).min(w - x.abs())
                }
            };
            let figure = palette[(id >> 8) as usize % 3].map(|c| c * (0.3 + 1.3 * draw(7)));
            color = blend(color, figure, smoothstep(-soft, soft, inside));
        }
    }
    color
}

/// Three colours: one of any lightness, one that differs a little or much, one for lines and joints.
fn palette(rng: &mut ChaCha8Rng) -> [Rgb; 3] {
    let first = color(rng);
    let second = if rng.random_bool(0.4) {
        let factor = log_uniform(rng, 0.4, 2.2) as f32;
        first.map(|c| (c * factor).clamp(0.01, 0.9))
    } else {
        color(rng)
    };
    let third = if rng.random_bool(0.5) {
        let lightness = log_uniform(rng, 0.02, 0.8) as f32;
        [lightness, lightness * rng.random_range(0.85..1.05), lightness * rng.random_range(0.7..1.1)]
    } else {
        color(rng)
    };
    [first, second, third]
}

/// Mostly muted colours, some strong ones.
pub fn color(rng: &mut ChaCha8Rng) -> Rgb {
    let value = log_uniform(rng, 0.05, 0.8) as f32;
    let strong = rng.random_bool(0.25);
    let saturation = rng.random_range(0.0_f32..1.0).powi(if strong { 1 } else { 3 });
    // Earth, wood, skin, brick and grass lie between red and green.
    let hue =
        if rng.random_bool(0.5) { rng.random_range(0.0_f32..1.0) } else { rng.random_range(0.0_f32..3.0) };
    std::array::from_fn(|c| {
        let distance = (hue - c as f32).abs();
        let share = (1.5 - distance.min(3.0 - distance)).clamp(0.0, 1.0);
        value * (1.0 - saturation * (1.0 - share))
    })
}

fn mean(palette: &[Rgb; 3]) -> Rgb {
    std::array::from_fn(|c| 0.45 * palette[0][c] + 0.4 * palette[1][c] + 0.15 * palette[2][c])
}

/// From `a` at 0 to `b` at 1.
pub fn blend(a: Rgb, b: Rgb, t: f32) -> Rgb {
    [lerp(a[0], b[0], t), lerp(a[1], b[1], t), lerp(a[2], b[2], t)]
}
