//! How core calls run: without the GIL, in the thread pool of this process, and long ones on a separate
//! thread, so that Ctrl-C works. Everything that may run in parallel goes through one of these functions.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use mtm_core::MtmError;
use mtm_core::pool;
use pyo3::prelude::*;

use crate::errors::{self, Failure};

/// Interval at which signals are checked while the core works.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);
/// Stack of the worker: factorisations recurse.
const STACK_BYTES: usize = 16 << 20;

/// Result of `work`, run without the GIL on threads of this process.
pub fn detached<T, W>(py: Python<'_>, work: W) -> PyResult<T>
where
    T: Send,
    W: FnOnce() -> T + Send,
{
    Ok(py.detach(|| pool::run(work)).map_err(Failure)?)
}

/// The same for `work` that may fail.
pub fn attempted<T, W>(py: Python<'_>, work: W) -> PyResult<T>
where
    T: Send,
    W: FnOnce() -> Result<T, MtmError> + Send,
{
    Ok(detached(py, work)?.map_err(Failure)?)
}

/// Result of `work`, run without the GIL; `work` learns from its argument whether Python was interrupted.
///
/// The call returns at once on Ctrl-C. A step that cannot be interrupted (a numeric factorisation)
/// finishes in the background and its result is discarded.
pub fn interruptible<T, W>(py: Python<'_>, work: W) -> PyResult<T>
where
    T: Send + 'static,
    W: FnOnce(&(dyn Fn() -> bool + Sync)) -> Result<T, MtmError> + Send + 'static,
{
    let stop = Arc::new(AtomicBool::new(false));
    let (sender, receiver) = channel();
    let flag = stop.clone();
    std::thread::Builder::new()
        .name("cmfsim".into())
        .stack_size(STACK_BYTES)
        .spawn(move || {
            // After an interruption the receiver no longer exists, and the result is not needed.
            let done = pool::run(|| work(&|| flag.load(Ordering::Relaxed)));
            let _ = sender.send(done.and_then(|result| result));
        })
        .map_err(|e| errors::internal(format!("no thread could be started: {e}")))?;
    // `Receiver` is not `Sync`: it is moved into the detached closure and back.
    let mut receiver = receiver;
    loop {
        let (back, outcome) = py.detach(move || {
            let outcome = receiver.recv_timeout(SIGNAL_INTERVAL);
            (receiver, outcome)
        });
        receiver = back;
        match outcome {
            Ok(result) => return result.map_err(|e| Failure(e).into()),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(errors::internal("a core thread stopped without a result".into()));
            }
            Err(RecvTimeoutError::Timeout) => {
                if let Err(signal) = py.check_signals() {
                    stop.store(true, Ordering::Relaxed);
                    return Err(signal);
                }
            }
        }
    }
}
