//! Distances on a grid, and thin parts of a shape.

use mtm_core::internals::thin_parts;
use mtm_core::{Grid, squared_distance};

#[test]
fn distances_equal_those_of_brute_force() {
    let grid = Grid::new([7, 5, 9], [1.0, 2.5, 0.7], [0.0; 3]).expect("a grid");
    let targets = [3_usize, 40, 200, 310];
    let fast = squared_distance(&grid, f32::INFINITY, |index| targets.contains(&index));
    for (index, &found) in fast.iter().enumerate() {
        let x = grid.centre(index);
        let exact = targets
            .iter()
            .map(|&t| {
                let y = grid.centre(t);
                (0..3).map(|a| (x[a] - y[a]).powi(2)).sum::<f64>()
            })
            .fold(f64::INFINITY, f64::min);
        assert!((f64::from(found) - exact).abs() <= 1e-5 * exact.max(1.0), "voxel {index}");
    }
    assert!(squared_distance(&grid, f32::INFINITY, |_| false).iter().all(|d| d.is_infinite()));
}

#[test]
fn distances_up_to_a_bound_are_the_same_bits_and_the_others_infinite() {
    let grid = Grid::new([21, 19, 40], [1.0, 1.3, 0.7], [0.0; 3]).expect("a grid");
    // Single voxels, a solid block and whole rows.
    let is_target = |index: usize| {
        let [i, j, k] = [index / 760, index / 40 % 19, index % 40];
        index % 1117 == 5 || (i < 4 && j < 5 && k < 9) || (i == 15 && j == 12)
    };
    let all = squared_distance(&grid, f32::INFINITY, is_target);
    for most in [0.0, 2.0, 9.0, 60.0] {
        let near = squared_distance(&grid, most, is_target);
        for (index, (&found, &whole)) in near.iter().zip(&all).enumerate() {
            let expected = if whole <= most { whole } else { f32::INFINITY };
            assert_eq!(found.to_bits(), expected.to_bits(), "voxel {index}, up to {most}");
        }
    }
    for (index, &found) in all.iter().enumerate().step_by(13) {
        let x = grid.centre(index);
        let exact = (0..grid.len())
            .filter(|&t| is_target(t))
            .map(|t| {
                let y = grid.centre(t);
                (0..3).map(|a| (x[a] - y[a]).powi(2)).sum::<f64>()
            })
            .fold(f64::INFINITY, f64::min);
        assert!((f64::from(found) - exact).abs() <= 1e-5 * exact.max(1.0), "voxel {index}");
    }
}

#[test]
fn a_sheet_is_thin_and_a_slab_is_not() {
    let grid = Grid::new([30, 30, 30], [1.0; 3], [0.0; 3]).expect("a grid");
    let i_of = |index: usize| index / 900;
    let inside = |index: usize| (5..8).contains(&i_of(index)) || i_of(index) >= 15;
    let squared = squared_distance(&grid, f32::INFINITY, |index| !inside(index));
    let thin = thin_parts(&grid, &squared, 3.0, 0.5);
    for (index, &found) in thin.iter().enumerate() {
        assert_eq!(found, (5..8).contains(&i_of(index)), "voxel {index}");
    }
}
