//! The multigrid hierarchy that the tangents of one plan share: setting one up takes as long as some fifteen
//! iterations of conjugate gradients, and tissue that stretches keeps its order of stiffness.

use std::cell::{Cell, RefCell};
use std::sync::{Arc, OnceLock};

use crate::algebra::multigrid::Multigrid;
use crate::error::{MtmError, Result};

/// Iterations, relative to those of the first solve with a hierarchy, above which the next tangent gets a new one.
const WORN: usize = 2;

/// The hierarchy shared so far, if there is one.
#[derive(Default)]
pub(super) struct SharedHierarchy {
    used: RefCell<Option<Used>>,
    /// Whether the body is still at rest, under the conditions of its first tangent.
    is_at_rest: Cell<bool>,
}

/// A hierarchy and its use so far.
struct Used {
    multigrid: Arc<Multigrid>,
    /// Iterations of the first solve with it; none before.
    first: Option<usize>,
}

/// What a solve with a hierarchy found.
pub(super) struct HierarchyResult<T> {
    pub value: T,
    /// The hierarchy; none if the system was factorised.
    pub multigrid: Option<Arc<Multigrid>>,
    pub iterations: usize,
}

impl SharedHierarchy {
    /// Begins with the hierarchy of the body at `rest`, if there is one yet.
    pub fn starting(rest: &OnceLock<Arc<Multigrid>>) -> Self {
        let used = rest.get().map(|m| Used { multigrid: m.clone(), first: None });
        Self { used: RefCell::new(used), is_at_rest: Cell::new(true) }
    }

    /// The result of `solve` with the hierarchy of an earlier tangent, or with its own if it is given none.
    ///
    /// `again`: whether a solve that does not converge with an earlier hierarchy is repeated with its own.
    ///
    /// # Errors
    /// Those of `solve`.
    pub fn serve<T>(
        &self,
        again: bool,
        solve: impl Fn(Option<Arc<Multigrid>>) -> Result<HierarchyResult<T>>,
    ) -> Result<T> {
        let kept = self.used.borrow().as_ref().map(|used| used.multigrid.clone());
        let is_old = kept.is_some();
        let found = match solve(kept) {
            Err(MtmError::NotConverged { .. }) if is_old && again => solve(None)?,
            other => other?,
        };
        let HierarchyResult { value, multigrid, iterations } = found;
        let mut shared = self.used.borrow_mut();
        let before = shared.take();
        *shared = multigrid.and_then(|multigrid| {
            let first = before
                .filter(|used| Arc::ptr_eq(&used.multigrid, &multigrid))
                .and_then(|used| used.first)
                .unwrap_or(iterations);
            (iterations <= WORN * first).then_some(Used { multigrid, first: Some(first) })
        });
        Ok(value)
    }

    /// Keeps the hierarchy of the first tangent at `rest` for other plans: the next tangent gets its own. Does
    /// nothing if the body has left rest before.
    pub fn leave_rest(&self, rest: &OnceLock<Arc<Multigrid>>) {
        if self.is_at_rest.take()
            && let Some(used) = self.used.take()
        {
            rest.get_or_init(|| used.multigrid);
        }
    }
}
