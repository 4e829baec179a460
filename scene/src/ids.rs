//! Identifiers that cannot be mixed up.

use std::fmt;

use serde::{Deserialize, Serialize};

/// The identifier of a view (one photograph with its camera), as the scene's files give it.
///
/// Ids need neither start at zero nor be contiguous.
///
/// ```compile_fail
/// let id: planesweep_scene::ViewId = 3_u32; // a plain number is not a view
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ViewId(pub u32);

impl fmt::Display for ViewId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
