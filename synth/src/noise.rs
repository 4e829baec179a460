//! Deterministic hashes and the smooth noise made of them.

/// Mixes a word until each of its bits depends on all of them.
#[inline]
pub fn mix(mut word: u32) -> u32 {
    word ^= word >> 16;
    word = word.wrapping_mul(0x7feb_352d);
    word ^= word >> 15;
    word = word.wrapping_mul(0x846c_a68b);
    word ^ (word >> 16)
}

/// The hash of a lattice point.
#[inline]
pub fn hash(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let word = (x as u32).wrapping_mul(0x9e37_79b1)
        ^ (y as u32).wrapping_mul(0x85eb_ca77)
        ^ (z as u32).wrapping_mul(0xc2b2_ae3d);
    mix(word ^ seed.wrapping_mul(0x27d4_eb2f))
}

/// A hash as a number in `[0, 1)`.
#[inline]
pub fn unit(hash: u32) -> f32 {
    (hash >> 8) as f32 / (1 << 24) as f32
}

/// Gradient noise of unit wavelength, about `[-1, 1]`, zero at lattice points.
#[inline]
pub fn gradient_noise([x, y, z]: [f32; 3], seed: u32) -> f32 {
    let [ix, iy, iz] = [x, y, z].map(floor);
    let [fx, fy, fz] = [x - ix as f32, y - iy as f32, z - iz as f32];
    let [u, v, w] = [fx, fy, fz].map(fade);
    let corner = |dx: i32, dy: i32, dz: i32| {
        let h = hash(ix + dx, iy + dy, iz + dz, seed);
        let component = |shift: u32| ((h >> shift) & 255) as f32 - 127.5;
        let along = component(0) * (fx - dx as f32)
            + component(8) * (fy - dy as f32)
            + component(16) * (fz - dz as f32);
        along / 96.0
    };
    let x00 = lerp(corner(0, 0, 0), corner(1, 0, 0), u);
    let x10 = lerp(corner(0, 1, 0), corner(1, 1, 0), u);
    let x01 = lerp(corner(0, 0, 1), corner(1, 0, 1), u);
    let x11 = lerp(corner(0, 1, 1), corner(1, 1, 1), u);
    lerp(lerp(x00, x10, v), lerp(x01, x11, v), w)
}

/// Octaves of gradient noise, each of half the wavelength and `persistence` times the height of the
/// one before; the first has unit wavelength and height.
#[inline]
pub fn octaves(point: [f32; 3], count: u32, persistence: f32, seed: u32) -> f32 {
    let (mut sum, mut frequency, mut height) = (0.0, 1.0, 1.0);
    for octave in 0..count {
        sum += height * gradient_noise(point.map(|v| v * frequency), seed.wrapping_add(octave));
        frequency *= 2.0;
        height *= persistence;
    }
    sum
}

/// What cellular noise finds at a point of the plane whose unit squares hold one seed point each.
pub struct Cell {
    /// Distance to the nearest seed point.
    pub nearest: f32,
    /// Distance to the second nearest.
    pub second: f32,
    /// The hash of the nearest one's square.
    pub id: u32,
}

/// Cellular noise in the plane; `scatter` in `[0, 1]` is how far seed points leave their squares'
/// middles.
#[inline]
pub fn cells(x: f32, y: f32, scatter: f32, seed: u32) -> Cell {
    let (ix, iy) = (floor(x), floor(y));
    let mut cell = Cell { nearest: f32::INFINITY, second: f32::INFINITY, id: 0 };
    for cy in iy - 1..=iy + 1 {
        for cx in ix - 1..=ix + 1 {
            let id = hash(cx, cy, 0, seed);
            let px = cx as f32 + 0.5 + scatter * (unit(id) - 0.5);
            let py = cy as f32 + 0.5 + scatter * (unit(mix(id)) - 0.5);
            let distance = (x - px).hypot(y - py);
            if distance < cell.nearest {
                cell = Cell { nearest: distance, second: cell.nearest, id };
            } else if distance < cell.second {
                cell.second = distance;
            }
        }
    }
    cell
}

/// `a` at 0, `b` at 1.
#[inline]
pub fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// 0 up to `low`, 1 from `high` on, smooth between.
#[inline]
pub fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The next integer below. Without the instruction for it, as on the plainest of processors that are
/// compiled for, the library's own is a call.
#[inline]
fn floor(x: f32) -> i32 {
    let towards_zero = x as i32;
    towards_zero - i32::from((towards_zero as f32) > x)
}

#[inline]
fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_smooth_centred_and_not_flat() {
        let samples: Vec<f32> = (0..4000)
            .map(|i| gradient_noise([i as f32 * 0.317, i as f32 * 0.113, i as f32 * 0.071], 7))
            .collect();
        let mean = samples.iter().sum::<f32>() / samples.len() as f32;
        let deviation = (samples.iter().map(|v| v * v).sum::<f32>() / samples.len() as f32).sqrt();
        assert!(mean.abs() < 0.05, "mean {mean}");
        assert!((0.15..0.6).contains(&deviation), "deviation {deviation}");
        for i in -300..300 {
            let x = i as f32 * 0.01;
            let step = gradient_noise([x, 0.4, -1.3], 7) - gradient_noise([x + 0.001, 0.4, -1.3], 7);
            assert!(step.abs() < 0.01, "jump of {step} at {x}");
        }
    }

    #[test]
    fn cells_are_ordered_and_seeds_matter() {
        for i in 0..500 {
            let (x, y) = (i as f32 * 0.31 - 70.0, i as f32 * 0.17);
            let cell = cells(x, y, 0.8, 3);
            assert!(cell.nearest <= cell.second && cell.nearest < 1.3);
        }
        assert_ne!(hash(1, 2, 3, 4), hash(1, 2, 3, 5));
        assert_ne!(gradient_noise([0.5, 0.5, 0.5], 1), gradient_noise([0.5, 0.5, 0.5], 2));
    }
}
