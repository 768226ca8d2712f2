//! Input that a static solver refuses: combinations without an answer, and starts of another scene.

use crate::error::{ErrorKind, MtmError, Result};
use crate::mechanics::kinematics::Kinematics;
use crate::statics::solution::Solution;
use crate::statics::solver::StaticSolver;

impl StaticSolver {
    /// Rejects kinematics and boundaries without a linear map from what drives the body to its displacements:
    /// `kinematics` and `boundary` are what the error calls them.
    pub(crate) fn check_linear(
        &self,
        kinematics: &'static str,
        boundary: &'static str,
    ) -> Result<()> {
        if self.kinematics() != Kinematics::Linear {
            return Err(MtmError::UnknownName {
                what: kinematics,
                found: self.kinematics().name().into(),
                known: "linear (the others are no linear map; use solve)",
                kind: ErrorKind::Solver,
            });
        }
        if !self.node_kinds.touching().is_empty() {
            return Err(MtmError::UnknownName {
                what: boundary,
                found: "touching pairs".into(),
                known: "one without (contacts change with the plan; use solve)",
                kind: ErrorKind::Solver,
            });
        }
        Ok(())
    }

    /// Rejects a starting solution of another mesh or boundary.
    pub(crate) fn check_start(&self, start: &Solution) -> Result<()> {
        let n = self.tensors.element_nodes().n_nodes();
        let nodes = self.sliding.as_ref().map_or(0, |s| s.nodes().len());
        let counts = [
            ("displacements of the start", start.displacements.len(), n),
            ("sliding nodes of the start", start.contact.nodes.len(), nodes),
        ];
        for (what, found, expected) in counts {
            if found != expected {
                return Err(MtmError::Length {
                    what: what.into(),
                    found,
                    expected,
                    why: "the start is a solution of the same solver",
                    kind: ErrorKind::Boundary,
                });
            }
        }
        Ok(())
    }
}
