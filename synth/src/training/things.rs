//! Things that stand in training scenes, from one body to some dozens, thin ones among them.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;

use super::draw::{along, direction, log_uniform, pick, rotation, yaw};
use super::moulded::mould;
use super::paint::Paint;
use super::stage::Builder;
use crate::geometry::{MeshShape, Shape};

/// Kinds of things, all of about the size that is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Thing {
    Crates,
    Ball,
    Pillar,
    Ring,
    Vase,
    Bush,
    Books,
    Table,
    Chair,
    Lattice,
    Tripod,
    Rubble,
    Sign,
    Stairs,
    Bottle,
    Tree,
    Moulded,
    Scanned,
}

/// What lies on tables and floors.
pub const SMALL_THINGS: [Thing; 16] = [
    Thing::Crates,
    Thing::Crates,
    Thing::Ball,
    Thing::Pillar,
    Thing::Ring,
    Thing::Vase,
    Thing::Vase,
    Thing::Bush,
    Thing::Books,
    Thing::Bottle,
    Thing::Rubble,
    Thing::Stairs,
    Thing::Moulded,
    Thing::Moulded,
    Thing::Scanned,
    Thing::Scanned,
];

/// What stands in rooms.
pub const FURNITURE: [Thing; 11] = [
    Thing::Table,
    Thing::Table,
    Thing::Chair,
    Thing::Chair,
    Thing::Crates,
    Thing::Books,
    Thing::Bush,
    Thing::Tripod,
    Thing::Vase,
    Thing::Moulded,
    Thing::Scanned,
];

/// What stands in the open.
pub const STREET_THINGS: [Thing; 12] = [
    Thing::Tree,
    Thing::Tree,
    Thing::Bush,
    Thing::Lattice,
    Thing::Sign,
    Thing::Pillar,
    Thing::Crates,
    Thing::Rubble,
    Thing::Stairs,
    Thing::Tripod,
    Thing::Moulded,
    Thing::Scanned,
];

impl Builder<'_> {
    /// Puts a thing of `size` (height or width) with its foot at `foot`, turned about the vertical.
    pub fn add_thing(&mut self, thing: Thing, foot: Point3<f64>, size: f64) {
        let turn = yaw(self.rng.random_range(0.0..TAU));
        let up = |z: f64| foot + Vector3::z() * z;
        match thing {
            Thing::Crates => self.add_crates(foot, turn, size),
            Thing::Ball => {
                let radii = Vector3::new(1.0, self.between(0.6, 1.0), self.between(0.4, 1.0)) * (size / 2.0);
                let paint = self.paint();
                self.add(Shape::Ellipsoid { radii }, up(0.97 * radii.z), turn, &paint);
            }
            Thing::Pillar => {
                let (radius, half_height) = (size * self.between(0.12, 0.4), size * self.between(0.3, 0.7));
                let paint = self.paint();
                self.add(Shape::Cylinder { radius, half_height }, up(half_height), turn, &paint);
                if self.chance(0.4) {
                    let cap = self.paint();
                    let shape = Shape::Torus { major: radius, minor: 0.15 * radius };
                    self.add(shape, up(2.0 * half_height), turn, &cap);
                }
            }
            Thing::Ring => {
                let major = size * 0.4;
                let minor = major * self.between(0.12, 0.4);
                let paint = self.paint();
                let (turn, z) = if self.chance(0.5) {
                    (turn * along(&Vector3::x()), major + minor)
                } else {
                    (turn, minor)
                };
                self.add(Shape::Torus { major, minor }, up(z), turn, &paint);
            }
            Thing::Vase => self.add_vase(foot, turn, size),
            Thing::Bush => self.add_leaves(up(size * 0.45), size * 0.45),
            Thing::Tree => self.add_tree(foot, size),
            Thing::Books => self.add_books(foot, turn, size),
            Thing::Table => self.add_table(foot, turn, size),
            Thing::Chair => self.add_chair(foot, turn, size),
            Thing::Lattice => self.add_lattice(foot, turn, size),
            Thing::Tripod => self.add_tripod(foot, turn, size),
            Thing::Rubble => self.add_rubble(foot, size),
            Thing::Sign => {
                let (pole, panel) = (self.plain_paint(), self.paint());
                let top = up(size);
                self.add_rod(foot, top, size * 0.02, &pole);
                let half = [size * self.between(0.15, 0.4), size * 0.01, size * self.between(0.12, 0.3)];
                self.add_box(half, top, turn, &panel);
            }
            Thing::Stairs => self.add_stairs(foot, turn, size),
            Thing::Bottle => self.add_bottle(foot, turn, size),
            Thing::Moulded => self.add_moulded(foot, turn, size),
            Thing::Scanned => self.add_scanned(foot, turn, size),
        }
    }

    /// Up to three boxes on each other, askew.
    fn add_crates(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let (mut z, mut half, mut turn) = (0.0, size / 2.0, turn);
        for _ in 0..self.rng.random_range(1..=3) {
            let h = [half, half * self.between(0.5, 1.0), half * self.between(0.25, 1.0)];
            let paint = self.paint();
            self.add_box(h, up(z + h[2]), turn, &paint);
            z += 2.0 * h[2];
            half *= self.between(0.5, 0.9);
            turn *= yaw(self.between(-0.6, 0.6));
        }
    }

    /// A belly, a neck and a lip.
    fn add_vase(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let belly = size * self.between(0.22, 0.4);
        let height = belly * self.between(0.8, 1.3);
        let paint = self.paint();
        let radii = Vector3::new(belly, belly, height);
        self.add(Shape::Ellipsoid { radii }, up(0.9 * height), turn, &paint);
        let (radius, half_height) = (0.45 * belly, 0.4 * height);
        let neck = if self.chance(0.5) { paint } else { self.paint() };
        self.add(Shape::Cylinder { radius, half_height }, up(1.9 * height), turn, &neck);
        let lip = Shape::Torus { major: radius, minor: 0.25 * radius };
        self.add(lip, up(2.3 * height), turn, &neck);
    }

    /// A trunk under leaves or bare branches.
    fn add_tree(&mut self, foot: Point3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let height = size * self.between(0.8, 1.4);
        let bark = self.paint();
        let crown = up(height * self.between(0.6, 0.8));
        let trunk = size * self.between(0.02, 0.06);
        self.add_rod(foot, crown, trunk, &bark);
        if self.chance(0.4) {
            self.add_branches(crown, size, &bark);
        } else {
            let radius = size * self.between(0.25, 0.45);
            self.add_leaves(crown, radius);
        }
    }

    /// Thin boxes in a pile or in a row.
    fn add_books(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let (mut z, count) = (0.0, self.rng.random_range(3..9));
        let standing = self.chance(0.4);
        for i in 0..count {
            let h = [
                size * self.between(0.3, 0.45),
                size * self.between(0.2, 0.32),
                size * 0.035 * self.between(0.5, 2.0),
            ];
            let paint = self.paint();
            if standing {
                let shift = turn * Vector3::new(0.0, (f64::from(i) - 4.0) * 0.13 * size, 0.0);
                self.add_box([h[1], h[2], h[0]], foot + shift + Vector3::z() * h[0], turn, &paint);
            } else {
                let askew = turn * yaw(self.between(-0.3, 0.3));
                self.add_box(h, up(z + h[2]), askew, &paint);
                z += 2.0 * h[2];
            }
        }
    }

    /// Four legs, a seat and a back of board or bars.
    fn add_chair(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let paint = self.paint();
        let seat = size * 0.5;
        let half = size * 0.25;
        self.add_legs(foot, turn, [half, half], seat, size * 0.025, &paint);
        self.add_box([half, half, size * 0.03], up(seat), turn, &paint);
        let back = foot + turn * Vector3::new(0.0, half, seat + half);
        if self.chance(0.5) {
            self.add_box([half, size * 0.025, half], back, turn, &paint);
        } else {
            for i in -2..=2 {
                let x = f64::from(i) * half * 0.45;
                let low = foot + turn * Vector3::new(x, half, seat);
                self.add_rod(low, low + Vector3::z() * (2.0 * half), size * 0.015, &paint);
            }
        }
    }

    /// Three thin legs under a box.
    fn add_tripod(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let paint = self.paint();
        let top = up(size);
        for leg in 0..3 {
            let (sin, cos) = (f64::from(leg) * TAU / 3.0 + 0.4).sin_cos();
            let end = foot + Vector3::new(cos, sin, 0.0) * (0.35 * size);
            self.add_rod(end, top, size * 0.018, &paint);
        }
        let head = self.paint();
        let half = [0.12, 0.08, 0.09].map(|h| h * size);
        self.add_box(half, top, turn, &head);
    }

    /// Lumps strewn about.
    fn add_rubble(&mut self, foot: Point3<f64>, size: f64) {
        let paint = self.paint();
        for _ in 0..self.rng.random_range(5..16) {
            let radius = size * log_uniform(self.rng, 0.04, 0.2);
            let at = Vector3::new(self.between(-0.5, 0.5), self.between(-0.5, 0.5), 0.0) * size;
            let turn = rotation(self.rng);
            let own = if self.chance(0.3) { self.paint() } else { paint.clone() };
            self.add_lump(foot + at + Vector3::z() * (0.5 * radius), radius, turn, &own);
        }
    }

    /// Steps that rise along the thing.
    fn add_stairs(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let paint = self.paint();
        let steps = self.rng.random_range(3..8);
        let (rise, run) = (size * 0.5 / f64::from(steps), size / f64::from(steps));
        for i in 0..steps {
            let half_height = rise * f64::from(i + 1) / 2.0;
            let at = turn * Vector3::new(0.0, (f64::from(i) + 0.5) * run - size / 2.0, half_height);
            self.add_box([size * 0.35, run / 2.0, half_height], foot + at, turn, &paint);
        }
    }

    /// A body, a shoulder and a neck.
    fn add_bottle(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let up = |z: f64| foot + Vector3::z() * z;
        let radius = size * self.between(0.1, 0.18);
        let paint = self.paint();
        let body = size * 0.3;
        self.add(Shape::Cylinder { radius, half_height: body }, up(body), turn, &paint);
        let shoulder = Vector3::new(radius, radius, 0.15 * size);
        let glass = if self.chance(0.5) { paint } else { self.plain_paint() };
        self.add(Shape::Ellipsoid { radii: shoulder }, up(2.0 * body), turn, &glass);
        let neck = Shape::Cylinder { radius: 0.35 * radius, half_height: 0.18 * size };
        self.add(neck, up(2.0 * body + 0.2 * size), turn, &glass);
    }

    /// A mesh made up, standing.
    fn add_moulded(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let mesh = mould(self.rng);
        let scale = size / 2.0;
        let low = mesh.bounds().map_or(0.0, |bounds| bounds.min.z * scale);
        let paint = self.paint();
        let shape = Shape::Mesh(MeshShape { mesh, scale, textured: false });
        self.add(shape, foot - Vector3::z() * low, turn, &paint);
    }

    /// A mesh of the library in any position, mostly in its own colours; a made up one without any.
    fn add_scanned(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let library = self.library;
        if library.meshes.is_empty() {
            return self.add_moulded(foot, turn, size);
        }
        let scan = &library.meshes[self.rng.random_range(0..library.meshes.len())];
        let turn = if self.chance(0.6) { turn } else { rotation(self.rng) };
        let scale = size / scan.size;
        let mut paint = self.paint();
        let skin = scan.texture.clone().filter(|_| self.chance(0.75));
        let textured = skin.is_some();
        if let Some(photo) = skin {
            paint = paint.with_skin(photo, (scan.uv_per_length / scale) as f32);
        }
        let middle = foot + Vector3::z() * (scan.reach_down(&turn) * scale);
        let shape = Shape::Mesh(MeshShape { mesh: scan.mesh.clone(), scale, textured });
        self.add(shape, middle - turn * scan.middle * scale, turn, &paint);
    }

    /// One convex or ring-shaped body of about `radius`.
    pub fn add_lump(&mut self, centre: Point3<f64>, radius: f64, turn: Matrix3<f64>, paint: &Paint) {
        let sides = Vector3::new(1.0, self.between(0.4, 1.0), self.between(0.25, 1.0)) * radius;
        let shape = match self.rng.random_range(0..7) {
            0..3 => Shape::Cuboid { half: sides * 0.8 },
            3..5 => Shape::Ellipsoid { radii: sides },
            5 => Shape::Cylinder { radius: sides.y * 0.7, half_height: radius * 0.8 },
            _ => Shape::Torus { major: radius * 0.75, minor: radius * self.between(0.1, 0.25) },
        };
        self.add(shape, centre, turn, paint);
    }

    /// A cloud of small flat bodies.
    fn add_leaves(&mut self, centre: Point3<f64>, radius: f64) {
        let paints = [self.paint(), self.paint()];
        let leaf = radius * self.between(0.12, 0.35);
        for _ in 0..self.rng.random_range(15..45) {
            let at = centre + direction(self.rng) * (radius * self.between(0.3, 1.0));
            let turn = rotation(self.rng);
            let flat = self.between(0.08, 0.7);
            let radii = Vector3::new(leaf, leaf * self.between(0.4, 1.0), leaf * flat);
            let paint = &paints[usize::from(self.chance(0.3))];
            self.add(Shape::Ellipsoid { radii }, at, turn, paint);
        }
    }

    fn add_branches(&mut self, crown: Point3<f64>, size: f64, bark: &Paint) {
        for _ in 0..self.rng.random_range(5..12) {
            let mut way = direction(self.rng);
            way.z = way.z.abs();
            let end = crown + way * (size * self.between(0.15, 0.4));
            self.add_rod(crown, end, size * 0.015, bark);
            for _ in 0..2 {
                let twig = end + (way + direction(self.rng) * 0.8) * (size * 0.15);
                self.add_rod(end, twig, size * 0.007, bark);
            }
        }
    }

    /// A table with things on it.
    fn add_table(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let paint = self.paint();
        let half = [size * self.between(0.4, 0.8), size * self.between(0.3, 0.5)];
        let height = size * self.between(0.5, 0.8);
        self.add_legs(foot, turn, half.map(|h| 0.92 * h), height, size * 0.03, &paint);
        let top = if self.chance(0.5) { paint } else { self.paint() };
        self.add_box([half[0], half[1], size * 0.025], foot + Vector3::z() * height, turn, &top);
        for _ in 0..self.rng.random_range(0..6) {
            let at = Vector3::new(self.between(-0.8, 0.8) * half[0], self.between(-0.8, 0.8) * half[1], 0.0);
            let place = foot + turn * at + Vector3::z() * (height + size * 0.025);
            let thing = pick(self.rng, &SMALL_THINGS);
            let small = size * self.between(0.1, 0.3);
            self.add_thing(thing, place, small);
        }
    }

    fn add_legs(
        &mut self,
        foot: Point3<f64>,
        turn: Matrix3<f64>,
        half: [f64; 2],
        height: f64,
        radius: f64,
        paint: &Paint,
    ) {
        for (sx, sy) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            let low = foot + turn * Vector3::new(sx * half[0], sy * half[1], 0.0);
            self.add_rod(low, low + Vector3::z() * height, radius, paint);
        }
    }

    /// Bars side by side, sometimes crossed: fences, railings, grilles.
    fn add_lattice(&mut self, foot: Point3<f64>, turn: Matrix3<f64>, size: f64) {
        let paint = if self.chance(0.5) { self.plain_paint() } else { self.paint() };
        let radius = size * self.between(0.006, 0.03);
        let bars = self.rng.random_range(5..14);
        let height = size * self.between(0.5, 1.0);
        for i in 0..=bars {
            let x = size * (2.0 * f64::from(i) / f64::from(bars) - 1.0);
            let low = foot + turn * Vector3::new(x, 0.0, 0.0);
            self.add_rod(low, low + Vector3::z() * height, radius, &paint);
        }
        for z in [0.1, 0.5, 0.95].iter().take(self.rng.random_range(1..=3)) {
            let ends = [-size, size].map(|x| foot + turn * Vector3::new(x, 0.0, z * height));
            self.add_rod(ends[0], ends[1], radius, &paint);
        }
    }

    /// A thing lying on its side at any angle, as in a heap.
    pub fn add_stick(&mut self, centre: Point3<f64>, length: f64) {
        let mut way = direction(self.rng);
        way.z *= 0.5;
        let paint = self.paint();
        let radius = length * self.between(0.01, 0.05);
        self.add_rod(centre - way * (length / 2.0), centre + way * (length / 2.0), radius, &paint);
    }
}
