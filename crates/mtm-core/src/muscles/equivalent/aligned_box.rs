//! Boxes along the coordinate axes.

use crate::vector::Vec3;

/// A box along the coordinate axes, mm; empty if `low` exceeds `high`.
#[allow(missing_docs)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignedBox {
    pub low: Vec3,
    pub high: Vec3,
}

#[allow(missing_docs)]
impl AlignedBox {
    pub const EMPTY: Self = Self {
        low: Vec3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        high: Vec3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    };

    /// Smallest box round `points`.
    pub fn of(points: &[Vec3]) -> Self {
        points.iter().fold(Self::EMPTY, |b, p| Self { low: b.low.inf(p), high: b.high.sup(p) })
    }

    /// Smallest box round both.
    pub fn joined(&self, other: &Self) -> Self {
        Self { low: self.low.inf(&other.low), high: self.high.sup(&other.high) }
    }

    /// Whether both have a point in common, their faces included.
    pub fn meets(&self, other: &Self) -> bool {
        (0..3).all(|i| self.low[i] <= other.high[i] && other.low[i] <= self.high[i])
    }

    pub fn centre(&self) -> Vec3 {
        0.5 * (self.low + self.high)
    }

    /// Distance from the centre to a corner, mm.
    pub fn radius(&self) -> f64 {
        0.5 * (self.high - self.low).norm()
    }
}
