//! The small twin of `benches/stability/error_estimate.rs`: scenes in which stiff and soft tissue are mixed.

#[path = "../../../benches/scenes/random_scenes.rs"]
#[allow(dead_code)] // the bench sorts scenes by more than the test
mod random_scenes;

use mtm_core::{Method, MtmError};

use random_scenes::{Scene, farthest, largest, refusal};

/// Roundings of the largest displacement that storing the answer costs.
const ROUNDINGS: f64 = 4.0;

/// True and reported error and the size of the solution, mm; none where the method refuses.
fn judged(scene: &Scene, method: Method) -> Option<(f64, f64, f64)> {
    match scene.solve(method) {
        Ok(found) => {
            let exact = scene.reference().expect("a scene that is solved has a reference");
            let error = farthest(&found.displacements, &exact);
            Some((error, found.error_estimate, largest(&exact)))
        }
        Err(error) => {
            assert!(refusal(&error), "{error}");
            None
        }
    }
}

/// Scenes in which conjugate gradients once reported up to 1e7 times less than their error, and a factor
/// 140 times less: each is answered with an honest estimate, or refused.
#[test]
fn estimates_hold_where_they_once_failed() {
    let by_pcg = [516, 5823, 2195, 5570, 2294, 2747, 3429, 4906, 551, 4190, 5060, 3557, 2003];
    let by_factor = [3390, 2377, 831, 1743, 4346, 753, 2800, 5899, 1200, 4940, 762, 4190];
    let mut answered = 0;
    for (method, indices) in [(Method::Pcg, &by_pcg[..]), (Method::Cholesky, &by_factor)] {
        for &index in indices {
            let scene = Scene::random(3, index, 300).unwrap();
            let Some((error, reported, size)) = judged(&scene, method) else { continue };
            answered += 1;
            let allowed = reported + ROUNDINGS * f64::EPSILON * size;
            assert!(
                error <= allowed,
                "{index}, {method:?}: {error:e} > {reported:e}: {}",
                scene.description
            );
        }
    }
    assert!(answered >= 15, "only {answered} were answered");
}

/// Random scenes, small enough for a test; at most one in three is refused.
#[test]
fn estimates_hold_in_random_scenes() {
    let (mut answered, mut refused) = (0, 0);
    for index in 0..150 {
        let Ok(scene) = Scene::random(11, index, 120) else { continue };
        for method in [Method::Pcg, Method::Cholesky] {
            let Some((error, reported, size)) = judged(&scene, method) else {
                refused += 1;
                continue;
            };
            answered += 1;
            assert!(
                error <= reported + ROUNDINGS * f64::EPSILON * size,
                "{index}, {method:?}: {error:e} > {reported:e}: {}",
                scene.description
            );
        }
    }
    assert!(refused <= answered / 3, "{refused} refused, {answered} answered");
}

/// The references themselves: Cholesky's method refined with residuals in pairs of doubles, and L D Lᵀ in
/// pairs of doubles, which share no factor.
#[test]
fn two_ways_to_the_reference_agree() {
    let mut compared = 0;
    for index in 0..40 {
        let Ok(scene) = Scene::random(5, index, 70) else { continue };
        let (Some(a), Some(b)) = (scene.refined(), scene.factored_in_pairs()) else { continue };
        compared += 1;
        assert!(farthest(&a, &b) <= 1e-15 * largest(&a), "{index}: {}", scene.description);
    }
    assert!(compared >= 20, "only {compared} were compared");
}

/// A refusal names a quantity whose value is above what was asked for.
#[test]
fn a_refusal_states_what_failed() {
    let mut seen = 0;
    for index in 0..150 {
        let Ok(scene) = Scene::random(11, index, 120) else { continue };
        if let Err(MtmError::NotConverged { shortfall, .. }) = scene.solve(Method::Pcg) {
            seen += 1;
            assert!(shortfall.value > shortfall.limit, "{index}: {shortfall}");
        }
    }
    assert!(seen > 5, "{seen}");
}
