//! Workspace and threads for the factorisations.

use faer::Par;
use faer::dyn_stack::{MemBuffer, StackReq};

use crate::error::{MtmError, Result};

/// Number of unknowns below which threads cost more than they save in dense work and in several columns at
/// once.
const PARALLEL_UNKNOWNS: usize = 3000;

/// Threads for dense work and for several columns at once, if they pay off.
pub fn parallelism(unknowns: usize) -> Par {
    if unknowns < PARALLEL_UNKNOWNS { Par::Seq } else { Par::rayon(0) }
}

/// Workspace of the required size.
pub fn buffer(need: StackReq) -> Result<MemBuffer> {
    MemBuffer::try_new(need)
        .map_err(|_| out_of_memory("workspace of the factorisation", need.size_bytes()))
}

/// The error for a system that cannot provide `bytes` for `what`.
pub fn out_of_memory(what: &'static str, bytes: usize) -> MtmError {
    MtmError::out_of_memory(what, bytes, None, "use method=\"pcg\", which keeps no factor")
}
