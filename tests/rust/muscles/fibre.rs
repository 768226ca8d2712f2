//! Fibre directions from boxes: shapes whose fibres are known in closed form, and bad input.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use mtm_core::{ErrorKind, MtmError, MuscleFibres, MuscleKind, NearFibres, OrientedBox, Surface};
use nalgebra::Vector3;

type Point = [f64; 3];

/// A plate of `thickness` mm over a map of (s, v) in [0, 1]² to the plane z = 0, without its rim.
fn plate(map: impl Fn(f64, f64) -> [f64; 2], steps: [usize; 2], thickness: f64) -> Surface {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for z in [0.0, thickness] {
        let base = vertices.len() as u32;
        for i in 0..=steps[0] {
            for j in 0..=steps[1] {
                let [x, y] = map(i as f64 / steps[0] as f64, j as f64 / steps[1] as f64);
                vertices.push([x, y, z]);
            }
        }
        let row = steps[1] as u32 + 1;
        for i in 0..steps[0] as u32 {
            for j in 0..steps[1] as u32 {
                let a = base + i * row + j;
                triangles.push([a, a + row, a + 1]);
                triangles.push([a + 1, a + row, a + row + 1]);
            }
        }
    }
    Surface::new(vertices, triangles).unwrap()
}

fn angle(a: Point, b: Point) -> f64 {
    let (a, b) = (Vector3::from(a), Vector3::from(b));
    // Not by the arc cosine: near 0 rounding alone makes 1e-6 degrees of it.
    a.cross(&b).norm().atan2(a.dot(&b).abs()).to_degrees()
}

fn arc_map(s: f64, v: f64) -> [f64; 2] {
    let (turn, radius) = (FRAC_PI_2 * s, 38.0 + 4.0 * v);
    [radius * turn.cos(), radius * turn.sin()]
}

#[test]
fn one_box_of_a_bar_is_the_bar() {
    let bar = plate(|s, v| [60.0 * s, 10.0 * v], [1, 1], 4.0);
    let fibres = MuscleFibres::from_surface(&bar, MuscleKind::Strap, Some(1)).unwrap();
    let [found] = fibres.boxes() else { panic!("one box") };
    for (value, expected) in found.centre.iter().zip([30.0, 5.0, 2.0]) {
        assert!((value - expected).abs() < 1e-9);
    }
    for (value, expected) in found.half_extents.iter().zip([30.0, 5.0, 2.0]) {
        assert!((value - expected).abs() < 1e-9);
    }
    assert!(angle(found.axes[0], [1.0, 0.0, 0.0]) < 1e-5);
    assert!((fibres.sheet_ratio().unwrap() - 1.0 / 6.0).abs() < 1e-9);
    assert!(!fibres.is_sheet());
}

#[test]
fn boxes_follow_an_arc_of_a_right_angle() {
    let strap = plate(arc_map, [40, 3], 3.0);
    let fibres = MuscleFibres::from_surface(&strap, MuscleKind::Strap, None).unwrap();
    assert!(fibres.boxes().len() > 4, "{} boxes", fibres.boxes().len());
    let off: Vec<f64> = (0..=40)
        .map(|i| {
            let turn = FRAC_PI_2 * f64::from(i) / 40.0;
            let at = [40.0 * turn.cos(), 40.0 * turn.sin(), 1.5];
            angle(fibres.direction(at), [-turn.sin(), turn.cos(), 0.0])
        })
        .collect();
    // The last box at each end stands for half of its own turn and for a slice beyond.
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    assert!(mean < 3.0 && off.iter().all(|&a| a < 13.0), "{mean}: {off:?}");
    // One box is what the paper warns of: it cannot follow.
    let one = MuscleFibres::from_surface(&strap, MuscleKind::Strap, Some(1)).unwrap();
    assert!(angle(one.direction([40.0, 0.0, 1.5]), [0.0, 1.0, 0.0]) > 30.0);
}

#[test]
fn direction_turns_without_jumps() {
    let strap = plate(arc_map, [40, 3], 3.0);
    let fibres = MuscleFibres::from_surface(&strap, MuscleKind::Strap, None).unwrap();
    let at = |i: i32| {
        let turn = FRAC_PI_2 * f64::from(i) / 2000.0;
        fibres.direction([40.0 * turn.cos(), 40.0 * turn.sin(), 1.5])
    };
    for i in 0..2000 {
        assert!(angle(at(i), at(i + 1)) < 0.2, "step {i}");
    }
}

#[test]
fn fan_converges_to_its_apex() {
    let (near, far, opening) = (8.0, 60.0, PI / 3.0);
    let map = |s: f64, v: f64| {
        let (r, turn) = (near + (far - near) * s, opening * (v - 0.5));
        [r * turn.cos(), r * turn.sin()]
    };
    let fan = plate(map, [20, 20], 3.0);
    let fibres = MuscleFibres::from_surface(&fan, MuscleKind::Fan, None).unwrap();
    let mut off = Vec::new();
    for i in 0..=10 {
        for j in 0..=10 {
            let [x, y] = map(0.05 + 0.09 * f64::from(i), 0.05 + 0.09 * f64::from(j));
            let r = x.hypot(y);
            off.push(angle(fibres.direction([x, y, 1.5]), [x / r, y / r, 0.0]));
        }
    }
    // At the tip all lanes are near one another.
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    assert!(mean < 3.0 && off.iter().all(|&a| a < 20.0), "{mean}: {off:?}");
}

#[test]
fn ring_runs_round_its_opening() {
    let ring = |half: [f64; 2]| {
        move |s: f64, v: f64| {
            let (turn, size) = (TAU * s, 1.0 + 0.5 * v);
            [half[0] * size * turn.cos(), half[1] * size * turn.sin()]
        }
    };
    let round = plate(ring([16.0, 16.0]), [72, 3], 2.0);
    let fibres = MuscleFibres::from_surface(&round, MuscleKind::Ring, None).unwrap();
    for i in 0..90 {
        let turn = TAU * f64::from(i) / 90.0;
        let at = [20.0 * turn.cos(), 20.0 * turn.sin(), 1.0];
        assert!(angle(fibres.direction(at), [-turn.sin(), turn.cos(), 0.0]) < 2.0);
    }
    assert!(!fibres.is_sheet());
    let oval = plate(ring([24.0, 14.0]), [72, 3], 2.0);
    let fibres = MuscleFibres::from_surface(&oval, MuscleKind::Ring, None).unwrap();
    let off: Vec<f64> = (0..90)
        .map(|i| {
            let turn = TAU * f64::from(i) / 90.0;
            let at = [30.0 * turn.cos(), 17.5 * turn.sin(), 1.0];
            let tangent = [-30.0 * turn.sin(), 17.5 * turn.cos(), 0.0];
            let length = tangent[0].hypot(tangent[1]);
            angle(fibres.direction(at), tangent.map(|t| t / length))
        })
        .collect();
    assert!(off.iter().sum::<f64>() / 90.0 < 5.0, "{off:?}");
}

#[test]
fn flipped_triangles_and_a_turned_muscle_change_nothing() {
    let strap = plate(arc_map, [30, 4], 3.0);
    let flipped = strap.triangles().iter().enumerate();
    let flipped = flipped.map(|(i, &[a, b, c])| if i % 3 == 0 { [a, c, b] } else { [a, b, c] });
    let flipped = Surface::new(strap.vertices().to_vec(), flipped.collect()).unwrap();
    let (sine, cosine) = 0.7_f64.sin_cos();
    let turn = |[x, y, z]: Point| [cosine * x - sine * z, y, sine * x + cosine * z];
    let turned = strap.vertices().iter().map(|&v| turn(v)).collect();
    let turned = Surface::new(turned, strap.triangles().to_vec()).unwrap();
    let fibres = |s: &Surface| MuscleFibres::from_surface(s, MuscleKind::Strap, None).unwrap();
    let (plain, flipped, turned) = (fibres(&strap), fibres(&flipped), fibres(&turned));
    for i in 0..20 {
        let bend = 0.08 * f64::from(i);
        let at = [40.0 * bend.cos(), 40.0 * bend.sin(), 1.0];
        assert!(angle(plain.direction(at), flipped.direction(at)) < 1e-3);
        assert!(angle(turn(plain.direction(at)), turned.direction(turn(at))) < 1e-3);
    }
}

#[test]
fn blend_is_the_principal_axis_of_the_weighted_sum() {
    let turned = |degrees: f64, x: f64| {
        let (sine, cosine) = degrees.to_radians().sin_cos();
        OrientedBox {
            centre: [x, 0.0, 0.0],
            axes: [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]],
            half_extents: [5.0, 5.0, 5.0],
        }
    };
    let fibres = MuscleFibres::from_boxes(vec![turned(0.0, 0.0), turned(20.0, 10.0)]).unwrap();
    // Half way the weights are equal: the axis is the bisector.
    let (sine, cosine) = 10_f64.to_radians().sin_cos();
    assert!(angle(fibres.direction([5.0, 0.0, 0.0]), [cosine, sine, 0.0]) < 1e-6);
    // Signs do not cancel.
    let opposite = MuscleFibres::from_boxes(vec![turned(0.0, 0.0), turned(180.0, 10.0)]).unwrap();
    assert!(angle(opposite.direction([5.0, 0.0, 0.0]), [1.0, 0.0, 0.0]) < 1e-6);
}

#[test]
fn lines_are_followed_and_come_before_boxes() {
    let line: Vec<Point> = (0..=30)
        .map(|i| {
            let turn = FRAC_PI_2 * f64::from(i) / 30.0;
            [40.0 * turn.cos(), 40.0 * turn.sin(), 0.0]
        })
        .collect();
    let bar = plate(|s, v| [60.0 * s, 10.0 * v], [4, 2], 4.0);
    let fibres = MuscleFibres::from_surface(&bar, MuscleKind::Sheet, None).unwrap();
    assert!(fibres.is_sheet());
    let fibres = fibres.with_courses(std::slice::from_ref(&line)).unwrap();
    assert!(!fibres.is_sheet());
    for (i, &point) in line.iter().enumerate() {
        let turn = FRAC_PI_2 * i as f64 / 30.0;
        assert!(angle(fibres.direction(point), [-turn.sin(), turn.cos(), 0.0]) < 0.1);
    }
    let closed: Vec<Point> = (0..=60)
        .map(|i| (TAU * f64::from(i % 60) / 60.0).sin_cos())
        .map(|(y, x)| [x, y, 0.0])
        .collect();
    let fibres = MuscleFibres::from_courses(&[closed]).unwrap();
    assert!(angle(fibres.direction([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0]) < 0.1);
}

/// In balls far from the lines, between them, on their ends, and so large that they hold everything.
#[test]
fn directions_near_a_ball_are_the_bits_of_all_lines() {
    let line = |turn: f64| -> Vec<Point> {
        let place = |i: i32| {
            let s = 0.1 * f64::from(i);
            [30.0 * (s + turn).cos(), 30.0 * (s * turn).sin(), 2.0 * s * turn]
        };
        (0..60).map(place).collect()
    };
    let lines: Vec<Vec<Point>> = [0.4, 0.9, 1.3, 2.2].map(line).to_vec();
    let fibres = MuscleFibres::from_courses(&lines).unwrap();
    let mut near = NearFibres::default();
    for (radius, step) in [(0.0, 1), (0.5, 1), (3.0, 7), (80.0, 30)] {
        for p in lines.iter().flatten().step_by(step) {
            let centre = [p[0] + 0.3 * radius, p[1], p[2] - 0.4 * radius];
            fibres.near(centre, radius, &mut near);
            for corner in 0..8 {
                let side = |axis: usize| if corner >> axis & 1 == 1 { 0.57 } else { -0.57 };
                let x = [0, 1, 2].map(|axis| centre[axis] + side(axis) * radius);
                assert_eq!(fibres.direction_near(&near, x), fibres.direction(x), "{x:?}, {radius}");
            }
        }
    }
}

#[test]
fn many_points_in_parallel_are_the_single_ones() {
    let strap = plate(arc_map, [30, 4], 3.0);
    let fibres = MuscleFibres::from_surface(&strap, MuscleKind::Strap, None).unwrap();
    let points: Vec<Point> =
        (0..5000).map(|i| [f64::from(i % 71), f64::from(i % 43), f64::from(i % 7)]).collect();
    let one: Vec<Point> = points.iter().map(|&p| fibres.direction(p)).collect();
    assert_eq!(fibres.directions(&points), one);
    for d in one {
        assert!((d.iter().map(|x| x * x).sum::<f64>() - 1.0).abs() < 1e-12);
    }
}

#[test]
fn bad_input_is_named() {
    let bar = plate(|s, v| [60.0 * s, 10.0 * v], [1, 1], 4.0);
    let number = |kind, boxes| MuscleFibres::from_surface(&bar, kind, Some(boxes)).unwrap_err();
    for error in [
        number(MuscleKind::Strap, 0),
        number(MuscleKind::Ring, 2),
        number(MuscleKind::Sheet, 65),
        number(MuscleKind::Fan, 100_000),
    ] {
        assert!(matches!(error, MtmError::OutOfRange { .. }), "{error}");
    }
    let text = MuscleKind::parse("stripe").unwrap_err().to_string();
    assert!(text.contains("stripe") && text.contains("fan"), "{text}");
    let good = OrientedBox {
        centre: [0.0; 3],
        axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        half_extents: [3.0, 2.0, 0.0],
    };
    assert!(MuscleFibres::from_boxes(vec![good]).is_ok());
    let bad = [
        vec![],
        vec![good, OrientedBox { centre: [f64::NAN, 0.0, 0.0], ..good }],
        vec![OrientedBox { axes: [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], ..good }],
        vec![OrientedBox { half_extents: [1.0, -1.0, 0.0], ..good }],
        vec![OrientedBox { half_extents: [0.0; 3], ..good }],
    ];
    for boxes in bad {
        assert_eq!(MuscleFibres::from_boxes(boxes).unwrap_err().kind(), ErrorKind::Mesh);
    }
    assert!(matches!(MuscleFibres::from_courses(&[]), Err(MtmError::Empty { .. })));
    let point = vec![[1.0, 2.0, 3.0]; 4];
    assert!(matches!(MuscleFibres::from_courses(&[point]), Err(MtmError::Length { .. })));
    let infinite = vec![[0.0; 3], [f64::INFINITY, 0.0, 0.0]];
    assert!(matches!(MuscleFibres::from_courses(&[infinite]), Err(MtmError::NotFinite { .. })));
}
