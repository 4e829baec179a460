//! The table of faults in docs/faults.md names tests that exist.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use planesweep_tests::files_below;

/// What a line says that has no test, in whole or in part.
const NONE: &str = "none yet";

/// The names of all functions in the sources of the workspace.
fn functions(root: &Path) -> BTreeSet<String> {
    let manifest = fs::read_to_string(root.join("Cargo.toml")).expect("the workspace");
    let (_, members) = manifest.split_once("members = [").expect("its members");
    let (members, _) = members.split_once(']').expect("their end");
    let members = members.split('"').filter(|name| name.starts_with(|c: char| c.is_ascii_alphabetic()));
    let mut found = BTreeSet::new();
    for member in members {
        let folder = root.join(member);
        let files = files_below(&folder).into_iter().map(|file| folder.join(file));
        for file in files.filter(|file| file.extension().is_some_and(|extension| extension == "rs")) {
            let text = fs::read_to_string(file).expect("a source is UTF-8");
            let names = text.split("fn ").skip(1).filter_map(|rest| rest.split_once('('));
            found.extend(names.map(|(name, _)| name.to_owned()));
        }
    }
    found
}

#[test]
fn every_line_names_a_test_that_exists_or_says_that_there_is_none() {
    let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
    let functions = functions(root);
    let table = fs::read_to_string(root.join("docs/faults.md")).expect("the table");
    let rows: Vec<Vec<&str>> = table
        .lines()
        .filter(|line| line.starts_with("| ") && !line.starts_with("| ---") && !line.ends_with("| tests |"))
        .map(|line| line.trim_matches('|').split(" | ").collect())
        .collect();
    assert!(rows.len() > 30, "only {} lines", rows.len());
    for row in rows {
        let [case, _, tests] = row[..] else { panic!("not three columns: {row:?}") };
        let named: Vec<&str> = tests.split('`').skip(1).step_by(2).collect();
        assert!(!named.is_empty() || tests.contains(NONE), "no test: {case}");
        for name in named {
            assert!(functions.contains(name), "there is no test {name}, for: {case}");
        }
    }
}
