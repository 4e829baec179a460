//! Middlebury multi-view scenes, NAME_par.txt, as MVSNet folders.

use std::fs;
use std::path::Path;

use nalgebra::{Matrix3, Point3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, Scene, View, ViewId, image_size, write_mvsnet,
};

/// A box around the object, in the world; the data set's README names it.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// The corner with the smallest coordinates.
    pub min: Point3<f64>,
    /// The corner with the largest.
    pub max: Point3<f64>,
}

impl Bounds {
    fn corners(self) -> impl Iterator<Item = Point3<f64>> {
        let pick = move |bits: usize, axis: usize| {
            if bits >> axis & 1 == 0 { self.min[axis] } else { self.max[axis] }
        };
        (0..8).map(move |bits| Point3::new(pick(bits, 0), pick(bits, 1), pick(bits, 2)))
    }
}

/// Converts the scene in `source`, whose cameras are in the file `cameras`. Depth ranges are those of
/// the corners of `bounds`, widened by a tenth.
pub fn convert_middlebury(source: &Path, cameras: &str, bounds: Bounds, target: &Path) {
    let images = target.join("images");
    fs::create_dir_all(&images).expect("made");
    let text = fs::read_to_string(source.join(cameras)).expect("the cameras");
    let mut scene = Scene::default();
    for (index, line) in text.lines().skip(1).filter(|line| !line.trim().is_empty()).enumerate() {
        let mut words = line.split_ascii_whitespace();
        let file = words.next().expect("an image");
        let numbers: Vec<f64> = words.map(|word| word.parse().expect("a number")).collect();
        assert_eq!(numbers.len(), 21, "K, R and t of {file}");
        let k = Matrix3::from_row_slice(&numbers[..9]);
        let pose =
            Pose::new(Matrix3::from_row_slice(&numbers[9..18]), Vector3::from_row_slice(&numbers[18..]))
                .expect("a pose");
        let name = format!("{index:08}.png");
        let image = images.join(&name);
        fs::copy(source.join(file), &image).expect("copied");
        let (width, height) = image_size(&image).expect("an image");
        let intrinsics = Intrinsics {
            width,
            height,
            fx: k[(0, 0)],
            fy: k[(1, 1)],
            skew: k[(0, 1)],
            cx: k[(0, 2)],
            cy: k[(1, 2)],
        };
        let depths: Vec<f64> = bounds.corners().map(|corner| pose.to_camera(&corner).z).collect();
        let (near, far) = depths.iter().fold((f64::MAX, 0.0_f64), |(a, b), z| (a.min(*z), b.max(*z)));
        let margin = 0.1 * (far - near);
        let view = View {
            id: ViewId(index as u32),
            name,
            image,
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: Some(DepthRange { min: near - margin, max: far + margin, count: Some(192) }),
        };
        scene.views.insert(view.id, view);
    }
    write_mvsnet(&scene, target).expect("written");
}
