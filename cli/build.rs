//! Tells the program where libtorch lies at run time; the same three lines of reasoning as in
//! mvsnet/build.rs, for link arguments do not reach the crates that depend on it.

use std::env;
use std::fs;

fn main() {
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    let library = env::var("LIBTORCH").ok().and_then(|root| fs::canonicalize(root).ok());
    if let Some(library) = library {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{}/lib", library.display());
    }
}
