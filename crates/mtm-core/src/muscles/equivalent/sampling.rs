//! What is sampled, how finely, and the work involved.

use std::sync::Arc;

use crate::error::{ErrorKind, Result};
use crate::geometry::surface::Surface;
use crate::muscles::equivalent::shape::InsideTest;
use crate::muscles::fibre::MuscleFibres;

/// Maximum number of samples per tet.
pub const MOST_SAMPLES: usize = 1 << 20;

/// A muscle: its surface and its fibres.
#[derive(Debug, Clone)]
pub struct Muscle {
    /// Its surface with outward normals; one that is inside out is reversed, and reported by
    /// [`MuscleVolume::was_turned`](crate::MuscleVolume::was_turned).
    pub surface: Arc<Surface>,
    /// The directions of its fibres.
    pub fibres: Arc<MuscleFibres>,
}

/// How the tets are sampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SamplingOptions {
    /// Number of points in each tet that a surface crosses; the others take one.
    pub samples: usize,
    /// Seed of the points.
    pub seed: u64,
    /// How a point is classified as inside.
    pub inside: InsideTest,
}

impl Default for SamplingOptions {
    fn default() -> Self {
        Self { samples: 64, seed: 0, inside: InsideTest::Winding }
    }
}

impl SamplingOptions {
    pub(super) fn check(&self) -> Result<()> {
        let samples = self.samples;
        let is_allowed = (1..=MOST_SAMPLES).contains(&samples);
        ErrorKind::Material.require(is_allowed, "samples", samples as f64, "1 to 1048576")
    }
}

impl InsideTest {
    /// The test called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        let known = [("winding", Self::Winding), ("normal", Self::Normal)];
        ErrorKind::Material.named("inside", name, known)
    }
}

/// Work of a sampling.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SamplingCounts {
    /// Number of points whose side of a muscle's surface was evaluated: one for a tet or group of tets that the
    /// surface does not cross, all samples for one that it does.
    pub points: usize,
    /// Number of pairs of a tet and a muscle that were examined individually.
    pub pairs: usize,
    /// Number of tets that were sampled.
    pub crossed: usize,
}

/// Time of a sampling, s.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SamplingTimings {
    /// Building the trees over triangles and tets.
    pub trees: f64,
    /// Finding the tets that the surfaces cross.
    pub crossing: f64,
    /// Evaluating samples, directions and sums.
    pub sampling: f64,
}
