//! The project's scripts that bring a test what it needs.

use std::path::PathBuf;
use std::process::{Command, Output};

/// The exit code of a script that says: not on this machine.
pub(crate) const UNAVAILABLE: i32 = 77;

/// A script of the project.
pub fn script(name: &str) -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../scripts")).join(name)
}

/// Whether a script said that this machine lacks what it needs; a line on stderr then says so.
pub fn unavailable(test: &str, output: &Output) -> bool {
    let lacks = output.status.code() == Some(UNAVAILABLE);
    if lacks {
        let said = String::from_utf8_lossy(&output.stderr);
        eprintln!("SKIPPED {test}: {}", said.lines().last().unwrap_or("no reason given"));
    }
    lacks
}

/// An interpreter with these Python packages; `None`, and a line on stderr, where they cannot be installed.
pub fn python(test: &str, packages: &[&str]) -> Option<PathBuf> {
    let made = Command::new("python3").arg(script("reference_venv.py")).args(packages).output();
    let reason = match made {
        Ok(output) if output.status.success() => {
            return Some(String::from_utf8_lossy(&output.stdout).trim().into());
        }
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("python3: {error}"),
    };
    eprintln!("SKIPPED {test}: {reason}");
    None
}
