//! Compiles the contract with protox, so that no `protoc` has to be installed.

use std::error::Error;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let contracts = ["planesweep/v1/coordinator.proto", "planesweep/v1/exchange.proto"];
    let files = protox::compile(contracts, ["proto"])?;
    tonic_prost_build::configure().btree_map(".").bytes(".planesweep.v1.FetchChunk").compile_fds(files)?;
    Ok(())
}
