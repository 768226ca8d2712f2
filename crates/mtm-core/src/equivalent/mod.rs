//! Equivalent material: how much muscle each tet holds, and where its fibres run (Kim et al. 2010, section
//! 2.3; Uesu, Bavoil, Fleishman, Shepherd & Silva 2005).

mod aligned_box;
mod border;
mod crossing;
mod direction;
mod packet;
mod sequence;
mod shape;
mod shares;
mod stiffness;
mod tet_tree;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};
use crate::fibre::MuscleFibres;
use crate::mesh::TetMesh;
use crate::surface::Surface;
use crate::triangle::Vec3;
use aligned_box::AlignedBox;
use crossing::{Passage, Touches};
pub use direction::MeanDirection;
use sequence::Sequence;
pub use shape::InsideTest;
use shape::MuscleShape;
pub use shares::{MuscleShares, MuscleVolume, Share, TetShares};
use shares::{Sampler, TetTouches};
use tet_tree::TetTree;

/// Names of the inside tests.
pub const INSIDE_TESTS: &str = "winding, normal";
/// Most samples of a tet.
pub const MOST_SAMPLES: usize = 1 << 20;

/// A muscle: its surface and the course of its fibres.
#[derive(Debug, Clone)]
pub struct Muscle {
    /// Its surface with outward normals; one that is inside out is turned, and
    /// [`MuscleVolume::was_turned`] says so.
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

/// Volume fraction and fibre direction of the muscles in every tet.
///
/// A tet that no surface crosses is decided by one evaluation, many at once where they lie together; a
/// crossed one by `samples` low-discrepancy points, uniform in volume, with a shift of its own drawn from
/// `seed`. A point inside k ≥ 2 muscles counts once in the fraction of the tet and 1/k for each of them.
/// The fibre of a tet is the principal eigenvector of Σ w a ⊗ a over the fibre directions a at its samples in
/// muscle, with these weights w ([`MeanDirection`]). Without muscles every tet is fat.
///
/// The result does not depend on the number of threads, nor on the order of the muscles.
///
/// # Errors
/// [`MtmError::OutOfRange`] for `samples` below 1 or above [`MOST_SAMPLES`]; [`MtmError::Interrupted`].
pub fn sample_muscles(
    mesh: &TetMesh,
    muscles: &[Muscle],
    options: &SamplingOptions,
    interrupt: &(dyn Fn() -> bool + Sync),
) -> Result<MuscleShares> {
    if !(1..=MOST_SAMPLES).contains(&options.samples) {
        return Err(MtmError::OutOfRange {
            what: "samples".to_owned(),
            index: 0,
            value: options.samples as f64,
            allowed: "1 to 1048576",
            kind: ErrorKind::Material,
        });
    }
    let start = Instant::now();
    let stopped = AtomicBool::new(false);
    let stop = || {
        if interrupt() {
            stopped.store(true, Ordering::Relaxed);
        }
        stopped.load(Ordering::Relaxed)
    };
    let shapes: Vec<MuscleShape<'_>> =
        muscles.par_iter().map(|m| MuscleShape::new(&m.surface, options.inside)).collect();
    let boxes: Vec<AlignedBox> = mesh
        .tets()
        .par_iter()
        .map(|tet| AlignedBox::of(&tet.map(|v| Vec3::from(mesh.nodes()[v as usize]))))
        .collect();
    let all = shapes.iter().fold(AlignedBox::EMPTY, |all, shape| all.joined(shape.bounds()));
    let near: Vec<u32> =
        (0..mesh.n_tets() as u32).filter(|&t| boxes[t as usize].meets(&all)).collect();
    let near_boxes: Vec<AlignedBox> = near.iter().map(|&t| boxes[t as usize]).collect();
    let tree = TetTree::new(&near, &near_boxes);
    let trees = start.elapsed();

    let touches: Vec<Touches> = shapes
        .par_iter()
        .map(|muscle| Passage { mesh, boxes: &boxes, tree: &tree, muscle, stop: &stop }.touches())
        .collect();
    if stop() {
        return Err(MtmError::Interrupted);
    }
    let crossing = start.elapsed() - trees;

    // Sums run in an order that the shapes themselves give.
    let mut rank: Vec<u32> = (0..muscles.len() as u32).collect();
    rank.sort_by(|&i, &j| muscles[i as usize].surface.order(&muscles[j as usize].surface));
    let by_tet = TetTouches::new(&touches, &rank);
    let sampler = Sampler {
        mesh,
        muscles,
        shapes: &shapes,
        touches: &touches,
        sequence: Sequence::new(options.samples),
        seed: options.seed,
        stop: &stop,
    };
    let tets = sampler.shares(&by_tet);
    if stop() {
        return Err(MtmError::Interrupted);
    }
    let timings = SamplingTimings {
        trees: trees.as_secs_f64(),
        crossing: crossing.as_secs_f64(),
        sampling: (start.elapsed() - trees - crossing).as_secs_f64(),
    };
    let mut made = MuscleShares::new(mesh, &shapes, muscles, tets, timings);
    made.counts.points += touches.iter().map(|t| t.evaluations).sum::<usize>();
    made.counts.pairs = touches.iter().map(|t| t.looked_at).sum();
    Ok(made)
}
