//! Points per second through a thin-plate spline of 32 landmarks, and of closest-point iterations.
//!
//! `cargo bench -p mtm-benches --bench registration`

#![allow(missing_docs)] // criterion's macros make public items without any

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use mtm_core::{Fixed, IcpOptions, PointTree, Surface, ThinPlateSpline, icp};

const POINTS: usize = 100_000;
const LANDMARKS: usize = 32;

/// The i-th of low-discrepancy points in a cube of 200 mm (Roberts' R3 sequence).
fn point(i: usize) -> [f64; 3] {
    const STEP: [f64; 3] = [0.819_172_513_4, 0.671_043_606_7, 0.549_700_477_9];
    STEP.map(|step| 200.0 * ((0.5 + step * i as f64).fract() - 0.5))
}

fn spline(c: &mut Criterion) {
    let source: Vec<[f64; 3]> = (0..LANDMARKS).map(point).collect();
    let target: Vec<[f64; 3]> =
        source.iter().map(|p| p.map(|x| 1.1 * x + 5.0 * (0.03 * x).sin())).collect();
    let points: Vec<[f64; 3]> = (LANDMARKS..LANDMARKS + POINTS).map(point).collect();
    let warp = ThinPlateSpline::new(source.clone(), target.clone(), 0.0).expect("a spline");
    let mut group = c.benchmark_group("thin plate");
    group.bench_function("solve 32 landmarks", |b| {
        b.iter(|| black_box(ThinPlateSpline::new(source.clone(), target.clone(), 0.0)));
    });
    group.throughput(Throughput::Elements(POINTS as u64));
    group.bench_function("warp", |b| b.iter(|| black_box(warp.warp(&points))));
    group.bench_function("folds", |b| b.iter(|| black_box(warp.folds(&points))));
    group.finish();
}

/// A bumpy sphere-like grid surface of about 20 000 triangles, radius 80 mm.
fn bone() -> Surface {
    let (rows, columns) = (100_u32, 100_u32);
    let at = |i: u32, k: u32| {
        let (u, v) = (f64::from(i) / f64::from(rows), f64::from(k) / f64::from(columns));
        let (theta, phi) = (0.3 + 2.5 * u, 3.0 * v);
        let r = 80.0 + 6.0 * (3.0 * theta).sin() * (4.0 * phi).cos();
        [r * theta.sin() * phi.cos(), r * theta.sin() * phi.sin(), r * theta.cos()]
    };
    let index = |i: u32, k: u32| i * (columns + 1) + k;
    let vertices = (0..=rows).flat_map(|i| (0..=columns).map(move |k| at(i, k))).collect();
    let square = |i: u32, k: u32| {
        let [a, b, c, d] = [index(i, k), index(i + 1, k), index(i + 1, k + 1), index(i, k + 1)];
        [[a, b, c], [a, c, d]]
    };
    let triangles = (0..rows).flat_map(|i| (0..columns).flat_map(move |k| square(i, k))).collect();
    Surface::new(vertices, triangles).expect("a surface")
}

fn closest(c: &mut Criterion) {
    let fixed = bone();
    let (sine, cosine) = 0.05_f64.sin_cos();
    let moving: Vec<[f64; 3]> = fixed
        .vertices()
        .iter()
        .map(|[x, y, z]| [cosine * x - sine * y + 2.0, sine * x + cosine * y, z - 1.0])
        .collect();
    let tree = PointTree::new(fixed.vertices()).expect("a tree");
    let mut group = c.benchmark_group("icp, 10 steps");
    group.sample_size(10);
    let options = IcpOptions { max_iterations: 10, tolerance: 0.0, ..IcpOptions::default() };
    for (name, target) in [("surface", Fixed::Surface(&fixed)), ("points", Fixed::Points(&tree))] {
        group.bench_function(name, |b| {
            b.iter(|| black_box(icp(&moving, None, target, &options, &|| false)));
        });
    }
    group.finish();
}

criterion_group!(benches, spline, closest);
criterion_main!(benches);
