//! Splines, rigid fits and closest points against closed forms, brute force and known motions.

use mtm_core::{
    ErrorKind, Fixed, IcpMethod, IcpOptions, MtmError, PointTree, RigidFitOptions, RigidMotion,
    Surface, ThinPlateSpline, icp, rigid_fit,
};
use nalgebra::{Matrix3, Rotation3, Unit, Vector3};
use proptest::prelude::*;

type Vec3 = Vector3<f64>;

/// Where a head lies in a scanner, mm.
const OFFSET: [f64; 3] = [0.0, -150.0, 1500.0];

/// The i-th of points spread evenly in a cube (Roberts' R3 sequence).
fn spread(i: usize, size: f64) -> [f64; 3] {
    const STEP: [f64; 3] = [0.819_172_513_4, 0.671_043_606_7, 0.549_700_477_9];
    STEP.map(|step| size * ((0.5 + step * (i + 1) as f64).fract() - 0.5))
}

fn landmarks(n: usize) -> Vec<[f64; 3]> {
    (0..n).map(|i| add(spread(i, 160.0), OFFSET)).collect()
}

fn bent(points: &[[f64; 3]], size: f64) -> Vec<[f64; 3]> {
    let bend = |i: usize, p: &[f64; 3]| add(*p, spread(7 * i + 3, size));
    points.iter().enumerate().map(|(i, p)| bend(i, p)).collect()
}

fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

fn gap(a: [f64; 3], b: [f64; 3]) -> f64 {
    (Vec3::from(a) - Vec3::from(b)).norm()
}

fn largest_gap(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&a, &b)| gap(a, b)).fold(0.0, f64::max)
}

fn rigid(axis: [f64; 3], angle: f64, t: [f64; 3]) -> [[f64; 4]; 4] {
    let r = Rotation3::from_axis_angle(&Unit::new_normalize(Vec3::from(axis)), angle);
    let row = |i: usize| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

fn apply(m: &[[f64; 4]; 4], points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let image = |p: &[f64; 3]| {
        [0, 1, 2].map(|i| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3])
    };
    points.iter().map(image).collect()
}

fn with_threads<T: Send>(n: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(work)
}

/// Half of an egg with bumps, open below, about 60 mm wide: no rotation leaves it alike.
fn bone(n: u32) -> Surface {
    let at = |i: u32, k: u32| {
        let (u, v) = (f64::from(i) / f64::from(n), f64::from(k) / f64::from(n));
        let (theta, phi) = (0.2 + 1.6 * u, 4.0 * v);
        let r = 30.0 + 4.0 * (2.0 * theta).sin() * (3.0 * phi).cos() + 3.0 * phi.sin();
        let p = [r * theta.sin() * phi.cos(), 0.8 * r * theta.sin() * phi.sin(), r * theta.cos()];
        add(p, OFFSET)
    };
    let vertices = (0..=n).flat_map(|i| (0..=n).map(move |k| at(i, k))).collect();
    let index = |i: u32, k: u32| i * (n + 1) + k;
    let mut triangles = Vec::new();
    for i in 0..n {
        for k in 0..n {
            let [a, b] = [index(i, k), index(i + 1, k)];
            let [c, d] = [index(i + 1, k + 1), index(i, k + 1)];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    Surface::new(vertices, triangles).unwrap()
}

#[test]
fn spline_takes_landmarks_to_their_targets() {
    for n in [4, 5, 32, 200] {
        let source = landmarks(n);
        let target = bent(&source, 10.0);
        let warp = ThinPlateSpline::new(source.clone(), target.clone(), 0.0).unwrap();
        assert!(largest_gap(&warp.warp(&source).unwrap(), &target) < 1e-9, "{n}");
        assert!(warp.residuals().iter().all(|&r| r < 1e-9), "{n}");
    }
}

#[test]
fn spline_of_an_affine_map_is_that_map_with_and_without_smoothing() {
    let a = Matrix3::new(1.1, 0.2, -0.1, 0.05, 0.9, 0.3, -0.2, 0.1, 1.3);
    let image = |p: &[f64; 3]| add((a * Vec3::from(*p)).into(), [3.0, -40.0, 12.0]);
    for smoothing in [0.0, 10.0] {
        let source = landmarks(32);
        let target = source.iter().map(image).collect();
        let warp = ThinPlateSpline::new(source, target, smoothing).unwrap();
        let points: Vec<[f64; 3]> = (0..50).map(|i| add(spread(i, 900.0), OFFSET)).collect();
        let expected: Vec<[f64; 3]> = points.iter().map(image).collect();
        assert!(largest_gap(&warp.warp(&points).unwrap(), &expected) < 1e-9);
        assert!(warp.bending_energy() < 1e-12);
        let affine = warp.affine();
        assert!((0..3).all(|i| (0..3).all(|k| (affine[i][k] - a[(i, k)]).abs() < 1e-12)));
    }
}

#[test]
fn smoothing_leaves_each_landmark_its_weight_times_lambda() {
    let source = landmarks(20);
    let target = bent(&source, 10.0);
    let mut energy = f64::INFINITY;
    for smoothing in [0.0, 0.5, 5.0, 500.0] {
        let warp = ThinPlateSpline::new(source.clone(), target.clone(), smoothing).unwrap();
        for (residual, weight) in warp.residuals().iter().zip(warp.weights()) {
            assert!((residual - smoothing * Vec3::from(weight).norm()).abs() < 1e-9);
        }
        assert!(warp.bending_energy() < energy);
        energy = warp.bending_energy();
    }
}

#[test]
fn jacobian_equals_central_differences() {
    let source = landmarks(12);
    let warp = ThinPlateSpline::new(source.clone(), bent(&source, 15.0), 0.0).unwrap();
    let points: Vec<[f64; 3]> = (0..40).map(|i| add(spread(3 * i + 1, 200.0), OFFSET)).collect();
    let h = 1e-3;
    for (point, j) in points.iter().zip(warp.jacobian(&points).unwrap()) {
        for axis in 0..3 {
            let (mut above, mut below) = (*point, *point);
            above[axis] += h;
            below[axis] -= h;
            let ends = warp.warp(&[above, below]).unwrap();
            for i in 0..3 {
                assert!(((ends[0][i] - ends[1][i]) / (2.0 * h) - j[i][axis]).abs() < 1e-7);
            }
        }
    }
}

#[test]
fn folds_are_counted_and_the_worst_place_is_found() {
    // Four corners stay, and the fifth landmark goes through the opposite face.
    let mut source: Vec<[f64; 3]> =
        vec![[0.0; 3], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0], [0.0, 0.0, 10.0], [2.5, 2.5, 2.5]];
    let mut target = source.clone();
    target[4] = [-20.0, -20.0, -20.0];
    source.push([10.0, 10.0, 10.0]);
    target.push([10.0, 10.0, 10.0]);
    let warp = ThinPlateSpline::new(source, target, 0.0).unwrap();
    let points: Vec<[f64; 3]> = (0..1000).map(|i| add(spread(i, 10.0), [5.0; 3])).collect();
    let folds = warp.folds(&points).unwrap();
    let j = warp.jacobian(&points).unwrap();
    let det = |j: &[[f64; 3]; 3]| Matrix3::from_fn(|i, k| j[i][k]).determinant();
    let expected = j.iter().filter(|j| det(j) <= 0.0).count();
    assert!(expected > 10 && folds.count == expected);
    let worst = folds.worst.unwrap();
    assert!(folds.determinants.iter().all(|&d| d >= folds.determinants[worst]));
    assert_eq!(folds.smallest(), Some(folds.determinants[worst]));
    assert_eq!(warp.folds(&[]).unwrap().worst, None);
}

#[test]
fn smallest_determinant_at_a_landmark_is_that_of_directions_round_it() {
    let source = landmarks(9);
    let warp = ThinPlateSpline::new(source.clone(), bent(&source, 60.0), 0.0).unwrap();
    let near = warp.landmark_folds();
    for (at, &smallest) in source.iter().zip(&near.determinants) {
        let round: Vec<[f64; 3]> = (0..4000)
            .map(|i| add(*at, (Vec3::from(spread(i, 2.0)).normalize() * 1e-5).into()))
            .collect();
        let seen = warp.folds(&round).unwrap().smallest().unwrap();
        // Sampled directions come within a tenth of a radian of the worst one.
        assert!(seen > smallest - 1e-5 && seen - smallest < 6e-3, "{seen} {smallest}");
    }
}

#[test]
fn image_of_a_point_does_not_depend_on_threads_or_company() {
    let source = landmarks(32);
    let warp = ThinPlateSpline::new(source.clone(), bent(&source, 10.0), 0.0).unwrap();
    let points: Vec<[f64; 3]> = (0..5003).map(|i| add(spread(i, 200.0), OFFSET)).collect();
    let alone: Vec<[f64; 3]> = points.iter().map(|&p| warp.warp(&[p]).unwrap()[0]).collect();
    for n in 1..=3 {
        assert_eq!(with_threads(n, || warp.warp(&points).unwrap()), alone);
    }
}

#[test]
fn unusable_landmarks_are_refused_with_the_fact() {
    let source = landmarks(6);
    let spline = |s: &[[f64; 3]], t: &[[f64; 3]], smoothing| {
        ThinPlateSpline::new(s.to_vec(), t.to_vec(), smoothing).unwrap_err()
    };
    let flat = |points: &[[f64; 3]], keep: usize| -> Vec<[f64; 3]> {
        let zero = |p: &[f64; 3]| [0, 1, 2].map(|i| if i < keep { p[i] } else { 1500.0 });
        points.iter().map(zero).collect()
    };
    let mut double = source.clone();
    double[4] = add(double[1], [1e-9, 0.0, 0.0]);
    let mut broken = source.clone();
    broken[2][1] = f64::NAN;
    let mut far = source.clone();
    far[5][0] = 1e200;
    assert!(matches!(
        spline(&source[..3], &source[..3], 0.0),
        MtmError::TooFewPoints { found: 3, .. }
    ));
    assert!(matches!(spline(&[], &[], 0.0), MtmError::TooFewPoints { found: 0, .. }));
    assert!(matches!(spline(&source, &source[..5], 0.0), MtmError::Length { found: 5, .. }));
    assert!(matches!(
        spline(&flat(&source, 2), &source, 0.0),
        MtmError::FlatPoints { shape: "plane", .. }
    ));
    assert!(matches!(
        spline(&flat(&source, 1), &source, 0.0),
        MtmError::FlatPoints { shape: "line", .. }
    ));
    assert!(matches!(
        spline(&double, &source, 0.0),
        MtmError::CoincidentPoints { first: 1, second: 4, .. }
    ));
    assert!(matches!(
        spline(&[[1.0; 3]; 6], &source, 0.0),
        MtmError::CoincidentPoints { first: 0, second: 1, .. }
    ));
    assert!(matches!(spline(&source, &broken, 0.0), MtmError::NotFinite { index: 2, .. }));
    assert!(matches!(spline(&far, &source, 0.0), MtmError::OutOfRange { index: 5, .. }));
    for smoothing in [-1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(spline(&source, &source, smoothing), MtmError::OutOfRange { .. }));
    }
    let warp = ThinPlateSpline::new(source.clone(), source, 0.0).unwrap();
    let error = warp.warp(&[[0.0; 3], [0.0, f64::INFINITY, 0.0]]).unwrap_err();
    assert!(matches!(error, MtmError::NotFinite { index: 1, .. }));
    assert_eq!(error.kind(), ErrorKind::Registration);
    assert!(matches!(warp.jacobian(&[[1e9; 3]]), Err(MtmError::OutOfRange { index: 0, .. })));
}

#[test]
fn rigid_fit_ignores_pairs_without_weight_and_finds_the_scale() {
    let moving = landmarks(12);
    let motion = rigid([1.0, 2.0, -1.0], 2.9, [30.0, -7.0, 11.0]);
    let mut scaled = motion;
    scaled[..3].iter_mut().for_each(|row| row[..3].iter_mut().for_each(|x| *x *= 1.7));
    let mut fixed = apply(&scaled, &moving);
    fixed[5] = [1000.0, 0.0, 0.0];
    let mut weights = vec![0.3; 12];
    weights[5] = 0.0;
    let options = RigidFitOptions { weights: Some(&weights), scale: true };
    let fit = rigid_fit(&moving, &fixed, &options).unwrap();
    assert!((fit.scale - 1.7).abs() < 1e-12);
    assert!(fit.rms < 1e-9 && fit.residuals[5] > 100.0);
    let rigid_only = rigid_fit(&moving, &apply(&motion, &moving), &RigidFitOptions::default());
    let rigid_only = rigid_only.unwrap();
    assert!(largest_gap(&apply(&rigid_only.matrix, &moving), &apply(&motion, &moving)) < 1e-9);
    assert_eq!(rigid_only.scale, 1.0);
}

#[test]
fn rigid_fit_of_a_mirror_image_is_a_rotation() {
    let moving = landmarks(15);
    let fixed: Vec<[f64; 3]> = moving.iter().map(|p| [-p[0], p[1], p[2]]).collect();
    let fit = rigid_fit(&moving, &fixed, &RigidFitOptions::default()).unwrap();
    let r = Matrix3::from_fn(|i, k| fit.matrix[i][k]);
    assert!((r.determinant() - 1.0).abs() < 1e-12 && fit.rms > 1.0);
}

#[test]
fn pairs_that_fix_no_rotation_are_refused() {
    let line: Vec<[f64; 3]> = (0..5).map(|i| [f64::from(i), 2.0 * f64::from(i), 1.0]).collect();
    let points = landmarks(5);
    let fit = |m: &[[f64; 3]], f: &[[f64; 3]], weights: Option<&[f64]>| {
        rigid_fit(m, f, &RigidFitOptions { weights, scale: false }).unwrap_err()
    };
    assert!(matches!(
        fit(&line, &points, None),
        MtmError::FlatPoints { what: "moving points", .. }
    ));
    assert!(matches!(fit(&points, &line, None), MtmError::FlatPoints { what: "fixed points", .. }));
    assert!(matches!(fit(&points[..2], &points[..2], None), MtmError::TooFewPoints { .. }));
    let weights = [1.0, 1.0, 0.0, 0.0, 0.0];
    assert!(matches!(
        fit(&points, &points, Some(&weights)),
        MtmError::TooFewPoints { found: 2, .. }
    ));
    assert!(matches!(
        fit(&points, &points, Some(&[1.0, 1.0, -2.0, 1.0, 1.0])),
        MtmError::OutOfRange { index: 2, .. }
    ));
    assert!(matches!(fit(&points, &points[..4], None), MtmError::Length { found: 4, .. }));
    assert!(matches!(fit(&points, &points, Some(&weights[..3])), MtmError::Length { .. }));
    // A regular octahedron and its inside-out: three half turns fit alike.
    let octahedron: Vec<[f64; 3]> = (0..6)
        .map(|i| [0, 1, 2].map(|k| if i / 2 == k { 1.0 - 2.0 * (i % 2) as f64 } else { 0.0 }))
        .collect();
    let mirrored: Vec<[f64; 3]> = octahedron.iter().map(|p| p.map(|x| -x)).collect();
    assert!(matches!(fit(&octahedron, &mirrored, None), MtmError::NotDetermined { .. }));
}

#[test]
fn nearest_point_equals_brute_force_and_the_smallest_index_wins() {
    // Whole coordinates: many points coincide and many distances are equal.
    let coarse = |p: [f64; 3]| p.map(f64::round);
    let points: Vec<[f64; 3]> = (0..700).map(|i| coarse(spread(i, 9.0))).collect();
    let tree = PointTree::new(&points).unwrap();
    for i in 0..500 {
        let place = if i % 2 == 0 { spread(i + 31, 14.0) } else { coarse(spread(i + 31, 14.0)) };
        let squared = |p: &[f64; 3]| (Vec3::from(place) - Vec3::from(*p)).norm_squared();
        let best = (0..points.len())
            .min_by(|&a, &b| squared(&points[a]).total_cmp(&squared(&points[b])).then(a.cmp(&b)))
            .unwrap();
        let found = tree.nearest(place);
        assert_eq!(found.index as usize, best);
        assert_eq!(found.point, points[best]);
    }
    assert!(matches!(PointTree::new(&[]), Err(MtmError::Empty { .. })));
}

#[test]
fn icp_recovers_a_known_motion_exactly() {
    let fixed = bone(24);
    let tree = PointTree::new(fixed.vertices()).unwrap();
    let plane = IcpOptions { keep_border: true, ..IcpOptions::default() };
    let point = IcpOptions { max_iterations: 2000, tolerance: 1e-13, ..plane };
    // Points find their partners from within their spacing only; a surface from far away.
    for (target, options, size) in
        [(Fixed::Surface(&fixed), plane, 1.0), (Fixed::Points(&tree), point, 0.1)]
    {
        // Turned about its own middle, or the offset would carry it away.
        let turn = rigid([1.0, -1.0, 2.0], 0.06 * size, [1.5, -2.0, 1.0].map(|x| x * size));
        let about = OFFSET.map(|x| -x);
        let centred: Vec<[f64; 3]> = fixed.vertices().iter().map(|&p| add(p, about)).collect();
        let moving: Vec<[f64; 3]> =
            apply(&turn, &centred).iter().map(|&p| add(p, OFFSET)).collect();
        let fit = icp(&moving, None, target, &options, &|| false).unwrap();
        assert!(fit.converged && fit.kept.iter().all(|&kept| kept));
        let reached = apply(&fit.matrix, &moving);
        assert!(largest_gap(&reached, fixed.vertices()) < 1e-9, "{:?}", fit.rms_history);
        assert_eq!(fit.rms_history.len(), fit.iterations + 1);
        assert!(fit.rms_history.windows(2).all(|w| w[1] <= w[0] + 1e-12));
    }
}

#[test]
fn icp_gives_the_same_bits_for_any_number_of_threads() {
    let fixed = bone(24);
    let moving: Vec<[f64; 3]> =
        fixed.vertices().iter().enumerate().map(|(i, &p)| add(p, spread(i, 1.0))).collect();
    let options = IcpOptions { trim: 0.1, ..IcpOptions::default() };
    let run = || icp(&moving, None, Fixed::Surface(&fixed), &options, &|| false).unwrap();
    let one = with_threads(1, run);
    for n in 2..=3 {
        assert_eq!(with_threads(n, run), one);
    }
}

#[test]
fn icp_says_what_stops_it() {
    let fixed = bone(12);
    let surface = Fixed::Surface(&fixed);
    let points = fixed.vertices().to_vec();
    let shifted: Vec<[f64; 3]> = points.iter().map(|&p| add(p, [2.0, 1.0, 0.5])).collect();
    let run = |options: IcpOptions| icp(&shifted, None, surface, &options, &|| false);
    let base = IcpOptions { keep_border: true, ..IcpOptions::default() };
    match run(IcpOptions { max_iterations: 2, ..base }).unwrap_err() {
        MtmError::IcpNotConverged { iterations: 2, history, .. } => assert_eq!(history.len(), 3),
        other => panic!("{other}"),
    }
    let fit = run(IcpOptions { max_iterations: 2, tolerance: 0.0, ..base }).unwrap();
    assert!(fit.iterations == 2 && !fit.converged);
    assert!(matches!(
        run(IcpOptions { max_distance: Some(1e-6), ..base }),
        Err(MtmError::NotDetermined { .. })
    ));
    for bad in [
        IcpOptions { trim: 1.0, ..base },
        IcpOptions { trim: f64::NAN, ..base },
        IcpOptions { tolerance: -1.0, ..base },
        IcpOptions { max_iterations: 0, ..base },
        IcpOptions { max_distance: Some(0.0), ..base },
        IcpOptions { max_angle: Some(1.0), ..base },
    ] {
        assert!(matches!(run(bad), Err(MtmError::OutOfRange { .. })), "{bad:?}");
    }
    let mut stretched = *RigidMotion::identity().matrix();
    stretched[0][0] = 2.0;
    let error = run(IcpOptions { initial: stretched, ..base }).unwrap_err();
    assert!(matches!(&error, MtmError::NotRigid { .. }) && error.kind() == ErrorKind::Registration);
    let tree = PointTree::new(&points).unwrap();
    let plane = IcpOptions { method: Some(IcpMethod::Plane), ..base };
    let error = icp(&shifted, None, Fixed::Points(&tree), &plane, &|| false).unwrap_err();
    assert!(matches!(error, MtmError::NotTogether { .. }));
    let one = PointTree::new(&points[..1]).unwrap();
    let error = icp(&shifted, None, Fixed::Points(&one), &base, &|| false).unwrap_err();
    assert!(matches!(error, MtmError::NotDetermined { .. }));
    let stopped = icp(&shifted, None, surface, &base, &|| true).unwrap_err();
    assert_eq!(stopped, MtmError::Interrupted);
}

#[test]
fn icp_on_a_plane_names_the_open_motions() {
    let corner = [[-50.0, -50.0, 0.0], [50.0, -50.0, 0.0], [50.0, 50.0, 0.0], [-50.0, 50.0, 0.0]];
    let plane = Surface::new(corner.to_vec(), vec![[0, 1, 2], [0, 2, 3]]).unwrap();
    let moving: Vec<[f64; 3]> =
        (0..30).map(|i| spread(i, 20.0)).map(|[x, y, _]| [x, y, 1.0 + 0.1 * x]).collect();
    let run = |method| {
        let options = IcpOptions { method: Some(method), ..IcpOptions::default() };
        icp(&moving, None, Fixed::Surface(&plane), &options, &|| false)
    };
    assert!(
        matches!(run(IcpMethod::Plane), Err(MtmError::NotDetermined { reason, .. }) if reason.starts_with("3 of 6"))
    );
    assert!(run(IcpMethod::Point).unwrap().rms < 1e-6);
}

proptest! {
    #[test]
    fn rigid_fit_recovers_any_motion(
        axis in prop::array::uniform3(-1.0..1.0_f64),
        angle in -3.1..3.1_f64,
        t in prop::array::uniform3(-500.0..500.0_f64),
    ) {
        prop_assume!(Vec3::from(axis).norm() > 0.1);
        let moving = landmarks(8);
        let fixed = apply(&rigid(axis, angle, t), &moving);
        let fit = rigid_fit(&moving, &fixed, &RigidFitOptions::default()).unwrap();
        prop_assert!(largest_gap(&apply(&fit.matrix, &moving), &fixed) < 1e-9);
    }
}
