//! Large deformation where a small part of a body is squeezed far more than the rest.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, bits, boundary, isotropic, joined, largest_difference, plan, plane, rigid,
    sliding, solve, surface, tensors, with_method,
};
use mtm_core::{Boundary, Gap, Kinematics, Method, Motion, Plan, Solution, StaticOptions, TetMesh};

/// A block, a punch on its lid that goes 70 % of the way down, and what holds the block.
struct Punched {
    mesh: Arc<TetMesh>,
    boundary: Arc<Boundary>,
    plan: Plan,
}

/// The floor of the block is fixed.
const FIXED: bool = false;
/// The floor of the block slides on a plane.
const SLIDING: bool = true;

fn punched(slides: bool) -> Punched {
    let shape = BoxShape { cells: [14, 14, 6], size: [14.0, 14.0, 6.0], jitter: 0.1 };
    let lid = shape.side(2, true);
    let middle = shape.nodes_where(|[i, j, _]| (6..=8).contains(&i) && (6..=8).contains(&j));
    let punch = lid.iter().copied().filter(|node| middle.contains(node)).collect();
    let punch = joined("punch", punch);
    let down = Motion::Rigid(rigid([1.0, 0.5, 0.0], 5.0, [7.0, 7.0, 6.0], [0.4, 0.2, -4.2]));
    let (mesh, below) = (shape.mesh(), shape.side(2, false));
    if slides {
        let floor = surface(plane(9, 30.0, 0.2));
        let segments = vec![punch, sliding("floor", below, &floor, Gap::Rest)];
        let boundary = boundary(shape.side(0, false), segments);
        Punched { mesh, boundary, plan: plan([("punch", down), ("floor", meshes::stays())]) }
    } else {
        Punched { mesh, boundary: boundary(below, vec![punch]), plan: plan([("punch", down)]) }
    }
}

impl Punched {
    fn solved(&self, method: Method, tolerance: f64) -> Solution {
        let options =
            StaticOptions { tolerance, kinematics: Kinematics::NEO_HOOKEAN, ..with_method(method) };
        let tensors = tensors(&self.mesh, &isotropic(0.01, 0.3));
        solve(&tensors, &self.boundary, options, &self.plan, None).unwrap()
    }
}

#[test]
fn methods_and_tolerances_reach_the_same_equilibrium() {
    for (slides, most) in [(FIXED, 13), (SLIDING, 13)] {
        let scene = punched(slides);
        let exact = scene.solved(Method::Cholesky, 1e-8);
        assert!(exact.residual < 1e-7, "{slides}: residual {}", exact.residual);
        let by_cg = scene.solved(Method::Pcg, 1e-8);
        let apart = largest_difference(&exact.displacements, &by_cg.displacements);
        assert!(apart < 1e-6, "{slides}: {apart} mm");
        // More if the nodes around the punch do not move on their own.
        assert!(by_cg.iterations <= most, "{slides}: {} steps", by_cg.iterations);
        let early = scene.solved(Method::Pcg, 0.05);
        let apart = largest_difference(&exact.displacements, &early.displacements);
        assert!(apart <= early.error_estimate, "{slides}: {apart} over {}", early.error_estimate);
        assert!(early.iterations < by_cg.iterations, "{slides}: stopped no earlier");
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    for slides in [FIXED, SLIDING] {
        let scene = punched(slides);
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool.install(|| scene.solved(Method::Pcg, 1e-3));
            (bits(&found.displacements), bits(&found.forces))
        };
        assert_eq!(run(1), run(3), "{slides}");
    }
}
