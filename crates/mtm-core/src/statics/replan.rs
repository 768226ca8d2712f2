//! Exact re-planning: the solution for any rigid plan from columns that are solved once.
//!
//! A rigid motion is affine, u_b = (R − I)(x − c) + s, so twelve unit fields per segment span all its finite
//! motions: nine for R − I, three for s = t + (R − I) c. If the contact normals are frozen, the sliding
//! constraints are affine in the same numbers.

use rayon::prelude::*;

use crate::boundary::{Motion, NodeKind, Plan, matched};
use crate::contact::{ContactState, SlidingNode, Spring};
use crate::error::{ErrorKind, MtmError, Result};
use crate::geometry::motion::RigidMotion;
use crate::mechanics::kinematics::Kinematics;
use crate::statics::options::Interrupt;
use crate::statics::reduction::NO_ROW;
use crate::statics::solver::StaticSolver;
use crate::statics::system::Frozen;
use crate::vector::{add, dot, scaled, sub};

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
        if self.kinematics() != Kinematics::Linear {
            return Err(MtmError::UnknownName {
                what: "kinematics of a plan operator",
                found: self.kinematics().name().into(),
                known: "linear (no linear map gives the others; use solve)",
                kind: ErrorKind::Solver,
            });
        }
        if !self.node_kinds.touching().is_empty() {
            return Err(MtmError::UnknownName {
                what: "boundary of a plan operator",
                found: "touching pairs".into(),
                known: "one without (what touches changes with the plan; use solve)",
                kind: ErrorKind::Solver,
            });
        }
        let mesh = self.tensors.mesh();
        let places = self.tensors.element_nodes().positions();
        let n = places.len();
        let nodes = nodes.unwrap_or_else(|| (0..mesh.n_nodes() as u32).collect());
        if let Some(row) = nodes.iter().position(|&j| j as usize >= n) {
            return Err(MtmError::IndexOutOfRange {
                what: "nodes".into(),
                row,
                item: "node",
                index: nodes[row] as usize,
                count: n,
                kind: ErrorKind::Boundary,
            });
        }
        let segments = self.node_kinds.segments();
        let rest: Plan = segments
            .iter()
            .map(|s| (s.name.clone(), Motion::Rigid(RigidMotion::identity())))
            .collect();
        let reference = reference.unwrap_or(&rest);
        rigid_plan(reference)?;
        let contact = self.settled(reference, interrupted)?;
        let centres: Vec<[f64; 3]> = segments
            .iter()
            .map(|s| {
                let members = s.joined.iter().chain(&s.sliding);
                let count = (s.joined.len() + s.sliding.len()) as f64;
                let mut c = [0.0; 3];
                for &j in members {
                    c = [0, 1, 2].map(|i| c[i] + places[j as usize][i] / count);
                }
                c
            })
            .collect();

        // Prescribed fields of all columns, followed by the constant column if there is contact.
        let (mut fields, mut scales) = (Vec::new(), Vec::new());
        for (s, segment) in segments.iter().enumerate() {
            for column in 0..COLUMNS {
                let mut u = vec![[0.0; 3]; n];
                for &j in &segment.joined {
                    u[j as usize] = unit_field(column, places[j as usize], centres[s]);
                }
                scales.push(if column < 9 { mesh.diagonal() } else { 1.0 });
                fields.push(self.coupled(&u));
            }
        }
        let solved = match (&contact, &self.sliding) {
            (Some(state), Some(sliding)) => {
                scales.push(1.0);
                fields.push(vec![[0.0; 3]; self.reduction.unknowns.len()]);
                let about = About { state, sliding: sliding.nodes(), places, centres: &centres };
                let names: Vec<&str> = segments.iter().map(|s| s.name.as_str()).collect();
                let slopes = about.slopes(reference, &names, &mut fields);
                let frozen = Frozen {
                    rows: &state.rows,
                    offsets: &slopes.offsets,
                    springs: &state.springs,
                    goals: &slopes.goals,
                };
                self.solve_columns(fields, &scales, Some(frozen), interrupted)?
            }
            _ => self.solve_columns(fields, &scales, None, interrupted)?,
        };

        let kinds = self.node_kinds.kinds(n)?;
        let mut rows = vec![[0.0; COLUMNS]; 3 * nodes.len() * segments.len()];
        let mut offset = contact.as_ref().map(|_| vec![0.0; 3 * nodes.len()]);
        for (at, &j) in nodes.iter().enumerate() {
            let row = self.reduction.row_of[j as usize];
            for s in 0..segments.len() {
                for column in 0..COLUMNS {
                    let u = if row != NO_ROW {
                        solved[COLUMNS * s + column][row as usize]
                    } else if kinds[j as usize] == NodeKind::Joined(s) {
                        unit_field(column, places[j as usize], centres[s])
                    } else {
                        [0.0; 3]
                    };
                    for i in 0..3 {
                        rows[(3 * at + i) * segments.len() + s][column] = u[i];
                    }
                }
            }
            if let (Some(offset), true) = (&mut offset, row != NO_ROW) {
                let u = solved[COLUMNS * segments.len()][row as usize];
                offset[3 * at..3 * at + 3].copy_from_slice(&u);
            }
        }
        let segments = segments.iter().map(|s| s.name.clone()).collect();
        Ok(PlanOperator { nodes, segments, centres, rows, offset })
    }
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
        if out.len() != self.nodes.len() {
            return Err(MtmError::Length {
                what: "output".into(),
                found: out.len(),
                expected: self.nodes.len(),
                why: "one row per node of the operator",
                kind: ErrorKind::Boundary,
            });
        }
        rigid_plan(plan)?;
        let names: Vec<&str> = self.segments.iter().map(String::as_str).collect();
        let mut numbers = Vec::with_capacity(names.len());
        for (motion, &centre) in matched(plan, &names)?.into_iter().zip(&self.centres) {
            // Motions that are not rigid were rejected above.
            let Motion::Rigid(rigid) = motion else { continue };
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

/// Contact at the reference plan, about which other plans are linearised.
struct About<'a> {
    state: &'a ContactState,
    sliding: &'a [SlidingNode],
    places: &'a [[f64; 3]],
    centres: &'a [[f64; 3]],
}

/// Derivatives of the contact conditions with respect to the columns of the operator, followed by their
/// constant part.
struct Slopes {
    /// Offset of every row, for each column.
    offsets: Vec<Vec<f64>>,
    /// Goal of every spring, for each column.
    goals: Vec<Vec<f64>>,
}

impl About<'_> {
    /// First-order change of the contact conditions about the reference. A row follows its surface along its
    /// normal, n·u = n·w(p), where w is the displacement of the point p of the segment. The force f n turns
    /// with the surface, and as the node slides on it: f H (u − w) + f (R − R₀) R₀ᵀ n across the normal. The
    /// first term is a spring that moves with the surface, the second a load, which is added to `fields`.
    fn slopes(&self, reference: &Plan, segments: &[&str], fields: &mut [Vec<[f64; 3]>]) -> Slopes {
        let Self { state, sliding, places, centres } = *self;
        let columns = fields.len();
        let mut out = Slopes {
            offsets: vec![vec![0.0; state.rows.len()]; columns],
            goals: vec![vec![0.0; state.springs.len()]; columns],
        };
        let identity = RigidMotion::identity();
        let motion = |s: usize| find(reference, segments[s]).unwrap_or(&identity);
        let mut feet = vec![[0.0; 3]; sliding.len()];
        for (r, row) in state.rows.iter().enumerate() {
            let node = &sliding[row.node];
            let foot = motion(node.segment).apply_inverse(row.point);
            feet[row.node] = foot;
            for column in 0..COLUMNS {
                let way = unit_field(column, foot, centres[node.segment]);
                out.offsets[COLUMNS * node.segment + column][r] = dot(row.normal, way);
            }
            out.offsets[columns - 1][r] = dot(row.normal, sub(foot, places[node.node as usize]));
        }
        for (r, spring) in state.springs.iter().enumerate() {
            let Spring { node: i, axis, .. } = *spring;
            let node = &sliding[i];
            let rigid = motion(node.segment);
            let reached = sub(rigid.apply(feet[i]), feet[i]);
            out.goals[columns - 1][r] = dot(axis, sub(state.displacements[i], reached));
            let unit = |column: usize| unit_field(column, feet[i], centres[node.segment]);
            for column in 0..COLUMNS {
                out.goals[COLUMNS * node.segment + column][r] = dot(axis, unit(column));
            }
        }
        // Rotation of the forces with their segments, only across the normal: the component along it belongs to
        // the row.
        for (i, node) in sliding.iter().enumerate().filter(|(i, _)| state.active[*i]) {
            let (normal, force) = (state.normals[i], state.forces[i]);
            let back = motion(node.segment).rotate_inverse(normal);
            let mut push = |column: usize, turn: [f64; 3]| {
                let across = sub(turn, scaled(normal, dot(normal, turn)));
                let row = &mut fields[column][node.row as usize];
                *row = add(*row, scaled(across, force));
            };
            for entry in 0..9 {
                push(COLUMNS * node.segment + entry, unit_field(entry, back, [0.0; 3]));
            }
            push(columns - 1, sub(back, normal));
        }
        out
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

/// Displacement of `x` in unit field `column`: entry (r, c) of R − I, or component of the shift.
fn unit_field(column: usize, x: [f64; 3], centre: [f64; 3]) -> [f64; 3] {
    let mut u = [0.0; 3];
    if column < 9 {
        u[column / 3] = x[column % 3] - centre[column % 3];
    } else {
        u[column - 9] = 1.0;
    }
    u
}

fn find<'a>(plan: &'a Plan, name: &str) -> Option<&'a RigidMotion> {
    plan.iter().find_map(|(segment, motion)| match motion {
        Motion::Rigid(rigid) if segment == name => Some(rigid),
        _ => None,
    })
}

fn rigid_plan(plan: &Plan) -> Result<()> {
    for (segment, motion) in plan {
        if !matches!(motion, Motion::Rigid(_)) {
            return Err(MtmError::Plan {
                segment: segment.clone(),
                problem: "the operator takes rigid 4×4 matrices only; use solve for other motions"
                    .into(),
            });
        }
    }
    Ok(())
}
