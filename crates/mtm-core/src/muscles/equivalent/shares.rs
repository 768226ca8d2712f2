//! The muscles' shares in each tet, from the samples inside them.

use rayon::prelude::*;

use crate::error::Result;
use crate::mechanics::material::{FibreLaw, Lame, Mixing, Preset, Spencer, Voigt};
use crate::mechanics::tissue::Tissue;
use crate::mesh::TetMesh;
use crate::muscles::equivalent::crossing::{Touch, Touches};
use crate::muscles::equivalent::direction::{DirectionSum, MeanDirection};
use crate::muscles::equivalent::packet::Packet;
use crate::muscles::equivalent::sampling::{Muscle, SamplingCounts, SamplingTimings};
use crate::muscles::equivalent::sequence::Sequence;
use crate::muscles::equivalent::shape::MuscleShape;
use crate::muscles::fibre::NearFibres;
use crate::vector::Vec3;

/// Tets per parallel task.
const TETS_PER_TASK: usize = 64;

/// Factor of the standard error: tets cut by planes have errors of 0.7 to 0.9 of it, for any fraction and
/// number of samples (`tests/rust/muscles/equivalent.rs`).
const ERROR_FACTOR: f64 = 0.7;

/// Maximum number of samples in a muscle whose fibre directions are used, the first of a tet: they are as
/// evenly spread as all samples, and directions change little within a tet.
const DIRECTION_SAMPLES: u32 = 16;

/// Muscle in a mesh, tet by tet.
#[derive(Debug, Clone)]
pub struct MuscleShares {
    /// Volume fraction of muscle in each tet, 0 to 1.
    pub fraction: Vec<f64>,
    /// Direction of the fibres of each tet; zero if it contains no muscle.
    pub fibre: Vec<MeanDirection>,
    /// Standard error of each fraction, 0.7 q^(1/3) n^(−2/3) with q = min(p, 1 − p), if the surface is smooth
    /// over the tet; never more than that of as many random points, √(p(1−p)/n). 0 if no surface crosses the
    /// tet.
    pub error: Vec<f64>,
    /// The tets that contain muscle, ascending.
    pub tets: Vec<TetShares>,
    /// Volumes of each muscle, in the order given.
    pub volumes: Vec<MuscleVolume>,
    /// Work involved.
    pub counts: SamplingCounts,
    /// Time taken.
    pub timings: SamplingTimings,
}

/// The muscles of one tet.
#[derive(Debug, Clone, PartialEq)]
pub struct TetShares {
    /// The tet.
    pub tet: u32,
    /// One for each muscle in it, in an order that does not depend on the one given.
    pub shares: Vec<Share>,
}

/// One muscle's part of one tet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Share {
    /// Index of the muscle.
    pub muscle: u32,
    /// Fraction of the tet inside the muscle.
    pub inside: f64,
    /// The same where k muscles overlap counted 1/k: these sum to the fraction of the tet.
    pub fraction: f64,
    /// Direction of the fibres of this muscle in the tet.
    pub fibre: MeanDirection,
}

/// Volumes of one muscle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MuscleVolume {
    /// Volume inside the muscle and the mesh, mm³.
    pub inside: f64,
    /// The same where k muscles overlap counted 1/k, mm³.
    pub shared: f64,
    /// Standard error of `inside`, mm³, stated as that of [`MuscleShares::error`].
    pub error: f64,
    /// Volume that the surface encloses, mm³, inside the mesh or not, where it overlaps itself counted twice;
    /// none if it is not closed.
    pub enclosed: Option<f64>,
    /// Whether its triangles faced inwards and were reversed.
    pub was_turned: bool,
}

/// Result of one tet.
#[derive(Debug, Clone)]
pub(super) struct TetMuscle {
    shares: TetShares,
    fraction: f64,
    fibre: MeanDirection,
    /// Number of samples; 1 if no surface crosses the tet.
    samples: usize,
    /// Muscles that cross the tet, and were therefore evaluated at every sample.
    crossing: usize,
}

/// The muscles that touch each tet.
pub(super) struct TetTouches {
    /// Muscle and its touch of a tet: by tet, then by rank.
    list: Vec<(u32, Touch)>,
    /// Where the next tet starts in the list.
    start: Vec<usize>,
}

impl TetTouches {
    /// Of the touches of each muscle, those on a tet in the order of `rank`.
    pub fn new(touches: &[Touches], rank: &[u32]) -> Self {
        let mut ranked: Vec<(u32, u32, Touch)> = rank
            .iter()
            .enumerate()
            .flat_map(|(place, &muscle)| {
                let tets = touches[muscle as usize].tets.iter();
                tets.map(move |touch| (place as u32, muscle, *touch))
            })
            .collect();
        ranked.par_sort_unstable_by_key(|(place, _, touch)| (touch.tet, *place));
        let start = (0..=ranked.len())
            .filter(|&i| i == 0 || i == ranked.len() || ranked[i].2.tet != ranked[i - 1].2.tet)
            .collect();
        Self { list: ranked.into_iter().map(|(_, muscle, touch)| (muscle, touch)).collect(), start }
    }

    fn n_tets(&self) -> usize {
        self.start.len() - 1
    }

    /// Muscles of the `i`-th of the tets that any touches.
    fn of(&self, i: usize) -> &[(u32, Touch)] {
        &self.list[self.start[i]..self.start[i + 1]]
    }
}

/// Input for sampling a tet.
pub(super) struct Sampler<'a> {
    pub mesh: &'a TetMesh,
    pub muscles: &'a [Muscle],
    pub shapes: &'a [MuscleShape<'a>],
    pub touches: &'a [Touches],
    pub sequence: Sequence,
    pub seed: u64,
    pub stop: &'a (dyn Fn() -> bool + Sync),
}

/// Buffers that a thread refills for each tet.
struct TetBuffers {
    packet: Packet,
    /// Whether each sample lies inside each muscle of the tet, muscle by muscle.
    inside: Vec<bool>,
    /// Number of muscles that contain each sample.
    depth: Vec<u32>,
    /// The data that determine the fibre directions in the tet.
    near: NearFibres,
}

impl Sampler<'_> {
    /// Result of each touched tet, ascending; incomplete once `stop` returns true.
    pub fn shares(&self, touched: &TetTouches) -> Vec<TetMuscle> {
        let n = self.sequence.count();
        let scratch = || TetBuffers {
            packet: Packet::new(n),
            inside: Vec::new(),
            depth: vec![0; n],
            near: NearFibres::default(),
        };
        (0..touched.n_tets())
            .into_par_iter()
            .with_min_len(TETS_PER_TASK)
            .map_init(scratch, |scratch, i| {
                if i % TETS_PER_TASK == 0 {
                    (self.stop)();
                }
                let muscles = touched.of(i);
                if muscles.iter().all(|(_, touch)| touch.is_whole) {
                    self.whole(muscles)
                } else {
                    self.sampled(muscles, scratch)
                }
            })
            .collect()
    }

    fn corners(&self, tet: u32) -> [Vec3; 4] {
        self.mesh.tets()[tet as usize].map(|v| Vec3::from(self.mesh.nodes()[v as usize]))
    }

    /// A tet wholly inside all of its muscles.
    fn whole(&self, muscles: &[(u32, Touch)]) -> TetMuscle {
        let tet = muscles[0].1.tet;
        let centroid = self.corners(tet).iter().sum::<Vec3>() / 4.0;
        let weight = 1.0 / muscles.len() as f64;
        let mut all = DirectionSum::default();
        let shares = muscles
            .iter()
            .map(|&(muscle, _)| {
                let mut sum = DirectionSum::default();
                sum.add(self.muscles[muscle as usize].fibres.direction(centroid.into()), weight);
                all.append(&sum);
                Share { muscle, inside: 1.0, fraction: weight, fibre: sum.mean() }
            })
            .collect();
        let shares = TetShares { tet, shares };
        TetMuscle { shares, fraction: 1.0, fibre: all.mean(), samples: 1, crossing: 0 }
    }

    /// A tet that at least one surface may cross.
    fn sampled(&self, muscles: &[(u32, Touch)], scratch: &mut TetBuffers) -> TetMuscle {
        let TetBuffers { packet, inside, depth, near } = scratch;
        let (tet, n) = (muscles[0].1.tet, self.sequence.count());
        packet.fill(&self.sequence, self.seed, tet, self.corners(tet));
        inside.clear();
        inside.resize(n * muscles.len(), true);
        for ((muscle, touch), side) in muscles.iter().zip(inside.chunks_exact_mut(n)) {
            if !touch.is_whole {
                let triangles = self.touches[*muscle as usize].triangles(touch);
                packet.inside(&self.shapes[*muscle as usize], triangles, side);
            }
        }
        depth.fill(0);
        for side in inside.chunks_exact(n) {
            depth.iter_mut().zip(side).for_each(|(k, &is_inside)| *k += u32::from(is_inside));
        }
        let mut all = DirectionSum::default();
        let mut shares = Vec::with_capacity(muscles.len());
        for (&(muscle, _), side) in muscles.iter().zip(inside.chunks_exact(n)) {
            let fibres = &self.muscles[muscle as usize].fibres;
            let mut sum = DirectionSum::default();
            let (mut count, mut weights, mut asked) = (0, 0.0, 0.0);
            if side.contains(&true) {
                let (centre, radius) = packet.ball();
                fibres.near(centre.into(), radius, near);
            }
            for s in (0..n).filter(|&s| side[s]) {
                let weight = 1.0 / f64::from(depth[s]);
                if count < DIRECTION_SAMPLES {
                    sum.add(fibres.direction_near(near, packet.point(s).into()), weight);
                    asked += weight;
                }
                count += 1;
                weights += weight;
            }
            if count > 0 {
                sum.scale(weights / asked);
                all.append(&sum);
                let (inside, fraction) = (f64::from(count) / n as f64, weights / n as f64);
                shares.push(Share { muscle, inside, fraction, fibre: sum.mean() });
            }
        }
        let in_muscle = depth.iter().filter(|&&k| k > 0).count();
        TetMuscle {
            shares: TetShares { tet, shares },
            fraction: in_muscle as f64 / n as f64,
            fibre: all.mean(),
            samples: n,
            crossing: muscles.iter().filter(|(_, touch)| !touch.is_whole).count(),
        }
    }
}

impl MuscleShares {
    /// The whole mesh from the results of its touched tets.
    pub(super) fn new(
        mesh: &TetMesh,
        shapes: &[MuscleShape<'_>],
        touched: Vec<TetMuscle>,
        timings: SamplingTimings,
    ) -> Self {
        let m = mesh.n_tets();
        let none = DirectionSum::default().mean();
        let (mut fraction, mut fibre, mut error) = (vec![0.0; m], vec![none; m], vec![0.0; m]);
        let mut volumes: Vec<MuscleVolume> = shapes
            .iter()
            .map(|shape| MuscleVolume {
                inside: 0.0,
                shared: 0.0,
                error: 0.0,
                enclosed: shape.enclosed(),
                was_turned: shape.orientation < 0.0,
            })
            .collect();
        let mut counts = SamplingCounts::default();
        let mut tets = Vec::with_capacity(touched.len());
        for one in touched {
            let tet = one.shares.tet as usize;
            let volume = mesh.volumes()[tet];
            if one.crossing > 0 {
                counts.crossed += 1;
                counts.points += one.samples * one.crossing;
                error[tet] = standard_error(one.fraction, one.samples);
            }
            for share in &one.shares.shares {
                let sum = &mut volumes[share.muscle as usize];
                sum.inside += volume * share.inside;
                sum.shared += volume * share.fraction;
                if one.crossing > 0 {
                    sum.error += (volume * standard_error(share.inside, one.samples)).powi(2);
                }
            }
            fraction[tet] = one.fraction;
            fibre[tet] = one.fibre;
            if !one.shares.shares.is_empty() {
                tets.push(one.shares);
            }
        }
        volumes.iter_mut().for_each(|v| v.error = v.error.sqrt());
        Self { fraction, fibre, error, tets, volumes, counts, timings }
    }

    /// Tissue of every tet with the constants of `preset`.
    ///
    /// [`Mixing::Moduli`]: Young's moduli and Poisson's ratio are interpolated with the fraction of muscle,
    /// along the mean fibre (Kim et al. 2010, section 2.3). [`Mixing::Stiffness`]: C = Σ p_i C_muscle(a_i) + (1
    /// − Σ p_i) C_fat with fraction p_i and fibre a_i of each muscle (Voigt's bound).
    ///
    /// # Errors
    /// [`crate::MtmError::IndefiniteMaterial`] with the tet.
    pub fn tissue(&self, preset: Preset, mixing: Mixing) -> Result<Tissue> {
        match mixing {
            Mixing::Moduli => {
                let fibre: Vec<[f64; 3]> = self.fibre.iter().map(|f| f.direction).collect();
                Tissue::mixture(&self.fraction, &fibre, preset, mixing)
            }
            Mixing::Stiffness => {
                let fat = Spencer::from(Lame::from(preset.fat)).voigt([1.0, 0.0, 0.0]);
                let muscle = Spencer::from_moduli(preset.muscle, FibreLaw::Spencer);
                let mixed = |one: &TetShares| stiffness(one, &fat, &muscle);
                let rows: Vec<Voigt> = self.tets.par_iter().map(mixed).collect();
                let tets: Vec<u32> = self.tets.iter().map(|one| one.tet).collect();
                Tissue::composite(preset.fat, self.fraction.len(), &tets, rows)
            }
        }
    }
}

/// 0.7 q^(1/3) n^(−2/3), q = min(p, 1 − p), or √(p(1−p)/n) if that is less; p is kept away from 0 and 1 by half
/// a point, since the fraction of a crossed tet is never known exactly.
///
/// With one point in each of n equal cells, errors occur only in the cells that the surface cuts, about
/// (nq)^(2/3) of them around a part of size q, of up to a half each.
fn standard_error(fraction: f64, samples: usize) -> f64 {
    let n = samples as f64;
    let p = (fraction * n + 0.5) / (n + 1.0);
    let smooth = ERROR_FACTOR * p.min(1.0 - p).cbrt() * n.powf(-2.0 / 3.0);
    smooth.min((p * (1.0 - p) / n).sqrt())
}

/// Σ p_i C(a_i) + (1 − Σ p_i) C_fat of one tet.
fn stiffness(tet: &TetShares, fat: &Voigt, muscle: &Spencer) -> Voigt {
    let rest = 1.0 - tet.shares.iter().map(|share| share.fraction).sum::<f64>();
    // Shares that fill the tet may exceed 1 by rounding.
    let mut sum = fat.map(|row| row.map(|c| c * rest.max(0.0)));
    for share in &tet.shares {
        let one = muscle.voigt(share.fibre.direction);
        for (row, add) in sum.iter_mut().flatten().zip(one.iter().flatten()) {
            *row += add * share.fraction;
        }
    }
    sum
}
