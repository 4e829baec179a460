//! Which scenes there are, and how big a pixel is in them.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::draw::log_uniform;
use super::library::Library;
use super::stage::{Shot, Stage};
use super::{indoors, outdoors};

/// A kind of scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Setting {
    /// Things on a table or the ground, from around.
    Objects,
    /// Many bodies on a heap, thin ones among them.
    Heap,
    /// A furnished room.
    Room,
    /// A long way between walls.
    Corridor,
    /// Shapes afloat before a wall.
    Floating,
    /// Near and far things in the open.
    Street,
    /// Houses and trees from above.
    Aerial,
    /// A wall with relief.
    Facade,
}

impl Setting {
    /// All kinds.
    pub const ALL: [Self; 8] = [
        Self::Objects,
        Self::Heap,
        Self::Room,
        Self::Corridor,
        Self::Floating,
        Self::Street,
        Self::Aerial,
        Self::Facade,
    ];

    /// One of them; what most captures are like comes most often.
    pub(super) fn random(rng: &mut ChaCha8Rng) -> Self {
        match rng.random_range(0..20) {
            0..4 => Self::Objects,
            4..7 => Self::Heap,
            7..11 => Self::Room,
            11 => Self::Corridor,
            12 => Self::Floating,
            13..16 => Self::Street,
            16..18 => Self::Aerial,
            _ => Self::Facade,
        }
    }

    pub(super) fn build(self, rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
        match self {
            Self::Objects => indoors::objects(rng, library, frame),
            Self::Heap => indoors::heap(rng, library, frame),
            Self::Room => indoors::room(rng, library, frame),
            Self::Corridor => indoors::corridor(rng, library, frame),
            Self::Floating => indoors::floating(rng, library, frame),
            Self::Street => outdoors::street(rng, library, frame),
            Self::Aerial => outdoors::aerial(rng, library, frame),
            Self::Facade => outdoors::facade(rng, library, frame),
        }
    }
}

/// The image that a scene is made for.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// Columns.
    pub width: u32,
}

impl Frame {
    /// The size of a pixel at a distance, in scene units, for a horizontal field of view in degrees.
    pub fn texel(self, distance: f64, field_of_view_degrees: f64) -> f64 {
        2.0 * distance * (field_of_view_degrees / 2.0).to_radians().tan() / f64::from(self.width)
    }
}

/// A field of view like those of telephones and cameras, in degrees.
pub fn field_of_view(rng: &mut ChaCha8Rng) -> f64 {
    log_uniform(rng, 24.0, 75.0)
}

/// The distance at which `extent` fills the width.
pub fn distance_for(extent: f64, field_of_view_degrees: f64) -> f64 {
    extent / 2.0 / (field_of_view_degrees / 2.0).to_radians().tan()
}
