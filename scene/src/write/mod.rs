//! Writers of the field's formats, and the one way in which files are written.

mod atomic;

pub use atomic::write_atomically;
