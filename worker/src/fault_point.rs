//! Where a test has this process die or freeze, so that the fault meets a job exactly there.
//!
//! The variable `PLANESWEEP_FAULT` names the fault: `kill:stored:infer:3` kills the process when the depth map of
//! view 3 is stored and not yet reported, `stop:stored:infer` freezes it when its first inference is, and with
//! `version:0.0.9` it says that it is of that version. Builds without debug assertions, as released ones are, do not
//! look at it.

use std::sync::atomic::{AtomicBool, Ordering};

use planesweep_plan::JobSpec;
use planesweep_proto::CODE_VERSION;
use rustix::process::{Signal, getpid, kill_process};

/// Points in the life of a job.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FaultPoint {
    /// Computing begins.
    Started,
    /// The result is in the store, and nobody knows.
    Stored,
}

/// Passes a point, unless the fault is there and was not met before.
pub(crate) fn pass(point: FaultPoint, spec: &JobSpec) {
    static MET: AtomicBool = AtomicBool::new(false);
    let Some(fault) = fault() else { return };
    let signal = match fault.split_once(':') {
        Some(("kill", place)) if is_at(place, point, spec) => Signal::KILL,
        Some(("stop", place)) if is_at(place, point, spec) => Signal::STOP,
        _ => return,
    };
    if !MET.swap(true, Ordering::Relaxed) {
        // What one sends oneself comes.
        let _ = kill_process(getpid(), signal);
    }
}

fn is_at(place: &str, point: FaultPoint, spec: &JobSpec) -> bool {
    let point = match point {
        FaultPoint::Started => "started",
        FaultPoint::Stored => "stored",
    };
    let any_view = format!("{point}:{}", spec.kind());
    place == any_view || spec.view().is_some_and(|view| place == format!("{any_view}:{view}"))
}

/// The version that this worker says it is of.
pub(crate) fn code_version() -> String {
    let other = fault().and_then(|fault| fault.strip_prefix("version:").map(str::to_owned));
    other.unwrap_or_else(|| CODE_VERSION.to_owned())
}

fn fault() -> Option<String> {
    if cfg!(debug_assertions) { std::env::var("PLANESWEEP_FAULT").ok() } else { None }
}
