//! Muscle fractions and fibres of tets against closed forms.

use std::f64::consts::PI;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::meshes::{BoxShape, GO_ON, Numbers, Triangles, Vec3, sphere, surface};
use mtm_core::{
    ErrorKind, InsideTest, Mixing, MtmError, Muscle, MuscleFibres, MuscleShares, Preset,
    SamplingOptions, TetMesh, sample_muscles,
};

/// A muscle whose fibres run along `direction`.
fn muscle(triangles: Triangles, direction: [f64; 3]) -> Muscle {
    let line = [-100.0, 100.0].map(|s| direction.map(|d| s * d)).to_vec();
    let fibres = Arc::new(MuscleFibres::from_courses(&[line]).unwrap());
    Muscle { surface: surface(triangles), fibres }
}

fn ball(radius: f64, centre: [f64; 3]) -> Triangles {
    let (vertices, triangles) = sphere(4, radius);
    (vertices.iter().map(|v| [0, 1, 2].map(|i| v[i] + centre[i])).collect(), triangles)
}

/// The box between two corners, closed, each face two triangles.
fn cuboid(low: [f64; 3], high: [f64; 3]) -> Triangles {
    let corner =
        |i: usize| [0, 1, 2].map(|axis| if i >> axis & 1 == 1 { high[axis] } else { low[axis] });
    let quads =
        [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles = quads.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    ((0..8).map(corner).collect(), triangles)
}

fn sampled(mesh: &TetMesh, muscles: &[Muscle], samples: usize) -> MuscleShares {
    let options = SamplingOptions { samples, ..Default::default() };
    sample_muscles(mesh, muscles, &options, GO_ON).unwrap()
}

/// Part of a tet where a linear function with values `f` at its corners is positive:
/// Σ over corners with f_i > 0 of f_i³ / Π_{j≠i} (f_i − f_j).
fn positive_part(f: [f64; 4]) -> f64 {
    (0..4)
        .filter(|&i| f[i] > 0.0)
        .map(|i| {
            let product: f64 = (0..4).filter(|&j| j != i).map(|j| f[i] - f[j]).product();
            f[i].powi(3) / product
        })
        .sum()
}

/// A box turned so that one face cuts the mesh as a plane and the others lie outside: the fraction of
/// each tet is exact.
#[test]
fn tets_cut_by_a_plane_have_their_exact_fraction_within_the_stated_error() {
    let shape = BoxShape { cells: [6; 3], size: [6.0; 3], jitter: 0.2 };
    let mesh = shape.mesh();
    let mut numbers = Numbers(3);
    let mut previous: Option<f64> = None;
    let mut rates = Vec::new();
    for samples in [16, 64, 256, 1024] {
        let (mut squares, mut stated, mut cut) = (0.0, 0.0, 0);
        for _ in 0..8 {
            let normal = Vec3::from(numbers.unit());
            let through = Vec3::from([3.0; 3]) + Vec3::from(numbers.point());
            let side = normal.cross(&Vec3::from(numbers.unit())).normalize();
            let frame = [normal, side, normal.cross(&side)];
            let (vertices, triangles) = cuboid([-40.0, -40.0, -40.0], [0.0, 40.0, 40.0]);
            let placed = |v: &[f64; 3]| {
                (through + frame[0] * v[0] + frame[1] * v[1] + frame[2] * v[2]).into()
            };
            let half_space =
                muscle((vertices.iter().map(placed).collect(), triangles), frame[2].into());
            let made = sampled(&mesh, &[half_space], samples);
            for (t, tet) in mesh.tets().iter().enumerate() {
                let height =
                    |v: u32| -normal.dot(&(Vec3::from(mesh.nodes()[v as usize]) - through));
                let exact = positive_part(tet.map(height));
                let error = made.fraction[t] - exact;
                if made.error[t] == 0.0 {
                    assert!(error.abs() < 1e-9, "tet {t}: {} for {exact}", made.fraction[t]);
                } else {
                    let limit = 6.0 * made.error[t];
                    assert!(error.abs() < limit, "tet {t}: {error}, 6 standard errors {limit}");
                    squares += error * error;
                    stated += made.error[t].powi(2);
                    cut += 1;
                }
            }
        }
        let (error, stated) = ((squares / f64::from(cut)).sqrt(), (stated / f64::from(cut)).sqrt());
        let share = error / stated;
        assert!((0.5..1.0).contains(&share), "{samples} samples: {error} where {stated} is stated");
        if let Some(before) = previous {
            rates.push((before / error).log2() / 2.0);
        }
        previous = Some(error);
    }
    // n^(−2/3) for a smooth surface; random points have n^(−1/2).
    let mean = rates.iter().sum::<f64>() / rates.len() as f64;
    assert!(mean > 0.6, "rates {rates:?}");
}

#[test]
fn a_ball_and_a_box_keep_their_volume_within_the_stated_error() {
    let mesh = BoxShape { cells: [10; 3], size: [10.0; 3], jitter: 0.2 }.mesh();
    let round = ball(3.3, [4.9, 5.1, 5.0]);
    let flat = cuboid([1.3, 2.1, 0.7], [8.9, 3.4, 8.2]);
    for (triangles, exact) in [(round, 4.0 / 3.0 * PI * 3.3_f64.powi(3)), (flat, 7.6 * 1.3 * 7.5)] {
        let made = sampled(&mesh, &[muscle(triangles, [0.0, 0.0, 1.0])], 64);
        let volume = made.volumes[0];
        let enclosed = volume.enclosed.unwrap();
        assert!((enclosed / exact - 1.0).abs() < 5e-3);
        assert!((volume.inside - enclosed).abs() < 4.0 * volume.error, "{volume:?}");
        assert!((volume.inside / enclosed - 1.0).abs() < 5e-3, "{volume:?}");
        let sum: f64 = made.fraction.iter().zip(mesh.volumes()).map(|(p, v)| p * v).sum();
        assert!((sum - volume.inside).abs() < 1e-9 * sum && volume.shared == volume.inside);
    }
}

#[test]
fn threads_and_the_order_of_muscles_do_not_change_a_bit() {
    let mesh = BoxShape::cube(8).mesh();
    let muscles = || {
        vec![
            muscle(ball(2.2, [3.0, 4.0, 4.0]), [0.0, 0.6, 0.8]),
            muscle(ball(2.2, [4.5, 4.0, 4.0]), [1.0, 0.0, 0.0]),
            muscle(ball(2.2, [4.0, 4.9, 3.0]), [0.0, -0.8, 0.6]),
        ]
    };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| sampled(&mesh, &muscles(), 32))
    };
    let one = run(1);
    let mut other_way = muscles();
    other_way.reverse();
    let turned_round = sampled(&mesh, &other_way, 32);
    for made in [run(2), run(3), turned_round] {
        assert_eq!(made.fraction, one.fraction);
        assert_eq!(made.fibre, one.fibre);
        assert_eq!(made.error, one.error);
        assert_eq!(made.counts, one.counts);
    }
    assert_eq!(run(2).tets, one.tets);
}

/// Where two muscles overlap a tet counts once, and each muscle has half of it.
#[test]
fn overlapping_muscles_count_once_and_share_equally() {
    let mesh = BoxShape::cube(6).mesh();
    let first = || muscle(cuboid([-1.0; 3], [4.0, 7.0, 7.0]), [1.0, 0.0, 0.0]);
    let second = || muscle(cuboid([2.0, -1.0, -1.0], [7.0; 3]), [0.0, 1.0, 0.0]);
    let made = sampled(&mesh, &[first(), second()], 64);
    let whole: f64 = mesh.volumes().iter().sum();
    assert!(made.fraction.iter().all(|&p| (p - 1.0).abs() < 1e-12));
    let [a, b] = [made.volumes[0], made.volumes[1]];
    assert!((a.shared + b.shared - whole).abs() < 1e-9 * whole);
    assert!((a.inside - whole * 4.0 / 6.0).abs() < 5.0 * a.error, "{a:?}");
    assert!((a.shared - whole * 0.5).abs() < 5.0 * a.error, "{a:?}");
    for one in &made.tets {
        let sum: f64 = one.shares.iter().map(|s| s.fraction).sum();
        assert!((sum - made.fraction[one.tet as usize]).abs() < 1e-12);
    }
    // Both directions weigh the same in the middle: neither leads.
    let centre =
        |t: usize| mesh.tets()[t].iter().map(|&v| mesh.nodes()[v as usize][0]).sum::<f64>() / 4.0;
    for t in 0..mesh.n_tets() {
        let found = made.fibre[t];
        if made.error[t] == 0.0 && (2.5..3.5).contains(&centre(t)) {
            assert!(found.coherence < 1e-12, "{found:?}");
        } else if centre(t) < 1.0 {
            assert_eq!((found.direction, found.coherence), ([1.0, 0.0, 0.0], 1.0));
        }
    }
}

#[test]
fn tets_away_from_every_muscle_cost_nothing() {
    let mesh = BoxShape { cells: [16; 3], size: [16.0; 3], jitter: 0.1 }.mesh();
    let far = muscle(ball(2.0, [100.0, 0.0, 0.0]), [0.0, 0.0, 1.0]);
    let made = sampled(&mesh, std::slice::from_ref(&far), 64);
    assert_eq!((made.counts.points, made.counts.pairs, made.counts.crossed), (0, 0, 0));
    assert_eq!(made.volumes[0].inside, 0.0);
    let near = muscle(ball(2.0, [8.0; 3]), [0.0, 0.0, 1.0]);
    let one = sampled(&mesh, std::slice::from_ref(&near), 64);
    let both = sampled(&mesh, &[far, near], 64).counts;
    assert_eq!(both.crossed, one.counts.crossed);
    assert!(both.pairs * 10 < one.counts.pairs * 11, "{both:?} for {:?}", one.counts);
    // The ball fills 1 % of the mesh; its box, and the leaves of the tree that meet it, a little more.
    assert!(one.counts.pairs * 20 < mesh.n_tets(), "{:?} of {}", one.counts, mesh.n_tets());
    assert!(one.counts.crossed < one.counts.pairs);
    assert!(one.counts.points < 64 * one.counts.crossed + one.counts.pairs + 1000);
}

#[test]
fn without_muscles_all_is_fat() {
    let mesh = BoxShape::cube(2).mesh();
    let made = sampled(&mesh, &[], 64);
    assert!(made.fraction.iter().all(|&p| p == 0.0) && made.tets.is_empty());
    let preset = Preset::from_name("kim2010").unwrap();
    let [moduli, stiffness] =
        [Mixing::Moduli, Mixing::Stiffness].map(|m| made.tissue(preset, m).unwrap().stiffness());
    assert_eq!(moduli.len(), mesh.n_tets());
    assert_eq!(moduli, stiffness);
}

#[test]
fn a_surface_inside_out_is_turned() {
    let mesh = BoxShape::cube(8).mesh();
    let (vertices, mut triangles) = ball(2.5, [4.0; 3]);
    let right =
        sampled(&mesh, &[muscle((vertices.clone(), triangles.clone()), [1.0, 0.0, 0.0])], 32);
    triangles.iter_mut().for_each(|t| t.swap(1, 2));
    for inside in [InsideTest::Winding, InsideTest::Normal] {
        let options = SamplingOptions { samples: 32, inside, ..Default::default() };
        let turned = muscle((vertices.clone(), triangles.clone()), [1.0, 0.0, 0.0]);
        let made = sample_muscles(&mesh, &[turned], &options, GO_ON).unwrap();
        assert!(made.volumes[0].was_turned && !right.volumes[0].was_turned);
        assert_eq!(made.volumes[0].enclosed, right.volumes[0].enclosed);
        assert_eq!(made.fraction, right.fraction, "{inside:?}");
    }
}

/// Two balls in one surface: the closest normal errs where one covers the other, the winding number does
/// not (19 % of the inside lost, and 0.07 %).
#[test]
fn overlaps_holes_and_flips_cost_the_normal_test_volume_and_the_winding_number_little() {
    let mesh = BoxShape { cells: [12; 3], size: [12.0; 3], jitter: 0.2 }.mesh();
    let (r, apart) = (3.0_f64, 2.0_f64);
    let (mut vertices, mut triangles) = ball(r, [5.0, 6.0, 6.0]);
    let n = vertices.len() as u32;
    let (others, more) = ball(r, [5.0 + apart, 6.0, 6.0]);
    vertices.extend(others);
    triangles.extend(more.iter().map(|t| t.map(|v| v + n)));
    // Union of two balls: each less its cap beyond the middle plane.
    let cap_height = r - 0.5 * apart;
    let cap = PI * cap_height * cap_height * (3.0 * r - cap_height) / 3.0;
    let exact = 2.0 * (4.0 / 3.0 * PI * r.powi(3) - cap);
    let lost = |triangles: &[[u32; 3]], inside: InsideTest| {
        let options = SamplingOptions { samples: 32, inside, ..Default::default() };
        let union = muscle((vertices.clone(), triangles.to_vec()), [1.0, 0.0, 0.0]);
        let made = sample_muscles(&mesh, &[union], &options, GO_ON).unwrap();
        1.0 - made.volumes[0].inside / exact
    };
    let overlapping = [InsideTest::Winding, InsideTest::Normal].map(|t| lost(&triangles, t));
    assert!(overlapping[0].abs() < 5e-3 && overlapping[1] > 0.05, "{overlapping:?}");
    let mut holed = triangles.clone();
    holed.drain(300..312);
    assert!(lost(&holed, InsideTest::Winding).abs() < 5e-3);
    let mut flipped = triangles;
    flipped.iter_mut().step_by(97).for_each(|t| t.swap(0, 1));
    assert!(lost(&flipped, InsideTest::Winding).abs() < 2e-2);
}

#[test]
fn bad_options_and_an_interruption_are_named() {
    let mesh = BoxShape::cube(2).mesh();
    let muscles = [muscle(ball(0.8, [1.0; 3]), [1.0, 0.0, 0.0])];
    for samples in [0, 1 << 21] {
        let options = SamplingOptions { samples, ..Default::default() };
        let error = sample_muscles(&mesh, &muscles, &options, GO_ON).unwrap_err();
        assert!(matches!(&error, MtmError::OutOfRange { what, .. } if what == "samples"));
        assert_eq!(error.kind(), ErrorKind::Material);
    }
    assert!(InsideTest::from_name("ray").unwrap_err().to_string().contains("winding, normal"));
    let asked = AtomicUsize::new(0);
    let stop = || {
        asked.fetch_add(1, Ordering::Relaxed);
        true
    };
    let error = sample_muscles(&mesh, &muscles, &SamplingOptions::default(), &stop).unwrap_err();
    assert_eq!(error, MtmError::Interrupted);
    assert!(asked.load(Ordering::Relaxed) > 0);
}
