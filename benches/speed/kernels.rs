//! Each kernel beside the time that its bytes alone would take, as a markdown table on stdout.
//!
//! `MTM_BENCH_SIZES=80000,300000 cargo bench -p mtm-benches --bench kernels`
//!
//! Bytes are counted from the data structures: each array once for every pass over it, as if nothing
//! stayed in cache between passes and nothing was fetched twice within one. The bandwidth is measured in
//! the same run, with arrays larger than the caches. Times are medians. A ratio below one means that the
//! caches hold part of the data from one call to the next; a factor does arithmetic, not traffic. Parts of the
//! multigrid's set-up that compute also show how many operations they do per second.

#![allow(missing_docs)]

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

#[path = "../scenes/scene.rs"]
mod scene;
#[path = "../scenes/shell.rs"]
mod shell;

use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use mtm_core::{
    BlockMatrix, CyclePrecision, MassTensors, Multigrid, MultigridOptions, Preconditioner,
    Symbolic, tet_tensor,
};
use rayon::prelude::*;
use shell::Shell;

/// Doubles in each of the three arrays of the triad: 3 × 256 MB, beyond any cache.
const TRIAD_LENGTH: usize = 32 << 20;
/// Doubles a thread is handed at once.
const TRIAD_CHUNK: usize = 1 << 16;
/// Calls of which the median counts.
const REPEATS: usize = 7;
/// Bytes above which a factor is left to machines with more memory.
const LARGEST_FACTOR: usize = 6 << 30;

/// One line of the table.
struct Line {
    kernel: String,
    bytes: usize,
    seconds: f64,
}

impl Line {
    fn of(kernel: &str, bytes: usize, seconds: f64) -> Self {
        Self { kernel: kernel.to_owned(), bytes, seconds }
    }
}

fn main() {
    let all = rayon::current_num_threads();
    println!(
        "| tets | threads | bandwidth GB/s | kernel | MB moved | bound ms | time ms | ratio |"
    );
    println!("|---:|---:|---:|---|---:|---:|---:|---:|");
    for threads in if all == 1 { vec![1] } else { vec![1, all] } {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        let bandwidth = pool.install(stream_bandwidth);
        for n_tets in scene::sizes() {
            for line in pool.install(|| kernels(n_tets)) {
                let bound = line.bytes as f64 / bandwidth;
                println!(
                    "| {n_tets} | {threads} | {:.1} | {} | {:.1} | {:.3} | {:.3} | {:.1} |",
                    1e-9 * bandwidth,
                    line.kernel,
                    1e-6 * line.bytes as f64,
                    1e3 * bound,
                    1e3 * line.seconds,
                    line.seconds / bound
                );
            }
        }
    }
}

/// Bytes per second of a = b + s c, the write counted once.
fn stream_bandwidth() -> f64 {
    let (b, c) = (vec![1.5_f64; TRIAD_LENGTH], vec![0.5_f64; TRIAD_LENGTH]);
    let mut a = vec![0.0_f64; TRIAD_LENGTH];
    let seconds = median(|| {
        let s = black_box(3.0);
        a.par_chunks_mut(TRIAD_CHUNK)
            .zip(b.par_chunks(TRIAD_CHUNK).zip(c.par_chunks(TRIAD_CHUNK)))
            .for_each(|(a, (b, c))| {
                for ((a, b), c) in a.iter_mut().zip(b).zip(c) {
                    *a = b + s * c;
                }
            });
        black_box(&a);
    });
    (3 * 8 * TRIAD_LENGTH) as f64 / seconds
}

/// Median seconds of a call, after one that does not count.
fn median(mut call: impl FnMut()) -> f64 {
    call();
    let mut seconds: Vec<f64> = (0..REPEATS)
        .map(|_| {
            let begin = Instant::now();
            call();
            begin.elapsed().as_secs_f64()
        })
        .collect();
    middle(&mut seconds)
}

fn middle(seconds: &mut [f64]) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}

fn matrix_bytes(a: &BlockMatrix) -> usize {
    a.row_start.len() * 8 + a.columns.len() * (4 + 72)
}

fn kernels(n_tets: usize) -> Vec<Line> {
    let shell = Shell::generate(n_tets);
    let (mesh, tissue) = (scene::mesh(&shell), scene::tissue(&shell));
    let made = || MassTensors::new(mesh.clone(), tissue.clone()).expect("matching tissue");
    let tensors = made();
    let (matrix, unknowns) = scene::reduced(&tensors, &scene::boundary(&shell, false));
    let n = unknowns.len();
    let positions: Vec<[f64; 3]> = unknowns.iter().map(|&j| shell.nodes[j as usize]).collect();
    let smooth: Vec<[f64; 3]> =
        positions.iter().map(|x| [0, 1, 2].map(|i| (0.03 * x[i]).sin())).collect();
    let mut product = vec![[0.0; 3]; n];
    let mut lines = Vec::new();
    let mut line = |kernel: &str, bytes, seconds| lines.push(Line::of(kernel, bytes, seconds));

    // Corners, gradients from positions, material and fibre in; nothing but a sum out.
    let element_bytes = mesh.n_tets() * (16 + 6 * 8) + mesh.n_nodes() * 24;
    let elements = median(|| {
        let sum: f64 = (0..mesh.n_tets())
            .into_par_iter()
            .with_min_len(1024)
            .map(|t| {
                let (geometry, material) = (mesh.geometry(t), tissue.of_tet(t));
                let pairs = (0..4).flat_map(|j| (j..4).map(move |k| (j, k)));
                pairs.map(|(j, k)| tet_tensor(&geometry, &material, j, k)[0]).sum::<f64>()
            })
            .sum();
        black_box(sum);
    });
    line("element tensors (10 a tet)", element_bytes, elements);
    let assembled = element_bytes + 2 * matrix_bytes(tensors.matrix());
    line("assembly, pattern included", assembled, median(|| drop(black_box(made()))));

    let traffic = matrix_bytes(&matrix) + 2 * 24 * n;
    let seconds = median(|| matrix.multiply_into(black_box(&smooth), &mut product));
    line("block product", traffic, seconds);

    let right = product.clone();
    let mut cycle = |degree: usize, precision: CyclePrecision| {
        let options =
            MultigridOptions { smoother_degree: degree, precision, ..MultigridOptions::default() };
        let multigrid = Multigrid::new(&matrix, &positions, &[], &options).expect("a held body");
        let seconds = median(|| multigrid.apply(black_box(&right), &mut product));
        (multigrid.traffic_bytes(), seconds)
    };
    let degree = MultigridOptions::default().smoother_degree;
    for (name, precision) in
        [("double", CyclePrecision::Double), ("single", CyclePrecision::Single)]
    {
        let (bytes, seconds) = cycle(degree, precision);
        let (more_bytes, more_seconds) = cycle(degree + 1, precision);
        let sweep = (0.5 * (more_seconds - seconds)).max(0.0);
        let kernel = format!("smoother sweep, all levels, {name} precision");
        line(&kernel, (more_bytes - bytes) / 2, sweep);
        line(&format!("multigrid cycle, {name} precision"), bytes, seconds);
    }

    let symbolic = Arc::new(Symbolic::new(&matrix, &[]).expect("an elimination order"));
    if symbolic.factor_bytes() <= LARGEST_FACTOR {
        let factored = || symbolic.factor(&matrix).expect("a held body");
        let bytes = symbolic.factor_bytes();
        let begin = Instant::now();
        let factor = factored();
        line("factor", matrix_bytes(&matrix) + bytes, begin.elapsed().as_secs_f64());
        let seconds = median(|| drop(black_box(factor.solve(&right))));
        line("back-substitution", 2 * bytes + 4 * 24 * n, seconds);
    }
    lines
}
