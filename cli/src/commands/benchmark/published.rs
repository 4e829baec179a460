//! The figures of the paper's tables 1 and 2 (Yao et al., ECCV 2018).

/// Table 1, DTU: accuracy, completeness and overall in mm; then accuracy, completeness and f-score in percent
/// within 1 mm, and within 2 mm.
pub const DTU: [(&str, [f64; 9]); 6] = [
    ("Camp", [0.835, 0.554, 0.695, 71.75, 64.94, 66.31, 84.83, 67.82, 73.02]),
    ("Furu", [0.613, 0.941, 0.777, 69.55, 61.52, 63.26, 78.99, 67.88, 70.93]),
    ("Tola", [0.342, 1.190, 0.766, 90.49, 57.83, 68.07, 93.94, 63.88, 73.61]),
    ("Gipuma", [0.283, 0.873, 0.578, 94.65, 59.93, 70.64, 96.42, 63.81, 74.16]),
    ("SurfaceNet", [0.450, 1.04, 0.745, 83.8, 63.38, 69.95, 87.15, 67.99, 74.4]),
    ("MVSNet (paper)", [0.396, 0.527, 0.462, 86.46, 71.13, 75.69, 91.06, 75.31, 80.25]),
];

/// Table 2, Tanks and Temples, intermediate: the mean F-score in percent, then those of the scenes in order.
pub const INTERMEDIATE: [(&str, [f64; 9]); 9] = [
    ("MVSNet (paper)", [43.48, 55.99, 28.55, 25.07, 50.79, 53.96, 50.86, 47.90, 34.69]),
    ("Pix4D", [43.24, 64.45, 31.91, 26.43, 54.41, 50.58, 35.37, 47.78, 34.96]),
    ("COLMAP", [42.14, 50.41, 22.25, 25.63, 56.43, 44.83, 46.97, 48.53, 42.04]),
    ("OpenMVG + OpenMVS", [41.71, 58.86, 32.59, 26.25, 43.12, 44.73, 46.85, 45.97, 35.27]),
    ("OpenMVG + MVE", [38.00, 49.91, 28.19, 20.75, 43.35, 44.51, 44.76, 36.58, 35.95]),
    ("OpenMVG + SMVS", [30.67, 31.93, 19.92, 15.02, 39.38, 36.51, 41.61, 35.89, 25.12]),
    ("OpenMVG-G + OpenMVS", [22.86, 56.50, 29.63, 21.69, 6.55, 39.54, 28.48, 0.00, 0.53]),
    ("MVE", [25.37, 48.59, 23.84, 12.70, 5.07, 39.62, 38.16, 5.81, 29.19]),
    ("OpenMVG + PMVS", [29.66, 41.03, 17.70, 12.83, 36.68, 35.93, 33.20, 31.78, 28.10]),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_the_scenes() {
        for (name, [mean, scenes @ ..]) in INTERMEDIATE {
            let computed = scenes.iter().sum::<f64>() / scenes.len() as f64;
            // The paper rounds each figure.
            let is_close = (computed - mean).abs() < 0.02;
            assert!(is_close, "{name}: {computed} is not {mean}");
        }
        for (name, figures) in DTU {
            assert!((f64::midpoint(figures[0], figures[1]) - figures[2]).abs() < 0.001, "{name}");
        }
    }
}
