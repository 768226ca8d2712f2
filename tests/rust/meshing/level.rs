//! Volumes of level images.

use mtm_core::{Grid, LevelImage};

/// Every voxel evaluated with eight sub-samples, and counted fully only if all 27 signs agree.
#[test]
fn volume_counts_surrounded_voxels_whole_and_the_others_by_eighths() {
    let grid = Grid::new([13, 11, 17], [1.0, 1.2, 0.8], [-3.0, 2.0, 1.0]).expect("a grid");
    let [nx, ny, nz] = grid.shape.map(|n| n as isize);
    let value = |i: usize| ((i * 7919 % 1013) as f32 / 300.0 - 1.0) + (i % 17) as f32 * 0.1;
    let near = |x: [f64; 3]| (x[0] - 3.0).hypot(x[1] - 8.0).hypot(x[2] - 8.0);
    let ball = |i: usize| (4.3 - near(grid.centre(i))) as f32;
    let noise: Vec<f32> = (0..grid.len()).map(value).collect();
    let smooth: Vec<f32> = (0..grid.len()).map(ball).collect();
    for values in [noise, smooth] {
        let level = LevelImage::new(grid, values).expect("finite");
        let is_inside =
            |at: [isize; 3]| level.values()[((at[0] * ny + at[1]) * nz + at[2]) as usize] > 0.0;
        let eighths_inside = |index: usize| {
            let sides = (0..8).map(|corner| [0, 1, 2].map(|a| f64::from(corner >> a & 1) - 0.5));
            let centre = grid.centre(index);
            let at = |s: [f64; 3]| [0, 1, 2].map(|a| centre[a] + 0.5 * s[a] * grid.spacing[a]);
            sides.filter(|&s| level.value(at(s)) > 0.0).count()
        };
        let mut eighths = 0;
        for i in 0..nx {
            for j in 0..ny {
                for k in 0..nz {
                    let border =
                        [(i, nx), (j, ny), (k, nz)].iter().any(|&(a, n)| a == 0 || a + 1 == n);
                    let here = is_inside([i, j, k]);
                    let same = !border
                        && (0..27).all(|d| {
                            is_inside([i + d / 9 - 1, j + d / 3 % 3 - 1, k + d % 3 - 1]) == here
                        });
                    let index = ((i * ny + j) * nz + k) as usize;
                    let whole = if here { 8 } else { 0 };
                    eighths += if same { whole } else { eighths_inside(index) };
                }
            }
        }
        let voxel: f64 = grid.spacing.iter().product();
        assert_eq!(level.volume(), eighths as f64 / 8.0 * voxel);
    }
}
