//! Kernels compiled twice: for any processor, and for the wide vectors of the current one.
//!
//! A binary for any x86-64 processor may only use vectors of two doubles, and the sparse products here are then
//! limited by arithmetic instead of memory. Both versions compute the same sums in the same order, without
//! fused multiply-adds, so their results are bitwise identical.

use std::hint::black_box;

use pulp::{Arch, Simd, WithSimd};

/// Number of doubles that the kernels here add at once.
pub(crate) const LANES: usize = 4;

/// A loop over many rows. `run`, and everything it calls in the loop, must be `#[inline(always)]`.
pub(crate) trait Kernel {
    /// Result of the loop.
    type Output;
    /// The loop.
    fn run(self) -> Self::Output;
}

/// Runs `kernel` with the widest vectors that this processor and [`LANES`] allow.
pub(crate) fn widest<K: Kernel>(kernel: K) -> K::Output {
    struct Chosen<K>(K);
    impl<K: Kernel> WithSimd for Chosen<K> {
        type Output = K::Output;
        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> K::Output {
            self.0.run()
        }
    }
    Arch::new().dispatch(Chosen(kernel))
}

/// `sums`, of which every lane counts as used: a compiler that drops some falls back to single numbers.
#[inline(always)]
pub(crate) fn whole_lanes<T>(sums: T) -> T {
    black_box(sums)
}

/// `sum += a b`, lane by lane.
#[inline(always)]
pub(crate) fn add_products(sum: &mut [f64; LANES], a: [f64; LANES], b: [f64; LANES]) {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [[f64; LANES]], f64);

    impl Kernel for Sum<'_> {
        type Output = [f64; LANES];
        #[inline(always)]
        fn run(self) -> [f64; LANES] {
            let mut sum = [0.0; LANES];
            for &row in self.0 {
                add_products(&mut sum, row, [self.1; LANES]);
                add_products(&mut sum, row, row);
            }
            sum
        }
    }

    #[test]
    fn wide_vectors_give_the_bits_of_plain_ones() {
        let rows: Vec<[f64; LANES]> =
            (0..1001).map(|i| [0.1, 0.7, 1.3, 1e9].map(|v| (v * f64::from(i)).sin())).collect();
        let plain = Sum(&rows, 1.0 / 3.0).run();
        assert_eq!(plain.map(f64::to_bits), widest(Sum(&rows, 1.0 / 3.0)).map(f64::to_bits));
    }
}
