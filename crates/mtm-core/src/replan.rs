//! Exact re-planning: the answer to any rigid plan from columns solved once.
//!
//! A rigid motion is affine, u_b = (R − I)(x − c) + s, so twelve unit fields per segment span every
//! finite motion of it: nine for R − I, three for s = t + (R − I) c. With contact normals frozen the
//! sliding constraints are affine in the same numbers.

use rayon::prelude::*;

use crate::boundary::{Motion, NodeKind, Plan, matched};
use crate::crease::ContactRow;
use crate::error::{ErrorKind, MtmError, Result};
use crate::mesh::{dot, sub};
use crate::method::Interrupt;
use crate::statics::{NO_ROW, StaticSolver};
use crate::system::Frozen;

/// Unit fields per segment.
pub const COLUMNS: usize = 12;
/// Nodes from which a second core brings more than its wake-up costs.
const NODES_FOR_THREADS: usize = 32_768;
/// Nodes a thread takes at once.
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
    /// Displacement that does not depend on the plan: rest gaps that contact closes.
    offset: Option<Vec<f64>>,
}

impl StaticSolver {
    /// The operator for `nodes` (all of them if `None`).
    ///
    /// Without sliding nodes it equals `solve` for every rigid plan. With them, contact points, normals
    /// and the set of held nodes are those of `reference` (at rest if `None`).
    ///
    /// # Errors
    /// Node indices out of range, a reference plan that does not fit or settle, a linear solve that
    /// fails.
    pub fn plan_operator(
        &self,
        nodes: Option<Vec<u32>>,
        reference: Option<&Plan>,
        interrupted: Interrupt<'_>,
    ) -> Result<PlanOperator> {
        let mesh = self.tensors.mesh();
        let n = mesh.n_nodes();
        let nodes = nodes.unwrap_or_else(|| (0..n as u32).collect());
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
        let segments = self.boundary.segments();
        let rest: Plan = segments
            .iter()
            .map(|s| (s.name.clone(), Motion::Rigid(crate::motion::RigidMotion::identity())))
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
                    c = [0, 1, 2].map(|i| c[i] + mesh.nodes()[j as usize][i] / count);
                }
                c
            })
            .collect();

        // Prescribed fields of every column, and the constant column last if there is contact.
        let (mut fields, mut offsets, mut scales) = (Vec::new(), Vec::new(), Vec::new());
        let sliding = self.sliding.as_ref().map_or(&[][..], |s| s.nodes());
        let rows = contact.as_ref().map_or(&[][..], |c| c.rows.as_slice());
        let feet: Vec<[f64; 3]> = rows
            .iter()
            .map(|row| match find(reference, &segments[sliding[row.node].segment].name) {
                Some(rigid) => rigid.apply_inverse(row.point),
                None => row.point,
            })
            .collect();
        for (s, segment) in segments.iter().enumerate() {
            for column in 0..COLUMNS {
                let mut u = vec![[0.0; 3]; n];
                for &j in &segment.joined {
                    u[j as usize] = unit_field(column, mesh.nodes()[j as usize], centres[s]);
                }
                scales.push(if column < 9 { mesh.diagonal() } else { 1.0 });
                fields.push(self.coupled(&u));
                if contact.is_none() {
                    continue;
                }
                let along = |(row, &foot): (&ContactRow, &[f64; 3])| {
                    if sliding[row.node].segment == s {
                        dot(row.normal, unit_field(column, foot, centres[s]))
                    } else {
                        0.0
                    }
                };
                offsets.push(rows.iter().zip(&feet).map(along).collect::<Vec<f64>>());
            }
        }
        if contact.is_some() {
            scales.push(1.0);
            fields.push(vec![[0.0; 3]; self.unknowns.len()]);
            let rest = |(row, &foot): (&ContactRow, &[f64; 3])| {
                let node = &sliding[row.node];
                dot(row.normal, sub(foot, mesh.nodes()[node.node as usize]))
            };
            offsets.push(rows.iter().zip(&feet).map(rest).collect());
        }
        let frozen = contact.as_ref().map(|_| Frozen { rows, offsets: &offsets });
        let solved = self.solve_columns(fields, &scales, frozen, interrupted)?;

        let kinds = self.boundary.kinds(n)?;
        let mut rows = vec![[0.0; COLUMNS]; 3 * nodes.len() * segments.len()];
        let mut offset = contact.as_ref().map(|_| vec![0.0; 3 * nodes.len()]);
        for (at, &j) in nodes.iter().enumerate() {
            let row = self.row_of[j as usize];
            for s in 0..segments.len() {
                for column in 0..COLUMNS {
                    let u = if row != NO_ROW {
                        solved[COLUMNS * s + column][row as usize]
                    } else if kinds[j as usize] == NodeKind::Joined(s) {
                        unit_field(column, mesh.nodes()[j as usize], centres[s])
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
    /// The nodes it answers for.
    pub fn nodes(&self) -> &[u32] {
        &self.nodes
    }

    /// The segments, in the order of its columns.
    pub fn segments(&self) -> &[String] {
        &self.segments
    }

    /// The twelve columns of each segment, (3k, 12·segments) row by row.
    pub fn matrix(&self) -> &[f64] {
        self.rows.as_flattened()
    }

    /// Displacements of the nodes under a rigid plan, mm.
    ///
    /// # Errors
    /// A plan that does not name every segment once, or moves one otherwise than rigidly.
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
            // Every other motion was refused above.
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

fn find<'a>(plan: &'a Plan, name: &str) -> Option<&'a crate::motion::RigidMotion> {
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
