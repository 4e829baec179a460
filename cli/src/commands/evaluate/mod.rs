//! `planesweep evaluate`: how good a result is. One file per metric.

mod consistency;
mod depth;
mod dtu;
mod eth3d;
mod figures;
mod photometric;
mod skipped;
mod tnt;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Subcommand;
use nalgebra::Point3;
use planesweep_fusion::read_ply;

pub use self::dtu::DtuArgs;
pub use self::tnt::TntArgs;
use crate::console::Outcome;

/// The evaluate commands.
#[derive(Debug, Subcommand)]
pub enum EvaluateCommand {
    /// Compare the depth maps of a result with true ones.
    Depth(depth::DepthArgs),
    /// Compare depth maps with photographs that they were not made from, in colour.
    Photometric(photometric::PhotometricArgs),
    /// Count the pixels that the views agree on, at equal kept share.
    Consistency(consistency::ConsistencyArgs),
    /// Compare clouds with the scans of the DTU data set: accuracy and completeness in millimetres.
    Dtu(DtuArgs),
    /// Compare a cloud with a laser scan as the Tanks and Temples benchmark does: precision, recall, F-score.
    Tnt(TntArgs),
    /// Compare a cloud with laser scans as the ETH3D benchmark does: accuracy, completeness, F1 at several tolerances.
    Eth3d(eth3d::Eth3dArgs),
}

/// Measures.
pub fn run(command: &EvaluateCommand) -> Result<Outcome> {
    match command {
        EvaluateCommand::Depth(args) => depth::run(args),
        EvaluateCommand::Photometric(args) => photometric::run(args),
        EvaluateCommand::Consistency(args) => consistency::run(args),
        EvaluateCommand::Dtu(args) => dtu::run(args),
        EvaluateCommand::Tnt(args) => tnt::run(args),
        EvaluateCommand::Eth3d(args) => eth3d::run(args),
    }
}

/// The cloud of a result: the file itself, or the one in a folder that `reconstruct` made.
fn cloud_file(result: &Path) -> PathBuf {
    if result.is_dir() { result.join("cloud.ply") } else { result.to_owned() }
}

/// The positions of a cloud.
fn read_positions(path: &Path) -> Result<Vec<Point3<f64>>> {
    Ok(read_ply(path)?.iter().map(|point| Point3::from(point.position)).collect())
}
