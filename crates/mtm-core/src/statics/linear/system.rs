//! The reduced linear system: what each method keeps from one plan to the next, and how it solves with and
//! without contact.

use std::sync::Arc;

use rayon::prelude::*;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::cholesky::{Factor, Symbolic, TailFlexibility};
use crate::algebra::constraints::{Constraint, projected};
use crate::algebra::krylov::StepAccuracy;
use crate::algebra::multigrid::Multigrid;
use crate::algebra::row_sums::in_pool;
use crate::contact::links::Link;
use crate::contact::{Constraints, ContactResult, Sliding, Spring};
use crate::error::{ErrorKind, MtmError, Result};
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::iterative::{Extremes, Iterative, KeptForNext, SolveMemory, hierarchy};
use crate::statics::linear::pressed::with_links;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::options::{Interrupt, Method, StaticOptions};
use crate::statics::plans::about::Slope;
use crate::statics::plans::frozen::FrozenContact;
use crate::statics::plans::reaction::ContactFactor;
use crate::statics::plans::settling::{
    ContactSolve, RowLinks, Unfactored, direct_error, settled_by_flexibility, touching_needs_pcg,
};
use crate::statics::restraint::Support;
use crate::statics::solution::{Clock, SolvedRows};
use crate::vector::add;

/// Maximum number of sliding nodes for which their flexibility is kept: 54 bytes a pair of nodes, 1.9 GB.
const MAX_KEPT_SLIDING: usize = 6000;

/// Relative error of the loads of unstable springs in a plan operator: no further step corrects them.
const OPERATOR_SPRING_SHARE: f64 = 1e-5;

/// One row of three for each unknown node.
type Rows = Vec<[f64; 3]>;

/// The system of the unknown nodes, ready for any right-hand side: what is kept from one plan to the next.
pub(crate) enum System {
    /// The factorisation, and the data for solving contact at the sliding nodes, if there are any.
    Factor { factor: Arc<Factor>, contact: ContactFactor },
    /// The matrix, in which sliding nodes are constrained.
    Matrix(Unfactored),
}

/// The rows of a body that form a system.
pub(crate) struct BodyRows<'a> {
    /// Coordinates of the rows, mm.
    pub positions: &'a [[f64; 3]],
    pub sliding: Option<&'a Sliding>,
    pub held: Support,
    /// Rows that plans hold or free, and the places among them of those that are held.
    pub liftable: (&'a [u32], &'a [usize]),
    /// Contrast and compressibility of the tissue.
    pub tissue: Extremes,
    /// The hierarchy of a similar matrix under the same conditions, if there is one.
    pub multigrid: Option<Arc<Multigrid>>,
}

/// Contact constraints that stay the same for several right-hand sides.
pub(crate) struct Frozen<'a> {
    pub state: &'a ContactResult,
    /// Offsets of its rows and goals of its springs, for each right-hand side.
    pub slopes: &'a [Slope],
}

impl Frozen<'_> {
    /// The springs with their goals for right-hand side `k`.
    fn springs(&self, k: usize) -> Vec<Spring> {
        let goals = self.state.springs.iter().zip(&self.slopes[k].goals);
        goals.map(|(spring, &goal)| Spring { goal, ..*spring }).collect()
    }
}

impl System {
    /// The system of `matrix`, with what the method of `options` keeps, and the method used.
    ///
    /// Errors refer to rows.
    pub fn new(
        matrix: BlockMatrix,
        body: &BodyRows<'_>,
        options: &StaticOptions,
        clock: &mut Clock,
        interrupted: Interrupt<'_>,
    ) -> Result<(Self, Method)> {
        let mut method = options.method.for_unknowns(3 * matrix.n_rows());
        if method.has_factor() {
            let slide_rows: Vec<u32> =
                body.sliding.iter().flat_map(|s| s.nodes.iter().map(|n| n.row)).collect();
            // If a part is constrained by sliding nodes alone, there is no flexibility without them.
            let (liftable, held) = body.liftable;
            let (n_sliding, n_tail) = (slide_rows.len(), slide_rows.len() + liftable.len());
            let kept = body.held == Support::ByPrescribed && n_tail <= MAX_KEPT_SLIDING;
            if !kept && !liftable.is_empty() {
                return Err(not_liftable("sliding and liftable nodes", n_tail.to_string()));
            }
            let symbolic = Arc::new(Symbolic::new(&matrix, liftable)?);
            clock.lap("ordering", true);
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let contact = kept.then(|| ContactFactor::bytes_for(n_sliding, liftable.len()));
            let needed = symbolic.factor_bytes() + contact.unwrap_or(0);
            let fits = options.memory_limit.is_none_or(|limit| needed <= limit);
            if fits && n_sliding > 0 && !kept {
                let refactored = Unfactored::Refactored { symbolic, matrix };
                return Ok((Self::Matrix(refactored), method));
            }
            if fits {
                let factor = Arc::new(symbolic.factor(&matrix)?);
                clock.lap("factor", true);
                let normals = body.sliding.map_or(&[][..], |s| &s.rest_normals);
                let contact = ContactFactor::new(&factor, (&slide_rows, normals), held)?;
                clock.lap("contact_factor", body.sliding.is_some());
                return Ok((Self::Factor { factor, contact }, method));
            }
            if options.method.has_factor() {
                let (what, advice) = ("the Cholesky factor", "use method=\"pcg\" or \"auto\"");
                return Err(MtmError::out_of_memory(what, needed, options.memory_limit, advice));
            }
            method = Method::Pcg;
        }
        if !body.liftable.0.is_empty() {
            return Err(not_liftable("method", method.name().into()));
        }
        let multigrid = match &body.multigrid {
            Some(kept) => kept.clone(),
            None => Arc::new(multigrid(&matrix, body)?),
        };
        let iterative = Iterative::new(matrix, multigrid, body.tissue, method, options);
        clock.lap("preconditioner", true);
        Ok((Self::Matrix(Unfactored::Iterative(Box::new(iterative))), method))
    }

    /// The same system with other rows `held`, by their places among those that may be lifted.
    ///
    /// # Errors
    /// Any method without a factor.
    pub fn holding(&self, held: &[usize]) -> Result<Self> {
        let Self::Factor { factor, contact } = self else {
            return Err(not_liftable("method", "one without a factorisation".into()));
        };
        Ok(Self::Factor { factor: factor.clone(), contact: contact.holding(held)? })
    }

    /// The hierarchy, if the system is solved by iteration.
    pub fn multigrid(&self) -> Option<&Arc<Multigrid>> {
        match self {
            Self::Matrix(Unfactored::Iterative(iterative)) => Some(&iterative.multigrid),
            Self::Matrix(Unfactored::Refactored { .. }) | Self::Factor { .. } => None,
        }
    }

    /// Bytes of the factor or preconditioner.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Factor { factor, contact } => factor.bytes() + contact.bytes(),
            Self::Matrix(Unfactored::Refactored { symbolic, .. }) => symbolic.factor_bytes(),
            Self::Matrix(Unfactored::Iterative(iterative)) => iterative.bytes(),
        }
    }

    /// A⁻¹ b without contact.
    pub fn solve(&self, b: &[[f64; 3]], solve: &mut PlanSolve<'_>) -> Result<Vec<[f64; 3]>> {
        match self {
            Self::Factor { factor, contact } => {
                let x = in_pool(|| match contact.flexibility.lifts() {
                    true => contact.answers(factor, b).of_all(&[]),
                    false => factor.solve(b),
                });
                solve.error_estimate = direct_error(factor, &x);
                Ok(x)
            }
            Self::Matrix(Unfactored::Refactored { symbolic, matrix }) => {
                Ok(symbolic.factor(matrix)?.solve(b))
            }
            Self::Matrix(Unfactored::Iterative(iterative)) => iterative.solve(b, solve),
        }
    }

    /// Displacements of the rows at contact equilibrium.
    pub fn solve_with_contact(
        &self,
        b: &[[f64; 3]],
        settle: &ContactSolve<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        match self {
            Self::Factor { .. } if !settle.linked.links.is_empty() => {
                Err(touching_needs_pcg(Method::Cholesky))
            }
            Self::Factor { factor, contact } => {
                settled_by_flexibility(factor, contact, b, settle, solve)
            }
            Self::Matrix(system) => system.settled(b, settle, solve),
        }
    }

    /// The hierarchy of the `body` of this system with `links`.
    ///
    /// # Errors
    /// Any method except conjugate gradients.
    pub fn multigrid_with(&self, links: &[Link], body: &BodyRows<'_>) -> Result<Arc<Multigrid>> {
        let Self::Matrix(kept) = self else {
            return Err(touching_needs_pcg(Method::Cholesky));
        };
        Ok(Arc::new(multigrid(&with_links(kept.matrix(), links), body)?))
    }

    /// Rows under links if no node slides, starting from displacements `start`.
    ///
    /// # Errors
    /// Any method except conjugate gradients; those of its solve.
    pub fn solve_linked(
        &self,
        b: &[[f64; 3]],
        linked: RowLinks<'_>,
        start: &[[f64; 3]],
        solve: &mut PlanSolve<'_>,
    ) -> Result<Rows> {
        let Self::Matrix(Unfactored::Iterative(iterative)) = self else {
            return Err(touching_needs_pcg(Method::Cholesky));
        };
        let conditions = RowConditions { constraints: Vec::new(), springs: Vec::new() };
        if let Some(pressing) = linked.pressing() {
            return Ok(iterative.press(b, conditions, pressing, start.to_vec(), solve)?.rows);
        }
        let mut b = b.to_vec();
        for link in linked.links {
            link.add(link.stiffness * link.goal, &mut b);
        }
        let leave = KeptForNext {
            reach: f64::INFINITY,
            enough: linked.share.map(StepAccuracy::Energy),
            links: linked.links,
        };
        let mut trail = SolveMemory::starting(start.to_vec());
        Ok(iterative.solve_projected(b, conditions, leave, &mut trail, solve)?.rows)
    }

    /// [`solve_columns`](Self::solve_columns) without contact.
    fn solve_free_columns(
        &self,
        mut columns: Vec<Vec<[f64; 3]>>,
        (scales, share): (&[f64], Option<f64>),
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        if let Self::Factor { factor, contact } = self {
            if contact.flexibility.lifts() {
                return all_together(factor, &contact.flexibility, columns, |_, _| Ok(Vec::new()));
            }
            factor.solve_many(&mut columns);
            return Ok(columns);
        }
        let linked = RowLinks { share, ..RowLinks::default() };
        let solve = |(b, &scale): (&Rows, &f64)| {
            let mut solve = PlanSolve::new(scale, interrupted);
            match (self, share) {
                (Self::Matrix(Unfactored::Iterative(_)), Some(_)) => {
                    self.solve_linked(b, linked, &[], &mut solve)
                }
                _ => self.solve(b, &mut solve),
            }
        };
        columns.iter().zip(scales).map(solve).collect()
    }

    /// Rows for several right-hand sides; `scales` are the lengths of their prescribed fields, mm. With a
    /// `share`, iterative solves may leave that error relative to the solution, in the energy norm.
    pub fn solve_columns(
        &self,
        columns: Vec<Vec<[f64; 3]>>,
        (scales, share): (&[f64], Option<f64>),
        sliding: Option<(&Sliding, Frozen<'_>)>,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        let Some((sliding, frozen)) = sliding else {
            return self.solve_free_columns(columns, (scales, share), interrupted);
        };
        let still = vec![[0.0; 3]; sliding.nodes.len()];
        let check = || if interrupted() { Err(MtmError::Interrupted) } else { Ok(()) };
        let Frozen { state, slopes } = frozen;
        match self {
            Self::Factor { factor, contact } => {
                let kept = FrozenContact::new(&contact.flexibility, &state.rows, &state.springs)?;
                let forces = |k: usize, free: &[_]| {
                    Ok(kept.forces(free, &slopes[k].offsets, &frozen.springs(k)))
                };
                check()?;
                all_together(factor, &contact.flexibility, columns, forces)
            }
            Self::Matrix(system) => {
                // All columns have the same constraints, so one trial serves them.
                let mut trail = SolveMemory::default();
                let solve = |((k, b), &scale): ((usize, &Rows), &f64)| {
                    check()?;
                    trail.begin_again();
                    let conditions = Constraints {
                        rows: &state.rows,
                        offsets: &slopes[k].offsets,
                        springs: &frozen.springs(k),
                        about: &still,
                        share: 0.0,
                        spring_share: OPERATOR_SPRING_SHARE,
                        reach: f64::INFINITY,
                    };
                    let nodes = (sliding, RowLinks { share, ..RowLinks::default() });
                    let mut solve = PlanSolve::new(scale, interrupted);
                    let found =
                        system.solve_projected(b, nodes, &conditions, &mut trail, &mut solve);
                    found.map(|found| found.rows)
                };
                columns.iter().enumerate().zip(scales).map(solve).collect()
            }
        }
    }
}

/// The error for liftable nodes where no factor can hold or free them.
pub(crate) fn not_liftable(what: &'static str, found: String) -> MtmError {
    ErrorKind::Solver.not_together((what, &found), "liftable nodes", "method \"cholesky\", linear kinematics, corner nodes alone, at most 6000 sliding and liftable \
                 nodes, and a body that others hold")
}

/// Displacements for all `columns`, first free and then under the contact `forces` that follow: two solves that
/// read the factor once for all of them.
fn all_together(
    factor: &Factor,
    tail: &TailFlexibility,
    mut columns: Vec<Rows>,
    forces: impl Fn(usize, &[[f64; 3]]) -> Result<Rows> + Sync,
) -> Result<Vec<Rows>> {
    factor.solve_many(&mut columns);
    let push = |(k, column): (usize, &Rows)| {
        let moved: Rows = tail.rows().iter().map(|&row| column[row as usize]).collect();
        let mut push = vec![[0.0; 3]; column.len()];
        let pushes = tail.pushes(&moved, |free| forces(k, free))?;
        for (&row, force) in tail.rows().iter().zip(pushes) {
            push[row as usize] = force;
        }
        Ok(push)
    };
    let mut pushed: Vec<Rows> = columns.par_iter().enumerate().map(push).collect::<Result<_>>()?;
    factor.solve_many(&mut pushed);
    for (to, more) in columns.iter_mut().flatten().zip(pushed.iter().flatten()) {
        *to = add(*to, *more);
    }
    Ok(columns)
}

/// The hierarchy for `matrix` with its sliding rows held along their normals at rest.
fn multigrid(matrix: &BlockMatrix, body: &BodyRows<'_>) -> Result<Multigrid> {
    let normals: Vec<(usize, [f64; 3])> = body
        .sliding
        .iter()
        .flat_map(|s| s.nodes.iter().zip(&s.rest_normals))
        .map(|(node, &n)| (node.row as usize, n))
        .collect();
    let constraints: Vec<Constraint> =
        normals.iter().map(|&(row, normal)| Constraint { row, normal, offset: 0.0 }).collect();
    let held_matrix = (!constraints.is_empty()).then(|| projected(matrix, &constraints));
    hierarchy(held_matrix.as_ref().unwrap_or(matrix), body.positions, &normals, body.tissue)
}
