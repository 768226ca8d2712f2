//! The reduced linear system: what a method keeps from one plan to the next, and how it solves with
//! and without contact.

use crate::blocks::BlockMatrix;
use crate::boundary::Motion;
use crate::cholesky::{Factor, Symbolic};
use crate::constraints::{
    Constraint, add_offsets, along_normals, orthonormal, projected, projected_rhs,
};
use crate::contact::{Constraints, ContactMode, ContactState, Response, Sliding, Spring};
use crate::crease::ContactRow;
use crate::error::{MtmError, Result};
use crate::iterative::{Effort, Extremes, Iterative, Trail};
use crate::mesh::{add, norm, scaled, sub};
use crate::method::{Interrupt, Method, StaticOptions};
use crate::reaction::ContactFactor;
use crate::restraint::Held;
use crate::row_sums::in_pool;
use crate::solution::Clock;

/// Most sliding nodes whose whole flexibility is kept (three unknowns each, 12 bytes a pair: doubles and
/// floats): with it a set of normals costs a few dense products, by sweeps a few passes over the factor.
const MAX_DENSE_SLIDING: usize = 2500;
/// Most sliding nodes of which the flexibility along the normals at rest is kept: 8 bytes a pair.
const MAX_KEPT_SLIDING: usize = 6000;

/// Share of the error at its start to which a contact iteration is solved, until the tolerance is near:
/// what it leaves is less than what the next closest points change.
const STEP_SHARE: f64 = 1e-2;
/// The same where nodes may lift off: small forces decide which.
const LIFTING_STEP_SHARE: f64 = 1e-4;
/// Share of the error allowed to an iterative solve that contact may have as well: it cannot settle nearer
/// than the solves repeat.
const CONTACT_SHARE: f64 = 0.1;
/// Multiple of a factor's trial error that stands for the error of any solution by it. Ten of them were too
/// few for one solution in 300 of `benches/error_estimate.rs`, most of them with contact.
const TRIAL_SAFETY: f64 = 100.0;

/// Multiple of the largest gap that contact leaves which stands for the error of a solution with it.
const GAP_SAFETY: f64 = 10.0;

/// What is kept from one plan to the next.
enum Kept {
    /// The factor, and with sliding nodes what answers for them.
    Direct { symbolic: Symbolic, factor: Factor, contact: Option<ContactFactor> },
    /// The structure of the factor: the values change with the contact normals.
    Refactored { symbolic: Symbolic, matrix: BlockMatrix },
    /// The preconditioner.
    Iterative(Iterative),
}

/// The system of the unknown nodes, ready for any right-hand side.
pub(crate) struct System {
    kept: Kept,
}

/// Where a solve with contact starts: the end of one for the same motions and a body a little different.
pub(crate) struct Begin<'a> {
    /// Displacements of the rows.
    pub rows: &'a [[f64; 3]],
    pub contact: &'a ContactState,
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
    /// `positions`: coordinates of the rows; `tissue`: how extreme the tissue is. Errors name rows.
    pub fn new(
        matrix: BlockMatrix,
        positions: &[[f64; 3]],
        sliding: Option<&Sliding>,
        held: Held,
        tissue: Extremes,
        options: &StaticOptions,
        clock: &mut Clock,
        interrupted: Interrupt<'_>,
    ) -> Result<(Self, Method)> {
        let mut method = options.method.for_unknowns(3 * matrix.n_rows());
        let with = |kept: Kept| Self { kept };
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
        let iterative = Iterative::new(matrix, positions, sliding, tissue, method, options)?;
        clock.lap("preconditioner", true);
        Ok((with(Kept::Iterative(iterative)), method))
    }

    /// Bytes of the factor or preconditioner.
    pub fn bytes(&self) -> usize {
        match &self.kept {
            Kept::Direct { symbolic, contact, .. } => {
                symbolic.factor_bytes() + contact.as_ref().map_or(0, ContactFactor::bytes)
            }
            Kept::Refactored { symbolic, .. } => symbolic.factor_bytes(),
            Kept::Iterative(iterative) => iterative.bytes(),
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
                let x = in_pool(|| symbolic.solve(factor, b));
                effort.error_estimate = direct_error(factor, &x);
                Ok(x)
            }
            Kept::Refactored { symbolic, matrix } => {
                Ok(symbolic.solve(&symbolic.factor(matrix)?, b))
            }
            Kept::Iterative(iterative) => iterative.solve(b, scale, effort, interrupted),
        }
    }

    /// Displacements of the rows with contact settled, the contact, and the seconds that contact took.
    pub fn solve_with_contact(
        &self,
        b: &[[f64; 3]],
        sliding: &Sliding,
        motions: &[&Motion],
        begin: Option<Begin<'_>>,
        options: &StaticOptions,
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, ContactState, f64)> {
        let clock = Clock::new();
        let share = match options.contact.mode {
            ContactMode::Bilateral => STEP_SHARE,
            ContactMode::Unilateral => LIFTING_STEP_SHARE,
        };
        let (first, rows) = begin.map_or((None, &[][..]), |b| (Some(b.contact), b.rows));
        if let Kept::Direct { symbolic, factor, contact: Some(contact) } = &self.kept {
            // Each on a thread of the pool, so that loops inside begin without a hand-over; not all at once:
            // interrupts are of the calling thread.
            let mut answers = in_pool(|| contact.answers(symbolic, factor, b));
            let tolerance = sliding.gap_limit(&options.contact) / sliding.diagonal;
            let state = sliding.settle(motions, first, &options.contact, interrupted, |c| {
                in_pool(|| answers.respond(c, share, tolerance))
            })?;
            let seconds = clock.total();
            let x = in_pool(|| answers.displacements(&pushes(&state.normals, &state.forces)));
            let gap = state.largest_gap();
            effort.error_estimate = direct_error(factor, &x).max(GAP_SAFETY * gap);
            return Ok((x, state, seconds));
        }
        let mut trail = Trail::starting(rows.to_vec());
        let share = Some(share);
        let mut contact = options.contact;
        if let Kept::Iterative(_) = self.kept {
            let far = scale.max(sliding.farthest(motions));
            contact.allowed = contact.allowed.max(CONTACT_SHARE * options.tolerance * far);
        }
        let state = sliding.settle(motions, first, &contact, interrupted, |c| {
            self.solve_projected(b, sliding, c, scale, share, &mut trail, effort, interrupted)
        })?;
        Ok((trail.rows, state, clock.total()))
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
                let mut answers = contact.answers(symbolic, factor, b);
                let forces = frozen.forces(&mut answers, k)?;
                Ok(answers.displacements(&forces))
            };
            return columns.iter().enumerate().map(solve).collect();
        }
        let solve = |((b, offsets), &scale): ((&Vec<[f64; 3]>, &Vec<f64>), &f64)| {
            if interrupted() {
                return Err(MtmError::Interrupted);
            }
            let c = Constraints { rows: frozen.rows, offsets, springs: &[] };
            let (mut trail, effort) = (Trail::default(), &mut effort);
            self.solve_projected(b, sliding, &c, scale, None, &mut trail, effort, interrupted)?;
            Ok(trail.rows)
        };
        columns.iter().zip(frozen.offsets).zip(scales).map(solve).collect()
    }

    /// One constrained solve on the projected system, P A P + k (I − P), P = I − n⊗n on held nodes; its
    /// rows are left in `trail`.
    ///
    /// `share`: see [`Iterative::solve_projected`].
    fn solve_projected(
        &self,
        b: &[[f64; 3]],
        sliding: &Sliding,
        c: &Constraints<'_>,
        scale: f64,
        share: Option<f64>,
        trail: &mut Trail,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Response> {
        let row = |node: usize| sliding.nodes()[node].row as usize;
        let asked: Vec<Constraint> = c
            .rows
            .iter()
            .zip(c.offsets)
            .map(|(r, &offset)| Constraint { row: row(r.node), normal: r.normal, offset })
            .collect();
        let constraints = orthonormal(&asked);
        let springs: Vec<(usize, Spring)> = c.springs.iter().map(|&s| (row(s.node), s)).collect();
        let pushed = |matrix: &BlockMatrix| {
            let mut rhs = projected_rhs(matrix, b, &constraints);
            for (row, s) in &springs {
                rhs[*row] = add(rhs[*row], scaled(s.axis, s.stiffness * s.goal));
            }
            rhs
        };
        let (matrix, (mut x, solved)) = match &self.kept {
            Kept::Iterative(iterative) => {
                let matrix = iterative.matrix();
                let found = iterative.solve_projected(
                    &pushed(matrix),
                    &constraints,
                    &springs,
                    scale,
                    share,
                    trail,
                    effort,
                    interrupted,
                )?;
                (matrix, found)
            }
            Kept::Refactored { symbolic, matrix } => {
                let mut system = projected(matrix, &constraints);
                for (row, s) in &springs {
                    system.add_to_diagonal(*row, s.axis, s.stiffness);
                }
                let factor = symbolic.factor(&system)?;
                let x = symbolic.solve(&factor, &pushed(matrix));
                effort.error_estimate = direct_error(&factor, &x);
                (matrix, (x, true))
            }
            Kept::Direct { .. } => unreachable!("the factor without contact serves there"),
        };
        add_offsets(&mut x, &constraints);
        let forces = along_normals(&asked, |row| sub(matrix.row_product(row, &x), b[row]));
        let displacements = sliding.nodes().iter().map(|n| x[n.row as usize]).collect();
        trail.rows = x;
        Ok(Response { displacements, forces, solved })
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
