//! Rigid motions and motions of surfaces against their closed forms.

use std::f64::consts::PI;

use super::surface::{Numbers, Vec3, gap, sphere};
use mtm_core::{MtmError, RigidMotion, Surface, SurfaceMotion};
use nalgebra::{Matrix4, Rotation3};

fn rigid(axis: [f64; 3], angle: f64, t: [f64; 3]) -> [[f64; 4]; 4] {
    let r = Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(Vec3::from(axis)), angle);
    let mut m = Matrix4::identity();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(r.matrix());
    m.fixed_view_mut::<3, 1>(0, 3).copy_from(&Vec3::from(t));
    std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
}

#[test]
fn transformed_surface_follows_a_rigid_motion() {
    let rest = sphere(3);
    let matrix = rigid([1.0, 2.0, 0.5], 1.1, [30.0, -4.0, 7.0]);
    let motion = RigidMotion::new("maxilla", &matrix).unwrap();
    let moved = rest.transformed(&matrix).unwrap();
    for p in Numbers(8).points(500, 2.0) {
        let (before, after) = (rest.closest_one(p), moved.closest_one(motion.apply(p)));
        assert!(gap(after.point, motion.apply(before.point)) < 1e-13);
        assert!(gap(after.normal, motion.rotate(before.normal)) < 1e-12);
    }
    assert!((moved.volume().unwrap() - rest.volume().unwrap()).abs() < 1e-12);
}

#[test]
fn surface_motion_follows_a_rigid_motion_on_and_off_the_surface() {
    let rest = sphere(2);
    for angle in [0.0, PI / 2.0, PI, 3.0] {
        let motion =
            RigidMotion::new("mandible", &rigid([0.2, -1.0, 0.4], angle, [9.0, 1.0, -3.0]))
                .unwrap();
        let moved = rest.vertices().iter().map(|&v| motion.apply(v)).collect();
        let followed = SurfaceMotion::new(rest.clone(), moved).unwrap();
        let points = Numbers(13).points(500, 3.0);
        for (p, u) in points.iter().zip(followed.displacement(&points)) {
            assert!(gap(u, motion.displacement(*p)) < 1e-12, "{angle} {p:?}");
        }
    }
}

#[test]
fn surface_motion_turns_by_the_polar_factor_and_moves_vertices_exactly() {
    let rest =
        Surface::new(vec![[0.0; 3], [2.0, 0.1, 0.0], [0.3, 1.0, 0.2]], vec![[0, 1, 2]]).unwrap();
    let target = vec![[1.0, 0.0, 0.0], [1.5, 2.0, 0.7], [-0.4, 1.0, 1.2]];
    let motion = SurfaceMotion::new(rest.clone(), target.clone()).unwrap();
    for (u, k) in motion.displacement(rest.vertices()).iter().zip(0..) {
        let expected = Vec3::from(target[k]) - Vec3::from(rest.vertices()[k]);
        assert!((Vec3::from(*u) - expected).norm() < 1e-13);
    }
    let frame = |surface: &Surface| {
        let [a, b, c] = [0, 1, 2].map(|k| Vec3::from(surface.vertices()[k]));
        nalgebra::Matrix3::from_columns(&[b - a, c - a, surface.facet_normals()[0].into()])
    };
    let map = frame(motion.moved()) * frame(&rest).try_inverse().unwrap();
    let svd = map.svd(true, true);
    let polar = svd.u.unwrap() * svd.v_t.unwrap();
    let above = |surface: &Surface, at: Vec3| at + Vec3::from(surface.facet_normals()[0]) * 0.5;
    let centre = |surface: &Surface| {
        surface.vertices().iter().fold(Vec3::zeros(), |sum, &v| sum + Vec3::from(v)) / 3.0
    };
    let u = motion.displacement(&[above(&rest, centre(&rest)).into()])[0];
    let expected = above(motion.moved(), centre(motion.moved())) - above(&rest, centre(&rest));
    assert!((Vec3::from(u) - expected).norm() < 1e-14);
    // Beyond the corner the offset has a part in the plane, which the polar factor turns.
    let offset = Vec3::new(-0.5, -0.4, 0.3);
    let u = motion.displacement(&[offset.into()])[0];
    let expected = Vec3::from(target[0]) + polar * offset - offset;
    assert!((Vec3::from(u) - expected).norm() < 1e-14);
}

#[test]
fn rigid_motion_refuses_what_is_not_one() {
    let problem = |matrix: [[f64; 4]; 4]| match RigidMotion::new("chin", &matrix) {
        Err(MtmError::Plan { segment, problem }) if segment == "chin" => problem,
        other => panic!("{other:?}"),
    };
    let good = rigid([1.0, 0.0, 1.0], 0.3, [1.0, 2.0, 3.0]);
    assert!(RigidMotion::new("chin", &good).is_ok());
    let mut bad = good;
    bad[1][3] = f64::NAN;
    assert!(problem(bad).contains("[1][3]"));
    let transposed = std::array::from_fn(|i| std::array::from_fn(|j| good[j][i]));
    assert!(problem(transposed).contains("transpose"));
    let mut bad = good;
    bad[0][..3].iter_mut().for_each(|entry| *entry *= -1.0);
    assert!(problem(bad).contains("reflection"));
    for scale in [1.0 + 1.1e-4, 0.0, 1e200] {
        let mut bad = good;
        bad[..3].iter_mut().for_each(|row| row[..3].iter_mut().for_each(|entry| *entry *= scale));
        assert!(problem(bad).contains("not rigid"), "{scale}");
    }
    let mut rounded = good;
    rounded[..3].iter_mut().for_each(|row| row[0] = (row[0] * 1e7).round() / 1e7);
    assert_ne!(RigidMotion::new("chin", &rounded).unwrap().matrix(), &rounded);
    assert_eq!(RigidMotion::identity().displacement([5.0, -6.0, 7.0]), [0.0; 3]);
}
