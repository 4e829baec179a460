//! One file per command.

pub mod bench;
pub mod benchmark;
pub mod convert;
pub mod coordinator;
pub mod depth;
pub mod evaluate;
mod export;
pub mod fuse;
pub mod inspect;
pub mod reconstruct;
pub mod render_depth;
pub mod status;
pub mod submit;
pub mod synth;
pub mod train;
pub mod weights;
pub mod worker;
