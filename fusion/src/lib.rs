//! Depth maps to a point cloud: filtering, visibility, fusion, and the writers of clouds.
//!
//! In the order of the data (DESIGN section 6; paper, section 4.2):
//!
//! - [`filter`] tests a depth for each pixel of a reference view, by one of the methods of
//!   [`FusionMethod`]: it drops what too few of the neighbours agree with, and averages depth and colour
//!   over the views that agree;
//! - [`emitted`] leaves out what another view sees better, so that each surface is emitted once;
//! - [`normals`] are the gradients of what is left;
//! - [`emit`] makes points of it;
//! - [`PlyWriter`] streams them to disk in the layout of COLMAP's `fused.ply`, [`read_ply`] reads
//!   such files back.
//!
//! All of it is deterministic for any number of threads.

#![warn(missing_docs)]

#[cfg(test)]
mod analytic;
mod cloud;
mod color;
mod dynamic;
mod filter;
mod funnel;
mod geometric;
mod hypotheses;
mod normals;
mod options;
mod photometric;
mod ply;
mod surface;
mod visibility;

pub use cloud::{Point, emit};
pub use filter::{FilteredMap, MAX_RECORDED, filter};
pub use funnel::{EmptyCloud, FilterStep, Funnel};
pub use normals::normals;
pub use options::{DepthSampling, FilterOptions, FusionMethod};
pub use ply::{PlyError, PlyWriter, VERTEX_BYTES, encode, ply_header, read_ply};
pub use surface::emitted;
