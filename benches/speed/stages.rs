//! Time of each stage by itself, at the sizes of `MTM_BENCH_SIZES` (tets, comma-separated).
//!
//! `MTM_BENCH_SIZES=20000,80000,300000 cargo bench -p mtm-benches --bench stages`

#![allow(missing_docs)] // criterion's macros make public items without any

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

#[path = "../scenes/scene.rs"]
mod scene;
#[path = "../scenes/shell.rs"]
mod shell;

use std::hint::black_box;
use std::sync::Arc;
use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use mtm_core::{
    BlockMatrix, Element, Kinematics, MassTensors, Method, Multigrid, MultigridOptions, PcgOptions,
    StaticOptions, StaticSolver, Symbolic, TetMesh, pcg,
};
use shell::Shell;

/// Bytes above which a factor is left to machines with more memory.
const LARGEST_FACTOR: usize = 6 << 30;

/// Tets of the shell on which elements and kinematics are compared.
const CHOICE_TETS: usize = 5_000;

/// What the stages share at one size, made before any clock runs.
struct Prepared {
    shell: Shell,
    tensors: std::sync::Arc<MassTensors>,
    matrix: BlockMatrix,
    positions: Vec<[f64; 3]>,
    right: Vec<[f64; 3]>,
}

fn prepare(n_tets: usize) -> Prepared {
    let shell = Shell::generate(n_tets);
    let tensors =
        MassTensors::new(scene::mesh(&shell), scene::tissue(&shell)).expect("matching tissue");
    let (matrix, unknowns) = scene::reduced(&tensors, &scene::boundary(&shell, false));
    let positions: Vec<[f64; 3]> = unknowns.iter().map(|&j| shell.nodes[j as usize]).collect();
    // Forces of a smooth displacement: all of the spectrum below the mesh's own is in them.
    let smooth: Vec<[f64; 3]> =
        positions.iter().map(|x| [0, 1, 2].map(|i| (0.03 * x[i]).sin())).collect();
    let right = matrix.multiply(&smooth);
    Prepared { shell, tensors: tensors.into(), matrix, positions, right }
}

fn stages(c: &mut Criterion) {
    for n_tets in scene::sizes() {
        let prepared = prepare(n_tets);
        geometry(c, n_tets, &prepared);
        direct(c, n_tets, &prepared);
        iterative(c, n_tets, &prepared);
        plans(c, n_tets, &prepared);
    }
    choices(c);
}

/// Set-up and solve of each element and kinematics, at one size whatever the others are: quadratic
/// tets in large deformation would take minutes at those.
fn choices(c: &mut Criterion) {
    let shell = Shell::generate(CHOICE_TETS);
    let (mesh, tissue) = (scene::mesh(&shell), scene::tissue(&shell));
    let boundary = scene::boundary(&shell, false);
    let plan = scene::plan(&shell, 0);
    let mut group = c.benchmark_group("choices");
    for element in [Element::Linear, Element::NodalPressure, Element::Quadratic] {
        for kinematics in [Kinematics::Linear, Kinematics::Corotational, Kinematics::NEO_HOOKEAN] {
            let options = StaticOptions { kinematics, ..StaticOptions::default() };
            let set_up = || {
                let tensors = MassTensors::with_element(mesh.clone(), tissue.clone(), element)
                    .expect("matching tissue");
                StaticSolver::new(tensors.into(), boundary.clone(), options, &|| false)
                    .expect("a held body")
            };
            let id = |stage: &str| {
                let name = format!("{}_{}_{stage}", element.name(), kinematics.name());
                BenchmarkId::new(name, CHOICE_TETS)
            };
            group.bench_function(id("set_up"), |b| b.iter(|| black_box(set_up())));
            let solver = set_up();
            group.bench_function(id("solve"), |b| {
                b.iter(|| black_box(solver.solve(&plan, None, &|| false).expect("a sound plan")));
            });
        }
    }
    group.finish();
}

fn geometry(c: &mut Criterion, n_tets: usize, p: &Prepared) {
    let id = |stage: &str| BenchmarkId::new(stage, n_tets);
    let mut group = c.benchmark_group("arrays");
    group.throughput(Throughput::Elements(p.shell.tets.len() as u64));
    group.bench_function(id("mesh"), |b| {
        let arrays = || (p.shell.nodes.clone(), p.shell.tets.clone());
        b.iter_batched(arrays, |(x, t)| black_box(TetMesh::new(x, t)), BatchSize::LargeInput);
    });
    group.bench_function(id("tensors"), |b| {
        b.iter(|| {
            black_box(MassTensors::new(p.tensors.mesh().clone(), p.tensors.tissue().clone()))
        });
    });
    group.bench_function(id("internal_force"), |b| {
        b.iter(|| black_box(p.tensors.internal_force(&p.shell.nodes)));
    });
    group.finish();
}

fn direct(c: &mut Criterion, n_tets: usize, p: &Prepared) {
    let id = |stage: &str| BenchmarkId::new(stage, n_tets);
    let mut group = c.benchmark_group("cholesky");
    let symbolic = Arc::new(Symbolic::new(&p.matrix, &[]).expect("an elimination order"));
    group.bench_function(id("ordering"), |b| b.iter(|| black_box(Symbolic::new(&p.matrix, &[]))));
    if symbolic.factor_bytes() > LARGEST_FACTOR {
        eprintln!("{n_tets} tets: factor of {} MB left out", symbolic.factor_bytes() >> 20);
    } else {
        group.bench_function(id("factor"), |b| b.iter(|| black_box(symbolic.factor(&p.matrix))));
        let factor = symbolic.factor(&p.matrix).expect("a held body");
        group.bench_function(id("back_substitution"), |b| {
            b.iter(|| black_box(factor.solve(&p.right)));
        });
    }
    group.finish();
}

fn iterative(c: &mut Criterion, n_tets: usize, p: &Prepared) {
    let id = |stage: &str| BenchmarkId::new(stage, n_tets);
    let mut group = c.benchmark_group("pcg");
    let set_up = || {
        Multigrid::new(&p.matrix, &p.positions, &[], &MultigridOptions::default())
            .expect("a held body")
    };
    group.bench_function(id("set_up"), |b| b.iter(|| black_box(set_up())));
    let multigrid = set_up();
    let start = vec![[0.0; 3]; p.right.len()];
    let options = PcgOptions { tolerance: 1e-7, ..PcgOptions::default() };
    group.bench_function(id("solve"), |b| {
        b.iter(|| {
            let found = pcg(&p.matrix, &p.right, &start, &multigrid, &options, &|| false);
            black_box(found.expect("convergence"))
        });
    });
    group.finish();
}

fn plans(c: &mut Criterion, n_tets: usize, p: &Prepared) {
    let id = |stage: &str| BenchmarkId::new(stage, n_tets);
    let options = StaticOptions { method: Method::Cholesky, ..StaticOptions::default() };
    let options = StaticOptions { memory_limit: Some(LARGEST_FACTOR), ..options };
    let solver = |sliding: bool| {
        let boundary = scene::boundary(&p.shell, sliding);
        StaticSolver::new(p.tensors.clone(), boundary, options, &|| false)
    };
    let mut group = c.benchmark_group("plans");
    for (stage, sliding) in [("next", false), ("next_sliding", true)] {
        let Ok(solver) = solver(sliding) else {
            eprintln!("{n_tets} tets: {stage} left out, the factor is too large");
            continue;
        };
        let mut step = 0;
        group.bench_function(id(stage), |b| {
            b.iter(|| {
                step = (step + 1) % 10;
                let plan = scene::plan(&p.shell, step);
                black_box(solver.solve(&plan, None, &|| false).expect("a sound plan"))
            });
        });
        if sliding {
            continue;
        }
        let operator = solver
            .plan_operator(Some(p.shell.skin.clone()), None, &|| false)
            .expect("a sound operator");
        let plan = scene::plan(&p.shell, 3);
        let mut skin = vec![[0.0; 3]; p.shell.skin.len()];
        group.bench_function(id("operator_skin"), |b| {
            b.iter(|| operator.apply_into(black_box(&plan), black_box(&mut skin)));
        });
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default()
        .sample_size(10)
        .warm_up_time(Duration::from_millis(500))
        .measurement_time(Duration::from_secs(3));
    targets = stages
}
criterion_main!(benches);
