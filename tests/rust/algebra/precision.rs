//! Numbers in sixteen bits.

use mtm_core::internals::Stored;

#[test]
fn sixteen_bits_are_the_nearest_ones() {
    for k in -32_767_i16..=32_767 {
        for shift in [-0.49, 0.0, 0.49] {
            assert_eq!(i16::nearest((f64::from(k) + shift) / i16::ONE), k);
        }
    }
    assert_eq!([1.5, -1.5].map(i16::nearest), [32_767, -32_767]);
}
