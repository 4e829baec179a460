//! The manifests of `deploy/kubernetes` against the schemas that Kubernetes publishes.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use planesweep_tests::{python, script};

/// The schemas, what reads them, and what that needs.
const PACKAGES: [&str; 10] = [
    "kubernetes-validate==1.37.0",
    "jsonschema==4.26.0",
    "referencing==0.37.0",
    "typing_extensions==4.16.0",
    "importlib_resources==7.1.0",
    "packaging==26.4",
    "PyYAML==6.0.4",
    "attrs==26.1.0",
    "jsonschema-specifications==2025.9.1",
    "rpds-py==2026.9.1",
];

fn manifests() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/kubernetes"))
}

fn check(python: &Path, folders: &[PathBuf]) -> Output {
    Command::new(python).arg(script("deploy_check.py")).args(folders).output().expect("python starts")
}

#[test]
fn manifests_meet_the_published_schemas() {
    let Some(python) = python("manifests_meet_the_published_schemas", &PACKAGES) else { return };
    let checked = check(&python, &["base", "gpu"].map(|name| manifests().join(name)));
    let said = String::from_utf8_lossy(&checked.stdout);
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    for line in [
        "base: Deployment coordinator is valid in 1.34",
        "base: NetworkPolicy worker is valid in 1.34",
        "gpu: Job worker is valid in 1.37",
        // Both reach each other's maps; what the patch adds takes nothing away.
        "base: Job worker runs planesweep worker --listen $(POD_IP):7071",
        "gpu: Job worker runs planesweep worker --listen $(POD_IP):7071 --device cuda",
    ] {
        assert!(said.lines().any(|said| said == line), "no '{line}' in:\n{said}");
    }

    // A field that Kubernetes does not know is found, and so is what it would take as it is.
    for (right, wrong, found) in [
        ("backoffLimit", "backofLimit", ["Job worker", "backofLimit"]),
        ("name: POD_IP", "name: POD_ID", ["Job worker", "no variable POD_IP"]),
        ("port: 7071", "port: 7072", ["NetworkPolicy worker", "has port 7072"]),
    ] {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for file in fs::read_dir(manifests().join("base")).expect("it is there").flatten() {
            let text = fs::read_to_string(file.path()).expect("it is text");
            fs::write(folder.path().join(file.file_name()), text.replace(right, wrong)).expect("written");
        }
        let checked = check(&python, &[folder.path().to_owned()]);
        let said = String::from_utf8_lossy(&checked.stderr);
        assert!(!checked.status.success() && found.iter().all(|text| said.contains(text)), "{said}");
    }
}
