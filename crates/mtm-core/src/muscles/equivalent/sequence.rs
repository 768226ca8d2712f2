//! Points spread evenly in a tet: a Sobol sequence, with a different shift for each tet.

use crate::vector::Vec3;

/// Bits of a coordinate: those of a number in 0 to 1.
const BITS: u32 = 52;
/// Sobol's recurrence in each dimension: m_i = 2^s m_{i−s} ⊕ m_{i−s} ⊕ Σ 2^k m_{i−k} over the marked k, from
/// its first s numbers. Dimension 0 is van der Corput's, the others have the primitive polynomials x + 1
/// and x² + x + 1 (Sobol 1967; first numbers of Joe & Kuo 2008).
const RECURRENCES: [(&[u64], &[usize]); 2] = [(&[1], &[]), (&[1, 3], &[1])];

/// The points in the unit cube that all tets use.
#[derive(Debug, Clone)]
pub struct Sequence {
    /// Binary digits of the coordinates, the first in bit 51.
    pub points: Vec<[u64; 3]>,
}

impl Sequence {
    /// The first `n` points of the sequence, at most 2⁵².
    pub fn new(n: usize) -> Self {
        let van_der_corput = (0..BITS).map(|i| 1 << (BITS - 1 - i)).collect();
        let [second, third] = RECURRENCES.map(|(first, marked)| directions(first, marked));
        let columns: [Vec<u64>; 3] = [van_der_corput, second, third];
        let point = |i: usize| {
            [0, 1, 2].map(|axis| {
                let digits = (0..BITS).filter(|b| i >> b & 1 == 1);
                digits.fold(0, |x, b| x ^ columns[axis][b as usize])
            })
        };
        Self { points: (0..n).map(point).collect() }
    }

    /// Number of points.
    pub fn count(&self) -> usize {
        self.points.len()
    }

    /// Barycentric weights of corners 1 to 3 of each point in a tet, uniform in volume.
    ///
    /// The digits are shifted (exclusive or) by a number that depends only on `seed` and `tet`: each point is
    /// uniform, so fractions are unbiased, the points stay as evenly spread as before, and the errors of two
    /// tets are independent (L'Ecuyer & Lemieux 2002).
    pub fn in_tet(&self, seed: u64, tet: u32) -> impl Iterator<Item = [f64; 3]> + '_ {
        let shift = shift(seed, tet);
        self.points.iter().map(move |point| {
            weights(
                [0, 1, 2].map(|k| ((point[k] ^ shift[k]) as f64 + 0.5) / (1_u64 << BITS) as f64),
            )
        })
    }
}

/// Numbers m_i of a [`RECURRENCES`] entry as binary fractions m_i / 2^(i + 1).
fn directions(first: &[u64], marked: &[usize]) -> Vec<u64> {
    let mut m = first.to_vec();
    let s = first.len();
    for i in s..BITS as usize {
        let start = m[i - s] << s ^ m[i - s];
        m.push(marked.iter().fold(start, |x, &k| x ^ m[i - k] << k));
    }
    m.iter().zip(1..).map(|(&m, i)| m << (BITS - i)).collect()
}

/// Weights of corners 1 to 3 of a tet for a point of the unit cube, uniform in volume.
///
/// The distribution functions of the corners' weights, inverted one after another: with points this evenly
/// spread, it halves the error of folding the cube into a tet.
fn weights([x, y, z]: [f64; 3]) -> [f64; 3] {
    let a = 1.0 - x.cbrt();
    let b = (1.0 - a) * (1.0 - y.sqrt());
    [a, b, (1.0 - a - b).max(0.0) * z]
}

/// Three numbers of [`BITS`] bits that depend only on `seed` and `tet`.
fn shift(seed: u64, tet: u32) -> [u64; 3] {
    let start = mixed(seed ^ mixed(u64::from(tet)));
    [1, 2, 3].map(|k| mixed(start.wrapping_add(k)) >> (u64::BITS - BITS))
}

/// A permutation of the 64-bit numbers without recognisable pattern (SplitMix64; Steele, Lea & Flood 2014).
fn mixed(x: u64) -> u64 {
    let mut z = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Point of a tet with barycentric weights `w` of corners 1 to 3, given by its edges from corner 0.
pub fn place(edges: &[Vec3; 3], w: [f64; 3]) -> Vec3 {
    edges[0] * w[0] + edges[1] * w[1] + edges[2] * w[2]
}
