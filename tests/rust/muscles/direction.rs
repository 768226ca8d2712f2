//! The mean direction of fibres.

use mtm_core::MeanDirection;
use mtm_core::internals::DirectionSum;
use nalgebra::Vector3;

type Vec3 = Vector3<f64>;

fn mean(directions: &[([f64; 3], f64)]) -> MeanDirection {
    let mut sum = DirectionSum::default();
    directions.iter().for_each(|&(a, w)| sum.add(a, w));
    sum.mean()
}

#[test]
fn signs_do_not_cancel() {
    let half = 0.5_f64.sqrt();
    let found = mean(&[([-half, half, 0.0], 1.0), ([half, -half, 0.0], 1.0)]);
    assert!(
        (Vec3::from(found.direction) - Vec3::new(half, -half, 0.0)).norm() < 1e-12
            || (Vec3::from(found.direction) - Vec3::new(-half, half, 0.0)).norm() < 1e-12
    );
    assert!(found.direction.iter().any(|&v| v > 0.7));
    assert!((found.coherence - 1.0).abs() < 1e-12);
}

#[test]
fn the_heavier_of_two_crossing_directions_leads() {
    let found = mean(&[([1.0, 0.0, 0.0], 1.0), ([0.0, 0.0, -1.0], 3.0)]);
    assert!((found.direction[2] - 1.0).abs() < 1e-12);
    assert!((found.coherence - 0.5).abs() < 1e-12);
}

#[test]
fn a_tie_goes_to_the_first_direction() {
    for axes in [[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]] {
        let found = mean(&[(axes[0], 1.0), (axes[1], 1.0)]);
        assert!((Vec3::from(found.direction) - Vec3::from(axes[0])).norm() < 1e-9);
        assert!(found.coherence < 1e-12);
    }
}
