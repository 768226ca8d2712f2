//! Kernels for wide vectors.

use mtm_core::internals::simd::{Kernel, LANES, add_products, widest};

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
