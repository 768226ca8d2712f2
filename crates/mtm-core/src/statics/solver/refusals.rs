//! Input that a static solver refuses: combinations without an answer, and starts of another scene.

use crate::error::{ErrorKind, MtmError, Result};
use crate::mechanics::kinematics::Kinematics;
use crate::statics::solution::Solution;
use crate::statics::solver::StaticSolver;

impl StaticSolver {
    /// Rejects kinematics and boundaries without a linear map from what drives the body to its displacements;
    /// `result`: what such a map is needed for.
    pub(crate) fn check_linear(&self, result: &'static str) -> Result<()> {
        if self.kinematics() != Kinematics::Linear {
            return Err(self.not_linear(result));
        }
        if !self.node_kinds.touching().is_empty() {
            let needed = "none, since contacts change with the plan (solve takes them)";
            return Err(ErrorKind::Solver.not_together(
                ("boundary", "touching pairs"),
                result,
                needed,
            ));
        }
        Ok(())
    }

    /// The error for kinematics that are no linear map, which `result` needs.
    pub(crate) fn not_linear(&self, result: &'static str) -> MtmError {
        let needed = "linear, since the others are no linear map (solve takes them)";
        ErrorKind::Solver.not_together(("kinematics", self.kinematics().name()), result, needed)
    }

    /// Rejects a starting solution of another mesh or boundary.
    pub(crate) fn check_start(&self, start: &Solution) -> Result<()> {
        let n = self.tensors.element_nodes().n_nodes();
        let nodes = self.sliding.as_ref().map_or(0, |s| s.nodes.len());
        let counts = [
            ("displacements of the start", start.displacements.len(), n),
            ("sliding nodes of the start", start.contact.nodes.len(), nodes),
        ];
        for (what, found, expected) in counts {
            let why = "the start is a solution of the same solver";
            ErrorKind::Boundary.require_length(what, found, expected, why)?;
        }
        Ok(())
    }
}
