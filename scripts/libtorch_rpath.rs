//! Build script of every crate whose programs or tests may link libtorch: tells the linker where they
//! find it when they run. It stands in each of them, for link arguments do not reach dependents.

use std::env;
use std::path::PathBuf;

fn main() {
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    // Without LIBTORCH the libraries are the system's own, which the loader finds by itself.
    if let Some(folder) = env::var_os("LIBTORCH").map(PathBuf::from) {
        let folder = folder.canonicalize().unwrap_or(folder);
        println!("cargo:rustc-link-arg=-Wl,-rpath,{}", folder.join("lib").display());
    }
}
