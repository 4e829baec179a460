//! The cluster of `docker/compose.yaml`.

use std::fs;
use std::path::Path;
use std::process::{Output, Stdio};

use tempfile::TempDir;

use crate::containers::{Containers, is_made};

const FILE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docker/compose.yaml");
/// For which images of a registry others stand in.
const STAND_INS: [&str; 2] = ["postgres", "s3"];
/// What their names begin with: those that a killed test leaves are the next one's.
const STAND_IN: &str = "planesweep-standin";

/// The file as it is, in a folder with the token and the settings that it asks for. What it started is removed with it,
/// and so are the images that stand in for those of a registry.
pub struct Composition<'a> {
    containers: &'a Containers,
    folder: TempDir,
}

impl<'a> Composition<'a> {
    /// With this image of ours, and this folder as `/scenes`; for the S3 server stands in the program `s3_server`, for
    /// PostgreSQL that of this host. `None`, and a line on stderr, where there is no Docker Compose or no PostgreSQL.
    pub fn new(
        test: &str,
        containers: &'a Containers,
        image: &str,
        scenes: &str,
        s3_server: &Path,
    ) -> Option<Self> {
        let runs = |output: std::io::Result<Output>| is_made(test, &output.expect("a script starts"));
        if !runs(containers.script("docker_compose.sh").arg("version").output()) {
            return None;
        }
        // From here on, what is made is removed.
        let made = Self { containers, folder: tempfile::tempdir().expect("a temporary folder") };
        let mut standins = containers.script("docker_standins.sh");
        if !runs(standins.arg(image).arg(s3_server).arg(STAND_IN).output()) {
            return None;
        }
        let folder = made.folder.path();
        let write = |name: &str, text: &str| fs::write(folder.join(name), text).expect("written");
        fs::copy(FILE, folder.join("compose.yaml")).expect("copied");
        write("token", "s3cret\n");
        write(
            ".env",
            &format!(
                "POSTGRES_PASSWORD=p4ssword\nS3_SECRET_KEY=k3y\nSCENES={scenes}\nPLANESWEEP_IMAGE={image}\n\
                 PLANESWEEP_PORT=\n"
            ),
        );
        let images = STAND_INS.map(|service| format!("  {service}: {{image: {STAND_IN}-{service}}}\n"));
        // Beside the images: inference is slow, and workers are asked soon how they are.
        write(
            "standins.yaml",
            &format!(
                "services:\n{}  fuse: {{healthcheck: {{interval: 5s}}}}\n  \
                 infer: {{healthcheck: {{interval: 5s}}, cpus: 0.5}}\n",
                images.concat()
            ),
        );
        Some(made)
    }

    /// Runs `docker compose` with these arguments, which must succeed; its stdout.
    #[track_caller]
    pub fn compose(&self, arguments: &[&str]) -> Vec<u8> {
        let output = self.try_compose(arguments);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "docker compose {}: {said}", arguments.join(" "));
        output.stdout
    }

    fn try_compose(&self, arguments: &[&str]) -> Output {
        let file = |name: &str| self.folder.path().join(name);
        let mut command = self.containers.script("docker_compose.sh");
        command.arg("--file").arg(file("compose.yaml")).arg("--file").arg(file("standins.yaml"));
        command.args(["--project-name", self.project()]).args(arguments);
        command.stdin(Stdio::null()).output().expect("a script starts")
    }

    /// What its containers and volumes carry as `com.docker.compose.project`.
    pub fn project(&self) -> &str {
        self.containers.prefix()
    }

    /// The name of one of a service's containers; they are counted from 1.
    pub fn container(&self, service: &str, number: usize) -> String {
        format!("{}-{service}-{number}", self.project())
    }
}

impl Drop for Composition<'_> {
    fn drop(&mut self) {
        let _ = self.try_compose(&[
            "--profile",
            "submit",
            "down",
            "--volumes",
            "--remove-orphans",
            "--timeout",
            "1",
        ]);
        for service in STAND_INS {
            let _ = self.containers.try_docker(&["image", "rm", &format!("{STAND_IN}-{service}")]);
        }
    }
}
