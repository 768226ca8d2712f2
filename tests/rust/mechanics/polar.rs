//! Rotation and stretch of a deformation gradient.

use mtm_core::internals::Polar;
use nalgebra::{Matrix3, Rotation3, Vector3};

#[test]
fn stretches_between_two_rotations_are_found() {
    let turn = |a: f64, b: f64, c: f64| *Rotation3::from_euler_angles(a, b, c).matrix();
    let (after, before) = (turn(0.3, -1.2, 2.0), turn(-0.7, 0.1, 1.5));
    for size in [1e-12, 1.0, 1e200] {
        for stretch in [[1.0, 1.0, 1.0], [2.0, 1.0, 1e-3], [1.0, 1e-9, 1e-9], [3.0, 3.0, -1e-12]] {
            let exact = Vector3::from(stretch) * size;
            let f = after * Matrix3::from_diagonal(&exact) * before.transpose();
            let mut found = Polar::new(&f).stretch;
            found.as_mut_slice().sort_by(|a, b| b.total_cmp(a));
            assert!((found - exact).amax() < 1e-15 * exact.max(), "{exact} {found}");
        }
    }
}

#[test]
fn the_factors_compose_to_the_gradient_and_the_rotation_never_mirrors() {
    let shear = Matrix3::new(1.2, 0.3, -0.1, 0.05, 0.9, 0.2, 0.1, -0.2, 1.1);
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -0.3));
    let flat = Matrix3::from_diagonal(&Vector3::new(1.0, 2.0, 0.0));
    let line = Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 2.0)) * shear;
    let flats = [flat, line, Matrix3::zeros()];
    for f in [shear, shear * mirror, -shear, Matrix3::identity()].into_iter().chain(flats) {
        let p = Polar::new(&f);
        let back = p.q * Matrix3::from_diagonal(&p.stretch) * p.v.transpose();
        assert!((back - f).amax() < 1e-14, "{f} {back}");
        for turn in [p.q, p.v, p.rotation()] {
            assert!((turn.transpose() * turn - Matrix3::identity()).amax() < 1e-14);
            assert!((turn.determinant() - 1.0).abs() < 1e-14);
        }
    }
}
