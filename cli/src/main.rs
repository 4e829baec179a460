//! The `planesweep` program.

fn main() {}
