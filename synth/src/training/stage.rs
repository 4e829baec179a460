//! A training scene: bodies, their paints, light, and the shot that is to be taken of it.

use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{along, log_uniform};
use super::library::Library;
use super::light::Light;
use super::paint::{Busyness, Paint};
use crate::geometry::{Body, Placement, Shape, World};

/// A scene that is ready to be photographed.
pub struct Stage {
    pub world: World,
    /// By the index of the body.
    pub paints: Vec<Paint>,
    pub light: Light,
}

/// Where the reference camera stands and how the others move from there.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    pub centre: Point3<f64>,
    pub target: Point3<f64>,
    pub motion: Motion,
    /// Horizontal, in degrees.
    pub field_of_view_degrees: f64,
}

/// How a person, a vehicle or a robot carries the camera between views.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// Around what is seen, aimed at it.
    Arc,
    /// Sideways with the direction kept, as from a car or an aeroplane.
    Track,
    /// Anywhere near, loosely aimed.
    Handheld,
    /// Along the line of sight, a little aside.
    Forward,
}

/// Collects bodies with a stream of random numbers at hand.
pub struct Builder<'a> {
    pub rng: &'a mut ChaCha8Rng,
    /// The size of a pixel at the distance that most is seen from, in scene units.
    pub texel: f64,
    pub library: &'a Library,
    bodies: Vec<Body>,
    paints: Vec<Paint>,
}

impl<'a> Builder<'a> {
    pub fn new(rng: &'a mut ChaCha8Rng, library: &'a Library, texel: f64) -> Self {
        Self { rng, texel, library, bodies: Vec::new(), paints: Vec::new() }
    }

    pub fn stage(self, light: Light) -> Stage {
        Stage { world: World::new(self.bodies), paints: self.paints, light }
    }

    /// Any paint with structures of the stage's size.
    pub fn paint(&mut self) -> Paint {
        Paint::random(self.rng, self.texel, Busyness::Any, &self.library.photos)
    }

    /// A paint that gives little to match.
    pub fn plain_paint(&mut self) -> Paint {
        Paint::random(self.rng, self.texel, Busyness::Plain, &[])
    }

    pub fn add(&mut self, shape: Shape, centre: Point3<f64>, rotation: Matrix3<f64>, paint: &Paint) {
        self.bodies.push(Body { shape, placement: Placement { rotation, centre } });
        self.paints.push(paint.clone());
    }

    pub fn add_box(&mut self, half: [f64; 3], centre: Point3<f64>, rotation: Matrix3<f64>, paint: &Paint) {
        self.add(Shape::Cuboid { half: Vector3::from(half) }, centre, rotation, paint);
    }

    /// A round bar between two points.
    pub fn add_rod(&mut self, from: Point3<f64>, to: Point3<f64>, radius: f64, paint: &Paint) {
        let axis = to - from;
        let half_height = axis.norm() / 2.0;
        if half_height > 0.0 {
            let shape = Shape::Cylinder { radius, half_height };
            self.add(shape, nalgebra::center(&from, &to), along(&axis.normalize()), paint);
        }
    }

    /// A number between two, all logarithms equally likely.
    pub fn size(&mut self, low: f64, high: f64) -> f64 {
        log_uniform(self.rng, low, high)
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        self.rng.random_range(low..=high)
    }

    pub fn chance(&mut self, probability: f64) -> bool {
        self.rng.random_bool(probability)
    }
}
