//! Depth maps to a point cloud: filtering, visibility, fusion, and the writers of clouds.

mod options;

pub use options::FilterOptions;
