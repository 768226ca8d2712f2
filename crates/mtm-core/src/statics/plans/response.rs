//! First-order change of a solution, as loads or the motions of segments change: one linear solve for each
//! change, with the factor or preconditioner of the solution, and contact continued to first order.
//!
//! Differentiating K(p) u = f with respect to a parameter p of the material gives K ∂u/∂p = −(∂K/∂p) u: the
//! change under a load that depends on the known u. Plans enter as loads of the joined nodes and as motions of
//! the contact surfaces.

use crate::boundary::{Plan, misplanned};
use crate::error::{ErrorKind, Result};
use crate::geometry::motion::RigidMotion;
use crate::statics::linear::system::Frozen;
use crate::statics::options::Interrupt;
use crate::statics::plans::about::{ContactEquilibrium, Rate, Slope};
use crate::statics::solution::Solution;
use crate::statics::solver::StaticSolver;
use crate::vector::add;

/// A change of what drives a body, per unit of a parameter.
#[derive(Debug, Clone)]
pub enum Change {
    /// Of the forces on the nodes, N: one row per corner node, or per node including mid-edge nodes.
    Loads(Vec<[f64; 3]>),
    /// Of the motions x ↦ R x + t of named segments, (Ṙ | ṫ); the others stay where they are.
    Rates(Vec<(String, [[f64; 4]; 3])>),
}

/// A change in terms of the system.
struct PosedChange {
    /// Displacement of every prescribed node, mm.
    prescribed: Vec<[f64; 3]>,
    /// Forces on the unknown rows, N.
    rows: Vec<[f64; 3]>,
    slope: Slope,
}

impl StaticSolver {
    /// The displacement of every node that each of `changes` adds to `solution`, the solution for `plan`, to
    /// first order, mm. The set of held sliding nodes stays as it is.
    ///
    /// `accuracy`: error that an iterative solve may leave, in the energy norm, as a share of the change.
    ///
    /// # Errors
    /// Large deformation, parts that may touch; a solution of another solver; loads or rates that do not fit; a
    /// rate of a segment whose motion is not rigid; a linear solve that fails.
    pub fn responses(
        &self,
        (plan, solution): (&Plan, &Solution),
        changes: &[Change],
        accuracy: f64,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        self.check_linear("a first-order change")?;
        self.check_start(solution)?;
        let what = "accuracy of a first-order change";
        let is_allowed = accuracy > 0.0 && accuracy < 1.0;
        ErrorKind::Solver.require(is_allowed, what, accuracy, "above 0 and below 1")?;
        let motions = self.node_kinds.motions(plan)?;
        let known: Vec<Option<RigidMotion>> = motions.iter().map(|m| m.rigid().copied()).collect();
        let motions: Vec<RigidMotion> =
            known.iter().map(|m| m.unwrap_or_else(RigidMotion::identity)).collect();
        let sliding = self.sliding.as_ref().map_or(&[][..], |s| &s.nodes[..]);
        let about = ContactEquilibrium { state: &solution.contact, sliding, motions: &motions };
        let (mut fields, mut slopes, mut prescribed) = (Vec::new(), Vec::new(), Vec::new());
        for change in changes {
            let found = self.posed(change, &about, &known)?;
            fields.push(found.rows);
            slopes.push(found.slope);
            prescribed.push(found.prescribed);
        }
        let frozen = Frozen { state: &solution.contact, slopes: &slopes };
        let scales = vec![0.0; fields.len()];
        let frozen = self.sliding.is_some().then_some(frozen);
        let solved = self.solve_columns(fields, (&scales, Some(accuracy)), frozen, interrupted)?;
        let filled = prescribed.iter().zip(&solved);
        Ok(filled.map(|(prescribed, rows)| self.filled(prescribed, rows)).collect())
    }

    /// `change` as prescribed displacements, forces on the rows and change of the contact conditions.
    fn posed(
        &self,
        change: &Change,
        about: &ContactEquilibrium<'_>,
        known: &[Option<RigidMotion>],
    ) -> Result<PosedChange> {
        let places = self.tensors.element_nodes().positions();
        let segments = self.node_kinds.segments();
        let (mut u, mut slope) = (vec![[0.0; 3]; places.len()], about.still());
        let mut field = vec![[0.0; 3]; self.reduction.unknowns.len()];
        let rates = match change {
            Change::Rates(rates) => rates,
            Change::Loads(loads) => {
                let loads = self.checked_loads(loads)?;
                let rows = self.reduction.rows(&loads);
                return Ok(PosedChange { prescribed: u, rows, slope });
            }
        };
        for (name, rows) in rates {
            let Some(s) = segments.iter().position(|segment| segment.name == *name) else {
                return Err(misplanned(name, "the scene has no such segment"));
            };
            if known[s].is_none() {
                return Err(misplanned(name, "a rate needs a segment that the plan moves rigidly"));
            }
            if rows.as_flattened().iter().any(|value| !value.is_finite()) {
                return Err(misplanned(name, "its rate is not finite"));
            }
            let rate = Rate::new(rows);
            for &j in &segments[s].joined {
                u[j as usize] = add(u[j as usize], rate.at(places[j as usize]));
            }
            about.add(s, &rate, &mut slope, &mut field);
        }
        for (row, b) in field.iter_mut().zip(self.coupled(&u)) {
            *row = add(*row, b);
        }
        Ok(PosedChange { prescribed: u, rows: field, slope })
    }
}
