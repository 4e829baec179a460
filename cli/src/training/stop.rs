//! The wish to end a run, by Ctrl-C or a signal to terminate.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, Result};

/// Becomes true with the first signal; the second ends the program at once, which harms nothing either.
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Listens on a thread of its own.
    pub fn on_signals() -> Result<Self> {
        let wished = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&wished);
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_all()
            .build()
            .context("cannot listen for signals")?;
        std::thread::spawn(move || {
            runtime.block_on(async {
                for again in [false, true] {
                    signal().await;
                    if again {
                        std::process::exit(130);
                    }
                    eprintln!("stopping after this step; once more stops at once");
                    flag.store(true, Ordering::Relaxed);
                }
            });
        });
        Ok(Self(wished))
    }

    /// Whether a signal came.
    pub fn is_wished(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

#[cfg(unix)]
async fn signal() {
    use tokio::signal::unix::{SignalKind, signal};
    let terminated = async {
        match signal(SignalKind::terminate()) {
            Ok(mut signals) => {
                signals.recv().await;
            }
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        interrupted = tokio::signal::ctrl_c() => if interrupted.is_err() { std::future::pending().await },
        () = terminated => {}
    }
}

#[cfg(not(unix))]
async fn signal() {
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending().await
    }
}
