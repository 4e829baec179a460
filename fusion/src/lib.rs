//! Depth maps to a point cloud: filtering, visibility, fusion, and the writers of clouds.
//!
//! In the order of the data (DESIGN section 6; paper, section 4.2):
//!
//! - [`filter`] drops the pixels of a reference view that are not confident or that too few of its
//!   neighbours agree with, and averages depth and colour over the views that agree;
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
mod filter;
mod funnel;
mod geometric;
mod normals;
mod options;
mod photometric;
mod ply;

pub use cloud::{Point, emit};
pub use filter::{FilteredMap, filter};
pub use funnel::{EmptyCloud, FilterStep, Funnel};
pub use normals::normals;
pub use options::{DepthSampling, FilterOptions};
pub use ply::{PlyError, PlyWriter, VERTEX_BYTES, encode, ply_header, read_ply};
