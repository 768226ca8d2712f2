//! How sliding nodes respond to constraints if the factorisation of the body without them is available.
//!
//! Contact forces λ along the normals N follow from (Nᵀ F N) λ = g − Nᵀ u_free, where F = A⁻¹ is the flexibility
//! of the sliding nodes, which is stored. Normals change with each step of contact. The flexibility along the
//! normals and the axes of springs, a ninth of F or a quarter, is assembled for each step in single precision.
//! Conjugate gradients run in it, preconditioned with the matrix at rest. The sum of their forces is then applied
//! to the nodes: by an approximate product in early steps, otherwise by exact ones, from which the forces are
//! corrected (iterative refinement; Wilkinson 1963).

mod along;
mod inner;
pub(crate) mod krylov;
mod rows;

use std::sync::Arc;

use along::Along;
use inner::{ForceAccuracy, Inner, RowForces};

use crate::algebra::cholesky::{Factor, NormalFactor, ProductAccuracy, ROUGH, TailFlexibility};
use crate::contact::{Constraints, ContactRow, Response, Spring};
use crate::error::{MtmError, Result};
use crate::vector::{add, dot, norm, scaled, sub};
use krylov::{Krylov, length};
use rows::pushes;
pub(crate) use rows::{ConditionRows, singular};

/// Accuracy of a step above which approximate products do for the nodes as well.
const ROUGH_STEP: f64 = 1e-2;
/// Maximum number of times that forces found with approximate products are corrected by an exact one; each takes
/// six digits off their error.
const MOST_ROUNDS: usize = 6;
/// Multiple of the error allowed up to which a step is accepted as it is.
const NEARLY: f64 = 2.0;
/// Share of the error of a round above which further rounds would only change rounding errors.
const STALLED: f64 = 0.5;
/// Maximum number of directions in which loads of unstable springs are sought.
const MOST_LOAD_STEPS: usize = 60;
/// Largest relative error of the response to one of them.
const MOST_PROBE_ERROR: f64 = 0.1;
/// Relative error of contact forces, in the energy norm, at which only rounding errors are left.
const ROUNDING: f64 = 1e-14;
/// Rounding error of a displacement, in roundings of the largest.
const ROUNDINGS: f64 = 64.0;
/// Share of the contact tolerance by which the final contact forces may be in error, relative to all of them.
const EXACT_SHARE: f64 = 1e-4;

/// Data kept for sliding nodes: their flexibility, and the inverse of its part along the normals at rest.
pub(crate) struct ContactFactor {
    /// The flexibility of the sliding nodes.
    pub flexibility: TailFlexibility,
    rest: Arc<NormalFactor>,
}

impl ContactFactor {
    /// The flexibility of the sliding nodes: their rows, and their normals at rest. Those that may be lifted are last
    /// in the elimination order; `held` are their places.
    pub fn new(
        factor: &Factor,
        (sliding, normals): (&[u32], &[[f64; 3]]),
        held: &[usize],
    ) -> Result<Self> {
        let flexibility = factor.flexibility(sliding, held)?;
        let row = |(node, &normal)| ContactRow { node, normal, point: [0.0; 3] };
        let rows: Vec<ContactRow> = normals.iter().enumerate().map(row).collect();
        let rows = ConditionRows::new(&rows, &vec![0.0; rows.len()], &[]);
        let rest = Arc::new(rows.factor(&flexibility)?.inverse());
        Ok(Self { flexibility, rest })
    }

    /// The same with other nodes `held`; the preconditioner stays, which costs a few iterations.
    pub fn holding(&self, held: &[usize]) -> Result<Self> {
        Ok(Self { flexibility: self.flexibility.holding(held)?, rest: self.rest.clone() })
    }

    /// Bytes held for `nodes` sliding nodes: their flexibility in double and in single precision, and the inverse of
    /// its part along the normals in single precision; with `liftable` nodes, what these carry and add.
    pub fn bytes_for(nodes: usize, liftable: usize) -> usize {
        let triangle = |size: usize| size * (size + 1) / 2;
        let lifted = 8 * 9 * liftable * 2 * (nodes + liftable);
        12 * triangle(3 * nodes) + 4 * triangle(nodes) + lifted
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.flexibility.bytes() + self.rest.bytes()
    }

    /// The responses to the constraints of one plan, with forces `b`.
    pub fn answers<'a>(&'a self, factor: &'a Factor, b: &[[f64; 3]]) -> Answers<'a> {
        let swept = factor.swept(b);
        let lifted = self.flexibility.lifted_by(factor.on_tail(&swept));
        let moved = factor.of_rows(swept.clone(), self.flexibility.sliding_rows());
        let free = self.flexibility.following(moved, &lifted);
        let (moved, pushed) = (vec![[0.0; 3]; free.len()], vec![[0.0; 3]; free.len()]);
        Answers {
            contact: self,
            factor,
            swept,
            free,
            pushed,
            moved,
            precision: ProductAccuracy::Exact,
            memory: Vec::new(),
            made: None,
        }
    }
}

/// Responses of the sliding nodes to the constraints of one plan, each starting from the previous one.
pub(crate) struct Answers<'a> {
    contact: &'a ContactFactor,
    factor: &'a Factor,
    /// The forces after the forward sweep, in elimination order.
    swept: Vec<f64>,
    /// Displacements of the sliding nodes without contact forces, mm.
    free: Vec<[f64; 3]>,
    /// Forces on each node in the last response, N.
    pushed: Vec<[f64; 3]>,
    /// Their contribution to the displacements, mm, and its accuracy.
    moved: Vec<[f64; 3]>,
    precision: ProductAccuracy,
    /// Memory of the last assembled matrix.
    memory: Vec<f32>,
    /// The last factorisation made for this plan, if the one at rest was not good enough.
    made: Option<Arc<NormalFactor>>,
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
    /// `NotPositiveDefinite` if the rows are degenerate.
    pub fn respond(&mut self, c: &Constraints<'_>, tolerance: f64) -> Result<Response> {
        let unstable: Vec<Spring> =
            c.springs.iter().filter(|s| s.stiffness < 0.0).copied().collect();
        let rows = ConditionRows::new(c.rows, c.offsets, c.springs);
        let mut inner = self.inner(&rows, &unstable);
        let found = self.balanced(c, &rows, &unstable, &mut inner, tolerance);
        if inner.is_made {
            self.made = Some(inner.kept.clone());
        }
        self.memory = inner.along.into_memory();
        let (solved, is_carried) = found?;
        let (displacements, reactions) = (self.displacements(), self.pushed.clone());
        Ok(Response { displacements, reactions, slopes: None, solved, is_carried })
    }

    /// Brings the nodes into balance; whether their forces are exact, and whether springs had to be softened.
    fn balanced(
        &mut self,
        c: &Constraints<'_>,
        rows: &ConditionRows,
        unstable: &[Spring],
        inner: &mut Inner<'_>,
        tolerance: f64,
    ) -> Result<(bool, bool)> {
        let exact = ROUNDING.max(EXACT_SHARE * tolerance);
        let precision =
            if c.share >= ROUGH_STEP { ProductAccuracy::Rough } else { ProductAccuracy::Exact };
        let n = self.free.len();
        // The last forces, turned with their normals.
        let mut forces = rows.turned(&self.pushed, c.rows.len());
        self.push(pushes(n, &rows.rows, &forces), precision);
        let mut open = rows.open(&self.displacements(), &forces);
        let mut measure = inner.preconditioner.measure(&open);
        let aim = if precision == ProductAccuracy::Rough { c.share * measure } else { 0.0 };
        let (mut loads, mut is_carried) = (vec![0.0; unstable.len()], false);
        for round in 0..MOST_ROUNDS {
            let enough = aim.max(ROUGH * measure).max(exact * self.size());
            let mut found = inner.solve(&open, ForceAccuracy::Measure(enough))?;
            if round == 0 && !unstable.is_empty() {
                (loads, is_carried) = self.loads(c, unstable, inner, &mut found)?;
                let more = inner.solve(&found.left, ForceAccuracy::Measure(enough))?;
                add_to(&mut found.forces, 1.0, &more.forces);
            }
            add_to(&mut forces, 1.0, &found.forces);
            let mut now = pushes(n, &rows.rows, &forces);
            for (s, z) in unstable.iter().zip(&loads) {
                now[s.node] = add(now[s.node], scaled(s.axis, *z));
            }
            self.push(now, precision);
            open = rows.open(&self.displacements(), &forces);
            let before = std::mem::replace(&mut measure, inner.preconditioner.measure(&open));
            let is_exact = measure <= exact * self.size() || self.is_rounding(&open);
            if is_exact && self.precision == ProductAccuracy::Exact {
                return Ok((true, is_carried));
            }
            if is_exact || measure <= NEARLY * aim || measure > STALLED * before {
                break;
            }
        }
        Ok((false, is_carried))
    }

    /// Loads along `unstable` springs, N, and whether the springs had to be softened; `found`, the forces along
    /// the rows without them, becomes those with them.
    fn loads(
        &self,
        c: &Constraints<'_>,
        unstable: &[Spring],
        inner: &mut Inner<'_>,
        found: &mut RowForces,
    ) -> Result<(Vec<f64>, bool)> {
        let n = found.forces.len();
        let root: Vec<f64> = unstable.iter().map(|s| (-s.stiffness).sqrt()).collect();
        let stretch = unstable.iter().zip(&found.along[n..]).map(|(s, more)| {
            dot(s.axis, add(self.free[s.node], self.moved[s.node])) + more - s.goal
        });
        let start: Vec<f64> = stretch.zip(&root).map(|(v, r)| v * r).collect();
        let size = length(&start);
        let mut krylov = Krylov::new(size);
        let mut answered: Vec<RowForces> = Vec::new();
        let mut next: Vec<f64> = start.iter().map(|v| v / size).collect();
        while size > 0.0 && krylov.basis.len() < MOST_LOAD_STEPS.min(unstable.len()) {
            let mut push = vec![0.0; n];
            push.extend(next.iter().zip(&root).map(|(v, r)| v * r));
            let there = inner.along.multiply(&push);
            let goals: Vec<f64> = there[..n].iter().map(|v| -v).collect();
            // Later directions contribute less, so that errors of their responses count less (Simoncini &
            // Szyld 2003).
            let error = (c.spring_share * size / krylov.left).min(MOST_PROBE_ERROR);
            let answer = inner.solve(&goals, ForceAccuracy::Share(error))?;
            let moved: Vec<f64> =
                there[n..].iter().zip(&answer.along[n..]).map(|(a, b)| a + b).collect();
            let product = moved.iter().zip(&root).map(|(v, r)| v * r).collect();
            next = krylov.push(next, product, by_node(unstable, &moved));
            answered.push(answer);
            krylov.soften(c.reach);
            if krylov.left <= c.spring_share * size {
                break;
            }
        }
        let mut loads = vec![0.0; unstable.len()];
        for ((y, q), answer) in krylov.solution.iter().zip(&krylov.basis).zip(&answered) {
            for ((z, q), root) in loads.iter_mut().zip(q).zip(&root) {
                *z += y * q * root;
            }
            add_to(&mut found.forces, *y, &answer.forces);
            add_to(&mut found.left, *y, &answer.left);
        }
        Ok((loads, krylov.softness > 0.0))
    }

    /// The rows and the axes of `unstable` springs, ready to be solved for.
    fn inner<'r>(&mut self, rows: &'r ConditionRows, unstable: &[Spring]) -> Inner<'r>
    where
        'a: 'r,
    {
        let kept = self.made.as_ref().unwrap_or(&self.contact.rest).clone();
        let contact: &'a ContactFactor = self.contact;
        let tail = &contact.flexibility;
        let along = Along::new(tail, rows, unstable, std::mem::take(&mut self.memory));
        Inner::new(along, rows, (self.diagonal(rows), kept), tail)
    }

    /// Displacements after the last response, mm.
    fn displacements(&self) -> Vec<[f64; 3]> {
        self.free.iter().zip(&self.moved).map(|(f, m)| add(*f, *m)).collect()
    }

    /// Size of the forces in the energy norm.
    fn size(&self) -> f64 {
        self.pushed.iter().zip(&self.moved).map(|(f, m)| dot(*f, *m)).sum::<f64>().max(0.0).sqrt()
    }

    /// Whether `open`, what is missing along rows, mm, is no more than the rounding errors of displacements.
    fn is_rounding(&self, open: &[f64]) -> bool {
        let most = |moved: &[[f64; 3]]| moved.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
        let limit = ROUNDINGS * f64::EPSILON * (most(&self.free) + most(&self.moved));
        open.iter().all(|v| v.abs() <= limit)
    }

    /// Replaces the forces on the nodes, N.
    ///
    /// Approximate products are of changes, which are smaller; the first exact one after them is of all.
    fn push(&mut self, forces: Vec<[f64; 3]>, precision: ProductAccuracy) {
        if self.precision < precision {
            self.moved = self.respond_to(&forces, precision);
            self.precision = precision;
        } else {
            let change: Vec<_> =
                forces.iter().zip(&self.pushed).map(|(a, b)| sub(*a, *b)).collect();
            let change = self.respond_to(&change, precision);
            for (to, v) in self.moved.iter_mut().zip(change) {
                *to = add(*to, v);
            }
            self.precision = precision;
        }
        self.pushed = forces;
    }

    fn respond_to(&self, forces: &[[f64; 3]], precision: ProductAccuracy) -> Vec<[f64; 3]> {
        match precision {
            ProductAccuracy::Rough => self.contact.flexibility.respond_roughly(forces),
            ProductAccuracy::Exact => self.contact.flexibility.respond(forces),
        }
    }

    /// Flexibility of each row on its own, mm/N.
    fn diagonal(&self, rows: &ConditionRows) -> Vec<f64> {
        let own = |r: &ContactRow| self.contact.flexibility.own(r.node, r.normal);
        rows.rows.iter().zip(&rows.softness).map(|(r, s)| own(r) + s).collect()
    }

    /// Displacements of all rows of the system with `forces` on the sliding nodes.
    pub fn of_all(self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut swept = self.swept;
        self.factor.push(self.contact.flexibility.sliding_rows(), forces, &mut swept);
        let lifted = self.contact.flexibility.lifted_by(self.factor.on_tail(&swept));
        self.factor.above_tail(swept, &lifted)
    }
}

/// Adds `share` of `change` to `to`.
fn add_to(to: &mut [f64], share: f64, change: &[f64]) {
    for (to, v) in to.iter_mut().zip(change) {
        *to += share * v;
    }
}

/// Displacement of each node with springs, mm, from that along each axis; springs of a node follow one another.
fn by_node(springs: &[Spring], moved: &[f64]) -> Vec<[f64; 3]> {
    let mut out: Vec<[f64; 3]> = Vec::new();
    for (i, (s, v)) in springs.iter().zip(moved).enumerate() {
        let way = scaled(s.axis, *v);
        match out.last_mut() {
            Some(last) if i > 0 && springs[i - 1].node == s.node => *last = add(*last, way),
            _ => out.push(way),
        }
    }
    out
}

/// The error for contact forces that drive nodes by more than the body can resist.
pub(crate) fn unheld() -> MtmError {
    let why = "contact forces push sliding nodes further than the tissue restrains";
    MtmError::not_definite(0, why)
}
