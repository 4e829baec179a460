//! Names from foreign files, which become paths only after a check.

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

/// The longest part between two slashes, in bytes; no common file system takes more.
const MAX_COMPONENT: usize = 255;

/// The longest name, in bytes; Linux takes paths of 4096 with the folder they lie in.
const MAX_NAME: usize = 2048;

/// Why a name does not become a path.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum NameError {
    /// The name, or a part between two slashes, is empty.
    #[error("name {name:?} has an empty part")]
    Empty {
        /// The name.
        name: String,
    },
    /// The name has `.` or `..` as a part.
    #[error("name {name:?} has the part {part:?}")]
    Relative {
        /// The name.
        name: String,
        /// `.` or `..`.
        part: String,
    },
    /// The name starts at a root.
    #[error("name {name:?} is an absolute path")]
    Absolute {
        /// The name.
        name: String,
    },
    /// The name has a control character, such as NUL.
    #[error("name {name:?} has a control character")]
    Control {
        /// The name.
        name: String,
    },
    /// The name or a part of it is too long.
    #[error("name of {length} bytes starting {start:?} is too long")]
    TooLong {
        /// Bytes of the name.
        length: usize,
        /// Its first characters.
        start: String,
    },
    /// The file is reached over a symbolic link that leads out of the folder.
    #[error("name {name:?} leads out of {}", root.display())]
    LeadsOut {
        /// The name.
        name: String,
        /// The folder it must stay in.
        root: PathBuf,
    },
}

/// Checks that a name, joined to a folder, names something below that folder and nothing else.
///
/// Sub-folders, spaces and any script are fine; `..`, `.`, empty parts, absolute paths, control
/// characters and over-long names are not. Symbolic links are [`resolve_inside`]'s affair.
pub fn safe_name(name: &str) -> Result<&Path, NameError> {
    let owned = || name.to_owned();
    if name.len() > MAX_NAME || name.split('/').any(|part| part.len() > MAX_COMPONENT) {
        return Err(NameError::TooLong { length: name.len(), start: name.chars().take(40).collect() });
    }
    if name.chars().any(char::is_control) {
        return Err(NameError::Control { name: owned() });
    }
    if name.starts_with('/') {
        return Err(NameError::Absolute { name: owned() });
    }
    for part in name.split('/') {
        match part {
            "" => return Err(NameError::Empty { name: owned() }),
            "." | ".." => return Err(NameError::Relative { name: owned(), part: part.to_owned() }),
            _ => {}
        }
    }
    Ok(Path::new(name))
}

/// Why a name was not found in a folder.
#[derive(Debug, Error)]
pub enum ResolveError {
    /// The name is refused.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The file is not there or cannot be reached.
    #[error("could not find {}", path.display())]
    Find {
        /// The path looked at.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
}

/// The path of an existing file named from `root`, refused when it or a link on the way to it leads
/// out of `root`. `root` itself may be a link.
pub fn resolve_inside(root: &Path, name: &str) -> Result<PathBuf, ResolveError> {
    let path = root.join(safe_name(name)?);
    let canonical = |path: &Path| {
        path.canonicalize().map_err(|source| ResolveError::Find { path: path.to_owned(), source })
    };
    if canonical(&path)?.starts_with(canonical(root)?) {
        Ok(path)
    } else {
        Err(NameError::LeadsOut { name: name.to_owned(), root: root.to_owned() }.into())
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn sub_folders_spaces_and_any_script_are_fine() {
        for name in ["a.jpg", "left camera/IMG 1.JPG", "写真/ü.png", "..a/b..", "-x"] {
            assert_eq!(safe_name(name), Ok(Path::new(name)));
        }
    }

    #[test]
    fn names_that_leave_the_folder_are_refused() {
        for name in ["../a", "a/../../b", "a/..", "..", "./a", "a/."] {
            assert!(matches!(safe_name(name), Err(NameError::Relative { .. })), "{name}");
        }
        assert!(matches!(safe_name("/etc/passwd"), Err(NameError::Absolute { .. })));
        for name in ["", "a//b", "a/"] {
            assert!(matches!(safe_name(name), Err(NameError::Empty { .. })), "{name}");
        }
        assert!(matches!(safe_name("a\0b"), Err(NameError::Control { .. })));
        assert!(matches!(safe_name(&"x".repeat(300)), Err(NameError::TooLong { length: 300, .. })));
        assert!(matches!(safe_name(&"x/".repeat(2000)), Err(NameError::TooLong { .. })));
    }

    #[cfg(unix)]
    #[test]
    fn links_may_lead_in_but_not_out() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (inside, outside) = (folder.path().join("in"), folder.path().join("out"));
        fs::create_dir_all(inside.join("sub")).expect("made");
        fs::create_dir_all(&outside).expect("made");
        fs::write(outside.join("secret"), b"s").expect("written");
        fs::write(inside.join("file"), b"f").expect("written");
        symlink(outside.join("secret"), inside.join("link")).expect("linked");
        symlink(&outside, inside.join("dir")).expect("linked");
        symlink("../file", inside.join("sub/fine")).expect("linked");
        symlink(&inside, folder.path().join("root")).expect("linked");
        for name in ["link", "dir/secret"] {
            let error = resolve_inside(&inside, name).expect_err("leads out");
            assert!(matches!(error, ResolveError::Name(NameError::LeadsOut { .. })), "{error}");
        }
        assert!(resolve_inside(&inside, "sub/fine").is_ok());
        assert!(resolve_inside(&folder.path().join("root"), "file").is_ok());
        assert!(matches!(resolve_inside(&inside, "none"), Err(ResolveError::Find { .. })));
    }
}
