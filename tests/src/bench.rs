//! A folder with a scene and weights in it, where runs leave their results.

use std::fs;
use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::cluster::Cluster;
use crate::program::{Finished, Running};
use crate::scenes::seeded_weights;

/// Options that give points although an untrained network is never sure of itself, and keep runs short.
const EASY: [&str; 8] = ["--min-confidence", "0", "--min-views", "1", "--views", "3", "--depths", "32"];

/// A temporary folder in which one scene is reconstructed, as often and as differently as a test likes.
pub struct Bench {
    folder: TempDir,
    weights: PathBuf,
}

impl Bench {
    /// With untrained weights and the scene that `make` writes into the folder it is given.
    pub fn new(make: impl FnOnce(&Path)) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let weights = seeded_weights(folder.path());
        let bench = Self { folder, weights };
        make(Path::new(&bench.scene()));
        bench
    }

    /// The scene's folder.
    pub fn scene(&self) -> String {
        self.path("scene")
    }

    /// The weights file.
    pub fn weights(&self) -> String {
        text(&self.weights)
    }

    /// A path in the folder, such as that of a result.
    pub fn path(&self, name: &str) -> String {
        text(&self.folder.path().join(name))
    }

    /// The bytes of a file in the folder.
    #[track_caller]
    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap_or_else(|error| panic!("cannot read {name}: {error}"))
    }

    /// Compares the bytes of two clouds.
    #[track_caller]
    pub fn same_cloud(&self, one: &str, other: &str) {
        let read = |out: &str| self.read(&format!("{out}/cloud.ply"));
        assert!(read(one).len() > 10_000 && read(one) == read(other), "{one} and {other} differ");
    }

    /// Starts `planesweep reconstruct --json` into `out`, with `more` options in place of the easy ones
    /// of the same name, or after them.
    pub fn start(&self, out: &str, more: &[&str]) -> Running {
        Running::start(self.arguments("reconstruct", out, more))
    }

    /// The same by a shell script, which has the program in `"$0" "$@"`.
    pub fn start_in_script(&self, script: &str, out: &str, more: &[&str]) -> Running {
        Running::start_in_script(script, self.arguments("reconstruct", out, more))
    }

    /// The same with `planesweep submit` to a cluster.
    pub fn submit(&self, out: &str, cluster: &Cluster, more: &[&str]) -> Running {
        let more = [&["--coordinator", cluster.url()], more].concat();
        Running::start_in(cluster.environment(), self.arguments("submit", out, &more))
    }

    /// The same to a coordinator that somebody else has started.
    pub fn submit_to(&self, out: &str, url: &str, more: &[&str]) -> Running {
        Running::start(self.arguments("submit", out, &[&["--coordinator", url], more].concat()))
    }

    /// The same by a shell script, which has the program in `"$0" "$@"`.
    pub fn submit_in_script(&self, script: &str, out: &str, url: &str, more: &[&str]) -> Running {
        let more = [&["--coordinator", url], more].concat();
        Running::start_in_script(script, self.arguments("submit", out, &more))
    }

    fn arguments(&self, command: &str, out: &str, more: &[&str]) -> Vec<String> {
        let (scene, out, weights) = (self.scene(), self.path(out), self.weights());
        let given = [command, &scene, "-o", &out, "--weights", &weights, "--json"];
        let easy = EASY.chunks(2).filter(|option| !more.contains(&option[0])).flatten();
        given.iter().chain(easy).chain(more).map(|argument| (*argument).to_owned()).collect()
    }

    /// [`Bench::start`], and waits for the end.
    #[track_caller]
    pub fn reconstruct(&self, out: &str, more: &[&str]) -> Finished {
        self.start(out, more).wait()
    }
}

fn text(path: &Path) -> String {
    path.to_str().expect("a temporary folder is UTF-8").to_owned()
}
