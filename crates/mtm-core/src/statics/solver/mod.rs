//! `StaticSolver`: eliminates prescribed nodes, keeps everything that does not depend on the plan, and
//! assembles the solution of each plan.

pub(crate) mod outcome;
pub(crate) mod refusals;
mod touching;

use std::sync::Arc;

use crate::algebra::blocks::{Block, BlockMatrix};
use crate::boundary::{Boundary, Motion, NodeKind, Plan};
use crate::contact::pairs::Pairs;
use crate::contact::{ContactMode, ContactResult, Sliding};
use crate::error::{ErrorKind, MtmError, Result, check_forces};
use crate::mechanics::kinematics::Kinematics;
use crate::mechanics::tensors::MassTensors;
use crate::statics::linear::confirmed::is_doubtful;
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::iterative::Extremes;
use crate::statics::linear::system::{BodyRows, Frozen, System, not_liftable};
use crate::statics::newton::{Equilibrium, SlidingBody};
use crate::statics::options::{Interrupt, Method, StaticOptions};
use crate::statics::plans::settling::{ContactSolve, RowLinks, WarmStart, method_for};
use crate::statics::reduction::{NO_ROW, Reduction};
use crate::statics::restraint::{self, Support};
use crate::statics::solution::{Clock, Solution, SolvedRows, Timings};
use crate::vector::{add, norm, scaled};

/// Multiple of the correction of a solution by factorisation that is taken as the error of the corrected one.
const CORRECTION_SAFETY: f64 = 2.0;

/// A patient's tensors and node kinds, ready for any plan.
#[derive(Clone)]
pub struct StaticSolver {
    pub(crate) tensors: Arc<MassTensors>,
    boundary: Arc<Boundary>,
    /// The boundary with the nodes in the middle of edges, where the element has them.
    pub(crate) node_kinds: Arc<Boundary>,
    options: StaticOptions,
    method: Method,
    /// Whether solutions by factorisation are corrected once.
    refines: bool,
    pub(crate) reduction: Arc<Reduction>,
    pub(crate) sliding: Option<Arc<Sliding>>,
    /// Nodes among the unknowns that the boundary holds: the same factor serves plans that free them.
    on_bone: Vec<u32>,
    /// What may touch what.
    pairs: Option<Arc<Pairs>>,
    mechanics: Mechanics,
    held: Support,
    /// Coupling of unknown rows with joined nodes: (row, node, tensor).
    couplings: Arc<[(u32, u32, Block)]>,
    timings: Timings,
}

/// How the unknown rows are computed for a plan.
#[derive(Clone)]
enum Mechanics {
    /// One linear system for every plan.
    Linear(Arc<System>),
    /// Newton's method.
    LargeRotation(Arc<Equilibrium>),
}

/// A plan in terms of the system.
struct PosedPlan<'a> {
    /// Forces from joined nodes and loads on the rows of the linear system, N.
    b: &'a [[f64; 3]],
    /// Displacements of all nodes, those of joined ones filled in, mm.
    u: &'a [[f64; 3]],
    loads: Option<&'a [[f64; 3]]>,
    motions: &'a [&'a Motion],
    start: Option<&'a Solution>,
}

/// What of a body slides on bone, and on other tissue.
fn contacts_of(
    tensors: &MassTensors,
    kinds: &Boundary,
    rows: &[u32],
    mode: ContactMode,
) -> Result<(Option<Sliding>, Option<Pairs>)> {
    let (mesh, places) = (tensors.mesh(), tensors.element_nodes().positions());
    // Of a node on its own: a third of the trace of K_jj.
    let stiffness = |j: usize| {
        let own = tensors.matrix().diagonal_block(j);
        (own[0] + own[4] + own[8]) / 3.0
    };
    let sliding = Sliding::new(kinds, mesh, places, rows, stiffness, mode)?;
    Ok((sliding, Pairs::new(kinds, mesh, places, rows, stiffness)?))
}

/// The equations of a body, whose matrix is that at rest, and the method by which they are solved. Errors refer to
/// rows.
fn mechanics_of(
    (tensors, reduction, matrix): (&Arc<MassTensors>, &Arc<Reduction>, BlockMatrix),
    body: &BodyRows<'_>,
    options: &StaticOptions,
    clock: &mut Clock,
    interrupted: Interrupt<'_>,
) -> Result<(Mechanics, Method)> {
    if interrupted() {
        return Err(MtmError::Interrupted);
    }
    if options.kinematics == Kinematics::Linear {
        return System::new(matrix, body, options, clock, interrupted)
            .map(|(system, method)| (Mechanics::Linear(Arc::new(system)), method));
    }
    if !body.liftable.0.is_empty() {
        return Err(not_liftable("kinematics", options.kinematics.name().into()));
    }
    Equilibrium::new(tensors.clone(), reduction.clone(), &matrix, options, clock)
        .map(|(body, method)| (Mechanics::LargeRotation(Arc::new(body)), method))
}

impl StaticSolver {
    /// The solver of `tensors` under `boundary`.
    ///
    /// # Errors
    /// Options out of range, node indices out of range, a body that is not constrained (with its free rigid
    /// modes), an inverted contact surface, a factorisation that fails or does not fit in memory.
    pub fn new(
        tensors: Arc<MassTensors>,
        boundary: Arc<Boundary>,
        options: StaticOptions,
        interrupted: Interrupt<'_>,
    ) -> Result<Self> {
        options.check()?;
        let options = StaticOptions { method: method_for(&boundary, &options)?, ..options };
        let mut clock = Clock::new();
        let mesh = tensors.mesh().clone();
        let places = tensors.element_nodes().positions();
        let node_kinds = with_mid_edges(&tensors, &boundary)?;
        let kinds = node_kinds.kinds(places.len())?;
        let (liftable, held_places) = node_kinds.liftable();
        let with_liftable = |kind: NodeKind| {
            let mut kinds = kinds.clone();
            liftable.iter().for_each(|&j| kinds[j as usize] = kind);
            kinds
        };
        let reduction = Arc::new(Reduction::new(&with_liftable(NodeKind::Free)));
        let rows = &reduction.row_of;
        let (sliding, pairs) = contacts_of(&tensors, &node_kinds, rows, options.contact.mode)?;
        clock.lap("contact_setup", sliding.is_some() || pairs.is_some());
        let normals = corner_normals(sliding.as_ref(), mesh.n_nodes());
        let held = restraint::check(&mesh, |j| rows[j] == NO_ROW, &normals)?;
        clock.lap("restraint", true);
        let outer = with_liftable(node_kinds.liftable_kind());
        let couplings = couplings(tensors.matrix(), &reduction.unknowns, &outer).into();
        let matrix = reduction.matrix(tensors.matrix());
        clock.lap("reduce", true);
        let tissue = Extremes::of(tensors.tissue());
        let (positions, slides) = (&reduction.rows(places), sliding.as_ref());
        let rows: Vec<u32> = liftable.iter().map(|&j| reduction.row_of[j as usize]).collect();
        let lifts = (&rows[..], &held_places[..]);
        let body =
            BodyRows { positions, sliding: slides, held, liftable: lifts, tissue, multigrid: None };
        let made = (&tensors, &reduction, matrix);
        let (mechanics, method) = mechanics_of(made, &body, &options, &mut clock, interrupted)
            .map_err(|e| by_node(e, &reduction.unknowns))?;
        let is_linear = options.kinematics == Kinematics::Linear;
        let refines = method.has_factor() && is_linear && is_doubtful(tissue.contrast);
        let on_bone = held_places.iter().map(|&place| liftable[place]).collect();
        let (sliding, pairs) = (sliding.map(Arc::new), pairs.map(Arc::new));
        Ok(Self {
            tensors,
            boundary,
            node_kinds,
            options,
            method,
            refines,
            reduction,
            sliding,
            on_bone,
            pairs,
            mechanics,
            held,
            couplings,
            timings: clock.laps,
        })
    }

    /// The solver of the same body under a boundary that holds `nodes` of the liftable ones and frees all others,
    /// with the same factor: its solutions are those of a solver of that boundary.
    ///
    /// # Errors
    /// A node that is not liftable.
    pub fn holding(&self, nodes: &[u32]) -> Result<Self> {
        let boundary = Arc::new(self.boundary.holding(nodes)?);
        let (liftable, held) = boundary.liftable();
        let on_bone = held.iter().map(|&place| liftable[place]).collect();
        let system = match &self.mechanics {
            Mechanics::Linear(system) => system.holding(&held),
            Mechanics::LargeRotation(_) => {
                Err(not_liftable("kinematics", self.options.kinematics.name().into()))
            }
        };
        let system = system.map_err(|e| by_node(e, &self.reduction.unknowns))?;
        let mechanics = Mechanics::Linear(Arc::new(system));
        Ok(Self { node_kinds: boundary.clone(), boundary, on_bone, mechanics, ..self.clone() })
    }

    /// How strain follows from displacement.
    pub fn kinematics(&self) -> Kinematics {
        self.options.kinematics
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
        3 * (self.reduction.unknowns.len() - self.on_bone.len())
    }

    /// Bytes of the factor or preconditioner that is kept.
    pub fn factor_bytes(&self) -> usize {
        match &self.mechanics {
            Mechanics::Linear(system) => system.bytes(),
            Mechanics::LargeRotation(body) => body.bytes(),
        }
    }

    /// Seconds by stage of the set-up.
    pub fn timings(&self) -> &Timings {
        &self.timings
    }

    /// Displacements under `plan` and nodal `loads` (N, one row per corner node, or per node including mid-edge
    /// nodes).
    ///
    /// Depends only on its arguments: earlier plans have no effect.
    ///
    /// # Errors
    /// A plan or loads that do not fit, contact that does not converge, an iteration that does not
    /// converge, interruption.
    pub fn solve(
        &self,
        plan: &Plan,
        loads: Option<&[[f64; 3]]>,
        interrupted: Interrupt<'_>,
    ) -> Result<Solution> {
        self.solve_from(None, plan, loads, interrupted)
    }

    /// As [`solve`](Self::solve), but contact starts with the nodes on their segments where `start`, a solution
    /// of this solver for another plan, has them: a plan that differs little takes fewer steps. The result is
    /// the same within the tolerances if there is only one equilibrium. Large deformation always starts from
    /// rest.
    ///
    /// # Errors
    /// As [`solve`](Self::solve); a start with a different number of nodes.
    pub fn solve_from(
        &self,
        start: Option<&Solution>,
        plan: &Plan,
        loads: Option<&[[f64; 3]]>,
        interrupted: Interrupt<'_>,
    ) -> Result<Solution> {
        if let Some(start) = start {
            self.check_start(start)?;
        }
        let mut clock = Clock::new();
        let loads = loads.map(|rows| self.checked_loads(rows)).transpose()?;
        let loads = loads.as_deref();
        let motions = self.node_kinds.motions(plan)?;
        let mut u = self.prescribed(&motions)?;
        let scale = u.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
        let mut b = self.coupled(&u);
        self.held_rows().for_each(|row| b[row] = [0.0; 3]);
        if let Some(rows) = loads {
            for (b, &j) in b.iter_mut().zip(&self.reduction.unknowns) {
                *b = [0, 1, 2].map(|i| b[i] + rows[j as usize][i]);
            }
        }
        clock.lap("plan", true);

        let mut solve = PlanSolve::new(scale, interrupted);
        let posed = PosedPlan { b: &b, u: &u, loads, motions: &motions, start };
        let SolvedRows { rows, contact, contact_seconds, touching, pushes } =
            self.solve_rows(&posed, &mut solve)?;
        clock.lap("solve", true);
        u = self.filled(&u, &rows);
        let mut forces = self.forces(&u)?;
        if self.refines && contact.is_none() {
            self.refine(&mut u, &forces, loads, &mut solve)?;
            forces = self.forces(&u)?;
        }
        let residual = self.residual(&forces, loads, (contact.as_ref(), &pushes), &b);
        if !(residual.is_finite() && solve.error_estimate.is_finite()) {
            let why = "the plan or the moduli are too large for f64";
            return Err(MtmError::Overflow { what: "the solution", why });
        }
        clock.lap("forces", true);

        let timings = self.timings_of(&clock, contact_seconds);
        let contact_iterations = contact.as_ref().map_or(0, |c| c.iterations);
        Ok(Solution {
            displacements: u,
            forces,
            residual,
            error_estimate: solve.error_estimate,
            iterations: solve.iterations,
            residual_history: solve.history,
            contact: self.contact_result(contact, &motions),
            touching,
            contact_iterations,
            timings,
        })
    }

    /// Values of every node: those of the `prescribed` ones, and `rows` at the unknown ones.
    pub(crate) fn filled(&self, prescribed: &[[f64; 3]], rows: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut out = self.reduction.filled(prescribed, rows);
        for &j in &self.on_bone {
            out[j as usize] = prescribed[j as usize];
        }
        out
    }

    /// Rows of the system that the boundary holds.
    fn held_rows(&self) -> impl Iterator<Item = usize> {
        self.on_bone.iter().map(|&j| self.reduction.row_of[j as usize] as usize)
    }

    /// Times of the stages of a plan after those of setting up, s.
    fn timings_of(&self, clock: &Clock, contact_seconds: f64) -> Timings {
        let mut timings: Timings = self.timings.clone();
        timings.extend(clock.laps.iter().map(|&(stage, seconds)| {
            (stage, if stage == "solve" { seconds - contact_seconds } else { seconds })
        }));
        timings.push(("contact", contact_seconds));
        timings.push(("total", clock.total()));
        timings
    }

    /// Internal forces under displacements of all nodes, N.
    fn forces(&self, u: &[[f64; 3]]) -> Result<Vec<[f64; 3]>> {
        match &self.mechanics {
            Mechanics::Linear(_) => Ok(self.tensors.matrix().multiply(u)),
            Mechanics::LargeRotation(body) => body.forces(u),
        }
    }

    /// Adds to `u` the correction for its own residual forces, and counts it as error: if stiff and soft tissue
    /// are mixed, a solution may lose digits that the factorisation's known solution kept.
    fn refine(
        &self,
        u: &mut [[f64; 3]],
        forces: &[[f64; 3]],
        loads: Option<&[[f64; 3]]>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<()> {
        let Mechanics::Linear(system) = &self.mechanics else { return Ok(()) };
        let out_of_balance = |&j: &u32| {
            let f = scaled(forces[j as usize], -1.0);
            loads.map_or(f, |rows| add(rows[j as usize], f))
        };
        let b: Vec<[f64; 3]> = self.reduction.unknowns.iter().map(out_of_balance).collect();
        let correction = system.solve(&b, &mut PlanSolve::new(0.0, solve.interrupted))?;
        let mut largest = 0.0_f64;
        for (&j, d) in self.reduction.unknowns.iter().zip(&correction) {
            u[j as usize] = add(u[j as usize], *d);
            largest = largest.max(norm(*d));
        }
        solve.leaves(CORRECTION_SAFETY * largest);
        Ok(())
    }

    /// Displacements of all nodes with the prescribed ones filled in, mm.
    fn prescribed(&self, motions: &[&Motion]) -> Result<Vec<[f64; 3]>> {
        let nodes = self.tensors.element_nodes().positions();
        let mut u = vec![[0.0; 3]; nodes.len()];
        for (s, motion) in motions.iter().enumerate() {
            for (j, v) in self.node_kinds.joined_displacements(s, motion, nodes)? {
                u[j as usize] = v;
            }
        }
        Ok(u)
    }

    /// Forces −K_UB u_B exerted by the prescribed nodes on the unknown rows, N.
    pub(crate) fn coupled(&self, u: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut b = vec![[0.0; 3]; self.reduction.unknowns.len()];
        for (row, node, k) in self.couplings.iter() {
            let v = u[*node as usize];
            let out = &mut b[*row as usize];
            for i in 0..3 {
                out[i] -= k[3 * i] * v[0] + k[3 * i + 1] * v[1] + k[3 * i + 2] * v[2];
            }
        }
        b
    }

    /// `loads` for every node, mid-edge nodes included.
    pub(crate) fn checked_loads(&self, loads: &[[f64; 3]]) -> Result<Vec<[f64; 3]>> {
        let n = self.tensors.element_nodes().n_nodes();
        let corners = self.tensors.mesh().n_nodes();
        if loads.len() != n && loads.len() != corners {
            let why = "one row per node";
            return Err(ErrorKind::Boundary.length("loads", loads.len(), corners, why));
        }
        check_forces("loads", loads, ErrorKind::Boundary)?;
        let mut out = loads.to_vec();
        out.resize(n, [0.0; 3]);
        Ok(out)
    }

    /// Displacements of the unknown rows at contact equilibrium, and what touches.
    fn solve_rows(&self, posed: &PosedPlan<'_>, solve: &mut PlanSolve<'_>) -> Result<SolvedRows> {
        let &PosedPlan { b, u, loads, motions, start } = posed;
        let found = match (&self.mechanics, &self.pairs, &self.sliding) {
            (Mechanics::Linear(system), Some(pairs), _) => {
                self.solve_touching((system, pairs), motions, loads, solve)
            }
            (Mechanics::LargeRotation(body), _, sliding) => {
                let slide = sliding.as_ref().map(|sliding| SlidingBody {
                    sliding,
                    motions,
                    held: self.held,
                });
                body.solve(u, loads, slide.as_ref(), solve)
            }
            (Mechanics::Linear(system), None, None) => {
                system.solve(b, solve).map(|rows| SolvedRows::new(rows, None, 0.0))
            }
            (Mechanics::Linear(system), None, Some(sliding)) => {
                let rows =
                    start.map_or_else(Vec::new, |start| self.reduction.rows(&start.displacements));
                let rest = start.and_then(|start| start.contact.at_rest.as_ref());
                let contact = rest.and_then(|rest| sliding.carried(motions, rest));
                let begin = contact.map(|contact| WarmStart { rows: &rows, contact });
                let (options, linked) = (&self.options, RowLinks::default());
                let settle = ContactSolve { sliding, motions, begin, options, linked };
                system.solve_with_contact(b, &settle, solve)
            }
        };
        found.map_err(|e| by_node(e, &self.reduction.unknowns))
    }

    /// Contact at equilibrium for `plan`: the state about which the linear operator of re-planning is frozen.
    pub(crate) fn settled(
        &self,
        plan: &Plan,
        interrupted: Interrupt<'_>,
    ) -> Result<Option<ContactResult>> {
        if self.sliding.is_none() {
            return Ok(None);
        }
        let motions = self.node_kinds.motions(plan)?;
        let u = self.prescribed(&motions)?;
        let scale = u.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
        let b = self.coupled(&u);
        let posed = PosedPlan { b: &b, u: &u, loads: None, motions: &motions, start: None };
        Ok(self.solve_rows(&posed, &mut PlanSolve::new(scale, interrupted))?.contact)
    }

    /// Unknown rows for several right-hand sides, with contact frozen if there is any; see
    /// [`System::solve_columns`].
    pub(crate) fn solve_columns(
        &self,
        columns: Vec<Vec<[f64; 3]>>,
        accuracy: (&[f64], Option<f64>),
        frozen: Option<Frozen<'_>>,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        let Mechanics::Linear(system) = &self.mechanics else {
            return Err(self.not_linear("a solve for columns"));
        };
        system
            .solve_columns(columns, accuracy, self.sliding.as_deref().zip(frozen), interrupted)
            .map_err(|e| by_node(e, &self.reduction.unknowns))
    }
}

/// `boundary` with the mid-edge nodes of `tensors`; unchanged if there are none.
fn with_mid_edges(tensors: &MassTensors, boundary: &Arc<Boundary>) -> Result<Arc<Boundary>> {
    let edges = tensors.element_nodes().mid_edges();
    if edges.is_empty() {
        return Ok(boundary.clone());
    }
    if !boundary.liftable().0.is_empty() {
        return Err(not_liftable("element", tensors.element_nodes().element().name().into()));
    }
    let mesh = tensors.mesh();
    let surface = mesh.boundary_edges();
    let on_surface = |edge: [u32; 2]| surface.binary_search(&edge).is_ok();
    Ok(Arc::new(boundary.with_mid_edges(mesh.n_nodes(), edges, on_surface)?))
}

/// Rest normals of the sliding corner nodes. The tets of a part share whole faces, so its corner nodes decide how it
/// is constrained.
fn corner_normals(sliding: Option<&Sliding>, n_corners: usize) -> Vec<(u32, [f64; 3])> {
    let nodes = sliding.iter().flat_map(|s| s.nodes.iter().zip(&s.rest_normals));
    nodes
        .map(|(node, &normal)| (node.node, normal))
        .filter(|(node, _)| (*node as usize) < n_corners)
        .collect()
}

/// Replaces the row of the reduced system in an error by its node.
fn by_node(error: MtmError, unknowns: &[u32]) -> MtmError {
    match error {
        MtmError::NotPositiveDefinite { node, detail } => {
            MtmError::not_definite(unknowns.get(node).map_or(node, |&j| j as usize), detail)
        }
        other => other,
    }
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
