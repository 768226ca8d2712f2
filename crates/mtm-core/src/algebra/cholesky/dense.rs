//! Sliding contact by dense matrices: the flexibility of the sliding nodes and its normal part.

use std::sync::Arc;

use rayon::prelude::*;

use super::lifting::{Liftable, Lifted, LowRank};
use super::symmetric::{DenseSymmetric, Number, Rough};
use crate::algebra::simd::{Kernel, widest};
use crate::error::{MtmError, Result};

/// The flexibility of the sliding nodes: their whole interaction.
pub struct TailFlexibility {
    /// S⁻¹ of the sliding nodes, while all nodes that may be lifted are held, mm/N.
    flexibility: Arc<DenseSymmetric>,
    /// The same in single precision, for intermediate displacements.
    rough: Arc<Rough>,
    /// Row of the system of each node: sliding nodes, then those that may be lifted.
    rows: Arc<[u32]>,
    /// The latter, if there are any.
    lifted: Option<Lifted>,
}

impl TailFlexibility {
    /// From the `flexibility` of the sliding nodes while all that may be lifted are held; `rows`: the row of the system
    /// of each, then of those. `carried` and `own`: how forces on sliding nodes are carried to those that may be
    /// lifted, and the part of the factor of the latter, row by row; those at the places `held`, ascending, are held.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the body does not hold the others.
    pub fn new(
        flexibility: DenseSymmetric,
        rows: Vec<u32>,
        (carried, own): (Vec<f64>, Vec<f64>),
        held: &[usize],
    ) -> Result<Self> {
        let width = flexibility.size();
        let liftable = (!own.is_empty()).then(|| Arc::new(Liftable::new(width, carried, &own)));
        let rough = Arc::new(Rough::of(&flexibility));
        let flexibility = Arc::new(flexibility);
        Self { flexibility, rough, rows: rows.into(), lifted: None }.with(liftable, held)
    }

    /// The same with other nodes `held`, by their places among those that may be lifted.
    pub fn holding(&self, held: &[usize]) -> Result<Self> {
        let (flexibility, rough) = (self.flexibility.clone(), self.rough.clone());
        let liftable = self.lifted.as_ref().map(|lifted| lifted.all.clone());
        Self { flexibility, rough, rows: self.rows.clone(), lifted: None }.with(liftable, held)
    }

    fn with(mut self, liftable: Option<Arc<Liftable>>, held: &[usize]) -> Result<Self> {
        let why = "tissue that is lifted off the bone is not held by the tissue around it";
        let loose = |place| MtmError::not_definite(self.row(self.n_sliding() + place), why);
        self.lifted = liftable.map(|all| Lifted::new(all, held).map_err(loose)).transpose()?;
        Ok(self)
    }

    /// Number of sliding nodes.
    pub fn n_sliding(&self) -> usize {
        self.flexibility.size() / 3
    }

    /// Row of the system of each sliding node, then of those that may be lifted.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// Whether any node may be lifted.
    pub fn lifts(&self) -> bool {
        self.lifted.is_some()
    }

    /// Row of the system of each sliding node.
    pub fn sliding_rows(&self) -> &[u32] {
        &self.rows[..self.n_sliding()]
    }

    /// Displacements of the nodes that may be lifted, under `forces` on them.
    pub fn lifted_by(&self, forces: &[f64]) -> Vec<f64> {
        self.lifted.as_ref().map_or_else(Vec::new, |lifted| lifted.hold(forces))
    }

    /// Displacements of the sliding nodes from `moved`, those while all nodes that may be lifted are held, and from
    /// those of these.
    pub fn following(&self, mut moved: Vec<f64>, lifted: &[f64]) -> Vec<[f64; 3]> {
        if let Some(own) = &self.lifted {
            own.all.take_back(lifted, &mut moved);
        }
        vectors(&moved)
    }

    /// Forces on all these nodes that bring them from `moved`, their displacements without contact and with all liftable
    /// nodes free, to those under `contact`, the forces on sliding nodes at given displacements.
    pub fn pushes(
        &self,
        moved: &[[f64; 3]],
        contact: impl Fn(&[[f64; 3]]) -> Result<Vec<[f64; 3]>>,
    ) -> Result<Vec<[f64; 3]>> {
        let Some(lifted) = &self.lifted else { return contact(moved) };
        let (sliding, own) = moved.split_at(self.n_sliding());
        let flat = |free: &[f64]| Ok(contact(&vectors(free))?.into_flattened());
        Ok(vectors(&lifted.pushes((sliding.as_flattened(), own.as_flattened()), flat)?))
    }

    /// What lifted nodes add to the flexibility between `directions`: node and unit vector each.
    pub fn more_along<T: Number>(&self, directions: &[(usize, [f64; 3])]) -> Option<LowRank<T>> {
        self.lifted.as_ref().map(|lifted| lifted.more.along(directions))
    }

    /// The displacements `moved` with what lifted nodes add under `forces`.
    fn with_lifted(&self, mut moved: Vec<f64>, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        if let Some(lifted) = &self.lifted {
            lifted.more.add_product(forces.as_flattened(), &mut moved);
        }
        vectors(&moved)
    }

    /// Row of the system of node `i`.
    pub fn row(&self, i: usize) -> usize {
        self.rows[i] as usize
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let lifted = self.lifted.as_ref().map_or(0, Lifted::bytes);
        self.flexibility.bytes() + self.rough.bytes() + lifted
    }

    /// Flexibility of sliding node `i` on its own along the unit vector `axis`, mm/N, while all liftable nodes are held.
    pub fn own(&self, i: usize, axis: [f64; 3]) -> f64 {
        let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.column(3 * i + b));
        let [x, y, z] = axis;
        x * x * c0[0]
            + y * y * c1[0]
            + z * z * c2[0]
            + 2.0 * (x * y * c0[1] + x * z * c0[2] + y * z * c1[1])
    }

    /// Displacements of the sliding nodes under forces on them alone, S⁻¹ f.
    pub fn respond(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        self.with_lifted(self.flexibility.multiply(forces.as_flattened()), forces)
    }

    /// The same to six digits of the largest, in half the time.
    pub fn respond_roughly(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        self.with_lifted(self.rough.multiply(forces.as_flattened()), forces)
    }

    /// Normal flexibility n_rᵀ S⁻¹_ij n_s of constraint rows: row r constrains node i along the unit normal n_r, its
    /// direction; a node may have several rows. `softness[r]` (mm/N) is added to the diagonal.
    pub fn normal_flexibility(
        &self,
        directions: &[(usize, [f64; 3])],
        softness: &[f64],
    ) -> DenseSymmetric {
        let more = self.more_along(directions).map(|more| more.product());
        DenseSymmetric::from_columns(directions.len(), |c, column| {
            let (j, n_j) = directions[c];
            // S⁻¹ n_j for node j and those after it. The columns begin on the diagonal, and the part of the
            // block there that is missing in the second and third is in the first.
            let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.column(3 * j + b));
            let mut along: Vec<f64> = c0.iter().map(|v| v * n_j[0]).collect();
            for (out, v) in along[1..].iter_mut().zip(c1) {
                *out += v * n_j[1];
            }
            for (out, v) in along[2..].iter_mut().zip(c2) {
                *out += v * n_j[2];
            }
            along[0] += c0[1] * n_j[1] + c0[2] * n_j[2];
            along[1] += c1[1] * n_j[2];
            for (out, &(i, n_i)) in column.iter_mut().zip(&directions[c..]) {
                *out = if i >= j {
                    let v = &along[3 * (i - j)..3 * (i - j) + 3];
                    n_i[0] * v[0] + n_i[1] * v[1] + n_i[2] * v[2]
                } else {
                    let entry = |a: usize, b: usize| {
                        n_i[a] * n_j[b] * self.flexibility.column(3 * i + a)[3 * (j - i) + b - a]
                    };
                    (0..3).map(|a| entry(a, 0) + entry(a, 1) + entry(a, 2)).sum()
                };
            }
            if let Some(more) = &more {
                for (r, out) in (c..).zip(column.iter_mut()) {
                    *out += more[(r, c)];
                }
            }
            column[0] += softness[c];
        })
    }

    /// The flexibility between `directions` (node and unit vector, nodes ascending) in single precision,
    /// with `softness` (mm/N) added to its diagonal, while all liftable nodes are held; `memory`: of an earlier one.
    pub fn rough_flexibility(
        &self,
        directions: &[(usize, [f64; 3])],
        softness: &[f64],
        memory: Vec<f32>,
    ) -> Rough {
        let scale: Vec<f64> = directions
            .par_iter()
            .zip(softness)
            .map(|(&(node, axis), soft)| (self.own(node, axis) + soft).sqrt())
            .collect();
        // In the units of the rough flexibility and of the result, both of which have ones on the diagonal.
        let weights: Vec<[f32; 3]> = directions
            .iter()
            .zip(&scale)
            .map(|(&(node, axis), s)| {
                std::array::from_fn(|a| (axis[a] * self.rough.scale[3 * node + a] / s) as f32)
            })
            .collect();
        let nodes: Vec<usize> = directions.iter().map(|(node, _)| *node).collect();
        let matrix = DenseSymmetric::from_columns_in(memory, nodes.len(), |c, column| {
            let columns = [0, 1, 2].map(|b| self.rough.matrix.column(3 * nodes[c] + b));
            let (nodes, weights) = (&nodes[c..], &weights[c..]);
            widest(Project { columns, nodes, weights, column });
            column[0] = 1.0;
        });
        Rough { matrix, scale }
    }
}

/// One column of a flexibility between directions, from the three columns of the flexibility of its node.
struct Project<'a> {
    /// From the diagonal down.
    columns: [&'a [f32]; 3],
    /// Node of the direction and of those after it, ascending.
    nodes: &'a [usize],
    /// Direction of each.
    weights: &'a [[f32; 3]],
    column: &'a mut [f32],
}

impl Kernel for Project<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { columns: [c0, c1, c2], nodes, weights, column } = self;
        let [w0, w1, w2] = weights[0];
        // The displacements of all later nodes under a force along the direction. The block on the diagonal is
        // stored as its lower triangle.
        let mut along = vec![0.0_f32; c0.len()];
        along[0] = c0[0] * w0 + c0[1] * w1 + c0[2] * w2;
        along[1] = c0[1] * w0 + c1[0] * w1 + c1[1] * w2;
        along[2] = c0[2] * w0 + c1[1] * w1 + c2[0] * w2;
        let later = along[3..].iter_mut().zip(&c0[3..]).zip(&c1[2..]).zip(&c2[1..]);
        for (((out, a), b), c) in later {
            *out = a * w0 + b * w1 + c * w2;
        }
        for ((out, &i), w) in column.iter_mut().zip(nodes).zip(weights) {
            let v = &along[3 * (i - nodes[0])..][..3];
            *out = v[0] * w[0] + v[1] * w[1] + v[2] * w[2];
        }
    }
}

fn vectors(values: &[f64]) -> Vec<[f64; 3]> {
    values.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect()
}
