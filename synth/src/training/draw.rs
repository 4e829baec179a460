//! Random draws that every part of a training scene makes.

use nalgebra::{Matrix3, Rotation3, Unit, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// A number whose logarithm is uniform: scales of all sizes are equally likely.
pub fn log_uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    rng.random_range(low.ln()..=high.ln()).exp()
}

/// One of several.
pub fn pick<T: Copy>(rng: &mut ChaCha8Rng, choices: &[T]) -> T {
    choices[rng.random_range(0..choices.len())]
}

/// The bell curve of mean 0 and deviation 1, as the sum of twelve uniform draws.
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0
}

/// A direction, each equally likely.
pub fn direction(rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let z: f64 = rng.random_range(-1.0..=1.0);
    let (sin, cos) = rng.random_range(0.0..std::f64::consts::TAU).sin_cos();
    let r = (1.0 - z * z).sqrt();
    Vector3::new(r * cos, r * sin, z)
}

/// A turn about the vertical.
pub fn yaw(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), angle).into_inner()
}

/// Any rotation.
pub fn rotation(rng: &mut ChaCha8Rng) -> Matrix3<f64> {
    let axis = Unit::new_normalize(direction(rng));
    Rotation3::from_axis_angle(&axis, rng.random_range(0.0..std::f64::consts::TAU)).into_inner()
}

/// The rotation that takes z to `axis`.
pub fn along(axis: &Vector3<f64>) -> Matrix3<f64> {
    Rotation3::rotation_between(&Vector3::z(), axis)
        .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI))
        .into_inner()
}
