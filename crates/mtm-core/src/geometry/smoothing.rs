//! Smoothing of closed surfaces by the means of neighbours (Taubin 1995).

use rayon::prelude::*;

use crate::vector::{add, scaled, sub};

/// The vertices after steps towards the means of their neighbours, of so many times the way (away, where negative).
///
/// The surface is closed, so that each edge is passed both ways, and every vertex has a triangle. The caller has
/// checked the indices.
pub fn smoothed(mut points: Vec<[f64; 3]>, triangles: &[[u32; 3]], steps: &[f64]) -> Vec<[f64; 3]> {
    let mut edges: Vec<u64> = triangles
        .par_iter()
        .flat_map_iter(|&[a, b, c]| [(a, b), (b, c), (c, a)])
        .map(|(from, to)| u64::from(from) << 32 | u64::from(to))
        .collect();
    edges.par_sort_unstable();
    edges.dedup();
    let starts: Vec<usize> = (0..=points.len() as u64)
        .into_par_iter()
        .map(|vertex| edges.partition_point(|&edge| edge >> 32 < vertex))
        .collect();
    for &step in steps {
        points = (0..points.len())
            .into_par_iter()
            .map(|vertex| {
                let near = &edges[starts[vertex]..starts[vertex + 1]];
                let sum = near
                    .iter()
                    .fold([0.0; 3], |sum, &edge| add(sum, points[(edge & 0xffff_ffff) as usize]));
                let mean = sum.map(|x| x / near.len() as f64);
                add(points[vertex], scaled(sub(mean, points[vertex]), step))
            })
            .collect();
    }
    points
}
