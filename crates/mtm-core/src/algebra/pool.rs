//! The threads for parallel work, including in a process that was forked.
//!
//! rayon keeps one pool for a process. The child of a `fork` inherits the memory of the pool without its
//! threads, so work submitted to it would wait for ever. A child therefore creates its own pool when it first
//! needs one.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::{MtmError, Result};

/// Stack of a thread of a child's pool, bytes: factorisations recurse, and in a child all of `work` runs on it.
const STACK_BYTES: usize = 16 << 20;

/// The process that rayon's own pool belongs to: the first one that ran anything. 0: none yet.
static HOME: AtomicU32 = AtomicU32::new(0);

/// The pools of the forked processes, from the first child down to this process: an append-only list.
static FORKED: OnceLock<Box<Forked>> = OnceLock::new();

/// The pool of a forked process.
struct Forked {
    process: u32,
    pool: ThreadPool,
    /// The pool of a child of this child.
    next: OnceLock<Box<Forked>>,
}

impl Forked {
    fn new(process: u32) -> Result<Box<Self>> {
        let built = ThreadPoolBuilder::new().stack_size(STACK_BYTES).build();
        let pool = built.map_err(|error| MtmError::NoThreads { reason: error.to_string() })?;
        Ok(Box::new(Self { process, pool, next: OnceLock::new() }))
    }
}

/// Result of `work`, whose parallel parts run on threads of this process.
///
/// In the process that calls this first, `work` runs on the calling thread and its parallel parts in rayon's
/// own pool. In a process forked from it, all of `work` runs in a pool created for that process. Either pool
/// has as many threads as `RAYON_NUM_THREADS` specifies, or as there are processors. Everything that may run in
/// a forked process must go through this function.
///
/// # Errors
/// [`MtmError::NoThreads`] if a forked process cannot start any.
pub fn run<T, W>(work: W) -> Result<T>
where
    T: Send,
    W: FnOnce() -> T + Send,
{
    let process = std::process::id();
    let home = match HOME.compare_exchange(0, process, Ordering::Relaxed, Ordering::Relaxed) {
        Ok(_) => process,
        Err(home) => home,
    };
    if home == process {
        return Ok(work());
    }
    Ok(pool_of(process)?.install(work))
}

/// The pool of the forked process `process`, which is this one.
///
/// No lock is taken: another thread of the parent may have held it when this process was forked. The parent's
/// pool is not touched: dropping it would wait for its threads.
#[doc(hidden)]
pub fn pool_of(process: u32) -> Result<&'static ThreadPool> {
    let (mut cell, mut made) = (&FORKED, None);
    loop {
        match cell.get() {
            // Another thread of this process may have been first: its pool is as good as `made`.
            Some(forked) if forked.process == process => return Ok(&forked.pool),
            Some(forked) => cell = &forked.next,
            None => {
                let forked = made.take().map_or_else(|| Forked::new(process), Ok)?;
                made = cell.set(forked).err();
            }
        }
    }
}
