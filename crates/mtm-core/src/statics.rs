//! `StaticSolver`: eliminates prescribed nodes, keeps all that a new plan does not change, and composes
//! the solution of each plan.

use std::sync::Arc;

use rayon::prelude::*;

use crate::blocks::{Block, BlockMatrix};
use crate::boundary::{Boundary, Motion, NodeKind, Plan};
use crate::contact::{ContactState, Sliding};
use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};
use crate::mesh::{dot, norm, scaled, sub};
use crate::method::{Interrupt, Method, StaticOptions};
use crate::restraint;
use crate::solution::{Clock, ContactResult, Solution, Timings};
use crate::system::{Effort, Frozen, System};
use crate::tensors::MassTensors;

/// Row of a node that is no unknown.
pub(crate) const NO_ROW: u32 = u32::MAX;

/// A patient's tensors and node kinds, ready for any plan.
pub struct StaticSolver {
    pub(crate) tensors: Arc<MassTensors>,
    pub(crate) boundary: Arc<Boundary>,
    options: StaticOptions,
    method: Method,
    /// Node of each row of the system.
    pub(crate) unknowns: Vec<u32>,
    pub(crate) row_of: Vec<u32>,
    pub(crate) sliding: Option<Sliding>,
    system: System,
    /// Coupling of unknown rows with joined nodes: (row, node, tensor).
    couplings: Vec<(u32, u32, Block)>,
    timings: Timings,
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
        let stiffness = |j: usize| own_stiffness(tensors.matrix(), j);
        let sliding = Sliding::new(&boundary, &mesh, &row_of, stiffness, options.contact.mode)?;
        clock.lap("contact_setup", sliding.is_some());
        let normals: Vec<(u32, [f64; 3])> = sliding
            .iter()
            .flat_map(|s| s.nodes().iter().zip(s.rest_normals()))
            .map(|(s, &n)| (s.node, n))
            .collect();
        let held = restraint::check(&mesh, |j| !is_unknown(&kinds[j]), &normals)?;
        clock.lap("restraint", true);

        let couplings = couplings(tensors.matrix(), &unknowns, &kinds);
        let matrix = submatrix(tensors.matrix(), &unknowns, &row_of);
        clock.lap("reduce", true);
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        let positions: Vec<[f64; 3]> = unknowns.iter().map(|&j| mesh.nodes()[j as usize]).collect();
        let (system, method) = System::new(
            matrix,
            &positions,
            sliding.as_ref(),
            held,
            tensors.tissue().largest_lame_ratio(),
            &options,
            &mut clock,
            interrupted,
        )
        .map_err(|e| by_node(e, &unknowns))?;
        Ok(Self {
            tensors,
            boundary,
            options,
            method,
            unknowns,
            row_of,
            sliding,
            system,
            couplings,
            timings: clock.laps,
        })
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

    /// Bytes of the factor or preconditioner that is kept.
    pub fn factor_bytes(&self) -> usize {
        self.system.bytes()
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

        let mut effort = Effort::default();
        let (rows, contact, contact_seconds) =
            self.solve_rows(&b, &motions, scale, &mut effort, interrupted)?;
        clock.lap("solve", true);
        for (&j, v) in self.unknowns.iter().zip(&rows) {
            u[j as usize] = *v;
        }
        let forces = self.tensors.matrix().multiply(&u);
        let residual = self.residual(&forces, loads, contact.as_ref(), &b);
        if !(residual.is_finite() && effort.error_bound.is_finite()) {
            return Err(MtmError::NotPositiveDefinite {
                node: 0,
                detail: "the solution is not finite; the plan or the moduli overflow f64".into(),
            });
        }
        clock.lap("forces", true);

        let mut timings: Timings = self.timings.clone();
        timings.extend(clock.laps.iter().map(|&(stage, seconds)| {
            (stage, if stage == "solve" { seconds - contact_seconds } else { seconds })
        }));
        timings.push(("contact", contact_seconds));
        timings.push(("total", clock.total()));
        let contact_iterations = contact.as_ref().map_or(0, |c| c.iterations);
        Ok(Solution {
            displacements: u,
            forces,
            residual,
            error_bound: effort.error_bound,
            iterations: effort.iterations,
            residual_history: effort.history,
            contact: self.contact_result(contact),
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

    /// Displacements of the unknown rows, contact, and the seconds it took.
    fn solve_rows(
        &self,
        b: &[[f64; 3]],
        motions: &[&Motion],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, Option<ContactState>, f64)> {
        let found = match &self.sliding {
            None => self.system.solve(b, scale, effort, interrupted).map(|u| (u, None, 0.0)),
            Some(sliding) => self
                .system
                .solve_with_contact(b, sliding, motions, &self.options, scale, effort, interrupted)
                .map(|(u, state, seconds)| (u, Some(state), seconds)),
        };
        found.map_err(|e| by_node(e, &self.unknowns))
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
            walls: state.walls,
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
        let b = self.coupled(&u);
        Ok(self.solve_rows(&b, &motions, scale, &mut Effort::default(), interrupted)?.1)
    }

    /// Unknown rows for several right-hand sides, with contact frozen where there is any.
    pub(crate) fn solve_columns(
        &self,
        columns: Vec<Vec<[f64; 3]>>,
        scales: &[f64],
        frozen: Option<Frozen<'_>>,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        self.system
            .solve_columns(columns, scales, self.sliding.as_ref().zip(frozen), interrupted)
            .map_err(|e| by_node(e, &self.unknowns))
    }
}

/// Mean stiffness of node `j` by itself, a third of the trace of K_jj, N/mm.
fn own_stiffness(matrix: &BlockMatrix, j: usize) -> f64 {
    let own = matrix.diagonal_block(j);
    (own[0] + own[4] + own[8]) / 3.0
}

/// Names the node instead of the row of the reduced system.
fn by_node(error: MtmError, unknowns: &[u32]) -> MtmError {
    match error {
        MtmError::NotPositiveDefinite { node, detail } => MtmError::NotPositiveDefinite {
            node: unknowns.get(node).map_or(node, |&j| j as usize),
            detail,
        },
        other => other,
    }
}

/// Rows and columns of `matrix` that belong to unknown nodes.
fn submatrix(matrix: &BlockMatrix, unknowns: &[u32], row_of: &[u32]) -> BlockMatrix {
    let kept = |j: u32| {
        let (columns, blocks) = matrix.row(j as usize);
        columns.iter().map(|&k| row_of[k as usize]).zip(blocks).filter(|(row, _)| *row != NO_ROW)
    };
    let lengths: Vec<usize> = unknowns.par_iter().map(|&j| kept(j).count()).collect();
    let mut row_start = Vec::with_capacity(unknowns.len() + 1);
    row_start.push(0);
    for length in lengths {
        row_start.push(row_start[row_start.len() - 1] + length);
    }
    let columns = unknowns.par_iter().flat_map_iter(|&j| kept(j).map(|(row, _)| row)).collect();
    let mut out = BlockMatrix::from_pattern(row_start, columns);
    out.row_tasks().into_par_iter().for_each(|task| {
        let (first, mut blocks) = (task.first, task.blocks);
        for &j in &unknowns[first..first + task.start.len() - 1] {
            let row: Vec<&Block> = kept(j).map(|(_, block)| block).collect();
            let (head, tail) = blocks.split_at_mut(row.len());
            for (out, block) in head.iter_mut().zip(row) {
                *out = *block;
            }
            blocks = tail;
        }
    });
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
