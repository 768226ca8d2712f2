//! Points spread evenly in a tet: a low-discrepancy sequence, shifted anew for each tet.

use crate::triangle::Vec3;

/// Real root of x⁴ = x + 1, the ratio of the additive sequence in three dimensions (Roberts 2018).
const RATIO: f64 = 1.220_744_084_605_759_5;

/// The points in the unit cube that every tet starts from.
#[derive(Debug, Clone)]
pub(super) struct Sequence {
    points: Vec<[f64; 3]>,
}

impl Sequence {
    /// The first `n` points i (1/g, 1/g², 1/g³) mod 1 with g the [`RATIO`].
    pub fn new(n: usize) -> Self {
        let step = [1, 2, 3].map(|k| RATIO.powi(-k));
        let point = |i: usize| step.map(|s| ((i + 1) as f64 * s).fract());
        Self { points: (0..n).map(point).collect() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Barycentric weights of corners 1 to 3 of each point in a tet, uniform in volume.
    ///
    /// Shifted modulo 1 by a vector that depends on `seed` and `tet` alone (Cranley & Patterson 1976): each
    /// point is uniform, so fractions are unbiased, and the errors of two tets are independent.
    pub fn in_tet(&self, seed: u64, tet: u32) -> impl Iterator<Item = [f64; 3]> + '_ {
        let shift = shift(seed, tet);
        self.points.iter().map(move |point| {
            folded([0, 1, 2].map(|k| {
                let x = point[k] + shift[k];
                if x >= 1.0 { x - 1.0 } else { x }
            }))
        })
    }
}

/// Weights of corners 1 to 3 for a point of the unit cube, folded into the corner tet (Rocchini & Cignoni
/// 2000).
fn folded([mut s, mut t, mut u]: [f64; 3]) -> [f64; 3] {
    if s + t > 1.0 {
        (s, t) = (1.0 - s, 1.0 - t);
    }
    if t + u > 1.0 {
        (t, u) = (1.0 - u, 1.0 - s - t);
    } else if s + t + u > 1.0 {
        (s, u) = (1.0 - t - u, s + t + u - 1.0);
    }
    [s, t, u]
}

/// Three numbers in 0 to 1 that depend on `seed` and `tet` alone.
fn shift(seed: u64, tet: u32) -> [f64; 3] {
    let start = mixed(seed ^ mixed(u64::from(tet)));
    [1, 2, 3].map(|k| (mixed(start.wrapping_add(k)) >> 11) as f64 / (1_u64 << 53) as f64)
}

/// A permutation of the 64-bit numbers that leaves no pattern (SplitMix64; Steele, Lea & Flood 2014).
fn mixed(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Point of a tet with barycentric weights `w` of corners 1 to 3, given by its edges from corner 0.
pub(super) fn place(edges: &[Vec3; 3], w: [f64; 3]) -> Vec3 {
    edges[0] * w[0] + edges[1] * w[1] + edges[2] * w[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// ∫ s dV / V = 1/4, ∫ s² dV / V = 1/10, ∫ s t dV / V = 1/20 over a tet.
    #[test]
    fn points_are_uniform_in_volume() {
        let sequence = Sequence::new(4096);
        let n = sequence.len() as f64;
        let (mut first, mut second) = ([0.0; 3], [[0.0; 3]; 3]);
        for w in sequence.in_tet(7, 3) {
            assert!(w.iter().all(|&x| x >= 0.0) && w.iter().sum::<f64>() <= 1.0 + 1e-15);
            for i in 0..3 {
                first[i] += w[i] / n;
                for j in 0..3 {
                    second[i][j] += w[i] * w[j] / n;
                }
            }
        }
        for i in 0..3 {
            assert!((first[i] - 0.25).abs() < 1e-3);
            for j in 0..3 {
                assert!((second[i][j] - if i == j { 0.1 } else { 0.05 }).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn shifts_depend_on_seed_and_tet() {
        let first = |seed, tet| Sequence::new(1).in_tet(seed, tet).next();
        assert_eq!(first(1, 2), first(1, 2));
        assert_ne!(first(1, 2), first(2, 2));
        assert_ne!(first(1, 2), first(1, 3));
    }
}
