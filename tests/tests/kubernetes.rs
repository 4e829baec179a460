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
        "base: Job worker runs registry.example.org/planesweep:cpu: \
         planesweep worker --listen $(POD_IP):7071 --cache-size 4G",
        "gpu: Job worker runs registry.example.org/planesweep:cuda: \
         planesweep worker --listen $(POD_IP):7071 --cache-size 4G --device cuda",
    ] {
        assert!(said.lines().any(|said| said == line), "no '{line}' in:\n{said}");
    }

    // A field that Kubernetes does not know is found, and so is what it would take as it is.
    for (right, wrong, found) in [
        ("backoffLimit", "backofLimit", "base: Job worker, spec: "),
        ("name: POD_IP", "name: POD_ID", "base: Job worker: no variable POD_IP"),
        ("port: 7071", "port: 7072", "base: NetworkPolicy worker: none of its pods has port 7072"),
        // Only where a policy lets it in.
        (
            "from: [{podSelector: {matchLabels: {app.kubernetes.io/name: planesweep,",
            "from: [{podSelector: {matchLabels: {app.kubernetes.io/name: planesweeper,",
            "base: NetworkPolicy worker: lets in no pod",
        ),
        // The overlay for GPUs names the base's image.
        (
            "newName: registry.example.org",
            "newName: registry.example.org:5000",
            "gpu: no container has the image registry.example.org/planesweep",
        ),
    ] {
        let copy = tempfile::tempdir().expect("a temporary folder");
        let folders = ["base", "gpu"].map(|name| copy.path().join(name));
        for folder in &folders {
            fs::create_dir(folder).expect("made");
            let original = manifests().join(folder.file_name().expect("it has a name"));
            for file in fs::read_dir(original).expect("it is there").flatten() {
                let text = fs::read_to_string(file.path()).expect("it is text");
                fs::write(folder.join(file.file_name()), text.replace(right, wrong)).expect("written");
            }
        }
        let checked = check(&python, &folders);
        let said = String::from_utf8_lossy(&checked.stderr);
        assert!(!checked.status.success(), "{wrong}");
        assert!(said.lines().any(|line| line.starts_with(found)), "no '{found}' in:\n{said}");
    }
}
