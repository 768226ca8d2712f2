//! Arithmetic of vectors in space: `[f64; 3]`, and nalgebra's type where a formula is more readable with it.

use nalgebra::Vector3;
use rayon::prelude::*;

/// Points per parallel task: enough to hide the cost of the hand-over.
const POINTS_PER_TASK: usize = 64;

/// `f` of each point, in their order; parallel.
pub(crate) fn of_each<T: Send>(points: &[[f64; 3]], f: impl Fn([f64; 3]) -> T + Sync) -> Vec<T> {
    points.par_iter().with_min_len(POINTS_PER_TASK).map(|&point| f(point)).collect()
}

/// The distinct ones of `values`, ascending.
pub(crate) fn distinct<T: Ord>(values: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut found: Vec<T> = values.into_iter().collect();
    found.sort_unstable();
    found.dedup();
    found
}

/// A point or direction, mm or dimensionless.
pub type Vec3 = Vector3<f64>;

pub(crate) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn add(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn scaled(a: [f64; 3], s: f64) -> [f64; 3] {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// a + share (b − a) row by row, and exactly `b` for a share of one.
pub(crate) fn between(a: &[[f64; 3]], b: &[[f64; 3]], share: f64) -> Vec<[f64; 3]> {
    if share == 1.0 {
        return b.to_vec();
    }
    a.iter().zip(b).map(|(a, b)| towards(*a, *b, share)).collect()
}

/// The point at `share` of the way from `a` to `b`.
pub(crate) fn towards(a: [f64; 3], b: [f64; 3], share: f64) -> [f64; 3] {
    add(a, scaled(sub(b, a), share))
}

pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn norm(a: [f64; 3]) -> f64 {
    dot(a, a).sqrt()
}
