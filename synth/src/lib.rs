//! Procedural scenes with exact ground truth.
//!
//! A [`SynthScene`] follows from a seed: bodies with procedural textures, a sun, cameras around
//! them. It renders images with exact depth from any camera, and samples sparse points with tracks
//! as structure from motion would find them. [`write_demo`] writes one as a COLMAP model.
//!
//! What the network learns from comes from here, too: [`training_sample`] makes up a scene for every seed,
//! [`DataSet`] reads folders of training data, and [`write_mesh_depth`] renders such a folder from a mesh.

#![warn(missing_docs)]

mod camera_path;
mod courtyard;
mod data_set;
mod demo;
mod geometry;
mod mesh_depth;
mod mesh_file;
mod noise;
mod render;
mod scene;
mod shade;
mod sparse;
mod texture;
mod training;
mod training_folder;

pub use data_set::{DataSet, DataSetError, DtuSplit, SampleShape};
pub use demo::{DemoError, DemoOptions, write_demo};
pub use geometry::TriangleMesh;
pub use mesh_depth::{
    MeshDepthError, MeshDepthOptions, MeshDepthReport, depth_range_of_mesh, render_mesh_depth,
    write_mesh_depth,
};
pub use mesh_file::{MeshError, is_mesh, read_mesh};
pub use scene::{Style, SynthScene};
pub use training::{
    Library, LibraryError, Setting, TrainingOptions, training_sample, training_sample_with,
    write_training_sample,
};
pub use training_folder::TrainingFolderError;
