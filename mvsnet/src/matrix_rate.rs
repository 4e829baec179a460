//! The yardstick of all rates: a large matrix product.

use std::time::Instant;

use tch::{Device, Kind, TchError, Tensor};

use crate::InferError;

/// Rows and columns: large enough that memory does not matter.
const SIZE: i64 = 2048;
/// Products of which the fastest counts.
const PRODUCTS: usize = 4;

/// Operations per second of libtorch's f32 matrix product with this many threads, the best of a few.
pub fn matrix_rate(threads: usize) -> Result<f64, InferError> {
    tch::set_num_threads(threads.max(1) as i32);
    measured().map_err(|error| InferError::Library {
        doing: "multiplying matrices",
        device: "cpu".to_owned(),
        message: error.to_string().lines().next().unwrap_or_default().to_owned(),
    })
}

fn measured() -> Result<f64, TchError> {
    let matrix = || Tensor::f_rand([SIZE, SIZE], (Kind::Float, Device::Cpu));
    let (a, b) = (matrix()?, matrix()?);
    let mut fastest = f64::INFINITY;
    for _ in 0..PRODUCTS {
        let begun = Instant::now();
        let _ = a.f_matmul(&b)?;
        fastest = fastest.min(begun.elapsed().as_secs_f64());
    }
    Ok(2.0 * (SIZE * SIZE * SIZE) as f64 / fastest)
}
