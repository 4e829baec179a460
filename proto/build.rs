//! Compiles the contract with protox, so that no `protoc` has to be installed.

use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let contracts = ["coordinator", "blobs", "exchange"].map(|name| format!("planesweep/v1/{name}.proto"));
    let files = protox::compile(contracts, ["proto"])?;
    // What carries the bytes of blobs copies none.
    tonic_prost_build::configure()
        .btree_map(".")
        .bytes(".planesweep.v1.BlobChunk.data")
        .compile_fds(files)?;
    Ok(())
}
