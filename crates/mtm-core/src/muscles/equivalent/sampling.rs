//! What is sampled, how finely, and the work that it took.

use std::sync::Arc;

use crate::error::{ErrorKind, MtmError, Result};
use crate::geometry::surface::Surface;
use crate::muscles::equivalent::shape::InsideTest;
use crate::muscles::fibre::MuscleFibres;

/// Names of the inside tests.
pub const INSIDE_TESTS: &str = "winding, normal";
/// Most samples of a tet.
pub const MOST_SAMPLES: usize = 1 << 20;

/// A muscle: its surface and the course of its fibres.
#[derive(Debug, Clone)]
pub struct Muscle {
    /// Its surface with outward normals; one that is inside out is turned, and
    /// [`MuscleVolume::was_turned`](crate::MuscleVolume::was_turned) says so.
    pub surface: Arc<Surface>,
    /// Where its fibres run.
    pub fibres: Arc<MuscleFibres>,
}

/// How the tets are sampled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SamplingOptions {
    /// Points in each tet that a surface crosses; the others take one.
    pub samples: usize,
    /// Seed of the points.
    pub seed: u64,
    /// How a point is found to lie inside.
    pub inside: InsideTest,
}

impl Default for SamplingOptions {
    fn default() -> Self {
        Self { samples: 64, seed: 0, inside: InsideTest::Winding }
    }
}

impl InsideTest {
    /// The test called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "winding" => Ok(Self::Winding),
            "normal" => Ok(Self::Normal),
            _ => Err(MtmError::UnknownName {
                what: "inside",
                found: name.to_owned(),
                known: INSIDE_TESTS,
                kind: ErrorKind::Material,
            }),
        }
    }
}

/// Work that a sampling took.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SamplingCounts {
    /// Points whose side of a muscle's surface was asked for: one for a tet or group of tets that the
    /// surface does not cross, all samples for one that it does.
    pub points: usize,
    /// Pairs of a tet and a muscle that were looked at by themselves.
    pub pairs: usize,
    /// Tets that took samples.
    pub crossed: usize,
}

/// Time that a sampling took, s.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SamplingTimings {
    /// Trees over triangles and tets.
    pub trees: f64,
    /// Which tets the surfaces cross.
    pub crossing: f64,
    /// Samples, directions and sums.
    pub sampling: f64,
}
