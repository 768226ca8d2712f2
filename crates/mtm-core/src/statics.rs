//! `StaticSolver`: eliminates prescribed nodes, chooses a method, runs the contact loop, and keeps all
//! that a new plan does not change.

use std::sync::Arc;
use std::time::Instant;

use crate::blocks::{Block, BlockMatrix};
use crate::boundary::{Boundary, Motion, NodeKind, Plan};
use crate::cholesky::{DenseSymmetric, Factor, Symbolic, TailFactor};
use crate::contact::{Constraints, ContactOptions, ContactState, Response, Sliding};
use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};
use crate::krylov::{PcgOptions, pcg};
use crate::mesh::{dot, norm, scaled, sub};
use crate::multigrid::{Multigrid, MultigridOptions};
use crate::relaxation::{RelaxationOptions, relax};
use crate::restraint::{self, Held};
use crate::solution::{ContactResult, Solution, Timings};
use crate::tensors::MassTensors;

/// Row of a node that is no unknown.
pub(crate) const NO_ROW: u32 = u32::MAX;
/// Above this many unknowns `Method::Auto` takes conjugate gradients: a factor grows like n^1.4.
const AUTO_DIRECT_UNKNOWNS: usize = 300_000;
/// Most sliding nodes whose dense flexibility is kept (three unknowns each, 8 bytes, twice).
const MAX_DENSE_SLIDING: usize = 2500;
/// Over-relaxation of the node-wise iteration.
const RELAXATION_FACTOR: f64 = 1.6;

/// Asked now and then whether to stop.
pub type Interrupt<'a> = &'a (dyn Fn() -> bool + Sync);

/// How the linear system is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Method {
    /// By size and memory: Cholesky up to about 300 000 unknowns, else conjugate gradients.
    Auto,
    /// Sparse Cholesky factor, kept for new plans.
    Cholesky,
    /// Conjugate gradients with multigrid, stopped by an error bound.
    Pcg,
    /// The node-wise iteration of the literature.
    Relaxation,
}

/// Names of the methods.
pub const METHODS: &str = "auto, cholesky, pcg, relaxation";

/// Options of a solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaticOptions {
    /// How the linear system is solved.
    pub method: Method,
    /// Error bound of the iterative methods over the largest prescribed displacement.
    pub tolerance: f64,
    /// Most iterations of the iterative methods; their own default if `None`.
    pub max_iterations: Option<usize>,
    /// The contact loop.
    pub contact: ContactOptions,
    /// Memory that a factor may take, bytes; without limit if `None`.
    pub memory_limit: Option<usize>,
}

impl Default for StaticOptions {
    fn default() -> Self {
        Self {
            method: Method::Auto,
            tolerance: 1e-9,
            max_iterations: None,
            contact: ContactOptions::default(),
            memory_limit: None,
        }
    }
}

impl Method {
    /// The method called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "auto" => Ok(Self::Auto),
            "cholesky" => Ok(Self::Cholesky),
            "pcg" => Ok(Self::Pcg),
            "relaxation" => Ok(Self::Relaxation),
            _ => Err(MtmError::UnknownName {
                what: "method",
                found: name.to_owned(),
                known: METHODS,
                kind: ErrorKind::Solver,
            }),
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cholesky => "cholesky",
            Self::Pcg => "pcg",
            Self::Relaxation => "relaxation",
        }
    }
}

impl StaticOptions {
    fn check(&self) -> Result<()> {
        let positive = |what: &str, value: f64| {
            if value.is_finite() && value > 0.0 && value < 1.0 {
                return Ok(());
            }
            Err(MtmError::OutOfRange {
                what: what.into(),
                index: 0,
                value,
                allowed: "above 0 and below 1 (relative)",
                kind: ErrorKind::Solver,
            })
        };
        positive("tolerance", self.tolerance)?;
        positive("contact_tolerance", self.contact.tolerance)?;
        let counts = [
            ("max_iterations", self.max_iterations),
            ("contact_iterations", Some(self.contact.max_iterations)),
        ];
        for (what, value) in counts {
            if value == Some(0) {
                return Err(MtmError::OutOfRange {
                    what: what.into(),
                    index: 0,
                    value: 0.0,
                    allowed: "1 or more",
                    kind: ErrorKind::Solver,
                });
            }
        }
        Ok(())
    }
}

/// What is kept from one plan to the next.
pub(crate) enum System {
    /// The factor, and with sliding nodes its dense end.
    Direct { symbolic: Symbolic, factor: Factor, tail: Option<TailFactor> },
    /// The structure of the factor: the values change with the contact normals.
    Refactored { symbolic: Symbolic },
    /// The preconditioner.
    Pcg { multigrid: Box<Multigrid> },
    /// Nothing.
    Relaxation,
}

/// A patient's tensors and node kinds, ready for any plan.
pub struct StaticSolver {
    pub(crate) tensors: Arc<MassTensors>,
    pub(crate) boundary: Arc<Boundary>,
    options: StaticOptions,
    method: Method,
    /// Node of each row of the system.
    pub(crate) unknowns: Vec<u32>,
    pub(crate) row_of: Vec<u32>,
    /// The system, where a method needs it after set-up.
    matrix: Option<BlockMatrix>,
    pub(crate) sliding: Option<Sliding>,
    pub(crate) system: System,
    /// Coupling of unknown rows with joined nodes: (row, node, tensor).
    couplings: Vec<(u32, u32, Block)>,
    timings: Timings,
}

/// Held nodes, the normal of every sliding node, and its offset for each right-hand side.
type FrozenContact<'a> = (&'a [usize], &'a [[f64; 3]], &'a [Vec<f64>]);

/// Solution of the unknown rows for one right-hand side, with contact settled.
struct Unknowns {
    displacements: Vec<[f64; 3]>,
    contact: Option<ContactState>,
    error_bound: f64,
    iterations: usize,
    history: Vec<f64>,
    contact_seconds: f64,
}

/// Counters of the iterative solves of one plan.
#[derive(Default)]
struct Effort {
    error_bound: f64,
    iterations: usize,
    history: Vec<f64>,
}

impl StaticSolver {
    /// The solver of `tensors` under `boundary`.
    ///
    /// # Errors
    /// Options out of range, node indices out of range, a body that is not held (with its free rigid
    /// modes), an inverted contact surface, a factor that fails or does not fit in memory.
    pub fn new(
        tensors: Arc<MassTensors>,
        boundary: Arc<Boundary>,
        options: StaticOptions,
        interrupted: Interrupt<'_>,
    ) -> Result<Self> {
        options.check()?;
        let mut clock = Clock::new();
        let mesh = tensors.mesh().clone();
        let kinds = boundary.kinds(mesh.n_nodes())?;
        let is_unknown = |k: &NodeKind| matches!(k, NodeKind::Free | NodeKind::Sliding(_));
        let mut row_of = vec![NO_ROW; kinds.len()];
        let mut unknowns = Vec::new();
        for (j, kind) in kinds.iter().enumerate() {
            if is_unknown(kind) {
                row_of[j] = unknowns.len() as u32;
                unknowns.push(j as u32);
            }
        }
        let sliding = Sliding::new(&boundary, &mesh, &row_of, options.contact.mode)?;
        clock.lap("contact_setup", sliding.is_some());
        let normals: Vec<(u32, [f64; 3])> = sliding.iter().flat_map(slid).collect();
        let held = restraint::check(&mesh, |j| !is_unknown(&kinds[j]), &normals)?;
        clock.lap("restraint", true);

        let couplings = couplings(tensors.matrix(), &unknowns, &kinds);
        let matrix = submatrix(tensors.matrix(), &unknowns, &row_of);
        clock.lap("reduce", true);
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        let method = match options.method {
            Method::Auto if 3 * unknowns.len() > AUTO_DIRECT_UNKNOWNS => Method::Pcg,
            Method::Auto => Method::Cholesky,
            named => named,
        };
        let mut solver = Self {
            tensors,
            boundary,
            options,
            method,
            unknowns,
            row_of,
            matrix: None,
            sliding,
            system: System::Relaxation,
            couplings,
            timings: Vec::new(),
        };
        solver.prepare(matrix, held, &mut clock, interrupted)?;
        solver.timings = clock.laps;
        Ok(solver)
    }

    /// Builds what the method keeps.
    fn prepare(
        &mut self,
        matrix: BlockMatrix,
        held: Held,
        clock: &mut Clock,
        interrupted: Interrupt<'_>,
    ) -> Result<()> {
        if self.method == Method::Cholesky {
            let slide_rows: Vec<u32> =
                self.sliding.iter().flat_map(|s| s.nodes().iter().map(|n| n.row)).collect();
            let dense = !slide_rows.is_empty()
                && held == Held::ByPrescribed
                && slide_rows.len() <= MAX_DENSE_SLIDING;
            let symbolic = Symbolic::new(&matrix, if dense { &slide_rows } else { &[] })?;
            clock.lap("ordering", true);
            let fits = |limit: usize| symbolic.factor_bytes() <= limit;
            if !self.options.memory_limit.is_none_or(fits) {
                if self.options.method == Method::Auto {
                    self.method = Method::Pcg;
                } else {
                    return Err(MtmError::OutOfMemory {
                        what: "the Cholesky factor",
                        needed_mb: symbolic.factor_bytes() >> 20,
                        limit_mb: self.options.memory_limit.unwrap_or(0) >> 20,
                        advice: "use method=\"pcg\" or \"auto\"",
                    });
                }
            } else if interrupted() {
                return Err(MtmError::Interrupted);
            } else if self.sliding.is_some() && !dense {
                self.system = System::Refactored { symbolic };
                self.matrix = Some(matrix);
                return Ok(());
            } else {
                let factor = symbolic.factor(&matrix).map_err(|e| self.by_node(e))?;
                clock.lap("factor", true);
                let tail = dense.then(|| symbolic.tail_flexibility(&factor));
                clock.lap("contact_factor", dense);
                self.system = System::Direct { symbolic, factor, tail };
                return Ok(());
            }
        }
        if self.method == Method::Pcg && !self.unknowns.is_empty() {
            let normals: Vec<(usize, [f64; 3])> = self
                .sliding
                .iter()
                .flat_map(slid)
                .map(|(node, n)| (self.row_of[node as usize] as usize, n))
                .collect();
            let constraints: Vec<(usize, [f64; 3], f64)> =
                normals.iter().map(|&(row, n)| (row, n, 0.0)).collect();
            let nodes: Vec<[f64; 3]> =
                self.unknowns.iter().map(|&j| self.tensors.mesh().nodes()[j as usize]).collect();
            let projected = (!constraints.is_empty()).then(|| projected(&matrix, &constraints));
            let multigrid = Multigrid::new(
                projected.as_ref().unwrap_or(&matrix),
                &nodes,
                &normals,
                &MultigridOptions::default(),
            )
            .map_err(|e| self.by_node(e))?;
            self.system = System::Pcg { multigrid: Box::new(multigrid) };
            clock.lap("preconditioner", true);
        }
        self.matrix = Some(matrix);
        Ok(())
    }

    /// The method used: never `Auto`.
    pub fn method(&self) -> Method {
        self.method
    }

    /// The tensors.
    pub fn tensors(&self) -> &Arc<MassTensors> {
        &self.tensors
    }

    /// The boundary.
    pub fn boundary(&self) -> &Arc<Boundary> {
        &self.boundary
    }

    /// Number of unknowns, three per free or sliding node.
    pub fn n_unknowns(&self) -> usize {
        3 * self.unknowns.len()
    }

    /// Bytes that the factor takes (0 without one).
    pub fn factor_bytes(&self) -> usize {
        match &self.system {
            System::Direct { symbolic, tail, .. } => {
                symbolic.factor_bytes() + tail.as_ref().map_or(0, TailFactor::bytes)
            }
            System::Refactored { symbolic } => symbolic.factor_bytes(),
            System::Pcg { multigrid } => multigrid.memory_bytes(),
            System::Relaxation => 0,
        }
    }

    /// Seconds by stage of the set-up.
    pub fn timings(&self) -> &Timings {
        &self.timings
    }

    /// Displacements under `plan` and nodal `loads` (N, one row per node).
    ///
    /// Depends on its arguments alone: nothing is left over from earlier plans.
    ///
    /// # Errors
    /// A plan or loads that do not fit, contact that does not settle, an iteration that does not
    /// converge, interruption.
    pub fn solve(
        &self,
        plan: &Plan,
        loads: Option<&[[f64; 3]]>,
        interrupted: Interrupt<'_>,
    ) -> Result<Solution> {
        let mut clock = Clock::new();
        let n = self.tensors.mesh().n_nodes();
        if let Some(rows) = loads {
            if rows.len() != n {
                return Err(MtmError::Length {
                    what: "loads".into(),
                    found: rows.len(),
                    expected: n,
                    why: "one row per node",
                    kind: ErrorKind::Boundary,
                });
            }
            check_finite_rows("loads", rows, ErrorKind::Boundary)?;
        }
        let motions = self.boundary.motions(plan)?;
        let mut u = self.prescribed(&motions)?;
        let scale = u.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
        let mut b = self.coupled(&u);
        if let Some(rows) = loads {
            for (b, &j) in b.iter_mut().zip(&self.unknowns) {
                *b = [0, 1, 2].map(|i| b[i] + rows[j as usize][i]);
            }
        }
        clock.lap("plan", true);

        let found = self.solve_unknowns(&b, &motions, scale, interrupted)?;
        clock.lap("solve", true);
        for (&j, v) in self.unknowns.iter().zip(&found.displacements) {
            u[j as usize] = *v;
        }
        let forces = self.tensors.matrix().multiply(&u);
        let residual = self.residual(&forces, loads, found.contact.as_ref(), &b);
        if !residual.is_finite() {
            return Err(MtmError::NotPositiveDefinite {
                node: 0,
                detail: "the solution is not finite; the plan or the moduli overflow f64".into(),
            });
        }
        clock.lap("forces", true);

        let contact_seconds = found.contact_seconds;
        let mut timings: Timings = self.timings.clone();
        timings.extend(clock.laps.iter().map(|&(stage, seconds)| {
            (stage, if stage == "solve" { seconds - contact_seconds } else { seconds })
        }));
        timings.push(("contact", contact_seconds));
        timings.push(("total", clock.total()));
        let contact_iterations = found.contact.as_ref().map_or(0, |c| c.iterations);
        Ok(Solution {
            displacements: u,
            forces,
            residual,
            error_bound: found.error_bound,
            iterations: found.iterations,
            residual_history: found.history,
            contact: self.contact_result(found.contact),
            contact_iterations,
            timings,
        })
    }

    /// Displacements of all nodes with the prescribed ones filled in, mm.
    fn prescribed(&self, motions: &[&Motion]) -> Result<Vec<[f64; 3]>> {
        let nodes = self.tensors.mesh().nodes();
        let mut u = vec![[0.0; 3]; nodes.len()];
        for (s, motion) in motions.iter().enumerate() {
            for (j, v) in self.boundary.joined_displacements(s, motion, nodes)? {
                u[j as usize] = v;
            }
        }
        Ok(u)
    }

    /// Forces −K_UB u_B that prescribed nodes bring to the unknown rows, N.
    pub(crate) fn coupled(&self, u: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut b = vec![[0.0; 3]; self.unknowns.len()];
        for (row, node, k) in &self.couplings {
            let v = u[*node as usize];
            let out = &mut b[*row as usize];
            for i in 0..3 {
                out[i] -= k[3 * i] * v[0] + k[3 * i + 1] * v[1] + k[3 * i + 2] * v[2];
            }
        }
        b
    }

    fn solve_unknowns(
        &self,
        b: &[[f64; 3]],
        motions: &[&Motion],
        scale: f64,
        interrupted: Interrupt<'_>,
    ) -> Result<Unknowns> {
        let mut effort = Effort::default();
        let Some(sliding) = &self.sliding else {
            let displacements = match &self.system {
                System::Direct { symbolic, factor, .. } => symbolic.solve(factor, b),
                _ => self.iterate(self.matrix(), b, scale, &mut effort, interrupted)?,
            };
            return Ok(Unknowns {
                displacements,
                contact: None,
                error_bound: effort.error_bound,
                iterations: effort.iterations,
                history: effort.history,
                contact_seconds: 0.0,
            });
        };
        let clock = Clock::new();
        let options = &self.options.contact;
        let (displacements, state, contact_seconds) =
            if let System::Direct { symbolic, factor, tail: Some(tail) } = &self.system {
                let mut x = symbolic.permuted(b);
                symbolic.forward(factor, &mut x, 1);
                let free = tail.free_displacements(&x);
                let state = sliding
                    .settle(motions, options, interrupted, |c| self.respond(tail, &free, c))?;
                let forces: Vec<[f64; 3]> =
                    state.normals.iter().zip(&state.forces).map(|(&n, &f)| scaled(n, f)).collect();
                tail.add_forces(&mut x, &forces);
                let seconds = clock.total();
                symbolic.backward(factor, &mut x, 1);
                (symbolic.unpermuted(&x), state, seconds)
            } else {
                let mut last = Vec::new();
                let state = sliding.settle(motions, options, interrupted, |c| {
                    let (u, response) =
                        self.solve_projected(b, c, scale, &mut effort, interrupted)?;
                    last = u;
                    Ok(response)
                })?;
                (last, state, clock.total())
            };
        Ok(Unknowns {
            displacements,
            contact: Some(state),
            error_bound: effort.error_bound,
            iterations: effort.iterations,
            history: effort.history,
            contact_seconds,
        })
    }

    /// Contact forces λ from (Nᵀ S⁻¹ N) λ = g − Nᵀ u_free, and the displacements of the sliding nodes.
    pub(crate) fn respond(
        &self,
        tail: &TailFactor,
        free: &[[f64; 3]],
        c: &Constraints<'_>,
    ) -> Result<Response> {
        let mut forces: Vec<f64> =
            c.active.iter().map(|&i| c.offsets[i] - dot(c.normals[i], free[i])).collect();
        let dense: DenseSymmetric = tail.normal_flexibility(c.active, c.normals);
        dense.solve(&mut forces).map_err(|at| MtmError::NotPositiveDefinite {
            node: self.sliding.as_ref().map_or(0, |s| s.nodes()[c.active[at]].node as usize),
            detail: "the flexibility of the sliding nodes is singular".into(),
        })?;
        let mut pushes = vec![[0.0; 3]; free.len()];
        for (&i, &force) in c.active.iter().zip(&forces) {
            pushes[i] = scaled(c.normals[i], force);
        }
        let displacements = tail
            .respond(&pushes)
            .iter()
            .zip(free)
            .map(|(r, f)| [0, 1, 2].map(|i| r[i] + f[i]))
            .collect();
        Ok(Response { displacements, forces })
    }

    /// One constrained solve on the projected system P A P + k (I − P), P = I − n⊗n on held nodes.
    fn solve_projected(
        &self,
        b: &[[f64; 3]],
        c: &Constraints<'_>,
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, Response)> {
        let nodes = self.sliding.as_ref().map_or(&[][..], Sliding::nodes);
        let constraints: Vec<(usize, [f64; 3], f64)> =
            c.active.iter().map(|&i| (nodes[i].row as usize, c.normals[i], c.offsets[i])).collect();
        let matrix = self.matrix();
        let system = projected(matrix, &constraints);
        let rhs = projected_rhs(matrix, b, &constraints);
        let mut x = match &self.system {
            System::Refactored { symbolic } => {
                let factor = symbolic.factor(&system).map_err(|e| self.by_node(e))?;
                symbolic.solve(&factor, &rhs)
            }
            _ => {
                let reach = constraints.iter().fold(scale, |m, (_, _, g)| m.max(g.abs()));
                self.iterate(&system, &rhs, reach, effort, interrupted)?
            }
        };
        add_offsets(&mut x, &constraints);
        let forces = constraints
            .iter()
            .map(|&(row, n, _)| dot(n, sub(matrix.row_product(row, &x), b[row])))
            .collect();
        let displacements = nodes.iter().map(|n| x[n.row as usize]).collect();
        Ok((x, Response { displacements, forces }))
    }

    /// Solves with the iterative method, to an error bound of `tolerance × scale`.
    fn iterate(
        &self,
        matrix: &BlockMatrix,
        b: &[[f64; 3]],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        if b.iter().flatten().all(|&v| v == 0.0) {
            return Ok(vec![[0.0; 3]; b.len()]);
        }
        let start = vec![[0.0; 3]; b.len()];
        // Loads without prescribed motion have no length of their own: the mesh lends its size.
        let scale = if scale > 0.0 { scale } else { 1e-3 * self.tensors.mesh().diagonal() };
        let tolerance = self.options.tolerance * scale;
        if let System::Pcg { multigrid } = &self.system {
            let defaults = PcgOptions::default();
            let options = PcgOptions {
                tolerance,
                max_iterations: self.options.max_iterations.unwrap_or(defaults.max_iterations),
                ..defaults
            };
            let found = pcg(matrix, b, &start, multigrid.as_ref(), &options, interrupted)
                .map_err(|e| self.by_node(e))?;
            effort.error_bound = found.error_bound_mm;
            effort.iterations += found.iterations;
            effort.history.extend(found.residual_history);
            return Ok(found.solution);
        }
        let options = RelaxationOptions {
            tolerance,
            factor: RELAXATION_FACTOR,
            max_sweeps: self.options.max_iterations.unwrap_or(200_000),
        };
        let found = relax(matrix, b, &start, &options, interrupted).map_err(|e| self.by_node(e))?;
        effort.error_bound = found.error_bound;
        effort.iterations += found.sweeps;
        effort.history.extend(found.steps);
        Ok(found.solution)
    }

    pub(crate) fn matrix(&self) -> &BlockMatrix {
        self.matrix.as_ref().expect("kept by every system but the direct one, which never asks")
    }

    /// Force out of balance at the unknown nodes over the forces that the plan brings in.
    fn residual(
        &self,
        forces: &[[f64; 3]],
        loads: Option<&[[f64; 3]]>,
        contact: Option<&ContactState>,
        b: &[[f64; 3]],
    ) -> f64 {
        let mut rest: Vec<[f64; 3]> = self
            .unknowns
            .iter()
            .map(|&j| {
                let f = forces[j as usize];
                loads.map_or(f, |rows| sub(f, rows[j as usize]))
            })
            .collect();
        let mut scale: f64 = b.iter().map(|v| dot(*v, *v)).sum();
        if let (Some(sliding), Some(state)) = (&self.sliding, contact) {
            for (i, node) in sliding.nodes().iter().enumerate() {
                let push = scaled(state.normals[i], state.forces[i]);
                rest[node.row as usize] = sub(rest[node.row as usize], push);
                scale += dot(push, push);
            }
        }
        let sum: f64 = rest.iter().map(|v| dot(*v, *v)).sum();
        if sum == 0.0 { 0.0 } else { (sum / scale.max(f64::MIN_POSITIVE)).sqrt() }
    }

    fn contact_result(&self, state: Option<ContactState>) -> ContactResult {
        let (Some(sliding), Some(state)) = (&self.sliding, state) else {
            return ContactResult::default();
        };
        ContactResult {
            nodes: sliding.nodes().iter().map(|n| n.node).collect(),
            points: state.points,
            normals: state.normals,
            forces: state.forces,
            gaps: state.gaps,
            active: state.active,
        }
    }

    /// Contact settled for `plan`: where the linear operator of re-planning is frozen.
    pub(crate) fn settled(
        &self,
        plan: &Plan,
        interrupted: Interrupt<'_>,
    ) -> Result<Option<ContactState>> {
        if self.sliding.is_none() {
            return Ok(None);
        }
        let motions = self.boundary.motions(plan)?;
        let u = self.prescribed(&motions)?;
        let scale = u.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
        Ok(self.solve_unknowns(&self.coupled(&u), &motions, scale, interrupted)?.contact)
    }

    /// Unknown rows for several right-hand sides with constraints n·u = g on fixed normals.
    ///
    /// `scales`: length of each prescribed field, mm; `frozen`: held nodes, normals, and g of every
    /// sliding node for each right-hand side.
    pub(crate) fn solve_frozen(
        &self,
        columns: Vec<Vec<[f64; 3]>>,
        scales: &[f64],
        frozen: Option<FrozenContact<'_>>,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        let mut effort = Effort::default();
        let mut columns = columns;
        let Some((active, normals, offsets)) = frozen else {
            if let System::Direct { symbolic, factor, .. } = &self.system {
                symbolic.solve_many(factor, &mut columns);
                return Ok(columns);
            }
            return columns
                .iter()
                .zip(scales)
                .map(|(b, &s)| self.iterate(self.matrix(), b, s, &mut effort, interrupted))
                .collect();
        };
        columns
            .iter()
            .zip(offsets)
            .zip(scales)
            .map(|((b, offsets), &scale)| {
                if interrupted() {
                    return Err(MtmError::Interrupted);
                }
                let c = Constraints { active, normals, offsets };
                let System::Direct { symbolic, factor, tail: Some(tail) } = &self.system else {
                    return Ok(self.solve_projected(b, &c, scale, &mut effort, interrupted)?.0);
                };
                let mut x = symbolic.permuted(b);
                symbolic.forward(factor, &mut x, 1);
                let free = tail.free_displacements(&x);
                let response = self.respond(tail, &free, &c)?;
                let mut forces = vec![[0.0; 3]; free.len()];
                for (&i, &force) in active.iter().zip(&response.forces) {
                    forces[i] = scaled(normals[i], force);
                }
                tail.add_forces(&mut x, &forces);
                symbolic.backward(factor, &mut x, 1);
                Ok(symbolic.unpermuted(&x))
            })
            .collect()
    }

    /// Names the node instead of the row of the reduced system.
    fn by_node(&self, error: MtmError) -> MtmError {
        match error {
            MtmError::NotPositiveDefinite { node, detail } => MtmError::NotPositiveDefinite {
                node: self.unknowns.get(node).map_or(node, |&j| j as usize),
                detail,
            },
            other => other,
        }
    }
}

fn slid(sliding: &Sliding) -> Vec<(u32, [f64; 3])> {
    sliding.nodes().iter().zip(sliding.rest_normals()).map(|(s, &n)| (s.node, n)).collect()
}

/// Rows and columns of `matrix` that belong to unknown nodes.
fn submatrix(matrix: &BlockMatrix, unknowns: &[u32], row_of: &[u32]) -> BlockMatrix {
    let (mut row_start, mut columns) = (Vec::with_capacity(unknowns.len() + 1), Vec::new());
    let mut blocks = Vec::new();
    row_start.push(0);
    for &j in unknowns {
        let (cols, values) = matrix.row(j as usize);
        for (&k, block) in cols.iter().zip(values) {
            if row_of[k as usize] != NO_ROW {
                columns.push(row_of[k as usize]);
                blocks.push(*block);
            }
        }
        row_start.push(columns.len());
    }
    let mut out = BlockMatrix::from_pattern(row_start, columns);
    out.blocks = blocks;
    out
}

fn couplings(matrix: &BlockMatrix, unknowns: &[u32], kinds: &[NodeKind]) -> Vec<(u32, u32, Block)> {
    let mut out = Vec::new();
    for (row, &j) in unknowns.iter().enumerate() {
        let (columns, blocks) = matrix.row(j as usize);
        for (&k, block) in columns.iter().zip(blocks) {
            if matches!(kinds[k as usize], NodeKind::Joined(_)) {
                out.push((row as u32, k, *block));
            }
        }
    }
    out
}

/// P A P + k (I − P) with P = I − n⊗n on the constrained rows, k the mean diagonal of each.
pub(crate) fn projected(
    matrix: &BlockMatrix,
    constraints: &[(usize, [f64; 3], f64)],
) -> BlockMatrix {
    let mut normal: Vec<Option<[f64; 3]>> = vec![None; matrix.n_rows()];
    for &(row, n, _) in constraints {
        normal[row] = Some(n);
    }
    let mut out = matrix.clone();
    for j in 0..out.n_rows() {
        for at in out.row_start[j]..out.row_start[j + 1] {
            let k = out.columns[at] as usize;
            let block = &mut out.blocks[at];
            let stiffness = (block[0] + block[4] + block[8]) / 3.0;
            if let Some(n) = normal[j] {
                for c in 0..3 {
                    let along = n[0] * block[c] + n[1] * block[3 + c] + n[2] * block[6 + c];
                    for r in 0..3 {
                        block[3 * r + c] -= n[r] * along;
                    }
                }
            }
            if let Some(n) = normal[k] {
                for r in 0..3 {
                    let along = dot([block[3 * r], block[3 * r + 1], block[3 * r + 2]], n);
                    for c in 0..3 {
                        block[3 * r + c] -= along * n[c];
                    }
                }
            }
            if let (true, Some(n)) = (k == j, normal[j]) {
                for r in 0..3 {
                    for c in 0..3 {
                        block[3 * r + c] += stiffness * n[r] * n[c];
                    }
                }
            }
        }
    }
    out
}

/// P (b − A g n): the right-hand side of the projected system for w = u − g n.
fn projected_rhs(
    matrix: &BlockMatrix,
    b: &[[f64; 3]],
    constraints: &[(usize, [f64; 3], f64)],
) -> Vec<[f64; 3]> {
    let mut shift = vec![[0.0; 3]; b.len()];
    add_offsets(&mut shift, constraints);
    let mut rhs = matrix.multiply(&shift);
    for (r, b) in rhs.iter_mut().zip(b) {
        *r = sub(*b, *r);
    }
    for &(row, n, _) in constraints {
        let along = dot(n, rhs[row]);
        rhs[row] = sub(rhs[row], scaled(n, along));
    }
    rhs
}

fn add_offsets(x: &mut [[f64; 3]], constraints: &[(usize, [f64; 3], f64)]) {
    for &(row, n, offset) in constraints {
        let along = dot(n, x[row]);
        x[row] = [0, 1, 2].map(|i| x[row][i] + (offset - along) * n[i]);
    }
}

/// Stop-watch with named laps.
struct Clock {
    begin: Instant,
    last: Instant,
    laps: Timings,
}

impl Clock {
    fn new() -> Self {
        let now = Instant::now();
        Self { begin: now, last: now, laps: Vec::new() }
    }

    /// Books the time since the last lap under `stage`; exactly zero where the stage was not needed.
    fn lap(&mut self, stage: &'static str, needed: bool) {
        let now = Instant::now();
        let seconds = if needed { (now - self.last).as_secs_f64() } else { 0.0 };
        self.laps.push((stage, seconds));
        self.last = now;
    }

    fn total(&self) -> f64 {
        self.begin.elapsed().as_secs_f64()
    }
}
