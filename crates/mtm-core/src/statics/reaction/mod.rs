//! How sliding nodes respond to constraints if the factorisation of the body without them is available.
//!
//! Contact forces λ along the normals N follow from (Nᵀ A⁻¹ N) λ = g − Nᵀ u_free, solved by conjugate gradients
//! with the matrix at rest as preconditioner. Until the closest points converge, the iterations stop early and
//! start from the last displacements: two or three products for each set of normals, of which all but two per
//! plan are approximate.
//!
//! If there are few sliding nodes, their whole flexibility A⁻¹ is stored for the products, and the matrix of
//! new normals is assembled and factorised if too many products would be needed. If there are many, products
//! are computed by sweeps through the part of the factor that the nodes reach. This takes less time to set up
//! and less memory, but springs and second walls, which the matrix at rest does not include, can require a
//! hundred of them.

mod krylov;
mod rows;

use crate::algebra::cholesky::{
    Begun, Factor, Moved, NormalFactor, NormalForces, Precision, Preconditioner, Progress, ROUGH,
    Reach, RowKey, TailFlexibility, Wanted, conjugate_gradients, hopeless,
};
use crate::contact::{Constraints, ContactRow, Sliding, Spring};
use crate::error::{MtmError, Result, Shortfall};
use crate::vector::{add, dot, scaled, sub};
use krylov::{Krylov, length};
use rows::pushes;
pub(crate) use rows::{Rows, singular};

/// Maximum number of steps with sweeps: ten are needed on smooth bone, a hundred on teeth.
const MOST_SWEEPS: usize = 1000;
/// Error that approximate products may accumulate, as a share of the remaining change, before an exact product
/// is needed.
const DOUBT_SHARE: f64 = 0.1;
/// Relative accuracy of the loads of unstable springs if no further step corrects them.
const LOAD_SHARE: f64 = 1e-5;
/// Maximum number of conjugate gradient steps for these loads.
const MOST_LOAD_STEPS: usize = 60;
/// Relative error of the response to a trial direction that is allowed in a step.
const PROBE_ERROR: f64 = 1e-3;
/// Size of trial loads relative to the contact forces: large enough for their effect to exceed rounding errors
/// by far.
const PROBE_SHARE: f64 = 1e-2;
/// Relative error of contact forces, in the energy norm, at which only rounding errors are left.
const ROUNDING: f64 = 1e-14;
/// Share of the contact tolerance by which the final contact forces may be in error, relative to all of them.
const EXACT_SHARE: f64 = 1e-2;

/// Data kept for sliding nodes: their flexibility, and the inverse of its part along the normals at rest.
pub(crate) struct ContactFactor {
    flexibility: Flexibility,
    rest: NormalFactor,
}

/// Displacements of sliding nodes under forces on them.
enum Flexibility {
    /// Stored as a matrix.
    Dense(TailFlexibility),
    /// Computed by sweeps.
    Sweeps {
        reach: Reach,
        /// Row of the system of each sliding node.
        rows: Vec<u32>,
        /// Flexibility of each on its own along its normal at rest, mm/N.
        own: Vec<f64>,
    },
}

impl ContactFactor {
    /// The whole flexibility of the sliding nodes, which are last in the elimination order.
    pub fn dense(factor: &Factor, sliding: &Sliding) -> Result<Self> {
        let tail = factor.tail_flexibility();
        let row = |(node, &normal)| ContactRow { node, normal, point: [0.0; 3] };
        let rows: Vec<ContactRow> = sliding.rest_normals().iter().enumerate().map(row).collect();
        let offsets = vec![0.0; rows.len()];
        let rows = Rows::new(&Constraints {
            rows: &rows,
            offsets: &offsets,
            springs: &[],
            about: &[],
            share: 0.0,
            reach: f64::INFINITY,
        });
        let rest = rows.factor(&tail)?.inverse();
        Ok(Self { flexibility: Flexibility::Dense(tail), rest })
    }

    /// The flexibility along the normals at rest, and the data that sweeps need for the rest of it.
    pub fn by_sweeps(factor: &Factor, sliding: &Sliding) -> Result<Self> {
        let rows: Vec<u32> = sliding.nodes().iter().map(|n| n.row).collect();
        let reach = factor.reach(&rows);
        let (normal, order) = factor.reach_flexibility(&reach, sliding.rest_normals());
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

    /// The responses to the constraints of one plan, with forces `b`.
    pub fn answers<'a>(&'a self, factor: &'a Factor, b: &[[f64; 3]]) -> Answers<'a> {
        let (free, swept) = match &self.flexibility {
            Flexibility::Dense(tail) => {
                let (forces, swept) = factor.on_tail(b);
                (tail.respond(&forces), swept)
            }
            Flexibility::Sweeps { reach, .. } => {
                let mut swept = factor.permuted(b);
                factor.forward(&mut swept);
                (factor.reach_displacements(reach, &mut swept.clone()), swept)
            }
        };
        let work = match &self.flexibility {
            Flexibility::Dense(_) => Vec::new(),
            Flexibility::Sweeps { .. } => vec![0.0; swept.len()],
        };
        let (moved, pushed) = (vec![[0.0; 3]; free.len()], vec![[0.0; 3]; free.len()]);
        Answers {
            contact: self,
            factor,
            swept,
            free,
            pushed,
            moved,
            precision: Precision::Exact,
            doubt: 0.0,
            enough: 0.0,
            work,
            made: None,
            last: Vec::new(),
            carried: None,
        }
    }

    /// The whole flexibility of the sliding nodes, if it is stored.
    pub fn tail(&self) -> Option<&TailFlexibility> {
        match &self.flexibility {
            Flexibility::Dense(tail) => Some(tail),
            Flexibility::Sweeps { .. } => None,
        }
    }
}

/// Responses of the sliding nodes to the constraints of one plan, each starting from the previous one.
pub(crate) struct Answers<'a> {
    contact: &'a ContactFactor,
    factor: &'a Factor,
    /// The forces after the forward sweep to the sliding nodes, in elimination order.
    swept: Vec<f64>,
    /// Displacements of the sliding nodes without contact forces, mm.
    free: Vec<[f64; 3]>,
    /// Forces on each node in the last response.
    pushed: Vec<[f64; 3]>,
    /// Their contribution to the displacements, mm, and its accuracy.
    moved: Vec<[f64; 3]>,
    precision: Precision,
    /// Error accumulated by approximate products, in the norm of the preconditioner.
    doubt: f64,
    /// Accuracy required of the last response, in the same norm.
    enough: f64,
    /// Zeros for the sweeps.
    work: Vec<f64>,
    /// The last factorisation made for this plan, if the one at rest was not good enough.
    made: Option<NormalFactor>,
    /// Rows of the last response, ascending, with their forces.
    last: Vec<(RowKey, f64)>,
    /// Loads due to unstable springs.
    carried: Option<Carried>,
}

/// Loads on the sliding nodes.
struct Carried {
    /// N.
    loads: Vec<[f64; 3]>,
    /// Their contribution to the displacements, mm.
    moved: Vec<[f64; 3]>,
}

/// Response of the sliding nodes to contact conditions.
pub(crate) struct Answer {
    /// Displacement of each, mm.
    pub displacements: Vec<[f64; 3]>,
    /// Force on each, N.
    pub forces: Vec<[f64; 3]>,
    /// Whether they are within the tolerance.
    pub solved: bool,
    /// Whether unstable springs would have carried nodes beyond their reach.
    pub is_carried: bool,
}

impl<'a> Answers<'a> {
    /// The response of the sliding nodes to conditions `c`, with the relative accuracy that `c` requests;
    /// `tolerance`: of contact, over the size of the scene.
    ///
    /// Springs that hold a node back are treated as rows. Those of negative stiffness −k along the axes A,
    /// which drive nodes further along, become loads z = k (Aᵀ u − goal): (1/k − Aᵀ F A) z = Aᵀ u₀ − goal,
    /// where F is the flexibility of the body under the rows. The system is solved by [`Krylov`], which softens
    /// springs that make the body unstable.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the loads make the body unstable and their reach is unlimited.
    pub fn respond(&mut self, c: &Constraints<'_>, tolerance: f64) -> Result<Answer> {
        let unstable: Vec<Spring> =
            c.springs.iter().filter(|s| s.stiffness < 0.0).copied().collect();
        let rows = Rows::new(c);
        let exact = ROUNDING.max(EXACT_SHARE * tolerance);
        self.carried = None;
        let mut found = self.forces(&rows, Aim::Share(c.share), exact)?;
        let mut is_carried = false;
        if !unstable.is_empty() {
            let enough = Aim::Measure(self.enough);
            let loads;
            (loads, is_carried) = self.loads(&unstable, c, &rows, exact)?;
            self.carry(&unstable, &loads, Precision::Exact);
            found = self.forces(&rows, enough, exact)?;
        }
        let mut forces = self.pushed.clone();
        if let Some(Carried { loads, .. }) = &self.carried {
            for (f, load) in forces.iter_mut().zip(loads) {
                *f = add(*f, *load);
            }
        }
        Ok(Answer { displacements: self.displacements(), forces, solved: found.solved, is_carried })
    }

    /// Loads along `unstable` springs, N, and whether the springs had to be softened.
    fn loads(
        &mut self,
        unstable: &[Spring],
        c: &Constraints<'_>,
        rows: &Rows,
        exact: f64,
    ) -> Result<(Vec<f64>, bool)> {
        // In a step, the next step corrects what is left; for an operator there is no next step.
        let is_step = c.reach.is_finite();
        let share = if is_step { c.share.max(PROBE_ERROR) } else { LOAD_SHARE };
        let (aim, precision) = if is_step {
            (Aim::Share(share), Precision::Rough)
        } else {
            (Aim::Share(0.0), Precision::Exact)
        };
        let root: Vec<f64> = unstable.iter().map(|s| (-s.stiffness).sqrt()).collect();
        let here = self.displacements();
        let stretch = unstable.iter().map(|s| dot(s.axis, here[s.node]) - s.goal);
        let open: Vec<f64> = stretch.zip(&root).map(|(v, r)| v * r).collect();
        let size = length(&open);
        let most = self.pushed.iter().map(|f| dot(*f, *f)).sum::<f64>().sqrt();
        let (base, mut answered) = (self.pose(), Vec::new());
        let mut krylov = Krylov::new(size);
        let mut next: Vec<f64> = open.iter().map(|v| v / size).collect();
        while size > 0.0 && krylov.basis.len() < MOST_LOAD_STEPS.min(unstable.len()) {
            let q: Vec<f64> = next.iter().zip(&root).map(|(v, r)| v * r).collect();
            // Scaled to the size of the responses known so far.
            let up = PROBE_SHARE * most / length(&q);
            let loads: Vec<f64> = q.iter().map(|q| q * up).collect();
            self.take(base.clone());
            self.carry(unstable, &loads, precision);
            self.forces(rows, aim, exact)?;
            answered.push((up, self.pose()));
            let there = self.displacements();
            let moved: Vec<[f64; 3]> =
                there.iter().zip(&here).map(|(a, b)| scaled(sub(*a, *b), 1.0 / up)).collect();
            let answer = unstable.iter().zip(&root).map(|(s, r)| r * dot(s.axis, moved[s.node]));
            let answer = answer.collect();
            next = krylov.push(next, answer, moved);
            krylov.soften(c.reach);
            if krylov.left <= share * size {
                break;
            }
        }
        if c.reach.is_infinite() && (krylov.softness > 0.0 || krylov.left > share * size) {
            return Err(unheld());
        }
        // Responses are linear: their sum is close to the final one.
        let mut sum = base.clone();
        for (y, (up, pose)) in krylov.solution.iter().zip(&answered) {
            sum.add(y / up, pose, &base);
        }
        self.take(sum);
        self.doubt = f64::INFINITY;
        let mut loads = vec![0.0; unstable.len()];
        for (y, q) in krylov.solution.iter().zip(&krylov.basis) {
            for ((z, q), root) in loads.iter_mut().zip(q).zip(&root) {
                *z += y * q * root;
            }
        }
        Ok((loads, krylov.softness > 0.0))
    }

    /// Applies loads z along unstable springs to the body.
    fn carry(&mut self, unstable: &[Spring], z: &[f64], precision: Precision) {
        let mut loads = vec![[0.0; 3]; self.free.len()];
        for (s, z) in unstable.iter().zip(z) {
            loads[s.node] = add(loads[s.node], scaled(s.axis, *z));
        }
        let moved = match (&self.contact.flexibility, precision) {
            (Flexibility::Dense(tail), Precision::Rough) => tail.respond_roughly(&loads),
            (Flexibility::Dense(tail), Precision::Exact) => tail.respond(&loads),
            (Flexibility::Sweeps { reach, .. }, _) => {
                self.factor.respond(reach, &loads, &mut self.work)
            }
        };
        self.carried = Some(Carried { loads, moved });
    }

    /// Displacements of the sliding nodes without contact, mm.
    pub fn free(&self) -> &[[f64; 3]] {
        &self.free
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

    /// Displacements after the last response, mm.
    fn displacements(&self) -> Vec<[f64; 3]> {
        self.unpushed().iter().zip(&self.moved).map(|(f, m)| add(*f, *m)).collect()
    }

    /// Contact forces and their effect, as a state to start from.
    fn pose(&self) -> Pose {
        Pose { last: self.last.clone(), pushed: self.pushed.clone(), moved: self.moved.clone() }
    }

    fn take(&mut self, pose: Pose) {
        (self.last, self.pushed, self.moved) = (pose.last, pose.pushed, pose.moved);
    }

    /// Contact forces along `rows`, with their contribution to the displacements: with the accuracy of `aim`,
    /// or to the share `exact` of the whole.
    fn forces(&mut self, rows: &Rows, aim: Aim, exact: f64) -> Result<NormalForces> {
        let kept = self.made.as_ref().unwrap_or(&self.contact.rest);
        let preconditioner = Preconditioner::new(self.diagonal(rows), &rows.keys, kept);
        let before = |key: &RowKey| {
            self.last.binary_search_by(|(k, _)| k.cmp(key)).map_or(0.0, |at| self.last[at].1)
        };
        let mut start: Vec<f64> = rows.keys.iter().map(before).collect();
        // What the last displacements leave open, assuming that the forces do not turn with the normals.
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
                (self.factor.respond(reach, pushes, work), Precision::Exact)
            }
        };
        // The error of an approximate product is a small share of the change, until the remaining change is
        // just as small.
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
        let enough = match aim {
            Aim::Share(share) => share * measure,
            Aim::Measure(enough) => enough,
        };
        self.enough = enough;
        let wanted = Wanted { exact, enough };
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

    /// Flexibility of each row on its own, mm/N.
    fn diagonal(&self, rows: &Rows) -> Vec<f64> {
        let own = |r: &ContactRow| match &self.contact.flexibility {
            Flexibility::Dense(tail) => tail.own(r.node, r.normal),
            Flexibility::Sweeps { own, .. } => own[r.node],
        };
        rows.rows.iter().zip(&rows.softness).map(|(r, s)| own(r) + s).collect()
    }

    /// Displacements of all rows of the system with `forces` on the sliding nodes.
    pub fn of_all(self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let Self { factor, mut swept, mut work, .. } = self;
        match &self.contact.flexibility {
            Flexibility::Dense(tail) => {
                let moved = tail.respond(forces);
                let there: Vec<_> =
                    moved.iter().zip(&self.free).map(|(r, f)| add(*r, *f)).collect();
                factor.above_tail(swept, &there)
            }
            Flexibility::Sweeps { reach, .. } => {
                factor.add_reach_forces(reach, forces, &mut work, &mut swept);
                factor.backward(&mut swept);
                factor.unpermuted(&swept)
            }
        }
    }
}

/// Accuracy required of the forces.
#[derive(Clone, Copy)]
enum Aim {
    /// Relative to the change that the rows cause.
    Share(f64),
    /// Absolute, in the norm of the preconditioner.
    Measure(f64),
}

/// Contact forces of a response, and their effect.
#[derive(Clone)]
struct Pose {
    last: Vec<(RowKey, f64)>,
    pushed: Vec<[f64; 3]>,
    moved: Vec<[f64; 3]>,
}

impl Pose {
    /// Adds `share` of the difference between `to` and `from`, for the same rows.
    fn add(&mut self, share: f64, to: &Self, from: &Self) {
        for (own, (to, from)) in self.last.iter_mut().zip(to.last.iter().zip(&from.last)) {
            own.1 += share * (to.1 - from.1);
        }
        let more = |own: &mut Vec<[f64; 3]>, to: &[[f64; 3]], from: &[[f64; 3]]| {
            for (own, (to, from)) in own.iter_mut().zip(to.iter().zip(from)) {
                *own = add(*own, scaled(sub(*to, *from), share));
            }
        };
        more(&mut self.pushed, &to.pushed, &from.pushed);
        more(&mut self.moved, &to.moved, &from.moved);
    }
}

/// The error for contact forces that drive nodes by more than the body can resist.
pub(crate) fn unheld() -> MtmError {
    MtmError::NotPositiveDefinite {
        node: 0,
        detail: "contact forces carry sliding nodes on by more than the tissue holds".into(),
    }
}
