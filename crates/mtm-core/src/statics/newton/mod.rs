//! Equilibrium of a body that rotates and stretches: Newton's method on its energy, with a line search.
//!
//! Each step solves with the exact tangent or, if that is not positive definite, with a tangent from which the
//! negative curvature at each integration point has been removed, so that every step goes downhill. Sliding
//! constraints n·u = g are enforced by projection, as in the linear system.

mod conditions;
mod descent;
mod hierarchy;
mod local;
mod sliding;
mod tangents;

use std::cell::RefCell;
use std::sync::{Arc, OnceLock};

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::cholesky::Symbolic;
use crate::algebra::multigrid::Multigrid;
use crate::contact::{Body, Constraints, ContactResult, Response, Sliding};
use crate::error::{ErrorKind, MtmError, Result, Shortfall};
use crate::mechanics::strain_energy::{LAG, PointTangents, StrainEnergy};
use crate::mechanics::tensors::MassTensors;
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::iterative::Extremes;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::newton::hierarchy::SharedHierarchy;
use crate::statics::options::{Method, StaticOptions};
use crate::statics::reduction::{ReducedPattern, Reduction};
use crate::statics::solution::{Clock, SolvedRows};
use crate::vector::{add, between, dot, norm, scaled, sub};

pub(crate) use sliding::SlidingBody;

/// Newton steps after which a share of the plan counts as too large.
const MAX_STEPS: usize = 40;
/// Smallest share of the plan that is tried.
const LEAST_SHARE: f64 = 1.0 / 64.0;
/// Error that conjugate gradients may leave in a step, relative to the tolerance of the solution.
const STEP_TOLERANCE: f64 = 0.1;
/// The same relative to the length of the previous step, whose own error is larger until the last steps (Dembo,
/// Eisenstat & Steihaug 1982).
const STEP_SHARE: f64 = 1e-3;

/// Ratio of moduli above which stiff parts that turn on soft ones make single steps short far from the solution:
/// on a bar with bands of 1e6 times the modulus, a step of 0.02 mm was followed by one of 0.14 mm.
const STIFF_PARTS: f64 = 500.0;

/// How tangent systems are solved.
enum TangentSolver {
    Cholesky(Arc<Symbolic>),
    Pcg,
}

/// A body with its unknowns, ready for any state of its boundary.
pub(crate) struct Equilibrium {
    energy: StrainEnergy,
    /// The same without that by which tissue resists being squeezed flat: Newton's method reaches its equilibrium
    /// first, because far from it tets pass through inverted states, where that energy makes steps short.
    yielding: StrainEnergy,
    tensors: Arc<MassTensors>,
    reduction: Arc<Reduction>,
    /// Where the rows are in the tangent, once there was one.
    pattern: OnceLock<ReducedPattern>,
    solver: TangentSolver,
    options: StaticOptions,
    tissue: Extremes,
    /// The hierarchy of the tangent at rest, once a plan has needed it: every plan starts there.
    at_rest: OnceLock<Arc<Multigrid>>,
}

/// A body under large deformation that follows contact conditions, reaching equilibrium under each set.
struct Followed<'a, 'i> {
    equilibrium: &'a Equilibrium,
    target: Target<'a>,
    sliding: &'a Sliding,
    u: Vec<[f64; 3]>,
    /// Displacements before the last step.
    before: Vec<[f64; 3]>,
    solve: &'a mut PlanSolve<'i>,
}

impl Body for Followed<'_, '_> {
    fn respond(&mut self, c: &Constraints<'_>) -> Result<Response> {
        self.target.conditions = RowConditions::new(self.sliding, c);
        let u = self.equilibrium.arrive(self.u.clone(), &mut self.target, self.solve)?;
        let forces = self.equilibrium.forces(&u)?;
        let loads = self.target.loads;
        let reaction = |j: u32| {
            let f = forces[j as usize];
            loads.map_or(f, |l| sub(f, l[j as usize]))
        };
        let nodes = &self.sliding.nodes;
        let displacements = nodes.iter().map(|n| u[n.node as usize]).collect();
        let reactions = nodes.iter().map(|n| reaction(n.node)).collect();
        self.before = std::mem::replace(&mut self.u, u);
        Ok(Response { displacements, reactions, slopes: None, solved: true, is_carried: false })
    }

    fn shorten(&mut self, share: f64) {
        self.u = between(&self.before, &self.u, share);
    }

    fn restart(&mut self) {}
}

/// The conditions at the boundary.
struct Target<'a> {
    energy: &'a StrainEnergy,
    /// Displacement of every node; those of unknowns are not read.
    prescribed: &'a [[f64; 3]],
    /// Forces on every node, N.
    loads: Option<&'a [[f64; 3]]>,
    conditions: RowConditions,
    /// Reference length of the tolerance, mm.
    scale: f64,
    /// The hierarchy that the steps towards it share.
    hierarchy: &'a SharedHierarchy,
    /// The tangents that they share.
    tangents: &'a RefCell<PointTangents>,
}

/// A state, with the data from which the next step starts.
struct Iterate {
    u: Vec<[f64; 3]>,
    /// Energy minus the work of loads, with springs, N mm.
    merit: f64,
    /// Sum of the absolute values of its parts.
    size: f64,
    /// Its derivative with respect to each row.
    slope: Vec<[f64; 3]>,
}

impl Equilibrium {
    /// The body of `tensors` with the unknowns of `reduction`, and the method used.
    ///
    /// `matrix`: the reduced stiffness at rest. Errors refer to rows.
    pub fn new(
        tensors: Arc<MassTensors>,
        reduction: Arc<Reduction>,
        matrix: &BlockMatrix,
        options: &StaticOptions,
        clock: &mut Clock,
    ) -> Result<(Self, Method)> {
        let method = match options.method {
            sweeps @ Method::Relaxation => {
                let (found, needed) = (("method", sweeps.name()), "auto, cholesky or pcg");
                return Err(ErrorKind::Solver.not_together(found, "large deformation", needed));
            }
            method @ (Method::Auto | Method::Cholesky | Method::Pcg) => {
                method.for_unknowns(3 * matrix.n_rows())
            }
        };
        let solver = if method.has_factor() {
            let symbolic = Symbolic::new(matrix, &[])?;
            if let Some(limit) = options.memory_limit
                && symbolic.factor_bytes() > limit
            {
                let (needed, advice) = (symbolic.factor_bytes(), "use method=\"pcg\"");
                let what = "the Cholesky factor";
                return Err(MtmError::out_of_memory(what, needed, Some(limit), advice));
            }
            TangentSolver::Cholesky(Arc::new(symbolic))
        } else {
            TangentSolver::Pcg
        };
        clock.lap("ordering", method.has_factor());
        let energy = StrainEnergy::new(tensors.clone(), options.kinematics);
        let tissue = Extremes::of(tensors.tissue());
        let made = Self {
            yielding: energy.without_barrier(),
            energy,
            tensors,
            reduction,
            pattern: OnceLock::new(),
            solver,
            options: *options,
            tissue,
            at_rest: OnceLock::new(),
        };
        Ok((made, method))
    }

    /// Bytes of a factorisation, or of the hierarchy at rest once there is one.
    pub fn bytes(&self) -> usize {
        match &self.solver {
            TangentSolver::Cholesky(symbolic) => symbolic.factor_bytes(),
            TangentSolver::Pcg => self.at_rest.get().map_or(0, |m| m.memory_bytes()),
        }
    }

    /// Internal forces under displacements of all nodes, N.
    pub fn forces(&self, u: &[[f64; 3]]) -> Result<Vec<[f64; 3]>> {
        Ok(self.energy.state(u)?.forces)
    }

    /// Displacements of the unknown rows at contact equilibrium.
    pub fn solve(
        &self,
        prescribed: &[[f64; 3]],
        loads: Option<&[[f64; 3]]>,
        slide: Option<&SlidingBody<'_>>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        // Stiff parts that turn on soft ones move by more than their own change of shape shows.
        let lag = if self.tissue.contrast > STIFF_PARTS { 0.0 } else { LAG };
        let tangents = RefCell::new(self.energy.begin(lag));
        let solved = self.solve_with(&tangents, (prescribed, loads), slide, solve);
        self.energy.end(tangents.into_inner());
        solved
    }

    /// [`solve`](Self::solve) with the tangents of its own.
    fn solve_with(
        &self,
        tangents: &RefCell<PointTangents>,
        (prescribed, loads): (&[[f64; 3]], Option<&[[f64; 3]]>),
        slide: Option<&SlidingBody<'_>>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<SolvedRows> {
        let clock = Clock::new();
        let scale = solve.scale;
        let shared = SharedHierarchy::starting(&self.at_rest);
        let hierarchy = &shared;
        let energy = &self.yielding;
        let conditions = RowConditions::default;
        let mut target = Target {
            energy,
            prescribed,
            loads,
            conditions: conditions(),
            scale,
            hierarchy,
            tangents,
        };
        let u = vec![[0.0; 3]; prescribed.len()];
        let settled = |u: &[[f64; 3]], contact: Option<ContactResult>| {
            let seconds = if contact.is_some() { clock.total() } else { 0.0 };
            SolvedRows::new(self.reduction.rows(u), contact, seconds)
        };
        let Some(slide) = slide else {
            let u = self.arrive(u, &mut target, solve)?;
            return Ok(settled(&u, None));
        };
        match self.slide(&target, slide, solve) {
            Ok((u, state)) => return Ok(settled(&u, Some(state))),
            // Too large a step: the plan is applied in shares, for every set of normals.
            Err(
                MtmError::NotConverged { .. }
                | MtmError::NotPositiveDefinite { .. }
                | MtmError::ContactNotConverged { .. },
            ) => {}
            Err(error) => return Err(error),
        }
        let SlidingBody { sliding, motions, .. } = slide;
        tangents.borrow_mut().forget();
        // Other constraints than those at rest.
        let own = SharedHierarchy::default();
        let target = Target { hierarchy: &own, conditions: conditions(), ..target };
        let (before, interrupted) = (u.clone(), solve.interrupted);
        let mut body = Followed { equilibrium: self, target, sliding, before, u, solve };
        let state = sliding.solve(motions, None, &self.options.contact, interrupted, &mut body)?;
        Ok(settled(&body.u, Some(state)))
    }

    /// The state of `target`, reached from the state `u`: first without the energy by which tissue resists being
    /// squeezed flat, then with it.
    fn arrive<'a>(
        &'a self,
        u: Vec<[f64; 3]>,
        target: &mut Target<'a>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        if !self.has_barrier_ahead(target) {
            target.energy = &self.yielding;
            target.tangents.borrow_mut().forget();
        }
        let u = self.follow(u, target, solve)?;
        if !self.energy.is_at_barrier(&u) {
            return Ok(u);
        }
        target.energy = &self.energy;
        target.tangents.borrow_mut().forget();
        self.resist(u, target, solve)
    }

    /// Whether the energy of `target` is still the one without the barrier.
    fn has_barrier_ahead(&self, target: &Target<'_>) -> bool {
        std::ptr::eq(target.energy, &self.yielding)
    }

    /// The state of `target`, reached from the state `u`: in one step, or in several if Newton's method does
    /// not converge.
    fn follow(
        &self,
        u: Vec<[f64; 3]>,
        target: &Target<'_>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let (mut here, mut done, mut share) = (u, 0.0, 1.0_f64);
        while done < 1.0 {
            // Share of the remaining motion.
            let part = (share / (1.0 - done)).min(1.0);
            match self.advance(&here, target, part, solve) {
                Ok(next) => {
                    here = next;
                    done = if part == 1.0 { 1.0 } else { done + share };
                }
                Err(MtmError::NotConverged { .. } | MtmError::NotPositiveDefinite { .. })
                    if share > LEAST_SHARE =>
                {
                    share *= 0.5;
                }
                Err(error) => return Err(error),
            }
        }
        Ok(here)
    }

    /// Error allowed in the next step from `pose`, mm, after a step of `length`; 0 for a factorisation.
    fn allowed(&self, pose: &Iterate, target: &Target<'_>, length: f64) -> f64 {
        if matches!(self.solver, TangentSolver::Cholesky(_)) {
            return 0.0;
        }
        let reach = reach(pose, target);
        let least = STEP_TOLERANCE * self.options.tolerance * reach;
        (STEP_SHARE * length.min(reach)).max(least)
    }

    /// Merit and slope at displacements `u`.
    fn pose(&self, u: Vec<[f64; 3]>, target: &Target<'_>) -> Result<Iterate> {
        let state = target.energy.state(&u)?;
        let mut slope = self.reduction.rows(&state.forces);
        let (mut merit, mut size) = (state.energy, state.energy.abs());
        if let Some(loads) = target.loads {
            for (s, &j) in slope.iter_mut().zip(&self.reduction.unknowns) {
                *s = sub(*s, loads[j as usize]);
                let work = dot(loads[j as usize], u[j as usize]);
                merit -= work;
                size += work.abs();
            }
        }
        let place = |row: usize| u[self.reduction.unknowns[row] as usize];
        target.conditions.add_stretch(&mut merit, &mut slope, place);
        if !merit.is_finite() {
            let limit = self.options.tolerance * target.scale;
            return Err(lost("the estimated error of a node", f64::INFINITY, limit, " mm"));
        }
        Ok(Iterate { u, merit, size, slope })
    }
}

/// The error for a `quantity` that Newton's method did not bring to `limit`.
fn lost(quantity: &'static str, value: f64, limit: f64, unit: &'static str) -> MtmError {
    MtmError::NotConverged {
        method: "newton",
        iterations: MAX_STEPS,
        shortfall: Shortfall { quantity, value, limit, unit },
        advice: "divide the plan into smaller moves, fix flat tets, or use kinematics=\"linear\"",
    }
}

/// Slope of the merit along `rows`.
fn along_slope(rows: &[[f64; 3]], pose: &Iterate) -> f64 {
    rows.iter().zip(&pose.slope).map(|(&d, &s)| dot(d, s)).sum()
}

/// Reference length of the tolerance, mm.
fn reach(pose: &Iterate, target: &Target<'_>) -> f64 {
    pose.u.iter().fold(target.scale, |m, v| m.max(norm(*v)))
}

/// `u` with the unknowns moved by `share` of `step`.
fn moved_by(reduction: &Reduction, u: &[[f64; 3]], step: &[[f64; 3]], share: f64) -> Vec<[f64; 3]> {
    let mut out = u.to_vec();
    for (&j, d) in reduction.unknowns.iter().zip(step) {
        out[j as usize] = add(out[j as usize], scaled(*d, share));
    }
    out
}
