//! Equivalent material: how much muscle each tet holds, and where its fibres run (Kim et al. 2010, section
//! 2.3; Uesu, Bavoil, Fleishman, Shepherd & Silva 2005).

pub(crate) mod aligned_box;
mod border;
mod crossing;
pub(crate) mod direction;
mod packet;
mod sampling;
pub(crate) mod sequence;
pub(crate) mod shape;
mod shares;
pub(crate) mod tet_tree;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use rayon::prelude::*;

use crate::error::{MtmError, Result};
use crate::mesh::TetMesh;
use crate::vector::Vec3;
use aligned_box::AlignedBox;
use crossing::{Passage, Touches};
pub use direction::MeanDirection;
pub use sampling::{MOST_SAMPLES, Muscle, SamplingCounts, SamplingOptions, SamplingTimings};
use sequence::Sequence;
pub use shape::InsideTest;
use shape::MuscleShape;
pub use shares::{MuscleShares, MuscleVolume, Share, TetShares};
use shares::{Sampler, TetTouches};
use tet_tree::TetTree;

/// Volume fraction and fibre direction of the muscles in every tet.
///
/// A tet that no surface crosses is decided by one evaluation, which may cover many adjacent tets at once; a
/// crossed one by `samples` low-discrepancy points, uniform in volume, with its own shift drawn from `seed`. A
/// point inside k ≥ 2 muscles counts once in the fraction of the tet and 1/k for each of them. The fibre of a
/// tet is the principal eigenvector of Σ w a ⊗ a over the fibre directions a at its samples in muscle, the
/// first 16 of each, with these weights w ([`MeanDirection`]). Tets without muscle are fat.
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
    options.check()?;
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
    let (boxes, tree) = tets_near(mesh, &shapes);
    let trees = start.elapsed();

    let touches: Vec<Touches> = shapes
        .par_iter()
        .map(|muscle| Passage { mesh, boxes: &boxes, tree: &tree, muscle, stop: &stop }.touches())
        .collect();
    if stop() {
        return Err(MtmError::Interrupted);
    }
    let crossing = start.elapsed() - trees;

    // Sums are computed in an order that depends only on the shapes.
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
    let mut made = MuscleShares::new(mesh, &shapes, tets, timings);
    made.counts.points += touches.iter().map(|t| t.evaluations).sum::<usize>();
    made.counts.pairs = touches.iter().map(|t| t.looked_at).sum();
    Ok(made)
}

/// The box of each tet, and the tree of those near any muscle.
fn tets_near(mesh: &TetMesh, shapes: &[MuscleShape<'_>]) -> (Vec<AlignedBox>, TetTree) {
    let boxes: Vec<AlignedBox> = mesh
        .tets()
        .par_iter()
        .map(|tet| AlignedBox::of(&tet.map(|v| Vec3::from(mesh.nodes()[v as usize]))))
        .collect();
    let all = shapes.iter().fold(AlignedBox::EMPTY, |all, shape| all.joined(&shape.bounds));
    let near = (0..).zip(boxes.iter().copied()).filter(|(_, one)| one.meets(&all));
    let tree = TetTree::new(near.collect());
    (boxes, tree)
}
