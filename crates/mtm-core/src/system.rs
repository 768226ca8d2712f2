//! The reduced linear system: what a method keeps from one plan to the next, and how it solves with
//! and without contact.

use crate::blocks::BlockMatrix;
use crate::boundary::Motion;
use crate::cholesky::{Factor, Symbolic};
use crate::constraints::{
    Constraint, add_offsets, along_normals, orthonormal, projected, projected_rhs,
};
use crate::contact::{Constraints, ContactState, Response, Sliding, Spring};
use crate::crease::ContactRow;
use crate::error::{MtmError, Result};
use crate::krylov::{PcgOptions, Preconditioner, pcg};
use crate::mesh::{add, dot, norm, scaled, sub};
use crate::method::{Interrupt, Method, StaticOptions};
use crate::multigrid::{Multigrid, MultigridOptions};
use crate::reaction::ContactFactor;
use crate::relaxation::{RelaxationOptions, relax};
use crate::restraint::Held;
use crate::solution::Clock;

/// Above this many unknowns `Method::Auto` takes conjugate gradients: a factor grows like n^1.4.
pub(crate) const AUTO_DIRECT_UNKNOWNS: usize = 300_000;
/// Most sliding nodes whose whole flexibility is kept (three unknowns each, 8 bytes a pair, twice): with
/// it a set of normals costs a few dense products, by sweeps a few passes over the factor.
const MAX_DENSE_SLIDING: usize = 2500;
/// Most sliding nodes of which the flexibility along the normals at rest is kept: 8 bytes a pair.
const MAX_KEPT_SLIDING: usize = 6000;
/// Over-relaxation of the node-wise iteration.
const RELAXATION_FACTOR: f64 = 1.6;
/// Sweeps after which the node-wise iteration gives up.
const MAX_SWEEPS: usize = 200_000;

/// Share of the tolerance to which the error left by the sweeps is measured.
const MEASURED_SHARE: f64 = 0.1;
/// λ/μ from which a stronger smoother pays: at ν = 0.499 it takes 113 iterations instead of 186. ν = 0.48.
const NEARLY_INCOMPRESSIBLE: f64 = 24.0;
/// Multiple of a factor's trial error that stands for the error of any solution by it.
const TRIAL_SAFETY: f64 = 10.0;

/// Counters of the iterative solves of one plan.
#[derive(Default)]
pub(crate) struct Effort {
    /// Error bound of the last solve, mm.
    pub error_bound: f64,
    /// Iterations of all solves.
    pub iterations: usize,
    /// Residual measure of each.
    pub history: Vec<f64>,
}

/// What is kept from one plan to the next.
enum Kept {
    /// The factor, and with sliding nodes what answers for them.
    Direct { symbolic: Symbolic, factor: Factor, contact: Option<ContactFactor> },
    /// The structure of the factor: the values change with the contact normals.
    Refactored { symbolic: Symbolic, matrix: BlockMatrix },
    /// The preconditioner.
    Pcg { multigrid: Box<Multigrid>, matrix: BlockMatrix },
    /// The preconditioner serves the error bound alone.
    Relaxation { multigrid: Box<Multigrid>, matrix: BlockMatrix },
}

/// The system of the unknown nodes, ready for any right-hand side.
pub(crate) struct System {
    kept: Kept,
    tolerance: f64,
    max_iterations: Option<usize>,
}

/// Contact constraints that do not change, for several right-hand sides.
pub(crate) struct Frozen<'a> {
    /// Sliding node and normal of each constraint.
    pub rows: &'a [ContactRow],
    /// Offset of every row, for each right-hand side.
    pub offsets: &'a [Vec<f64>],
}

impl System {
    /// The system of `matrix`, with what the method of `options` keeps, and the method used.
    ///
    /// `positions`: coordinates of the rows; `lame_ratio`: largest λ/μ of the tissue. Errors name rows.
    pub fn new(
        matrix: BlockMatrix,
        positions: &[[f64; 3]],
        sliding: Option<&Sliding>,
        held: Held,
        lame_ratio: f64,
        options: &StaticOptions,
        clock: &mut Clock,
        interrupted: Interrupt<'_>,
    ) -> Result<(Self, Method)> {
        let unknowns = 3 * matrix.n_rows();
        let mut method = match options.method {
            Method::Auto if unknowns > AUTO_DIRECT_UNKNOWNS => Method::Pcg,
            Method::Auto => Method::Cholesky,
            named => named,
        };
        let with = |kept: Kept| Self {
            kept,
            tolerance: options.tolerance,
            max_iterations: options.max_iterations,
        };
        if method == Method::Cholesky {
            let slide_rows: Vec<u32> =
                sliding.iter().flat_map(|s| s.nodes().iter().map(|n| n.row)).collect();
            // Where sliding nodes alone hold a part, there is no flexibility without them.
            let kept = !slide_rows.is_empty()
                && held == Held::ByPrescribed
                && slide_rows.len() <= MAX_KEPT_SLIDING;
            let dense = kept && slide_rows.len() <= MAX_DENSE_SLIDING;
            let symbolic = Symbolic::new(&matrix, if dense { &slide_rows } else { &[] })?;
            clock.lap("ordering", true);
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let fits = options.memory_limit.is_none_or(|limit| symbolic.factor_bytes() <= limit);
            if fits && sliding.is_some() && !kept {
                return Ok((with(Kept::Refactored { symbolic, matrix }), method));
            }
            if fits {
                let factor = symbolic.factor(&matrix)?;
                clock.lap("factor", true);
                let contact = sliding.map(|sliding| {
                    if dense {
                        ContactFactor::dense(&symbolic, &factor, sliding)
                    } else {
                        ContactFactor::by_sweeps(&symbolic, &factor, sliding)
                    }
                });
                let contact = contact.transpose()?;
                clock.lap("contact_factor", contact.is_some());
                return Ok((with(Kept::Direct { symbolic, factor, contact }), method));
            }
            if options.method == Method::Cholesky {
                return Err(MtmError::OutOfMemory {
                    what: "the Cholesky factor",
                    needed_mb: symbolic.factor_bytes() >> 20,
                    limit_mb: options.memory_limit.map(|bytes| bytes >> 20),
                    advice: "use method=\"pcg\" or \"auto\"",
                });
            }
            method = Method::Pcg;
        }
        let normals: Vec<(usize, [f64; 3])> = sliding
            .iter()
            .flat_map(|s| s.nodes().iter().zip(s.rest_normals()))
            .map(|(node, &n)| (node.row as usize, n))
            .collect();
        let constraints: Vec<Constraint> =
            normals.iter().map(|&(row, normal)| Constraint { row, normal, offset: 0.0 }).collect();
        let held_matrix = (!constraints.is_empty()).then(|| projected(&matrix, &constraints));
        let multigrid = Box::new(Multigrid::new(
            held_matrix.as_ref().unwrap_or(&matrix),
            positions,
            &normals,
            &multigrid_options(lame_ratio),
        )?);
        clock.lap("preconditioner", true);
        Ok((
            with(if method == Method::Relaxation {
                Kept::Relaxation { multigrid, matrix }
            } else {
                Kept::Pcg { multigrid, matrix }
            }),
            method,
        ))
    }

    /// Bytes of the factor or preconditioner.
    pub fn bytes(&self) -> usize {
        match &self.kept {
            Kept::Direct { symbolic, contact, .. } => {
                symbolic.factor_bytes() + contact.as_ref().map_or(0, ContactFactor::bytes)
            }
            Kept::Refactored { symbolic, .. } => symbolic.factor_bytes(),
            Kept::Pcg { multigrid, .. } | Kept::Relaxation { multigrid, .. } => {
                multigrid.memory_bytes()
            }
        }
    }

    /// A⁻¹ b without sliding nodes; `scale` is the length that the tolerance refers to, mm.
    pub fn solve(
        &self,
        b: &[[f64; 3]],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        match &self.kept {
            Kept::Direct { symbolic, factor, .. } => {
                let x = symbolic.solve(factor, b);
                effort.error_bound = direct_error(factor, &x);
                Ok(x)
            }
            Kept::Refactored { symbolic, matrix } => {
                Ok(symbolic.solve(&symbolic.factor(matrix)?, b))
            }
            Kept::Pcg { matrix, .. } | Kept::Relaxation { matrix, .. } => {
                let start = vec![[0.0; 3]; b.len()];
                self.iterate(matrix, b, &start, scale, effort, interrupted)
            }
        }
    }

    /// Displacements of the rows with contact settled, the contact, and the seconds that contact took.
    pub fn solve_with_contact(
        &self,
        b: &[[f64; 3]],
        sliding: &Sliding,
        motions: &[&Motion],
        options: &StaticOptions,
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactState, f64)> {
        let clock = Clock::new();
        if let Kept::Direct { symbolic, factor, contact: Some(contact) } = &self.kept {
            let mut x = symbolic.permuted(b);
            symbolic.forward(factor, &mut x, 1);
            let mut answers = contact.answers(symbolic, factor, &x);
            let state =
                sliding.settle(motions, &options.contact, interrupted, |c| answers.respond(c))?;
            answers.add_forces(&mut x, &pushes(&state.normals, &state.forces));
            let seconds = clock.total();
            symbolic.backward(factor, &mut x, 1);
            let x = symbolic.unpermuted(&x);
            effort.error_bound = direct_error(factor, &x);
            return Ok((x, state, seconds));
        }
        let mut last = Vec::new();
        let state = sliding.settle(motions, &options.contact, interrupted, |c| {
            let (u, response) =
                self.solve_projected(b, sliding, c, &last, scale, effort, interrupted)?;
            last = u;
            Ok(response)
        })?;
        Ok((last, state, clock.total()))
    }

    /// Rows for several right-hand sides; `scales` is the length of each one's prescribed field, mm.
    pub fn solve_columns(
        &self,
        mut columns: Vec<Vec<[f64; 3]>>,
        scales: &[f64],
        sliding: Option<(&Sliding, Frozen<'_>)>,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        let mut effort = Effort::default();
        let Some((sliding, frozen)) = sliding else {
            if let Kept::Direct { symbolic, factor, .. } = &self.kept {
                symbolic.solve_many(factor, &mut columns);
                return Ok(columns);
            }
            let each = columns.iter().zip(scales);
            return each.map(|(b, &s)| self.solve(b, s, &mut effort, interrupted)).collect();
        };
        if let Kept::Direct { symbolic, factor, contact: Some(contact) } = &self.kept {
            let frozen = contact.frozen(frozen.rows, frozen.offsets)?;
            let solve = |(k, b): (usize, &Vec<[f64; 3]>)| {
                if interrupted() {
                    return Err(MtmError::Interrupted);
                }
                let mut x = symbolic.permuted(b);
                symbolic.forward(factor, &mut x, 1);
                let mut answers = contact.answers(symbolic, factor, &x);
                let forces = frozen.forces(&mut answers, k)?;
                answers.add_forces(&mut x, &forces);
                symbolic.backward(factor, &mut x, 1);
                Ok(symbolic.unpermuted(&x))
            };
            return columns.iter().enumerate().map(solve).collect();
        }
        let solve = |((b, offsets), &scale): ((&Vec<[f64; 3]>, &Vec<f64>), &f64)| {
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let c = Constraints { rows: frozen.rows, offsets, springs: &[] };
            let solved = self.solve_projected(b, sliding, &c, &[], scale, &mut effort, interrupted);
            Ok(solved?.0)
        };
        columns.iter().zip(frozen.offsets).zip(scales).map(solve).collect()
    }

    /// One constrained solve on the projected system P A P + k (I − P), P = I − n⊗n on held nodes.
    ///
    /// `near`: displacements that conjugate gradients start from, or nothing.
    fn solve_projected(
        &self,
        b: &[[f64; 3]],
        sliding: &Sliding,
        c: &Constraints<'_>,
        near: &[[f64; 3]],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, Response)> {
        let asked: Vec<Constraint> = c
            .rows
            .iter()
            .zip(c.offsets)
            .map(|(r, &offset)| Constraint {
                row: sliding.nodes()[r.node].row as usize,
                normal: r.normal,
                offset,
            })
            .collect();
        let constraints = orthonormal(&asked);
        let matrix = match &self.kept {
            Kept::Refactored { matrix, .. }
            | Kept::Pcg { matrix, .. }
            | Kept::Relaxation { matrix, .. } => matrix,
            Kept::Direct { .. } => unreachable!("the factor without contact serves there"),
        };
        let mut system = projected(matrix, &constraints);
        let mut rhs = projected_rhs(matrix, b, &constraints);
        add_springs(&mut system, &mut rhs, sliding, c.springs);
        let mut x = match &self.kept {
            Kept::Refactored { symbolic, .. } => {
                let factor = symbolic.factor(&system)?;
                let x = symbolic.solve(&factor, &rhs);
                effort.error_bound = direct_error(&factor, &x);
                x
            }
            _ => {
                let reach = constraints.iter().fold(scale, |m, c| m.max(c.offset.abs()));
                let mut start = near.to_vec();
                start.resize(b.len(), [0.0; 3]);
                for k in &constraints {
                    start[k.row] = sub(start[k.row], scaled(k.normal, dot(k.normal, start[k.row])));
                }
                self.iterate(&system, &rhs, &start, reach, effort, interrupted)?
            }
        };
        add_offsets(&mut x, &constraints);
        let forces = along_normals(&asked, |row| sub(matrix.row_product(row, &x), b[row]));
        let displacements = sliding.nodes().iter().map(|n| x[n.row as usize]).collect();
        Ok((x, Response { displacements, forces }))
    }

    /// Solves with the iterative method, conjugate gradients from `start`, to an error bound of `tolerance × scale`.
    fn iterate(
        &self,
        matrix: &BlockMatrix,
        b: &[[f64; 3]],
        start: &[[f64; 3]],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        if b.iter().flatten().all(|&v| v == 0.0) {
            return Ok(vec![[0.0; 3]; b.len()]);
        }
        // Loads move the body where bone does not: one cycle tells how far, to the order of magnitude.
        let tolerance = |multigrid: &Multigrid| {
            let mut first = vec![[0.0; 3]; b.len()];
            multigrid.apply(b, &mut first);
            self.tolerance * first.iter().fold(scale, |m, v| m.max(norm(*v)))
        };
        match &self.kept {
            Kept::Pcg { multigrid, .. } => {
                let tolerance = tolerance(multigrid);
                let defaults = PcgOptions::default();
                let max_iterations = self.max_iterations.unwrap_or(defaults.max_iterations);
                let options = PcgOptions { tolerance, max_iterations, ..defaults };
                let found = pcg(matrix, b, start, multigrid.as_ref(), &options, interrupted)?;
                effort.error_bound = found.error_bound_mm;
                effort.iterations += found.iterations;
                effort.history.extend(found.residual_history);
                Ok(found.solution)
            }
            Kept::Relaxation { multigrid, .. } => {
                let tolerance = tolerance(multigrid);
                self.relax_to_bound(matrix, multigrid, b, tolerance, effort, interrupted)
            }
            Kept::Direct { .. } | Kept::Refactored { .. } => {
                unreachable!("a factor solves without iterating")
            }
        }
    }

    /// Sweeps until the error itself is within `tolerance`, mm.
    ///
    /// The steps of the sweeps do not tell: where a stiff body hangs on soft tissue they become tiny long
    /// before it has moved. The error that is left, A⁻¹ (b − A x), is therefore solved for by conjugate
    /// gradients each time the steps say that the sweeps are done, and measured, not used.
    fn relax_to_bound(
        &self,
        matrix: &BlockMatrix,
        multigrid: &Multigrid,
        b: &[[f64; 3]],
        tolerance: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let most = self.max_iterations.unwrap_or(MAX_SWEEPS);
        let (mut x, mut goal, mut sweeps) = (vec![[0.0; 3]; b.len()], tolerance, 0);
        loop {
            let options = RelaxationOptions {
                tolerance: goal,
                factor: RELAXATION_FACTOR,
                max_sweeps: most - sweeps,
            };
            let found = relax(matrix, b, &x, &options, interrupted)
                .map_err(|e| gave_up(e, most, tolerance))?;
            (x, sweeps) = (found.solution, sweeps + found.sweeps);
            effort.iterations += found.sweeps;
            effort.history.extend(found.steps);
            let rest: Vec<[f64; 3]> =
                b.iter().zip(matrix.multiply(&x)).map(|(&b, f)| sub(b, f)).collect();
            let options = PcgOptions {
                tolerance: MEASURED_SHARE * tolerance,
                energy_tolerance: MEASURED_SHARE,
                ..PcgOptions::default()
            };
            let start = vec![[0.0; 3]; b.len()];
            let left = pcg(matrix, &rest, &start, multigrid, &options, interrupted)
                .map_err(|e| gave_up(e, sweeps, tolerance))?;
            let largest = left.solution.iter().fold(0.0_f64, |m, e| m.max(norm(*e)));
            let error = largest + left.error_bound_mm;
            if error <= tolerance {
                effort.error_bound = error;
                return Ok(x);
            }
            if sweeps >= most {
                return Err(no_rest(most, error, tolerance));
            }
            goal *= (0.5 * tolerance / error).min(0.5);
        }
    }
}

/// Options of the cycle for tissue with the given largest λ/μ.
fn multigrid_options(lame_ratio: f64) -> MultigridOptions {
    let defaults = MultigridOptions::default();
    if lame_ratio < NEARLY_INCOMPRESSIBLE {
        return defaults;
    }
    MultigridOptions { smoother_degree: 2 * defaults.smoother_degree, ..defaults }
}

/// That the sweeps ended before the error was within the tolerance.
fn no_rest(sweeps: usize, error: f64, tolerance: f64) -> MtmError {
    MtmError::NotConverged {
        method: "relaxation",
        iterations: sweeps,
        error,
        tolerance,
        advice: "use method=\"cholesky\" or \"pcg\"; node-wise relaxation is kept for comparison",
    }
}

/// An error of a step of the relaxation, in the terms that the caller asked in.
fn gave_up(error: MtmError, sweeps: usize, tolerance: f64) -> MtmError {
    match error {
        MtmError::NotConverged { error, .. } => no_rest(sweeps, error, tolerance),
        other => other,
    }
}

/// Adds springs to a projected system: k a⊗a on their rows, and k a g to the right-hand side.
fn add_springs(
    system: &mut BlockMatrix,
    rhs: &mut [[f64; 3]],
    sliding: &Sliding,
    springs: &[Spring],
) {
    for spring in springs {
        let row = sliding.nodes()[spring.node].row as usize;
        rhs[row] = add(rhs[row], scaled(spring.axis, spring.stiffness * spring.goal));
        system.add_to_diagonal(row, spring.axis, spring.stiffness);
    }
}

/// Estimate of the largest nodal error of a solution by factor, mm.
fn direct_error(factor: &Factor, x: &[[f64; 3]]) -> f64 {
    TRIAL_SAFETY * factor.trial_error() * x.iter().fold(0.0_f64, |m, v| m.max(norm(*v)))
}

/// Force vector of each sliding node.
fn pushes(normals: &[[f64; 3]], forces: &[f64]) -> Vec<[f64; 3]> {
    normals.iter().zip(forces).map(|(&n, &f)| scaled(n, f)).collect()
}
