//! What Ctrl-C means.

use tokio_util::sync::CancellationToken;

/// What Ctrl-C means at the moment.
#[derive(Clone, Default)]
pub struct Interrupts {
    /// The first: what runs is ended, or no longer waited for; the run can be resumed.
    pub drain: CancellationToken,
    /// The second: everything is ended at once; the run can still be resumed.
    pub kill: CancellationToken,
    /// All is computed: now it just ends the program, for files are complete or absent.
    pub computed: CancellationToken,
}

impl Interrupts {
    /// Listens from now on, and says what each of the first two means; without a second meaning, the
    /// second ends the program.
    pub fn listen(self, first: &'static str, second: Option<&'static str>) {
        tokio::spawn(async move {
            while tokio::signal::ctrl_c().await.is_ok() {
                let was_drained = self.drain.is_cancelled();
                match second {
                    _ if self.computed.is_cancelled() || self.kill.is_cancelled() => std::process::exit(1),
                    _ if !was_drained => {
                        self.drain.cancel();
                        eprintln!("{first}");
                    }
                    Some(second) => {
                        self.kill.cancel();
                        eprintln!("{second}");
                    }
                    None => std::process::exit(1),
                }
            }
        });
    }
}
