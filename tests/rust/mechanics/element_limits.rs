//! What mid-edge nodes inherit, what elements refuse, and bodies under loads alone.

use std::sync::Arc;

use super::elements::{ALL, ELEMENTS, of_element, with_kinematics};
use crate::meshes::{
    self, BoxShape, GO_ON, Numbers, boundary, isotropic, joined, largest, largest_difference, plan,
    plane, rigid, solve, solver, surface,
};
use mtm_core::{
    Elastic, Element, Kinematics, Method, Motion, MtmError, StaticOptions, StrainEnergy,
    SurfaceMotion, Tissue,
};

#[test]
fn mid_edge_nodes_inherit_what_their_ends_share() {
    let shape = BoxShape::cube(2);
    let mesh = shape.mesh();
    let tensors = of_element(&mesh, &isotropic(0.01, 0.4), Element::Quadratic);
    let nodes = tensors.element_nodes();
    assert_eq!(nodes.n_nodes(), mesh.n_nodes() + nodes.mid_edges().len());
    let top = shape.side(2, true);
    let bounds = boundary(shape.side(2, false), vec![joined("bone", top.clone())]);
    let mut numbers = Numbers(3);
    let rows: Vec<[f64; 3]> =
        numbers.points(top.len()).iter().map(|v| v.map(|x| 0.1 * x)).collect();
    let motion = plan([("bone", Motion::Nodes(rows))]);
    let found =
        solve(&tensors, &bounds, with_kinematics(Kinematics::Linear), &motion, None).unwrap();
    let u = &found.displacements;
    for (i, &[a, b]) in nodes.mid_edges().iter().enumerate() {
        let own = u[mesh.n_nodes() + i];
        let mean = [0, 1, 2].map(|c| 0.5 * (u[a as usize][c] + u[b as usize][c]));
        if top.contains(&a) && top.contains(&b) {
            assert!(largest_difference(&[own], &[mean]) < 1e-15);
        }
    }
    // The operator of re-planning holds for the same nodes.
    let turn = rigid([0.0, 1.0, 0.2], 10.0, [1.0; 3], [0.2, 0.0, 0.1]);
    let motion = plan([("bone", Motion::Rigid(turn))]);
    let ready = solver(&tensors, &bounds, with_kinematics(Kinematics::Linear)).unwrap();
    let direct = ready.solve(&motion, None, GO_ON).unwrap().displacements;
    let operator = ready.plan_operator(None, None, GO_ON).unwrap();
    let off = largest_difference(&operator.apply(&motion).unwrap(), &direct[..mesh.n_nodes()]);
    assert!(off < 1e-12, "{off}");
    // A surface that moves carries them by their own place.
    let plate = surface(plane(2, 5.0, 0.0));
    let lifted = plate.vertices().iter().map(|v| [v[0], v[1], v[2] + 0.3]).collect();
    let moved = Arc::new(SurfaceMotion::new(plate.as_ref().clone(), lifted).unwrap());
    let found = ready.solve(&plan([("bone", Motion::Surface(moved))]), None, GO_ON).unwrap();
    let above = nodes.positions().iter().zip(&found.displacements).filter(|(x, _)| x[2] > 1.999);
    for (_, u) in above {
        assert!(largest_difference(&[*u], &[[0.0, 0.0, 0.3]]) < 1e-12);
    }
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let shape = BoxShape::cube(2);
    let mesh = shape.mesh();
    let bounds = boundary(shape.side(2, false), vec![joined("bone", shape.side(2, true))]);
    let tensors = of_element(&mesh, &isotropic(0.01, 0.4), Element::Quadratic);
    let name = |error: MtmError| error.to_string();
    assert!(name(Element::from_name("p3").unwrap_err()).contains("p1, anp, p2"));
    assert!(name(Kinematics::from_name("finite").unwrap_err()).contains("corotational"));
    for element in ELEMENTS {
        assert_eq!(Element::from_name(element.name()).unwrap(), element);
    }
    for kinematics in ALL {
        assert_eq!(Kinematics::from_name(kinematics.name()).unwrap(), kinematics);
    }
    let relaxed =
        StaticOptions { method: Method::Relaxation, ..with_kinematics(Kinematics::Corotational) };
    assert!(name(solver(&tensors, &bounds, relaxed).err().unwrap()).contains("relaxation"));
    let ready = solver(&tensors, &bounds, with_kinematics(Kinematics::Corotational)).unwrap();
    let refused = ready.plan_operator(None, None, GO_ON).unwrap_err();
    assert!(name(refused).contains("corotational"));
    let motion = plan([("bone", meshes::stays())]);
    let short = vec![[0.0; 3]; 5];
    assert!(name(ready.solve(&motion, Some(&short), GO_ON).unwrap_err()).contains("loads"));
    let corners = vec![[0.0; 3]; mesh.n_nodes()];
    assert!(matches!(tensors.internal_force(&corners), Err(MtmError::Length { .. })));
    let body = StrainEnergy::new(tensors.clone(), Kinematics::NEO_HOOKEAN);
    assert!(matches!(body.state(&corners), Err(MtmError::Length { .. })));
    let mut infinite = vec![[0.0; 3]; tensors.element_nodes().n_nodes()];
    infinite[3][1] = f64::NAN;
    assert!(matches!(body.state(&infinite), Err(MtmError::NotFinite { index: 3, .. })));
    let one = StaticOptions { memory_limit: Some(10), ..with_kinematics(Kinematics::Corotational) };
    assert!(matches!(solver(&tensors, &bounds, one), Err(MtmError::OutOfMemory { .. })));
    let stop: &(dyn Fn() -> bool + Sync) = &|| true;
    assert!(matches!(ready.solve(&motion, None, stop), Err(MtmError::Interrupted)));
    // A plan whose forces overflow f64 is an error, not a number that is none.
    let far = plan([("bone", Motion::Nodes(vec![[1e200, 0.0, 0.0]; 9]))]);
    assert!(ready.solve(&far, None, GO_ON).is_err());
}

#[test]
fn loads_alone_and_nothing_at_all_are_solved() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let bounds = boundary(shape.side(0, false), vec![]);
    let tissue = Arc::new(Tissue::isotropic(&[Elastic { young: 0.01, poisson: 0.45 }]).unwrap());
    let mut loads = vec![[0.0; 3]; mesh.n_nodes()];
    for &j in &shape.side(0, true) {
        loads[j as usize] = [0.0, 0.0, -2e-4];
    }
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        for kinematics in ALL {
            let ready = solver(&tensors, &bounds, with_kinematics(kinematics)).unwrap();
            let still = ready.solve(&plan([]), None, GO_ON).unwrap();
            assert!(largest(&still.displacements) == 0.0);
            let found = ready.solve(&plan([]), Some(&loads), GO_ON).unwrap();
            assert!(found.residual < 1e-8, "{element:?} {kinematics:?} {}", found.residual);
            let held: f64 = found.forces.iter().map(|f| f[2]).sum();
            assert!(held.abs() < 1e-12, "{element:?} {kinematics:?}: {held}");
        }
    }
}
