//! Kernels compiled twice: for any processor, and for the wide vectors of the current one.
//!
//! A binary for any x86-64 processor may only use vectors of two doubles, and the sparse products here are then
//! limited by arithmetic instead of memory. Both versions compute the same sums in the same order, without
//! fused multiply-adds, so their results are bitwise identical.

use std::hint::black_box;

use pulp::{Arch, Simd, WithSimd};

/// Number of doubles that the kernels here add at once.
pub const LANES: usize = 4;

/// A loop over many rows. `run`, and everything it calls in the loop, must be `#[inline(always)]`.
pub trait Kernel {
    /// Result of the loop.
    type Output;
    /// The loop.
    fn run(self) -> Self::Output;
}

/// Runs `kernel` with the widest vectors that this processor and [`LANES`] allow.
pub fn widest<K: Kernel>(kernel: K) -> K::Output {
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
pub fn add_products(sum: &mut [f64; LANES], a: [f64; LANES], b: [f64; LANES]) {
    for lane in 0..LANES {
        sum[lane] += a[lane] * b[lane];
    }
}
