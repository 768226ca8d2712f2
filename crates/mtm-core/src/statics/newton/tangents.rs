//! The tangent system of a state, and its solution by a factorisation or by conjugate gradients.

use std::sync::Arc;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::constraints::{Constraint, add_offsets, projected, projected_rhs};
use crate::algebra::multigrid::Multigrid;
use crate::error::Result;
use crate::mechanics::strain_energy::TangentKind::{self, Definite};
use crate::statics::linear::iterative::{Iterative, hierarchy};
use crate::statics::newton::descent::BoundaryMotion;
use crate::statics::newton::hierarchy::HierarchyResult;
use crate::statics::newton::{Equilibrium, Iterate, STEP_TOLERANCE, TangentSolver, Target};
use crate::statics::options::{Interrupt, Method, StaticOptions};
use crate::vector::{scaled, sub};

impl Equilibrium {
    /// Tangent system at `pose` on the rows, without constraints and springs: its matrix, and the right-hand
    /// side if the other nodes move by `change`.
    pub(super) fn tangent(
        &self,
        (pose, target): (&Iterate, &Target<'_>),
        kind: TangentKind,
        change: Option<&[[f64; 3]]>,
    ) -> Result<(BlockMatrix, Vec<[f64; 3]>)> {
        let mut b: Vec<[f64; 3]> = pose.slope.iter().map(|&s| scaled(s, -1.0)).collect();
        let tangents = &mut target.tangents.borrow_mut();
        let matrix = target.energy.with_stiffness(&pose.u, kind, tangents, |full| {
            if let Some(change) = change {
                for (b, f) in b.iter_mut().zip(self.reduction.rows(&full.multiply(change))) {
                    *b = sub(*b, f);
                }
            }
            self.pattern.get_or_init(|| self.reduction.pattern(full)).taken_from(full)
        })?;
        Ok((matrix, b))
    }

    /// Newton step from `pose` on the rows.
    ///
    /// `how`: the tangent, and the error allowed in the step, mm.
    pub(super) fn step(
        &self,
        pose: &Iterate,
        target: &Target<'_>,
        (constraints, change): BoundaryMotion<'_>,
        (kind, allowed): (TangentKind, f64),
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        target.hierarchy.serve(kind == Definite, |kept| {
            let (mut matrix, b) = self.tangent((pose, target), kind, change)?;
            for (row, spring) in &target.conditions.springs {
                matrix.add_to_diagonal(*row, spring.axis, spring.stiffness);
            }
            let rhs = projected_rhs(&matrix, &b, constraints);
            if !constraints.is_empty() {
                matrix = projected(&matrix, constraints);
            }
            let (mut value, multigrid, iterations) = match &self.solver {
                TangentSolver::Cholesky(symbolic) => {
                    (symbolic.factor(&matrix)?.solve(&rhs), None, 0)
                }
                TangentSolver::Pcg => {
                    let system = self.by_iteration(matrix, constraints, kept)?;
                    let (rows, iterations) = system.step(&rhs, allowed, interrupted)?;
                    (rows, Some(system.multigrid.clone()), iterations)
                }
            };
            add_offsets(&mut value, constraints);
            Ok(HierarchyResult { value, multigrid, iterations })
        })
    }

    /// The tangent system of the projected `matrix`, to be solved by conjugate gradients with the hierarchy
    /// `kept`, or with its own.
    fn by_iteration(
        &self,
        matrix: BlockMatrix,
        constraints: &[Constraint],
        kept: Option<Arc<Multigrid>>,
    ) -> Result<Iterative> {
        let multigrid = match kept {
            Some(kept) => kept,
            None => {
                let positions = self.reduction.rows(self.tensors.element_nodes().positions());
                let normals: Vec<(usize, [f64; 3])> =
                    constraints.iter().map(|c| (c.row, c.normal)).collect();
                Arc::new(hierarchy(&matrix, &positions, &normals, self.tissue)?)
            }
        };
        let options =
            StaticOptions { tolerance: STEP_TOLERANCE * self.options.tolerance, ..self.options };
        Ok(Iterative::new(matrix, multigrid, self.tissue, Method::Pcg, &options))
    }
}
