//! Points spread evenly in a tet.

use mtm_core::internals::Sequence;

/// Bits of a coordinate.
const BITS: u32 = 52;

/// ∫ s dV / V = 1/4, ∫ s² dV / V = 1/10, ∫ s t dV / V = 1/20 over a tet.
#[test]
fn points_are_uniform_in_volume() {
    let sequence = Sequence::new(4096);
    let n = sequence.count() as f64;
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
            assert!((second[i][j] - if i == j { 0.1 } else { 0.05 }).abs() < 1e-3, "{second:?}");
        }
    }
}

/// The first 2ᵏ points have one in each half, quarter ... of every axis, and one in each of the 2ᵏ boxes
/// of every shape that k halvings give for k ≤ 2: a net.
#[test]
fn points_are_a_net() {
    let top = |x: u64, bits: u32| (x >> (BITS - bits)) as usize;
    let points = Sequence::new(64).points;
    for axis in 0..3 {
        let mut seen = [0; 64];
        points.iter().for_each(|p| seen[top(p[axis], 6)] += 1);
        assert_eq!(seen, [1; 64], "axis {axis}");
    }
    for (first, second) in [(0, 1), (0, 2)] {
        let mut seen = [0; 4];
        let pairs = points[..4].iter().map(|p| 2 * top(p[first], 1) + top(p[second], 1));
        pairs.for_each(|i| seen[i] += 1);
        assert_eq!(seen, [1; 4], "axes {first}, {second}");
    }
}

#[test]
fn shifts_depend_on_seed_and_tet() {
    let first = |seed, tet| Sequence::new(1).in_tet(seed, tet).next();
    assert_eq!(first(1, 2), first(1, 2));
    assert_ne!(first(1, 2), first(2, 2));
    assert_ne!(first(1, 2), first(1, 3));
}
