//! Similarity transforms: rotation, translation and one scale.

use nalgebra::{Matrix3, Matrix4, Point3, SVD, Vector3};
use rayon::prelude::*;

/// A point that a transform shall bring to another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correspondence {
    /// Where it is.
    pub from: Point3<f64>,
    /// Where it shall be.
    pub to: Point3<f64>,
}

/// Correspondences whose sums one thread makes; fixed, so that sums do not depend on the threads.
const CHUNK: usize = 1 << 14;

/// The similarity that brings each `from` closest to its `to` in the sense of least squares (Umeyama
/// 1991), as a 4x4 matrix; `None` when the `from` all coincide or there are none.
pub fn fit_similarity(pairs: &[Correspondence]) -> Option<Matrix4<f64>> {
    let count = pairs.len() as f64;
    let sum = |of: &(dyn Fn(&Correspondence) -> Vector3<f64> + Sync)| {
        let sums: Vec<Vector3<f64>> =
            pairs.par_chunks(CHUNK).map(|chunk| chunk.iter().map(of).sum()).collect();
        sums.iter().sum::<Vector3<f64>>()
    };
    let (from_mean, to_mean) = (sum(&|pair| pair.from.coords) / count, sum(&|pair| pair.to.coords) / count);
    let moments: Vec<(Matrix3<f64>, f64)> = pairs
        .par_chunks(CHUNK)
        .map(|chunk| {
            chunk.iter().fold((Matrix3::zeros(), 0.0), |(covariance, variance), pair| {
                let (from, to) = (pair.from.coords - from_mean, pair.to.coords - to_mean);
                (covariance + to * from.transpose(), variance + from.norm_squared())
            })
        })
        .collect();
    let (covariance, variance) =
        moments.iter().fold((Matrix3::zeros(), 0.0), |sum, part| (sum.0 + part.0, sum.1 + part.1));
    if !(variance > 0.0 && variance.is_finite()) {
        return None;
    }
    let decomposed = SVD::new(covariance, true, true);
    let (u, v_transposed) = (decomposed.u?, decomposed.v_t?);
    // A reflection would fit better where the determinants differ: the weakest axis is turned over.
    let handedness = Vector3::new(1.0, 1.0, (u.determinant() * v_transposed.determinant()).signum());
    let rotation = u * Matrix3::from_diagonal(&handedness) * v_transposed;
    let scale = decomposed.singular_values.dot(&handedness) / variance;
    let mut matrix = Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&(rotation * scale));
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&(to_mean - rotation * from_mean * scale));
    Some(matrix)
}

/// The points after a transform.
pub fn transformed(points: &[Point3<f64>], transform: &Matrix4<f64>) -> Vec<Point3<f64>> {
    points.par_iter().map(|point| transform.transform_point(point)).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Similarity3, Translation3, UnitQuaternion};
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_similarity_is_found_again(
            angles in prop::array::uniform3(-3.0..3.0),
            shift in prop::array::uniform3(-9.0..9.0),
            scale in 0.1..10.0,
            flat in any::<bool>(),
        ) {
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_euler_angles(angles[0], angles[1], angles[2]));
            let truth = Similarity3::from_parts(Translation3::from(shift), rotation, scale);
            let pairs: Vec<_> = (0..40)
                .map(|i| {
                    let t = f64::from(i);
                    let from = Point3::new(t.sin(), (1.7 * t).cos(), if flat { 0.0 } else { 0.3 * (2.9 * t).sin() });
                    Correspondence { from, to: truth * from }
                })
                .collect();
            let found = fit_similarity(&pairs).expect("spread points");
            prop_assert!((found - truth.to_homogeneous()).abs().max() < 1e-9);
        }
    }

    #[test]
    fn points_in_one_place_fit_nothing() {
        let pair = Correspondence { from: Point3::new(1.0, 2.0, 3.0), to: Point3::origin() };
        assert_eq!(fit_similarity(&[pair, pair, pair]), None);
        assert_eq!(fit_similarity(&[]), None);
    }
}
