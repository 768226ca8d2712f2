//! Time from labels, levels and surfaces to tets: the stages of meshing one by one.
//!
//! `cargo bench -p mtm-benches --bench stuffing`

#![allow(missing_docs)] // criterion's macros make public items without any

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use mtm_core::{
    Grid, Halvings, LevelImage, StuffingOptions, Surface, signed_distance, squared_distance, stuff,
};

/// The image of the claim: 200 × 130 × 180 voxels of 1 mm.
const SHAPE: [usize; 3] = [200, 130, 180];
/// Radii of the outside of a shell of tissue in it, mm, and its thickness: 600 cm³.
const RADII: [f64; 3] = [95.0, 60.0, 85.0];
const THICKNESS: f64 = 8.5;

fn labels() -> (Grid, Vec<bool>) {
    let grid = Grid::new(SHAPE, [1.0; 3], [0.0; 3]).expect("a grid");
    let centre = SHAPE.map(|n| 0.5 * (n as f64 - 1.0));
    let inside = |x: [f64; 3], less: f64| {
        (0..3).map(|a| ((x[a] - centre[a]) / (RADII[a] - less)).powi(2)).sum::<f64>() < 1.0
    };
    let tissue = |i| inside(grid.centre(i), 0.0) && !inside(grid.centre(i), THICKNESS);
    let values = (0..grid.len()).map(tissue).collect();
    (grid, values)
}

fn meshing(c: &mut Criterion) {
    let (grid, inside) = labels();
    let level = LevelImage::from_labels(grid, &inside).expect("a level");
    let mut group = c.benchmark_group("stuffing");
    group.sample_size(10);
    for refinements in [0, 1] {
        let options = StuffingOptions { edge_length: 3.0, refinements, least_body: 0.0 };
        let made = stuff(&level, &options, &Halvings::default()).expect("a mesh").mesh;
        println!("refinements {refinements}: {} tets", made.n_tets());
        group.bench_function(format!("labels to tets, {refinements} refinements"), |b| {
            b.iter(|| {
                let level = LevelImage::from_labels(grid, &inside).expect("a level");
                black_box(stuff(&level, &options, &Halvings::default()).expect("a mesh"))
            });
        });
    }
    group.bench_function("distance transform", |b| {
        b.iter(|| black_box(squared_distance(&grid, f32::INFINITY, |i| !inside[i])));
    });
    let mesh = stuff(
        &level,
        &StuffingOptions { refinements: 0, ..Default::default() },
        &Halvings::default(),
    )
    .expect("a mesh")
    .mesh;
    let surface = Surface::new(mesh.nodes().to_vec(), mesh.boundary_triangles().to_vec());
    let surface = surface.expect("a surface");
    println!("surface: {} triangles", surface.triangles().len());
    group.bench_function("signed distance of a surface", |b| {
        b.iter(|| black_box(signed_distance(&surface, grid, 2.0).expect("a level")));
    });
    group.finish();
}

criterion_group!(benches, meshing);
criterion_main!(benches);
