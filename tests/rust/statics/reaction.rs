//! Reactions of springs, softened where the body does not hold them.

use mtm_core::internals::Krylov;

/// Loads of springs on three nodes that move along x, y and z alone: G is diagonal in the basis.
fn solved(flexibility: [f64; 3], b: [f64; 3], reach: f64) -> (Krylov, [f64; 3]) {
    let size = b.iter().map(|v| v * v).sum::<f64>().sqrt();
    let mut krylov = Krylov::new(size);
    let mut next: Vec<f64> = b.iter().map(|v| v / size).collect();
    for _ in 0..3 {
        let answer: Vec<f64> = next.iter().zip(flexibility).map(|(v, g)| v * g).collect();
        let moved = (0..3).map(|i| [0, 1, 2].map(|j| if i == j { answer[i] } else { 0.0 }));
        next = krylov.push(next.clone(), answer.clone(), moved.collect());
        krylov.soften(reach);
    }
    let mut y = [0.0; 3];
    for (share, q) in krylov.solution.iter().zip(&krylov.basis) {
        for (y, q) in y.iter_mut().zip(q) {
            *y += share * q;
        }
    }
    (krylov, y)
}

#[test]
fn springs_that_the_body_holds_are_not_softened() {
    let (flexibility, b) = ([0.2, 0.5, 0.9], [1.0, -2.0, 0.5]);
    let (krylov, y) = solved(flexibility, b, f64::INFINITY);
    assert_eq!(krylov.softness, 0.0);
    assert!(krylov.left < 1e-13, "{}", krylov.left);
    for i in 0..3 {
        assert!((y[i] * (1.0 - flexibility[i]) - b[i]).abs() < 1e-13, "{y:?}");
    }
}

#[test]
fn springs_that_the_body_does_not_hold_carry_nodes_as_far_as_they_reach() {
    // The last one takes more than the body holds, or nearly as much.
    for last in [1.3, 0.999] {
        let (flexibility, b) = ([0.2, 0.5, last], [1.0, -2.0, 0.5]);
        let (krylov, y) = solved(flexibility, b, 3.0);
        assert!(krylov.softness > last - 1.0 && krylov.softness > 0.0);
        let mu = krylov.softness;
        let mut farthest = 0.0_f64;
        for i in 0..3 {
            assert!((y[i] * (1.0 + mu - flexibility[i]) - b[i]).abs() < 1e-12, "{y:?}");
            farthest = farthest.max((y[i] * flexibility[i]).abs());
        }
        assert!((farthest - 3.0).abs() < 1e-6, "{farthest}");
    }
}
