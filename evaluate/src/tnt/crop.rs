//! The volume that a scene is judged in.

use nalgebra::Point3;
use rayon::prelude::*;
use serde::Deserialize;

use super::TntError;

/// A prism over a polygon, as Open3D's `SelectionPolygonVolume` files state it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct CropVolume {
    /// The axis of the prism.
    orthogonal_axis: Axis,
    /// Its extent along that axis.
    axis_min: f64,
    axis_max: f64,
    /// Its outline in the other two axes.
    bounding_polygon: Vec<Point3<f64>>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
enum Axis {
    #[serde(alias = "x")]
    X,
    #[serde(alias = "y")]
    Y,
    #[serde(alias = "z")]
    Z,
}

impl CropVolume {
    /// Reads the JSON of a crop file.
    pub fn parse(json: &str) -> Result<Self, TntError> {
        let volume: Self = serde_json::from_str(json).map_err(TntError::Crop)?;
        if volume.bounding_polygon.len() < 3 {
            return Err(TntError::Polygon { corners: volume.bounding_polygon.len() });
        }
        Ok(volume)
    }

    /// The points inside, in their order. Points that are not finite are outside.
    pub fn crop(&self, points: &[Point3<f64>]) -> Vec<Point3<f64>> {
        points.par_iter().filter(|point| self.contains(point)).copied().collect()
    }

    /// Whether a point is inside: within the extent, ends included, and right of an odd number of the
    /// polygon's edges that cross its row.
    pub fn contains(&self, point: &Point3<f64>) -> bool {
        let (across, row, along) = match self.orthogonal_axis {
            Axis::X => (1, 2, 0),
            Axis::Y => (0, 2, 1),
            Axis::Z => (0, 1, 2),
        };
        if !(self.axis_min..=self.axis_max).contains(&point[along]) {
            return false;
        }
        let corners = &self.bounding_polygon;
        let edges = corners.iter().zip(corners.iter().cycle().skip(1));
        let left_of_point = edges.filter(|(a, b)| {
            // The lower end belongs to the edge, the upper one does not, so a corner counts once.
            let crosses = (a[row] < point[row]) != (b[row] < point[row]);
            let crossing = a[across] + (point[row] - a[row]) / (b[row] - a[row]) * (b[across] - a[across]);
            crosses && crossing < point[across]
        });
        left_of_point.count() % 2 == 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const L_SHAPE: &str = r#"{ "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
        "orthogonal_axis": "Y", "axis_min": -1.0, "axis_max": 2,
        "bounding_polygon": [[0, 9, 0], [4, 9, 0], [4, 9, 1], [1, 9, 1], [1, 9, 3], [0, 9, 3]] }"#;

    #[test]
    fn inside_is_even_odd_over_the_two_other_axes() {
        let volume = CropVolume::parse(L_SHAPE).expect("a volume");
        let inside = |x: f64, y: f64, z: f64| volume.contains(&Point3::new(x, y, z));
        assert!(inside(0.5, 0.0, 0.5) && inside(3.0, 0.0, 0.5) && inside(0.5, 0.0, 2.5));
        assert!(!inside(3.0, 0.0, 2.5) && !inside(-0.1, 0.0, 0.5) && !inside(0.5, 0.0, 3.1));
        assert!(inside(0.5, 2.0, 0.5) && inside(0.5, -1.0, 0.5) && !inside(0.5, 2.1, 0.5));
        assert!(
            !inside(f64::NAN, 0.0, 0.5) && !inside(f64::INFINITY, 0.0, 0.5) && !inside(0.5, 0.0, f64::NAN)
        );
        let points = [[0.5, 0.0, 0.5], [3.0, 0.0, 2.5], [3.0, 0.0, 0.5]].map(Point3::from);
        assert_eq!(volume.crop(&points), [points[0], points[2]]);
    }

    #[test]
    fn what_is_no_volume_is_refused() {
        let error = |text: &str| CropVolume::parse(text).expect_err("refused").to_string();
        assert_eq!(error("{}"), "cannot understand the crop volume");
        assert_eq!(error(&L_SHAPE.replace("\"Y\"", "\"W\"")), "cannot understand the crop volume");
        let two = r#"{"orthogonal_axis": "X", "axis_min": 0, "axis_max": 1, "bounding_polygon": [[0,0,0],[1,1,1]]}"#;
        assert_eq!(error(two), "the crop volume's polygon has 2 corners");
    }
}
