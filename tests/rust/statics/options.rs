//! The choice of a method.

use mtm_core::Method;

/// Unknowns up to which `auto` chooses a factorisation.
const AUTO_DIRECT_UNKNOWNS: usize = 100_000;

#[test]
fn auto_goes_by_size_and_named_methods_do_not() {
    assert_eq!(Method::Auto.for_unknowns(AUTO_DIRECT_UNKNOWNS), Method::Cholesky);
    assert_eq!(Method::Auto.for_unknowns(AUTO_DIRECT_UNKNOWNS + 3), Method::Pcg);
    for named in [Method::Cholesky, Method::Pcg, Method::Relaxation] {
        assert_eq!(named.for_unknowns(0), named);
        assert_eq!(named.for_unknowns(usize::MAX), named);
    }
}
