//! The mean direction of fibres, whose signs have no meaning.

use nalgebra::{Matrix3, SymmetricEigen};

use crate::vector::Vec3;

/// Difference of eigenvalues over their sum below which they count as equal.
const TIE: f64 = 1e-9;

/// Weighted sum of a ⊗ a over fibre directions a.
#[derive(Debug, Clone, Copy, Default)]
pub struct DirectionSum {
    tensor: Matrix3<f64>,
    /// The first direction added, which decides if eigenvalues are equal.
    first: Option<Vec3>,
}

/// Mean direction of fibres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeanDirection {
    /// Unit vector; its component of largest magnitude is positive. Zero if there is no fibre.
    pub direction: [f64; 3],
    /// (λ₁ − λ₂)/(λ₁ + λ₂ + λ₃) of Σ w a ⊗ a: 1 if all fibres are parallel, 0 if no direction dominates.
    pub coherence: f64,
}

impl DirectionSum {
    /// Adds a unit direction.
    pub fn add(&mut self, direction: [f64; 3], weight: f64) {
        let a = Vec3::from(direction);
        self.tensor += a * a.transpose() * weight;
        self.first.get_or_insert(a);
    }

    /// Multiplies all weights.
    pub fn scale(&mut self, factor: f64) {
        self.tensor *= factor;
    }

    /// Adds another sum, whose directions follow those of this one.
    pub fn append(&mut self, other: &Self) {
        self.tensor += other.tensor;
        self.first = self.first.or(other.first);
    }

    /// Principal eigenvector of the sum.
    ///
    /// If the largest eigenvalue is double or triple, it is the direction of that eigenspace nearest to the
    /// first direction added.
    pub fn mean(&self) -> MeanDirection {
        let Some(first) = self.first else {
            return MeanDirection { direction: [0.0; 3], coherence: 0.0 };
        };
        let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::new(self.tensor);
        let mut rank = [0, 1, 2];
        rank.sort_by(|&i, &j| eigenvalues[j].total_cmp(&eigenvalues[i]));
        let sum = eigenvalues.sum();
        let [leading, second, _] = rank.map(|i| eigenvalues[i]);
        let lead = eigenvectors.column(rank[0]).into_owned();
        let tied = rank.into_iter().filter(|&i| leading - eigenvalues[i] <= TIE * sum);
        let nearest: Vec3 = tied
            .map(|i| {
                let e = eigenvectors.column(i).into_owned();
                e * e.dot(&first)
            })
            .sum();
        // `first` is part of the sum, so its eigenspace is rarely perpendicular to it.
        let axis = nearest.try_normalize(TIE).unwrap_or(lead);
        let coherence = ((leading - second) / sum).clamp(0.0, 1.0);
        MeanDirection { direction: signed(axis).into(), coherence }
    }
}

/// The one of ±`a` whose component of largest magnitude is positive.
fn signed(a: Vec3) -> Vec3 {
    if a[a.iamax()] < 0.0 { -a } else { a }
}
