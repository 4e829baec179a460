//! Trying again while a store cannot be reached, or is full.

use std::time::Duration;

use planesweep_proto::with_causes;
use tokio_util::sync::CancellationToken;

use crate::StoreError;

/// Pauses between tries: doubled up to the longest.
const PAUSES: (Duration, Duration) = (Duration::from_millis(200), Duration::from_secs(5));

/// Tries until the trouble is over, and says so once; the trouble itself when `impatience` is cancelled
/// before that.
pub(crate) async fn patiently<T, F: Future<Output = Result<T, StoreError>>>(
    impatience: &CancellationToken,
    attempt: impl Fn() -> F,
) -> Result<T, StoreError> {
    let mut pause = PAUSES.0;
    let mut was_in_trouble = false;
    loop {
        let error = match attempt().await {
            Err(error) if error.is_passing() => error,
            done => {
                if was_in_trouble && done.is_ok() {
                    tracing::warn!("the store works again");
                }
                return done;
            }
        };
        if impatience.is_cancelled() {
            return Err(error);
        }
        if !was_in_trouble {
            let trouble = match error.full_disk() {
                Some(url) => format!("disk full at {url}"),
                None => format!("the store does not answer ({})", with_causes(&error)),
            };
            tracing::warn!("{trouble}, trying again until it works");
        }
        was_in_trouble = true;
        tokio::select! {
            () = tokio::time::sleep(pause) => {}
            () = impatience.cancelled() => return Err(error),
        }
        pause = (2 * pause).min(PAUSES.1);
    }
}
