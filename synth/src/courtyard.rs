//! The bodies of a scene: a walled courtyard with things standing about.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use crate::geometry::{Body, Heightfield, Placement, Shape};
use crate::noise::octaves;
use crate::texture::{Material, Pattern, Rgb};

/// Half the width and depth of the ground, in scene units (metres).
const GROUND_HALF: f64 = 11.0;
const BACK_WALL_Y: f64 = 4.2;
const SIDE_WALL_X: f64 = 6.8;
const WALL_HEIGHT: f64 = 5.0;
/// Things stand within this distance of the middle.
const STAGE_RADIUS: f64 = 2.9;

/// Bodies and, at the same index, what they look like.
pub struct Courtyard {
    /// The bodies; the ground is the first.
    pub bodies: Vec<Body>,
    /// Their materials.
    pub materials: Vec<Material>,
}

/// Builds a courtyard around the origin, z up, open towards -y, with `things` on its ground and
/// `pebbles` strewn between.
pub fn build(things: usize, pebbles: usize, rng: &mut ChaCha8Rng) -> Courtyard {
    let ground = ground(rng.random());
    let mut builder = Builder {
        ground: ground.clone(),
        yard: Courtyard { bodies: Vec::new(), materials: Vec::new() },
        taken: Vec::new(),
        rng,
    };
    builder.add_ground(ground);
    builder.add_walls();
    for _ in 0..things {
        builder.add_thing();
    }
    for _ in 0..pebbles {
        builder.add_pebble();
    }
    builder.yard
}

/// Gently uneven, and heaped up where the walls meet it.
fn ground(seed: u32) -> Heightfield {
    Heightfield::new(221, 221, [GROUND_HALF, GROUND_HALF], move |x, y| {
        let uneven = f64::from(octaves([x as f32 * 0.6, y as f32 * 0.6, 0.0], 4, 0.5, seed));
        let heap = |cx: f64, cy: f64, height: f64, radius: f64| {
            height * (-((x - cx).powi(2) + (y - cy).powi(2)) / (radius * radius)).exp()
        };
        let heaps = heap(-4.6, 2.6, 1.3, 1.5) + heap(4.9, 3.0, 0.9, 1.3) + heap(5.6, -0.8, 0.6, 1.1);
        0.035 * uneven + heaps * (1.0 + 0.35 * uneven)
    })
}

struct Builder<'a> {
    ground: Heightfield,
    yard: Courtyard,
    /// Discs on the ground where something stands: x, y, radius.
    taken: Vec<[f64; 3]>,
    rng: &'a mut ChaCha8Rng,
}

impl Builder<'_> {
    fn add(&mut self, shape: Shape, centre: Point3<f64>, rotation: Matrix3<f64>, material: Material) {
        self.yard.bodies.push(Body { shape, placement: Placement { rotation, centre } });
        self.yard.materials.push(material);
    }

    fn add_ground(&mut self, ground: Heightfield) {
        let palette = [[0.36, 0.34, 0.31], [0.24, 0.23, 0.22], [0.12, 0.10, 0.07]];
        let material = self.material(Pattern::Cobbles, 0.24, palette, 0.34);
        self.add(Shape::Heightfield(ground), Point3::origin(), Matrix3::identity(), material);
    }

    fn add_walls(&mut self) {
        let bricks = [[0.45, 0.19, 0.11], [0.30, 0.13, 0.09], [0.50, 0.46, 0.40]];
        let plaster = [[0.52, 0.45, 0.33], [0.38, 0.33, 0.26], [0.26, 0.22, 0.19]];
        let half_z = WALL_HEIGHT / 2.0 + 0.5;
        let z = WALL_HEIGHT / 2.0 - 0.5;
        let back = Vector3::new(SIDE_WALL_X + 0.6, 0.3, half_z);
        let material = self.material(Pattern::Bricks, 0.36, bricks, 0.34);
        self.add_upright(Shape::Cuboid { half: back }, Point3::new(0.0, BACK_WALL_Y + 0.3, z), material);
        for (side, pattern, palette) in
            [(-1.0, Pattern::Rock, plaster), (1.0, Pattern::Bricks, [plaster[0], plaster[1], bricks[2]])]
        {
            let half = Vector3::new(0.3, 8.0, half_z);
            let material = self.material(pattern, 0.7, palette, 0.34);
            let centre = Point3::new(side * (SIDE_WALL_X + 0.3), BACK_WALL_Y - 7.7, z);
            self.add_upright(Shape::Cuboid { half }, centre, material);
        }
        // Pillars, sills and a beam: depth edges in front of the wall.
        for x in [-4.1, -1.4, 1.4, 4.1] {
            let material = self.material(Pattern::Speckle, 0.12, STONE, 0.3);
            let shape = Shape::Cylinder { radius: 0.19, half_height: 1.9 };
            self.add_upright(shape, Point3::new(x, BACK_WALL_Y - 0.35, 1.5), material);
        }
        for (x, z) in [(-2.75, 1.7), (0.0, 1.9), (2.75, 1.6)] {
            let material = self.material(Pattern::Planks, 0.16, WOOD[1], 0.3);
            let half = Vector3::new(0.62, 0.12, 0.8);
            self.add_upright(Shape::Cuboid { half }, Point3::new(x, BACK_WALL_Y, z), material);
        }
        let beam = self.material(Pattern::Planks, 0.2, WOOD[0], 0.3);
        let half = Vector3::new(SIDE_WALL_X, 0.25, 0.16);
        self.add_upright(Shape::Cuboid { half }, Point3::new(0.0, BACK_WALL_Y - 0.3, 3.5), beam);
    }

    fn add_upright(&mut self, shape: Shape, centre: Point3<f64>, material: Material) {
        self.add(shape, centre, Matrix3::identity(), material);
    }

    /// One of several kinds of things at a free place, or nothing when there is none.
    fn add_thing(&mut self) {
        let kind = self.rng.random_range(0..6);
        let size = self.rng.random_range(0.7..1.25);
        let footprint = size * [0.62, 0.5, 0.45, 0.55, 0.42, 0.6][kind];
        let Some([x, y]) = self.free_place(footprint) else { return };
        let turn = yaw(self.rng.random_range(0.0..TAU));
        let foot = Point3::new(x, y, self.ground.height(x, y) - 0.03);
        let raised = |z: f64| foot + Vector3::z() * z;
        match kind {
            0 => self.add_crates(foot, size, turn),
            1 => {
                let radii = Vector3::new(0.48, 0.4, self.rng.random_range(0.3..0.55)) * size;
                let material = self.solid_material();
                self.add(Shape::Ellipsoid { radii }, raised(0.8 * radii.z), turn, material);
            }
            2 => self.add_barrel(foot, size, turn),
            3 => {
                let half = Vector3::new(0.36, 0.36, 0.42) * size;
                let pattern = self.pick(&[Pattern::Bricks, Pattern::Speckle, Pattern::Checker]);
                let material = self.material(pattern, 0.22, STONE, 0.3);
                self.add(Shape::Cuboid { half }, raised(half.z), turn, material);
                let radius = 0.3 * size;
                let ball = self.solid_material();
                let radii = Vector3::repeat(radius);
                self.add(Shape::Ellipsoid { radii }, raised(2.0 * half.z + radius), turn, ball);
            }
            4 => {
                let shape = Shape::Cylinder { radius: 0.26 * size, half_height: 0.75 * size };
                let pattern = self.pick(&[Pattern::Marble, Pattern::Stripes, Pattern::Speckle]);
                let palette = self.bright_palette();
                let material = self.material(pattern, 0.25, palette, 0.25);
                self.add(shape, raised(0.75 * size), turn, material);
                let vase = self.solid_material();
                let radii = Vector3::new(0.24, 0.24, 0.34) * size;
                self.add(Shape::Ellipsoid { radii }, raised(1.5 * size + 0.8 * radii.z), turn, vase);
            }
            _ => {
                let (major, minor) = (0.42 * size, 0.15 * size);
                let palette = self.bright_palette();
                let material = self.material(Pattern::Checker, 0.14, palette, 0.25);
                let standing = self.rng.random_bool(0.5);
                let (rotation, z) = if standing {
                    (
                        turn * *Rotation3::from_axis_angle(&Vector3::x_axis(), FRAC_PI_2).matrix(),
                        major + minor,
                    )
                } else {
                    (turn, minor)
                };
                self.add(Shape::Torus { major, minor }, raised(z), rotation, material);
            }
        }
    }

    fn add_crates(&mut self, foot: Point3<f64>, size: f64, turn: Matrix3<f64>) {
        let mut z = 0.0;
        let mut turn = turn;
        for shrink in [1.0, 0.72] {
            let half = Vector3::new(0.45, 0.38, 0.3) * (size * shrink);
            let palette = self.pick(&WOOD);
            let material = self.material(Pattern::Planks, 0.15, palette, 0.3);
            self.add(Shape::Cuboid { half }, foot + Vector3::z() * (z + half.z), turn, material);
            z += 2.0 * half.z;
            turn *= yaw(self.rng.random_range(0.2..0.7));
        }
    }

    fn add_barrel(&mut self, foot: Point3<f64>, size: f64, turn: Matrix3<f64>) {
        let half_height = 0.5 * size;
        let palette = self.pick(&WOOD);
        let staves = self.material(Pattern::Stripes, 0.13, palette, 0.3);
        let middle = foot + Vector3::z() * half_height;
        self.add(Shape::Cylinder { radius: 0.38 * size, half_height }, middle, turn, staves);
        for z in [-0.6, 0.6] {
            let hoop = self.material(Pattern::Rock, 0.15, [[0.10; 3], [0.17; 3], [0.3, 0.2, 0.14]], 0.3);
            let shape = Shape::Torus { major: 0.38 * size, minor: 0.03 * size };
            self.add(shape, middle + Vector3::z() * (z * half_height), turn, hoop);
        }
    }

    fn add_pebble(&mut self) {
        let radius = self.rng.random_range(0.05..0.16);
        let Some([x, y]) = self.free_place(radius) else { return };
        let radii = Vector3::new(radius, radius * 0.8, radius * 0.6);
        let centre = Point3::new(x, y, self.ground.height(x, y) + 0.3 * radius);
        let turn = yaw(self.rng.random_range(0.0..TAU));
        let material = self.material(Pattern::Rock, 0.12, STONE, 0.35);
        self.add(Shape::Ellipsoid { radii }, centre, turn, material);
    }

    fn free_place(&mut self, radius: f64) -> Option<[f64; 2]> {
        for _ in 0..60 {
            let angle = self.rng.random_range(0.0..TAU);
            let distance = STAGE_RADIUS * self.rng.random_range(0.0_f64..1.0).sqrt();
            let (x, y) = (distance * angle.cos(), distance * angle.sin() + 0.3);
            if self.taken.iter().all(|[tx, ty, tr]| (x - tx).hypot(y - ty) > radius + tr) {
                self.taken.push([x, y, radius]);
                return Some([x, y]);
            }
        }
        None
    }

    fn material(&mut self, pattern: Pattern, scale: f32, palette: [Rgb; 3], grain: f32) -> Material {
        let gloss = if pattern == Pattern::Marble { 0.25 } else { 0.04 };
        Material { pattern, scale, palette, grain, gloss, seed: self.rng.random() }
    }

    fn solid_material(&mut self) -> Material {
        let pattern = self.pick(&[Pattern::Marble, Pattern::Rock, Pattern::Rock]);
        let palette = self.bright_palette();
        self.material(pattern, 0.3, palette, 0.3)
    }

    fn bright_palette(&mut self) -> [Rgb; 3] {
        self.pick(&[
            [[0.60, 0.55, 0.46], [0.32, 0.27, 0.22], [0.12, 0.10, 0.10]],
            [[0.14, 0.28, 0.40], [0.40, 0.48, 0.50], [0.62, 0.58, 0.48]],
            [[0.46, 0.20, 0.10], [0.60, 0.42, 0.22], [0.14, 0.09, 0.08]],
            [[0.18, 0.30, 0.14], [0.42, 0.44, 0.24], [0.10, 0.13, 0.09]],
            [[0.58, 0.44, 0.16], [0.30, 0.18, 0.10], [0.64, 0.60, 0.52]],
        ])
    }

    fn pick<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.rng.random_range(0..choices.len())]
    }
}

const STONE: [Rgb; 3] = [[0.46, 0.43, 0.38], [0.28, 0.27, 0.26], [0.60, 0.57, 0.50]];
const WOOD: [[Rgb; 3]; 2] = [
    [[0.40, 0.26, 0.14], [0.24, 0.14, 0.07], [0.06, 0.04, 0.03]],
    [[0.30, 0.34, 0.33], [0.18, 0.21, 0.22], [0.05, 0.05, 0.05]],
];

fn yaw(angle: f64) -> Matrix3<f64> {
    Rotation3::from_axis_angle(&Vector3::z_axis(), angle).into_inner()
}
