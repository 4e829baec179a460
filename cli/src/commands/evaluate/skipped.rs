//! Views that a measure goes on without.

use std::collections::BTreeMap;

use anyhow::Result;
use planesweep_scene::first_reasons;
use serde_json::{Value, json};

/// Why views could not be judged, by their names.
pub struct Skipped(BTreeMap<String, String>);

/// What came of each view by name, apart from the reasons why of some nothing did.
pub fn split<T>(views: Vec<(String, Result<T>)>) -> (Vec<T>, Skipped) {
    let (mut judged, mut skipped) = (Vec::new(), BTreeMap::new());
    for (name, result) in views {
        match result {
            Ok(result) => judged.push(result),
            Err(error) => {
                skipped.insert(name, format!("{error:#}"));
            }
        }
    }
    (judged, Skipped(skipped))
}

impl Skipped {
    /// Whether all views could be judged.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The first of them with their reasons, to be appended to an error.
    pub fn reasons(&self) -> String {
        first_reasons(self.0.iter())
    }

    /// A line for each of them.
    pub fn lines(&self) -> String {
        let mut lines = String::new();
        for (view, reason) in &self.0 {
            lines.push_str(&format!("skipped: {view}: {reason}\n"));
        }
        lines
    }

    /// Reasons by view.
    pub fn value(&self) -> Value {
        json!(self.0)
    }
}
