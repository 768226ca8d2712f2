//! The loads of unstable springs in a Krylov space, softened as far as the body needs.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use crate::vector::{add, norm, scaled};

/// Softness of unstable springs above which they have practically no effect.
const MOST_SOFTNESS: f64 = 1e6;

/// Number of bisections in the search for the softness.
const SOFTENINGS: usize = 30;

/// Loads y of unstable springs in the space spanned by their products: ((1 + μ) I − G) y = b, where G is the
/// flexibility between the springs, each scaled by the root of its stiffness. μ softens all springs equally, so
/// that the body is stable with them and no node moves beyond their reach (a trust region; Gould, Lucidi, Roma
/// & Toint 1999).
pub struct Krylov {
    /// Length of b.
    pub size: f64,
    /// Orthonormal directions, the first along b.
    pub basis: Vec<Vec<f64>>,
    /// Displacements of the sliding nodes under loads along them, mm.
    pub moved: Vec<Vec<[f64; 3]>>,
    /// G between them.
    pub flexibility: DMatrix<f64>,
    /// Part of the last product that lies outside them.
    pub rest: f64,
    /// y along each.
    pub solution: DVector<f64>,
    /// μ.
    pub softness: f64,
    /// Length of b − ((1 + μ) I − G) y.
    pub left: f64,
}

impl Krylov {
    /// No directions yet; `size`: length of b.
    pub fn new(size: f64) -> Self {
        Self {
            size,
            basis: Vec::new(),
            moved: Vec::new(),
            flexibility: DMatrix::zeros(0, 0),
            rest: 0.0,
            solution: DVector::zeros(0),
            softness: 0.0,
            left: size,
        }
    }

    /// Adds a direction with its product and the displacements it causes; returns the next direction.
    pub fn push(
        &mut self,
        direction: Vec<f64>,
        answer: Vec<f64>,
        moved: Vec<[f64; 3]>,
    ) -> Vec<f64> {
        let m = self.basis.len();
        self.basis.push(direction);
        self.moved.push(moved);
        let mut flexibility = std::mem::take(&mut self.flexibility).resize(m + 1, m + 1, 0.0);
        let mut next = answer;
        // Two passes are enough against rounding (Parlett 1980).
        for _ in 0..2 {
            for (k, q) in self.basis.iter().enumerate() {
                let along: f64 = q.iter().zip(&next).map(|(a, b)| a * b).sum();
                flexibility[(k, m)] += along;
                for (n, q) in next.iter_mut().zip(q) {
                    *n -= along * q;
                }
            }
        }
        for k in 0..m {
            flexibility[(m, k)] = flexibility[(k, m)];
        }
        self.flexibility = flexibility;
        self.rest = length(&next);
        next.iter().map(|v| v / self.rest.max(f64::MIN_POSITIVE)).collect()
    }

    /// The solution with the smallest softness for which no node moves further than `reach`, mm.
    pub fn soften(&mut self, reach: f64) {
        let m = self.basis.len();
        let eigen = SymmetricEigen::new(self.flexibility.clone());
        let start = eigen.eigenvectors.row(0).transpose() * self.size;
        let solution = |softness: f64| -> DVector<f64> {
            let held = eigen.eigenvalues.map(|g| 1.0 + softness - g);
            &eigen.eigenvectors * start.component_div(&held)
        };
        let farthest = |y: &DVector<f64>| {
            let moved = (0..self.moved[0].len()).map(|i| {
                let sum = (0..m).fold([0.0; 3], |sum, k| add(sum, scaled(self.moved[k][i], y[k])));
                norm(sum)
            });
            moved.fold(0.0, f64::max)
        };
        let most = eigen.eigenvalues.max();
        self.softness = 0.0;
        self.solution = solution(0.0);
        if most >= 1.0 || farthest(&self.solution) > reach {
            // Above the limit of stability, displacements decrease as the softness grows.
            let least = (most - 1.0).max(0.0);
            let (mut low, mut high) = (least, least + 1.0);
            while farthest(&solution(high)) > reach && high < MOST_SOFTNESS {
                high = least + 4.0 * (high - least);
            }
            for _ in 0..SOFTENINGS {
                let middle = 0.5 * (low + high);
                if farthest(&solution(middle)) > reach {
                    low = middle;
                } else {
                    high = middle;
                }
            }
            self.softness = high;
            self.solution = solution(high);
        }
        self.left = self.rest * self.solution[m - 1].abs();
    }
}

pub fn length(v: &[f64]) -> f64 {
    v.iter().map(|v| v * v).sum::<f64>().sqrt()
}
