//! Levels of tubes.

use mtm_core::{TubeEnd, tube_levels};

fn end(x: f64, thick: f64, wide: f64) -> TubeEnd {
    TubeEnd { place: [x, 0.0, 0.0], normal: [0.0, 0.0, 1.0], thick, wide }
}

#[test]
fn a_round_tube_is_a_distance() {
    let cone = [[end(0.0, 2.0, 2.0), end(10.0, 4.0, 4.0)]];
    let points = [[5.0, 3.0, 4.0], [5.0, 0.0, 1.0], [-3.0, 0.0, 4.0], [13.0, 4.0, 0.0]];
    let levels = tube_levels(&cone, &points, -24.0);
    for (level, expected) in levels.iter().zip([-2.0, 2.0, -3.0, -1.0]) {
        assert!((level - expected).abs() < 1e-12, "{level} {expected}");
    }
}

#[test]
fn a_flat_tube_ends_at_its_half_axes_and_the_best_segment_counts() {
    let strap =
        [[end(0.0, 1.0, 5.0), end(10.0, 1.0, 5.0)], [end(10.0, 1.0, 5.0), end(20.0, 3.0, 5.0)]];
    let points =
        [[5.0, 0.0, 1.0], [5.0, 5.0, 0.0], [20.0, 0.0, 3.0], [5.0, 0.0, 0.0], [5.0, 0.0, 900.0]];
    let levels = tube_levels(&strap, &points, -24.0);
    for (level, expected) in levels.iter().zip([0.0, 0.0, 0.0, 1.0, -24.0]) {
        assert!((level - expected).abs() < 1e-12, "{level} {expected}");
    }
}

#[test]
fn levels_do_not_depend_on_which_points_are_asked_together() {
    let strap = [[end(0.0, 1.0, 5.0), end(10.0, 2.0, 6.0)]];
    let points: Vec<[f64; 3]> =
        (0..1000).map(|i| [0.02 * f64::from(i) - 4.0, 0.3, 0.007 * f64::from(i)]).collect();
    let all = tube_levels(&strap, &points, -24.0);
    for (point, level) in points.iter().zip(all) {
        assert_eq!(tube_levels(&strap, &[*point], -24.0), [level]);
    }
}
