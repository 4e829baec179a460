//! Build script of every crate whose programs or tests may link libtorch: tells the linker where they
//! find it when they run, and to keep its CUDA part. It stands in each of them, for link arguments do
//! not reach dependents.

use std::env;
use std::path::PathBuf;

fn main() {
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    // Without LIBTORCH the libraries are the system's own, which the loader finds by itself.
    if let Some(folder) = env::var_os("LIBTORCH").map(PathBuf::from) {
        // A link that leads elsewhere from now on; what it led to does not change by that.
        if folder.is_symlink() {
            println!("cargo:rerun-if-changed={}", folder.display());
        }
        let folder = folder.canonicalize().unwrap_or(folder);
        let libraries = folder.join("lib");
        // The folder, not the one file: where that is missing, a file would count as changed with every build, and one
        // that comes out of an archive later is as old as it was in there.
        println!("cargo:rerun-if-changed={}", libraries.display());
        println!("cargo:rustc-link-arg=-Wl,-rpath,{}", libraries.display());
        // Nobody refers to it by a symbol, so the linker would leave it out: loaded, it makes itself known.
        let cuda = libraries.join("libtorch_cuda.so");
        if cuda.exists() {
            // Libraries that come after it are left out as before.
            println!("cargo:rustc-link-arg=-Wl,--push-state,--no-as-needed,{},--pop-state", cuda.display());
        }
    }
}
