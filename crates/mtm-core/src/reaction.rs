//! How sliding nodes answer to constraints where the factor of the body without them is kept.
//!
//! Contact forces λ along the normals N follow from (Nᵀ A⁻¹ N) λ = g − Nᵀ u_free, by conjugate gradients that
//! the matrix at rest preconditions. Until closest points settle they stop early, and begin where the last
//! displacements put them: two or three products for each set of normals, rough ones but for two in a plan.
//!
//! Few sliding nodes have their whole flexibility A⁻¹ at hand for the products, and the matrix of other
//! normals is written down and factored where too many are needed. Where nodes are many, products come from
//! sweeps through the part of the factor that they reach: less to make and to keep, but springs and second
//! walls, which the matrix at rest knows nothing of, can take a hundred of them.

use crate::cholesky::{
    Begun, DenseSymmetric, Factor, Moved, NormalFactor, NormalForces, Precision, Preconditioner,
    Progress, ROUGH, Reach, RowKey, Symbolic, TailFlexibility, Wanted, conjugate_gradients,
    hopeless,
};
use crate::contact::{Constraints, Response, Sliding};
use crate::crease::ContactRow;
use crate::error::{MtmError, Result, Shortfall};
use crate::mesh::{add, dot, scaled, sub};

/// Steps of sweeps after which contact gives up: ten on smooth bone, a hundred on teeth.
const MOST_SWEEPS: usize = 1000;
/// Share of what is left to change that rough products may have left open before one that is exact.
const DOUBT_SHARE: f64 = 0.1;
/// Relative error of contact forces, in the energy norm, at which only rounding is left.
const ROUNDING: f64 = 1e-14;
/// Share of the contact tolerance that the forces of settled contact may be off, relative to all of them.
const EXACT_SHARE: f64 = 1e-2;

/// What is kept for sliding nodes: their flexibility, and the inverse of its part along the normals at
/// rest.
pub(crate) struct ContactFactor {
    flexibility: Flexibility,
    rest: NormalFactor,
}

/// Displacements of sliding nodes under forces on them.
enum Flexibility {
    /// Written down.
    Dense(TailFlexibility),
    /// By sweeps.
    Sweeps {
        reach: Reach,
        /// Row of the system of each sliding node.
        rows: Vec<u32>,
        /// Flexibility of each by itself along its normal at rest, mm/N.
        own: Vec<f64>,
    },
}

impl ContactFactor {
    /// The whole flexibility of the sliding nodes, which the structure keeps last.
    pub fn dense(symbolic: &Symbolic, factor: &Factor, sliding: &Sliding) -> Result<Self> {
        let tail = symbolic.tail_flexibility(factor);
        let row = |(node, &normal)| ContactRow { node, normal, point: [0.0; 3] };
        let rows: Vec<ContactRow> = sliding.rest_normals().iter().enumerate().map(row).collect();
        let offsets = vec![0.0; rows.len()];
        let rows = Rows::new(&Constraints { rows: &rows, offsets: &offsets, springs: &[] });
        let rest = rows.factor(&tail)?.inverse();
        Ok(Self { flexibility: Flexibility::Dense(tail), rest })
    }

    /// The flexibility along the normals at rest, and what sweeps need for the rest of it.
    pub fn by_sweeps(symbolic: &Symbolic, factor: &Factor, sliding: &Sliding) -> Result<Self> {
        let rows: Vec<u32> = sliding.nodes().iter().map(|n| n.row).collect();
        let reach = symbolic.reach(&rows);
        let (normal, order) = symbolic.reach_flexibility(factor, &reach, sliding.rest_normals());
        let mut own = vec![0.0; rows.len()];
        for (c, &i) in order.iter().enumerate() {
            own[i] = normal.column(c)[0];
        }
        let keys = order.iter().map(|&i| (i, 0)).collect();
        let rest = NormalFactor::new(normal, keys).map_err(|at| singular(rows[order[at]]))?;
        let rest = rest.inverse();
        Ok(Self { flexibility: Flexibility::Sweeps { reach, rows, own }, rest })
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let flexibility = match &self.flexibility {
            Flexibility::Dense(tail) => tail.bytes(),
            Flexibility::Sweeps { reach, rows, .. } => reach.bytes() + 12 * rows.len(),
        };
        flexibility + self.rest.bytes()
    }

    /// Answers to one plan's constraints, whose forces are `b`.
    pub fn answers<'a>(
        &'a self,
        symbolic: &'a Symbolic,
        factor: &'a Factor,
        b: &[[f64; 3]],
    ) -> Answers<'a> {
        let (free, swept) = match &self.flexibility {
            Flexibility::Dense(tail) => {
                let (forces, swept) = symbolic.on_tail(factor, b);
                (tail.respond(&forces), swept)
            }
            Flexibility::Sweeps { reach, .. } => {
                let mut swept = symbolic.permuted(b);
                symbolic.forward(factor, &mut swept);
                (symbolic.reach_displacements(factor, reach, &mut swept.clone()), swept)
            }
        };
        let work = match &self.flexibility {
            Flexibility::Dense(_) => Vec::new(),
            Flexibility::Sweeps { .. } => vec![0.0; swept.len()],
        };
        let (moved, pushed) = (vec![[0.0; 3]; free.len()], vec![[0.0; 3]; free.len()]);
        Answers {
            contact: self,
            symbolic,
            factor,
            swept,
            free,
            pushed,
            moved,
            precision: Precision::Exact,
            doubt: 0.0,
            work,
            made: None,
            last: Vec::new(),
        }
    }

    /// Answers to constraints that stay the same for several right-hand sides.
    pub fn frozen<'a>(
        &self,
        rows: &'a [ContactRow],
        offsets: &'a [Vec<f64>],
    ) -> Result<FrozenAnswers<'a>> {
        let normal = match &self.flexibility {
            Flexibility::Dense(tail) => {
                let none = vec![0.0; rows.len()];
                let c = Constraints { rows, offsets: &none, springs: &[] };
                Some(Rows::new(&c).factor(tail)?)
            }
            Flexibility::Sweeps { .. } => None,
        };
        Ok(FrozenAnswers { rows, offsets, normal })
    }
}

/// Constraints that stay the same for several right-hand sides.
pub(crate) struct FrozenAnswers<'a> {
    rows: &'a [ContactRow],
    /// Offset of every row, for each right-hand side.
    offsets: &'a [Vec<f64>],
    /// The factor of their flexibility, where it is written down.
    normal: Option<NormalFactor>,
}

impl FrozenAnswers<'_> {
    /// Force on each sliding node for right-hand side `k`, whose answers are `answers`.
    pub fn forces(&self, answers: &mut Answers<'_>, k: usize) -> Result<Vec<[f64; 3]>> {
        let c = Constraints { rows: self.rows, offsets: &self.offsets[k], springs: &[] };
        let rows = Rows::new(&c);
        let forces = match &self.normal {
            Some(normal) => normal.solve(rows.missing(&answers.free)),
            None => answers.forces(&rows, 0.0, ROUNDING)?.forces,
        };
        Ok(pushes(answers.free.len(), &rows.rows, &forces))
    }
}

/// Answers of the sliding nodes to one plan's constraints, each begun from the one before.
pub(crate) struct Answers<'a> {
    contact: &'a ContactFactor,
    symbolic: &'a Symbolic,
    factor: &'a Factor,
    /// The forces after the sweep to the sliding nodes, in elimination order.
    swept: Vec<f64>,
    /// Displacements of the sliding nodes without contact forces, mm.
    free: Vec<[f64; 3]>,
    /// Forces of the last answer on each.
    pushed: Vec<[f64; 3]>,
    /// What they added to the displacements, mm, and how exactly.
    moved: Vec<[f64; 3]>,
    precision: Precision,
    /// What rough products may have left open, in the measure of the preconditioner.
    doubt: f64,
    /// Zeros for the sweeps.
    work: Vec<f64>,
    /// The factor made last in this plan, once the one at rest did not serve.
    made: Option<NormalFactor>,
    /// Rows of the last answer, ascending, with their forces.
    last: Vec<(RowKey, f64)>,
}

impl Answers<'_> {
    /// Displacements of the sliding nodes and contact forces under constraints `c`, to `share` of what these
    /// change, as long as `tolerance` of contact asks for no less.
    ///
    /// How exact the forces are shows in the gaps that the displacements leave, which `settle` measures.
    pub fn respond(&mut self, c: &Constraints<'_>, share: f64, tolerance: f64) -> Result<Response> {
        let rows = Rows::new(c);
        let exact = ROUNDING.max(EXACT_SHARE * tolerance);
        let NormalForces { mut forces, solved, .. } = self.forces(&rows, share, exact)?;
        let displacements = self.moved.iter().zip(&self.free).map(|(r, f)| add(*r, *f)).collect();
        forces.truncate(c.rows.len());
        Ok(Response { displacements, forces, solved })
    }

    /// Contact forces along `rows`, and what they add to the displacements: to `share` of what the rows change,
    /// or to `exact` of all.
    fn forces(&mut self, rows: &Rows, share: f64, exact: f64) -> Result<NormalForces> {
        let kept = self.made.as_ref().unwrap_or(&self.contact.rest);
        let preconditioner = Preconditioner::new(self.diagonal(rows), &rows.keys, kept);
        let before = |key: &RowKey| {
            self.last.binary_search_by(|(k, _)| k.cmp(key)).map_or(0.0, |at| self.last[at].1)
        };
        let mut start: Vec<f64> = rows.keys.iter().map(before).collect();
        // What the last displacements leave open, were its forces not to turn with the normals.
        let goals = rows.missing(&self.free);
        let there = rows.along(&self.moved, &start);
        let open: Vec<f64> = goals.iter().zip(there).map(|(g, v)| g - v).collect();
        let (change, measure) = preconditioner.measure(&open);
        for (x, v) in start.iter_mut().zip(change) {
            *x += v;
        }
        let (n, work) = (self.free.len(), &mut self.work);
        let mut respond = |pushes: &[[f64; 3]], precision| match &self.contact.flexibility {
            Flexibility::Dense(tail) if precision == Precision::Rough => {
                (tail.respond_roughly(pushes), precision)
            }
            Flexibility::Dense(tail) => (tail.respond(pushes), precision),
            Flexibility::Sweeps { reach, .. } => {
                (self.symbolic.respond(self.factor, reach, pushes, work), Precision::Exact)
            }
        };
        // What is rough of a change is little of the whole, until that little is what is left to change.
        let now = pushes(n, &rows.rows, &start);
        let (nodes, precision) = if self.doubt > DOUBT_SHARE * measure {
            self.doubt = 0.0;
            respond(&now, Precision::Exact)
        } else {
            let change: Vec<_> = now.iter().zip(&self.pushed).map(|(a, b)| sub(*a, *b)).collect();
            let (change, precision) = respond(&change, Precision::Rough);
            let nodes = self.moved.iter().zip(change).map(|(a, b)| add(*a, b)).collect();
            (nodes, precision.min(self.precision))
        };
        let begun = Begun {
            moved: Moved { along: rows.along(&nodes, &start), nodes, precision },
            forces: start,
        };
        let product = |x: &[f64], precision| {
            let (nodes, precision) = respond(&pushes(n, &rows.rows, x), precision);
            Moved { along: rows.along(&nodes, x), nodes, precision }
        };
        let wanted = Wanted { exact, enough: share * measure };
        let found = match &self.contact.flexibility {
            Flexibility::Dense(tail) => {
                let near =
                    conjugate_gradients(product, &preconditioner, &goals, begun, wanted, hopeless);
                match near {
                    Ok(found) => found,
                    Err(_) => {
                        let made = rows.factor(tail)?;
                        let forces = made.solve(goals);
                        let nodes = tail.respond(&pushes(n, &rows.rows, &forces));
                        self.made = Some(made);
                        let precision = Precision::Exact;
                        NormalForces { forces, nodes, precision, solved: true }
                    }
                }
            }
            Flexibility::Sweeps { .. } => {
                let give_up = |progress: &Progress| progress.step >= MOST_SWEEPS;
                conjugate_gradients(product, &preconditioner, &goals, begun, wanted, give_up)
                    .map_err(|error| MtmError::NotConverged {
                        method: "contact by sweeps",
                        iterations: MOST_SWEEPS,
                        shortfall: Shortfall {
                            quantity: "the error of the contact nodes",
                            value: error,
                            limit: exact,
                            unit: " mm",
                        },
                        advice: "use method=\"pcg\"; contact normals or walls may be degenerate",
                    })?
            }
        };
        self.moved.clone_from(&found.nodes);
        self.precision = found.precision;
        self.doubt = match found.precision {
            Precision::Rough => self.doubt + ROUGH * measure,
            Precision::Exact => 0.0,
        };
        self.pushed = pushes(n, &rows.rows, &found.forces);
        self.last = rows.keys.iter().copied().zip(found.forces.iter().copied()).collect();
        self.last.sort_unstable_by_key(|(key, _)| *key);
        Ok(found)
    }

    /// Flexibility of each row by itself, mm/N.
    fn diagonal(&self, rows: &Rows) -> Vec<f64> {
        let own = |r: &ContactRow| match &self.contact.flexibility {
            Flexibility::Dense(tail) => tail.own(r.node, r.normal),
            Flexibility::Sweeps { own, .. } => own[r.node],
        };
        rows.rows.iter().zip(&rows.softness).map(|(r, s)| own(r) + s).collect()
    }

    /// Displacements of all rows of the system with `forces` on the sliding nodes.
    pub fn displacements(self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let Self { symbolic, factor, mut swept, mut work, .. } = self;
        match &self.contact.flexibility {
            Flexibility::Dense(tail) => {
                let moved = tail.respond(forces);
                let there: Vec<_> =
                    moved.iter().zip(&self.free).map(|(r, f)| add(*r, *f)).collect();
                symbolic.above_tail(factor, swept, &there)
            }
            Flexibility::Sweeps { reach, .. } => {
                symbolic.add_reach_forces(factor, reach, forces, &mut work, &mut swept);
                symbolic.backward(factor, &mut swept);
                symbolic.unpermuted(&swept)
            }
        }
    }
}

/// Constraint rows, and after them one for each spring: a spring of stiffness k adds a column along its
/// axis, with 1/k on the diagonal.
struct Rows {
    rows: Vec<ContactRow>,
    /// Displacement that each row asks for, mm.
    goals: Vec<f64>,
    /// What is added to the diagonal, mm/N.
    softness: Vec<f64>,
    keys: Vec<RowKey>,
}

impl Rows {
    fn new(c: &Constraints<'_>) -> Self {
        let (mut rows, mut goals) = (c.rows.to_vec(), c.offsets.to_vec());
        let mut softness = vec![0.0; rows.len()];
        for spring in c.springs {
            rows.push(ContactRow { node: spring.node, normal: spring.axis, point: [0.0; 3] });
            goals.push(spring.goal);
            softness.push(1.0 / spring.stiffness);
        }
        let most = rows.iter().map(|r| r.node + 1).max().unwrap_or(0);
        let mut count = vec![0; most];
        let key = |r: &ContactRow| {
            count[r.node] += 1;
            (r.node, count[r.node] - 1)
        };
        let keys = rows.iter().map(key).collect();
        Self { rows, goals, softness, keys }
    }

    /// What contact forces have to add to displacements `free`, mm.
    fn missing(&self, free: &[[f64; 3]]) -> Vec<f64> {
        self.rows.iter().zip(&self.goals).map(|(r, g)| g - dot(r.normal, free[r.node])).collect()
    }

    /// Displacement along each row where nodes move by `nodes` and the forces along the rows are `forces`.
    fn along(&self, nodes: &[[f64; 3]], forces: &[f64]) -> Vec<f64> {
        let along = |((r, s), f): ((&ContactRow, &f64), &f64)| dot(r.normal, nodes[r.node]) + s * f;
        self.rows.iter().zip(&self.softness).zip(forces).map(along).collect()
    }

    /// Nᵀ S⁻¹ N with the softness.
    fn flexibility(&self, tail: &TailFlexibility) -> DenseSymmetric {
        let nodes: Vec<usize> = self.rows.iter().map(|r| r.node).collect();
        let normals: Vec<[f64; 3]> = self.rows.iter().map(|r| r.normal).collect();
        tail.normal_flexibility(&nodes, &normals, &self.softness)
    }

    /// The factor of the flexibility.
    fn factor(&self, tail: &TailFlexibility) -> Result<NormalFactor> {
        NormalFactor::new(self.flexibility(tail), self.keys.clone())
            .map_err(|at| self.singular(tail, at))
    }

    fn singular(&self, tail: &TailFlexibility, at: usize) -> MtmError {
        singular(tail.row(self.rows[at].node) as u32)
    }
}

/// That the flexibility has no positive pivot at a row of the system.
fn singular(row: u32) -> MtmError {
    MtmError::NotPositiveDefinite {
        node: row as usize,
        detail: "the flexibility of the sliding nodes is singular".into(),
    }
}

/// Force vector of each of `n` sliding nodes from the forces along the rows.
fn pushes(n: usize, rows: &[ContactRow], forces: &[f64]) -> Vec<[f64; 3]> {
    let mut out = vec![[0.0; 3]; n];
    for (r, &force) in rows.iter().zip(forces) {
        out[r.node] = add(out[r.node], scaled(r.normal, force));
    }
    out
}
