//! Exact re-planning: the solution for any rigid plan from columns that are solved once.
//!
//! A rigid motion is affine, u_b = (R − I)(x − c) + s, so twelve unit fields per segment span all its finite
//! motions: nine for R − I, three for s = t + (R − I) c. If the contact normals are frozen, the sliding
//! constraints are affine in the same numbers.

use rayon::prelude::*;

use crate::boundary::{Motion, NodeKind, Plan, Segment, matched, misplanned};
use crate::contact::{ContactResult, Sliding};
use crate::error::{ErrorKind, Result};
use crate::geometry::motion::RigidMotion;
use crate::statics::linear::system::Frozen;
use crate::statics::options::Interrupt;
use crate::statics::plans::about::{ContactEquilibrium, Rate};
use crate::statics::reduction::NO_ROW;
use crate::statics::solver::StaticSolver;

/// Unit fields per segment.
pub const COLUMNS: usize = 12;
/// Number of nodes from which a second core saves more than it costs to wake it up.
const NODES_FOR_THREADS: usize = 32_768;
/// Nodes per parallel task.
const NODES_PER_TASK: usize = 8192;

/// Linear map from rigid plans to the displacements of chosen nodes.
#[derive(Debug, Clone)]
pub struct PlanOperator {
    nodes: Vec<u32>,
    segments: Vec<String>,
    /// Centre c of each segment's motion, mm.
    centres: Vec<[f64; 3]>,
    /// Coefficients of the twelve numbers of each segment: component i of the nodes, then segment.
    rows: Vec<[f64; COLUMNS]>,
    /// Displacement that does not depend on the plan: gaps at rest that contact closes.
    offset: Option<Vec<f64>>,
}

impl StaticSolver {
    /// The operator for `nodes` (all of them if `None`).
    ///
    /// Without sliding nodes it equals `solve` for every rigid plan. With them, contact points, normals and the
    /// set of held nodes are those of the plan `reference` (of the state at rest if `None`).
    ///
    /// # Errors
    /// Node indices out of range, a reference plan that does not fit or converge, a linear solve that fails.
    pub fn plan_operator(
        &self,
        nodes: Option<Vec<u32>>,
        reference: Option<&Plan>,
        interrupted: Interrupt<'_>,
    ) -> Result<PlanOperator> {
        self.check_linear("a plan operator")?;
        let nodes = self.nodes_or_all(nodes)?;
        let segments = self.node_kinds.segments();
        let rest: Plan = segments
            .iter()
            .map(|s| (s.name.clone(), Motion::Rigid(RigidMotion::identity())))
            .collect();
        let reference = reference.unwrap_or(&rest);
        rigid_plan(reference)?;
        let contact = self.settled(reference, interrupted)?;
        let centres = self.centres();
        let columns = self.unit_columns(&centres);
        let solved = match (&contact, &self.sliding) {
            (Some(state), Some(sliding)) => {
                self.solve_in_contact(columns, (state, sliding), &centres, reference, interrupted)?
            }
            _ => self.solve_columns(columns.fields, (&columns.scales, None), None, interrupted)?,
        };
        let rows = self.rows_of(&nodes, &centres, &solved)?;
        // The last column is that which does not depend on the plan.
        let constant = contact.is_some().then(|| solved.last()).flatten();
        let offset = constant.map(|u| self.values_of(&nodes, u));
        let segments = segments.iter().map(|s| s.name.clone()).collect();
        Ok(PlanOperator { nodes, segments, centres, rows, offset })
    }

    /// The `nodes` of an operator, checked: all nodes of the mesh if there are none.
    fn nodes_or_all(&self, nodes: Option<Vec<u32>>) -> Result<Vec<u32>> {
        let n = self.tensors.element_nodes().positions().len();
        let nodes = nodes.unwrap_or_else(|| (0..self.tensors.mesh().n_nodes() as u32).collect());
        match nodes.iter().position(|&j| j as usize >= n) {
            Some(row) => Err(ErrorKind::Boundary.no_such(("nodes", row), "node", nodes[row], n)),
            None => Ok(nodes),
        }
    }

    /// Mean position of the joined and sliding nodes of each segment, mm.
    fn centres(&self) -> Vec<[f64; 3]> {
        let places = self.tensors.element_nodes().positions();
        let centre = |s: &Segment| {
            let count = (s.joined.len() + s.sliding.len()) as f64;
            s.joined
                .iter()
                .chain(&s.sliding)
                .fold([0.0; 3], |c, &j| [0, 1, 2].map(|i| c[i] + places[j as usize][i] / count))
        };
        self.node_kinds.segments().iter().map(centre).collect()
    }

    /// The right-hand sides of the unit fields of all segments.
    fn unit_columns(&self, centres: &[[f64; 3]]) -> UnitColumns {
        let places = self.tensors.element_nodes().positions();
        let mut columns = UnitColumns::default();
        for (segment, &centre) in self.node_kinds.segments().iter().zip(centres) {
            for column in 0..COLUMNS {
                let mut u = vec![[0.0; 3]; places.len()];
                for &j in &segment.joined {
                    u[j as usize] = Rate::unit(column, centre).at(places[j as usize]);
                }
                columns.scales.push(if column < 9 { self.tensors.mesh().diagonal() } else { 1.0 });
                columns.fields.push(self.coupled(&u));
            }
        }
        columns
    }

    /// The rows of all `columns` under the contact of the plan `reference`, and last those of the column that does
    /// not depend on the plan.
    fn solve_in_contact(
        &self,
        mut columns: UnitColumns,
        (state, sliding): (&ContactResult, &Sliding),
        centres: &[[f64; 3]],
        reference: &Plan,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<Vec<[f64; 3]>>> {
        columns.scales.push(1.0);
        columns.fields.push(vec![[0.0; 3]; self.reduction.unknowns.len()]);
        let motions = self.node_kinds.motions(reference)?;
        let motions: Vec<RigidMotion> = motions.iter().filter_map(|m| m.rigid()).copied().collect();
        let about = ContactEquilibrium { state, sliding: &sliding.nodes, motions: &motions };
        let places = self.tensors.element_nodes().positions();
        let mut slopes = Vec::new();
        for (k, field) in columns.fields.iter_mut().enumerate() {
            slopes.push(match centres.get(k / COLUMNS) {
                Some(&centre) => {
                    let rate = Rate::unit(k % COLUMNS, centre);
                    let mut slope = about.still();
                    about.add(k / COLUMNS, &rate, &mut slope, field);
                    slope
                }
                None => about.at_rest(places, field),
            });
        }
        let frozen = Frozen { state, slopes: &slopes };
        self.solve_columns(columns.fields, (&columns.scales, None), Some(frozen), interrupted)
    }

    /// The coefficients of an operator for `nodes`, of the columns that were `solved`.
    fn rows_of(
        &self,
        nodes: &[u32],
        centres: &[[f64; 3]],
        solved: &[Vec<[f64; 3]>],
    ) -> Result<Vec<[f64; COLUMNS]>> {
        let places = self.tensors.element_nodes().positions();
        let kinds = self.node_kinds.kinds(places.len())?;
        let width = centres.len();
        let mut rows = vec![[0.0; COLUMNS]; 3 * nodes.len() * width];
        for (at, &j) in nodes.iter().enumerate() {
            let row = self.reduction.row_of[j as usize];
            for (s, &centre) in centres.iter().enumerate() {
                for column in 0..COLUMNS {
                    let u = match kinds[j as usize] {
                        NodeKind::Free | NodeKind::Sliding(_) => {
                            solved[COLUMNS * s + column][row as usize]
                        }
                        NodeKind::Joined(own) if own == s => {
                            Rate::unit(column, centre).at(places[j as usize])
                        }
                        NodeKind::Joined(_) | NodeKind::Fixed => [0.0; 3],
                    };
                    for i in 0..3 {
                        rows[(3 * at + i) * width + s][column] = u[i];
                    }
                }
            }
        }
        Ok(rows)
    }

    /// The components of the rows `u` at `nodes`, 0 where a node has no row.
    fn values_of(&self, nodes: &[u32], u: &[[f64; 3]]) -> Vec<f64> {
        let row = |&j: &u32| match self.reduction.row_of[j as usize] {
            NO_ROW => [0.0; 3],
            row => u[row as usize],
        };
        nodes.iter().flat_map(row).collect()
    }
}

/// Right-hand sides of an operator, with the lengths of their prescribed fields, mm.
#[derive(Default)]
struct UnitColumns {
    fields: Vec<Vec<[f64; 3]>>,
    scales: Vec<f64>,
}

impl PlanOperator {
    /// The nodes whose displacements it returns.
    pub fn nodes(&self) -> &[u32] {
        &self.nodes
    }

    /// The segments, in the order of its columns.
    pub fn segments(&self) -> &[String] {
        &self.segments
    }

    /// Point of each segment about which its columns are defined, mm.
    pub fn centres(&self) -> &[[f64; 3]] {
        &self.centres
    }

    /// The twelve columns of each segment, (3k, 12·segments) row by row.
    pub fn matrix(&self) -> &[f64] {
        self.rows.as_flattened()
    }

    /// Displacements of the nodes under a rigid plan, mm.
    ///
    /// # Errors
    /// A plan that does not name every segment exactly once, or contains a motion that is not rigid.
    pub fn apply(&self, plan: &Plan) -> Result<Vec<[f64; 3]>> {
        let mut out = vec![[0.0; 3]; self.nodes.len()];
        self.apply_into(plan, &mut out)?;
        Ok(out)
    }

    /// [`apply`](Self::apply) into a buffer of one row per node.
    pub fn apply_into(&self, plan: &Plan, out: &mut [[f64; 3]]) -> Result<()> {
        let why = "one row per node of the operator";
        ErrorKind::Boundary.require_length("output", out.len(), self.nodes.len(), why)?;
        rigid_plan(plan)?;
        let names: Vec<&str> = self.segments.iter().map(String::as_str).collect();
        let mut numbers = Vec::with_capacity(names.len());
        for (motion, &centre) in matched(plan, &names)?.into_iter().zip(&self.centres) {
            // Motions that are not rigid were rejected above.
            let Some(rigid) = motion.rigid() else { continue };
            // (R − I)(x − c) + s with s the displacement of the centre.
            let mut own = [0.0; COLUMNS];
            for r in 0..3 {
                for c in 0..3 {
                    let unit = f64::from(u8::from(r == c));
                    own[3 * r + c] = rigid.matrix()[r][c] - unit;
                }
            }
            own[9..].copy_from_slice(&rigid.displacement(centre));
            numbers.push(own);
        }
        let width = self.segments.len().max(1);
        let fill = |out: &mut [[f64; 3]], rows: &[[f64; COLUMNS]]| {
            for (out, rows) in out.as_flattened_mut().iter_mut().zip(rows.chunks_exact(width)) {
                *out = rows.iter().zip(&numbers).map(|(row, own)| dot12(row, own)).sum();
            }
        };
        if out.len() < NODES_FOR_THREADS {
            fill(out, &self.rows);
        } else {
            out.par_chunks_mut(NODES_PER_TASK)
                .zip(self.rows.par_chunks(3 * width * NODES_PER_TASK))
                .for_each(|(out, rows)| fill(out, rows));
        }
        for (out, offset) in out.as_flattened_mut().iter_mut().zip(self.offset.iter().flatten()) {
            *out += offset;
        }
        Ok(())
    }
}

/// Scalar product in four interleaved sums, which the compiler keeps in vector registers.
fn dot12(a: &[f64; COLUMNS], b: &[f64; COLUMNS]) -> f64 {
    let mut sums = [0.0; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for lane in 0..4 {
            sums[lane] += a[lane] * b[lane];
        }
    }
    (sums[0] + sums[2]) + (sums[1] + sums[3])
}

/// Rejects motions that are not rigid.
fn rigid_plan(plan: &Plan) -> Result<()> {
    let why = "the operator takes rigid 4×4 matrices only; use solve for other motions";
    let other = plan.iter().find(|(_, motion)| motion.rigid().is_none());
    other.map_or(Ok(()), |(segment, _)| Err(misplanned(segment, why)))
}
