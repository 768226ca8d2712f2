//! Time from muscles' surfaces to fractions and fibres of tets: sampling alone, and a whole head.
//!
//! `cargo bench -p mtm-benches --bench equivalent`

#![allow(missing_docs)] // criterion's macros make public items without any

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use criterion::{Criterion, criterion_group, criterion_main};
use mtm_core::{
    InsideTest, Mixing, Muscle, MuscleFibres, OrientedBox, Preset, SamplingOptions, Surface,
    TetMesh, WindingTree, sample_muscles,
};

/// Cubes along the axes of the block of tets, of edge 3 mm: 300 000 tets.
const CUBES: [usize; 3] = [40, 25, 50];
const EDGE: f64 = 3.0;
/// Points round and along a muscle: 50 000 triangles.
const AROUND: usize = 125;
const ALONG: usize = 200;
const MUSCLES: usize = 20;

/// The block cut into Kuhn's tets.
fn block() -> TetMesh {
    let [nx, ny, nz] = CUBES;
    let id = |i: usize, j: usize, k: usize| ((i * (ny + 1) + j) * (nz + 1) + k) as u32;
    let mut nodes = Vec::new();
    for i in 0..=nx {
        for j in 0..=ny {
            nodes.extend((0..=nz).map(|k| [i, j, k].map(|n| n as f64 * EDGE)));
        }
    }
    let paths = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [1, 0, 2], [0, 2, 1], [2, 1, 0]];
    let mut tets = Vec::new();
    for i in 0..nx {
        for j in 0..ny {
            for k in 0..nz {
                for (p, path) in paths.iter().enumerate() {
                    let mut at = [i, j, k];
                    let mut tet = [id(i, j, k); 4];
                    for (corner, &axis) in path.iter().enumerate() {
                        at[axis] += 1;
                        tet[corner + 1] = id(at[0], at[1], at[2]);
                    }
                    if p >= 3 {
                        tet.swap(1, 2);
                    }
                    tets.push(tet);
                }
            }
        }
    }
    TetMesh::new(nodes, tets).expect("a mesh")
}

/// A wavy ellipsoid of 50 000 triangles.
fn ellipsoid(centre: [f64; 3], radii: [f64; 3]) -> Muscle {
    let turn = std::f64::consts::PI;
    let mut vertices = vec![[centre[0], centre[1], centre[2] - radii[2]]];
    for a in 1..=ALONG {
        let theta = turn * a as f64 / (ALONG + 1) as f64;
        for b in 0..AROUND {
            let phi = 2.0 * turn * b as f64 / AROUND as f64;
            let r = theta.sin() * (1.0 + 0.05 * (5.0 * phi + 7.0 * theta).sin());
            let direction = [r * phi.cos(), r * phi.sin(), -theta.cos()];
            vertices.push([0, 1, 2].map(|i| centre[i] + radii[i] * direction[i]));
        }
    }
    let top = vertices.len() as u32;
    vertices.push([centre[0], centre[1], centre[2] + radii[2]]);
    let id = |a: usize, b: usize| (1 + a * AROUND + b % AROUND) as u32;
    let mut triangles = Vec::new();
    for b in 0..AROUND {
        triangles.push([0, id(0, b + 1), id(0, b)]);
        triangles.push([top, id(ALONG - 1, b), id(ALONG - 1, b + 1)]);
        for a in 0..ALONG - 1 {
            triangles.push([id(a, b), id(a, b + 1), id(a + 1, b + 1)]);
            triangles.push([id(a, b), id(a + 1, b + 1), id(a + 1, b)]);
        }
    }
    let axes = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let half_extents = [radii[2], radii[0], radii[1]];
    let fibres = MuscleFibres::from_boxes(vec![OrientedBox { centre, axes, half_extents }]);
    Muscle {
        surface: Arc::new(Surface::new(vertices, triangles).expect("a surface")),
        fibres: Arc::new(fibres.expect("fibres")),
    }
}

/// Twenty muscles, some of which overlap, about as large as those of a face.
fn muscles() -> Vec<Muscle> {
    let place = |i: usize| {
        let [a, b] = [i % 5, i / 5].map(|n| n as f64);
        [14.0 + 23.0 * a, 14.0 + 15.5 * b, 40.0 + 17.5 * ((i * 7) % 5) as f64]
    };
    (0..MUSCLES).map(|i| ellipsoid(place(i), [8.5, 7.0, 35.0])).collect()
}

fn equivalent(c: &mut Criterion) {
    let (mesh, muscles) = (block(), muscles());
    let mut group = c.benchmark_group("equivalent");
    group.sample_size(10);
    for (inside, name) in [(InsideTest::Winding, "winding"), (InsideTest::Normal, "normal")] {
        let options = SamplingOptions { inside, ..Default::default() };
        let start = Instant::now();
        let made = sample_muscles(&mesh, &muscles, &options, &|| false).expect("a mixture");
        let total = start.elapsed().as_secs_f64();
        println!(
            "{name}: {} tets, {} muscles of {} triangles: {:?} {:?} total {total:.3} s, {:.3e} points/s \
             sampling, {:.3e} points/s in all",
            mesh.n_tets(),
            muscles.len(),
            muscles[0].surface.triangles().len(),
            made.counts,
            made.timings,
            made.counts.points as f64 / made.timings.sampling,
            made.counts.points as f64 / total,
        );
        group.bench_function(format!("300k tets, 20 muscles, {name}"), |b| {
            b.iter(|| black_box(sample_muscles(&mesh, &muscles, &options, &|| false)));
        });
        let preset = Preset::from_name("kim2010").expect("a preset");
        for (mixing, rule) in [(Mixing::Moduli, "moduli"), (Mixing::Stiffness, "stiffness")] {
            if inside == InsideTest::Winding {
                group.bench_function(format!("tissue, {rule}"), |b| {
                    b.iter(|| black_box(made.tissue(preset, mixing)));
                });
            }
        }
    }
    let tree = WindingTree::new(&muscles[0].surface);
    let points: Vec<[f64; 3]> =
        (0..20_000).map(|i| [i % 29, i / 29 % 27, i / 783].map(|n| f64::from(n) + 0.37)).collect();
    group.bench_function("20k single winding numbers", |b| {
        b.iter(|| black_box(tree.winding_number(&points)));
    });
    group.finish();
}

criterion_group!(benches, equivalent);
criterion_main!(benches);
