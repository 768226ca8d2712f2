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
use crate::contact::{Constraints, ContactRow, Sliding, Spring};
use crate::error::{MtmError, Result, Shortfall};
use crate::mesh::{add, dot, scaled, sub};

/// Steps of sweeps after which contact gives up: ten on smooth bone, a hundred on teeth.
const MOST_SWEEPS: usize = 1000;
/// Share of what is left to change that rough products may have left open before one that is exact.
const DOUBT_SHARE: f64 = 0.1;
/// Share of the loads of unstable springs to which they are solved at the least.
const LOAD_SHARE: f64 = 1e-5;
/// Steps of conjugate gradients after which they count as too much for the body.
const MOST_LOAD_STEPS: usize = 40;
/// Share of a direction's load that the body has to hold by itself: with less, steps go anywhere.
const LEAST_HOLD: f64 = 0.05;
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
        let rows = Rows::new(&Constraints {
            rows: &rows,
            offsets: &offsets,
            springs: &[],
            about: &[],
            share: 0.0,
        });
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
            frozen: None,
            made: None,
            last: Vec::new(),
            carried: None,
        }
    }

    /// What answers for conditions that stay the same for several right-hand sides, where the flexibility is
    /// written down.
    pub fn frozen(&self, rows: &[ContactRow], springs: &[Spring]) -> Result<Option<NormalFactor>> {
        let Flexibility::Dense(tail) = &self.flexibility else { return Ok(None) };
        let offsets = vec![0.0; rows.len()];
        let c = Constraints { rows, offsets: &offsets, springs, about: &[], share: 0.0 };
        Rows::new(&c).factor(tail).map(Some)
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
    /// The factor for conditions that stay the same.
    frozen: Option<&'a NormalFactor>,
    /// The factor made last in this plan, once the one at rest did not serve.
    made: Option<NormalFactor>,
    /// Rows of the last answer, ascending, with their forces.
    last: Vec<(RowKey, f64)>,
    /// Loads that unstable springs bring.
    carried: Option<Carried>,
}

/// Loads on the sliding nodes.
struct Carried {
    /// N.
    loads: Vec<[f64; 3]>,
    /// What they add to the displacements, mm.
    moved: Vec<[f64; 3]>,
}

/// What sliding nodes do under contact conditions.
pub(crate) struct Answer {
    /// Displacement of each, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Force on each, N.
    pub forces: Vec<[f64; 3]>,
    /// Whether they are within the tolerance.
    pub solved: bool,
}

impl<'a> Answers<'a> {
    /// The sliding nodes under conditions `c`, to the share of what these change that they ask for; `tolerance`:
    /// of contact, over the size of the scene.
    ///
    /// Springs that hold a node back stand among the rows. Those that carry it on, of stiffness −k along the axes
    /// A, are loads z = k (Aᵀ u − goal): (1/k − Aᵀ F A) z = Aᵀ u₀ − goal with F the flexibility of the body
    /// under the rows, by conjugate gradients, which also show where the loads are more than the body holds.
    ///
    /// # Errors
    /// `NotPositiveDefinite` where the body does not hold the loads.
    pub fn respond(&mut self, c: &Constraints<'_>, tolerance: f64) -> Result<Answer> {
        let unstable: Vec<Spring> =
            c.springs.iter().filter(|s| s.stiffness < 0.0).copied().collect();
        let rows = Rows::new(c);
        let exact = ROUNDING.max(EXACT_SHARE * tolerance);
        self.carried = None;
        let mut found = self.forces(&rows, c.share, exact)?;
        let mut here = self.displacements();
        if !unstable.is_empty() {
            let share = c.share.max(LOAD_SHARE);
            let stretch = |u: &[[f64; 3]]| -> Vec<f64> {
                unstable.iter().map(|s| dot(s.axis, u[s.node]) - s.goal).collect()
            };
            let mut z = vec![0.0; unstable.len()];
            // Scaled by √k: the matrix is I − √k Aᵀ F A √k.
            let root: Vec<f64> = unstable.iter().map(|s| (-s.stiffness).sqrt()).collect();
            let scaled_by_root = |v: Vec<f64>| -> Vec<f64> {
                v.into_iter().zip(&root).map(|(v, r)| v * r).collect()
            };
            let mut r = scaled_by_root(stretch(&here));
            let mut p = r.clone();
            let mut size: f64 = r.iter().map(|v| v * v).sum();
            let first = size;
            for step in 0.. {
                if size <= share * share * first {
                    break;
                }
                if step == MOST_LOAD_STEPS {
                    return Err(unheld());
                }
                let ahead: Vec<f64> = (0..z.len()).map(|i| z[i] + root[i] * p[i]).collect();
                self.forces_under(&unstable, &ahead, &rows, c.share, exact)?;
                let there = self.displacements();
                let moved: Vec<[f64; 3]> =
                    there.iter().zip(&here).map(|(a, b)| sub(*a, *b)).collect();
                let along = unstable.iter().map(|s| dot(s.axis, moved[s.node])).collect();
                let along = scaled_by_root(along);
                let held: Vec<f64> = p.iter().zip(&along).map(|(p, a)| p - a).collect();
                let curvature: f64 = p.iter().zip(&held).map(|(p, h)| p * h).sum();
                // Also false for NaN.
                let is_held = curvature > LEAST_HOLD * p.iter().map(|v| v * v).sum::<f64>();
                if !is_held {
                    return Err(unheld());
                }
                let alpha = size / curvature;
                for i in 0..z.len() {
                    z[i] += alpha * root[i] * p[i];
                    r[i] -= alpha * held[i];
                }
                for (u, v) in here.iter_mut().zip(&moved) {
                    *u = add(*u, scaled(*v, alpha));
                }
                let next: f64 = r.iter().map(|v| v * v).sum();
                let beta = next / size;
                size = next;
                for (p, r) in p.iter_mut().zip(&r) {
                    *p = r + beta * *p;
                }
            }
            found = self.forces_under(&unstable, &z, &rows, c.share, exact)?;
        }
        let mut forces = self.pushed.clone();
        if let Some(Carried { loads, .. }) = &self.carried {
            for (f, load) in forces.iter_mut().zip(loads) {
                *f = add(*f, *load);
            }
        }
        Ok(Answer { displacements: self.displacements(), forces, solved: found.solved })
    }

    /// As `forces`, under loads z along unstable springs as well.
    fn forces_under(
        &mut self,
        unstable: &[Spring],
        z: &[f64],
        rows: &Rows,
        share: f64,
        exact: f64,
    ) -> Result<NormalForces> {
        let mut loads = vec![[0.0; 3]; self.free.len()];
        for (s, z) in unstable.iter().zip(z) {
            loads[s.node] = add(loads[s.node], scaled(s.axis, *z));
        }
        let moved = self.response_to(&loads);
        self.carried = Some(Carried { loads, moved });
        self.forces(rows, share, exact)
    }

    /// The same answers by a factor for their conditions.
    pub fn frozen(self, frozen: Option<&'a NormalFactor>) -> Self {
        Self { frozen, ..self }
    }

    /// Displacements without the forces of the rows, mm.
    fn unpushed(&self) -> Vec<[f64; 3]> {
        match &self.carried {
            Some(Carried { moved, .. }) => {
                self.free.iter().zip(moved).map(|(f, a)| add(*f, *a)).collect()
            }
            None => self.free.clone(),
        }
    }

    /// Displacements after the last answer, mm.
    fn displacements(&self) -> Vec<[f64; 3]> {
        self.unpushed().iter().zip(&self.moved).map(|(f, m)| add(*f, *m)).collect()
    }

    /// What forces on the sliding nodes add to their displacements, mm.
    fn response_to(&mut self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        match &self.contact.flexibility {
            Flexibility::Dense(tail) => tail.respond(forces),
            Flexibility::Sweeps { reach, .. } => {
                self.symbolic.respond(self.factor, reach, forces, &mut self.work)
            }
        }
    }

    /// Contact forces along `rows`, and what they add to the displacements: to `share` of what the rows change,
    /// or to `exact` of all.
    fn forces(&mut self, rows: &Rows, share: f64, exact: f64) -> Result<NormalForces> {
        let kept = self.made.as_ref().or(self.frozen).unwrap_or(&self.contact.rest);
        let preconditioner = Preconditioner::new(self.diagonal(rows), &rows.keys, kept);
        let before = |key: &RowKey| {
            self.last.binary_search_by(|(k, _)| k.cmp(key)).map_or(0.0, |at| self.last[at].1)
        };
        let mut start: Vec<f64> = rows.keys.iter().map(before).collect();
        // What the last displacements leave open, were its forces not to turn with the normals.
        let goals = rows.missing(&self.unpushed());
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
    pub fn of_all(self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
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
        for spring in c.springs.iter().filter(|s| s.stiffness > 0.0) {
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

/// That contact forces carry nodes on by more than the body holds.
fn unheld() -> MtmError {
    MtmError::NotPositiveDefinite {
        node: 0,
        detail: "contact forces carry sliding nodes on by more than the tissue holds".into(),
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
