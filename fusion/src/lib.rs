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
//!   such files back; [`LasWriter`] and [`VisibilityWriter`] write what others want.
//!
//! [`fuse_out_of_core`] does all of it for any number of views in bounded memory.
//!
//! All of it is deterministic for any number of threads.

#![warn(missing_docs)]

#[cfg(test)]
mod analytic;
mod cloud;
mod dynamic;
mod filter;
mod filtered_bytes;
mod funnel;
mod geometric;
mod hypotheses;
mod kernel;
mod las;
mod normals;
mod options;
mod out_of_core;
mod output;
mod photometric;
mod ply;
mod surface;
mod vis;
mod visibility;

pub use cloud::{Point, emit};
pub use filter::{FilteredMap, MAX_RECORDED, filter};
pub use filtered_bytes::{FilteredMapError, decode_filtered_map, encode_filtered_map};
pub use funnel::{EmptyCloud, FilterStep, Funnel};
pub use las::{LasError, LasWriter};
pub use normals::normals;
pub use options::{DepthSampling, FilterOptions, FusionMethod, Preset};
pub use out_of_core::{Fused, LoadError, LoadMap, OutOfCoreError, ViewPoints, Work, fuse_out_of_core};
pub use ply::{PlyError, PlyWriter, VertexFormat, encode, ply_header, read_ply};
pub use surface::emitted;
pub use vis::{VisibilityError, VisibilityWriter};
