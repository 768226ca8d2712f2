//! Conjugate gradients and multigrid against dense factors.

use std::sync::atomic::{AtomicUsize, Ordering};

use mtm_core::{
    BlockMatrix, CyclePrecision, MtmError, Multigrid, MultigridOptions, PcgOptions, PcgOutcome,
    Preconditioner, Result, pcg,
};
use nalgebra::{Matrix3, Vector3};

use super::elastic_box::{
    BoxCase, System, block_matrix, dense_solution, elastic_box, largest_difference, scattered,
};

fn dot(x: &[[f64; 3]], y: &[[f64; 3]]) -> f64 {
    x.as_flattened().iter().zip(y.as_flattened()).map(|(x, y)| x * y).sum()
}

/// The inverse diagonal blocks as a preconditioner; the identity in place of an indefinite one.
struct BlockJacobi(Vec<Matrix3<f64>>);

impl BlockJacobi {
    fn new(a: &BlockMatrix) -> Self {
        let block = |j: usize| Matrix3::from_row_slice(a.diagonal_block(j));
        let inverse = |j: usize| block(j).cholesky().map_or(Matrix3::identity(), |c| c.inverse());
        Self((0..a.n_rows()).map(inverse).collect())
    }
}

impl Preconditioner for BlockJacobi {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        for ((z, r), inverse) in z.iter_mut().zip(r).zip(&self.0) {
            *z = (inverse * Vector3::from(*r)).into();
        }
    }
}

fn solve_by_jacobi(s: &System, options: &PcgOptions) -> Result<PcgOutcome> {
    let x0 = vec![[0.0; 3]; s.b.len()];
    pcg(&s.a, &s.b, &x0, &BlockJacobi::new(&s.a), options, &|| false)
}

#[test]
fn block_jacobi_reaches_the_dense_solution_within_its_bound() {
    for (contrast, nu) in [(1.0, 0.3), (263.0, 0.46), (1e6, 0.46), (263.0, 0.499)] {
        let s = elastic_box(BoxCase { contrast, nu, ..BoxCase::default() });
        let exact = dense_solution(&s.a, &s.b);
        let size = largest_difference(&exact, &vec![[0.0; 3]; exact.len()]);
        let out = solve_by_jacobi(&s, &PcgOptions { tolerance: 1e-7 * size, ..Default::default() })
            .unwrap();
        let error = largest_difference(&out.solution, &exact);
        assert!(out.error_estimate_mm <= 1e-6 * size);
        assert!(
            error <= out.error_estimate_mm + 1e-13 * contrast * size,
            "{contrast} {nu} {error:e}"
        );
    }
}

#[test]
fn energy_bound_holds() {
    let s = elastic_box(BoxCase { contrast: 1e4, ..BoxCase::default() });
    let exact = dense_solution(&s.a, &s.b);
    for tolerance in [1e-1, 1e-2, 1e-3, 1e-4] {
        let options =
            PcgOptions { tolerance: 1e9, energy_tolerance: tolerance, ..Default::default() };
        let out = solve_by_jacobi(&s, &options).unwrap();
        let e: Vec<[f64; 3]> = out
            .solution
            .iter()
            .zip(&exact)
            .map(|(x, y)| [x[0] - y[0], x[1] - y[1], x[2] - y[2]])
            .collect();
        let error = (dot(&e, &s.a.multiply(&e)) / dot(&s.b, &exact)).sqrt();
        assert!(error <= out.energy_error, "{error:e} > {:e}", out.energy_error);
        assert!(out.energy_error <= tolerance);
    }
}

#[test]
fn a_start_near_the_solution_saves_iterations() {
    let s = elastic_box(BoxCase { contrast: 10.0, ..BoxCase::default() });
    let exact = dense_solution(&s.a, &s.b);
    let jacobi = BlockJacobi::new(&s.a);
    let options = PcgOptions { tolerance: 1e-6, ..Default::default() };
    let out = pcg(&s.a, &s.b, &exact, &jacobi, &options, &|| false).unwrap();
    let cold = solve_by_jacobi(&s, &options).unwrap();
    assert!(out.iterations < cold.iterations, "{} {}", out.iterations, cold.iterations);
    assert!(largest_difference(&out.solution, &exact) <= 1e-6);
}

#[test]
fn nothing_to_solve_gives_zero() {
    let s = elastic_box(BoxCase::default());
    let zero = vec![[0.0; 3]; s.b.len()];
    let jacobi = BlockJacobi::new(&s.a);
    let out = pcg(&s.a, &zero, &s.b, &jacobi, &PcgOptions::default(), &|| false).unwrap();
    assert_eq!(out.solution, zero);
}

#[test]
fn unreachable_tolerance_is_an_error_and_never_nan() {
    let s = elastic_box(BoxCase::default());
    let options = PcgOptions { tolerance: 1e-40, ..Default::default() };
    assert!(matches!(solve_by_jacobi(&s, &options), Err(MtmError::NotConverged { .. })));
    let few = PcgOptions { max_iterations: 3, tolerance: 1e-12, ..Default::default() };
    assert!(matches!(solve_by_jacobi(&s, &few), Err(MtmError::NotConverged { .. })));
}

#[test]
fn indefinite_matrix_is_refused() {
    let mut s = elastic_box(BoxCase::default());
    let position = s.a.diagonal[10];
    s.a.blocks[position][0] = 1e-9;
    s.a.blocks[position][4] = 1e-9;
    s.a.blocks[position][8] = 1e-9;
    let outcome = solve_by_jacobi(&s, &PcgOptions::default());
    assert!(matches!(outcome, Err(MtmError::NotPositiveDefinite { .. })), "{outcome:?}");
}

#[test]
fn mechanism_never_gives_nan() {
    // Two blocks tied to one another and to nothing else, pulled apart and along.
    let k = Matrix3::identity();
    let a = block_matrix(&[
        [(0, k), (1, -k)].into_iter().collect(),
        [(0, -k), (1, k)].into_iter().collect(),
    ]);
    let b = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
    let jacobi = BlockJacobi::new(&a);
    let out = pcg(&a, &b, &[[0.0; 3]; 2], &jacobi, &PcgOptions::default(), &|| false);
    assert!(out.is_err(), "{out:?}");
}

#[test]
fn caller_can_stop_it() {
    let s = elastic_box(BoxCase::default());
    let calls = AtomicUsize::new(0);
    let stop = || calls.fetch_add(1, Ordering::Relaxed) >= 4;
    let x0 = vec![[0.0; 3]; s.b.len()];
    let jacobi = BlockJacobi::new(&s.a);
    let out = pcg(&s.a, &s.b, &x0, &jacobi, &PcgOptions::default(), &stop);
    assert_eq!(out, Err(MtmError::Interrupted));
}

/// Small enough that even the test boxes get three levels.
fn deep(precision: CyclePrecision) -> MultigridOptions {
    MultigridOptions { coarsest_rows: 6, precision, ..MultigridOptions::default() }
}

fn solve_by_multigrid(s: &System, relative: f64) -> PcgOutcome {
    solve_in(CyclePrecision::Double, s, relative)
}

fn solve_in(precision: CyclePrecision, s: &System, relative: f64) -> PcgOutcome {
    let mg = Multigrid::new(&s.a, &s.nodes, &s.normals, &deep(precision)).unwrap();
    let size = largest_difference(&dense_solution(&s.a, &s.b), &vec![[0.0; 3]; s.b.len()]);
    let options = PcgOptions { tolerance: relative * size, ..PcgOptions::default() };
    pcg(&s.a, &s.b, &vec![[0.0; 3]; s.b.len()], &mg, &options, &|| false).unwrap()
}

#[test]
fn true_error_stays_below_the_bound_at_every_contrast() {
    for contrast in [1.0, 263.0, 1e4, 1e6, 1e8] {
        for (nu, sliding) in [(0.3, false), (0.46, true), (0.499, false)] {
            let s = elastic_box(BoxCase { contrast, nu, sliding, ..BoxCase::default() });
            let exact = dense_solution(&s.a, &s.b);
            let size = largest_difference(&exact, &vec![[0.0; 3]; exact.len()]);
            let out = solve_by_multigrid(&s, 1e-6);
            let error = largest_difference(&out.solution, &exact);
            // What double precision leaves of a stiff part afloat in a soft one.
            let round_off = 1e-14 * contrast * size;
            assert!(error <= out.error_estimate_mm + round_off, "{contrast} {nu}: {error:e}");
            assert!(out.error_estimate_mm <= PcgOptions::default().slack * 1e-6 * size);
            // Linear tets lock towards nu = 0.5, and slow the cycle as they do.
            let most = if nu > 0.49 { 250 } else { 60 };
            assert!(out.iterations < most, "{contrast} {nu}: {} iterations", out.iterations);
            if contrast <= 1e4 && nu < 0.49 {
                let single = solve_in(CyclePrecision::Single, &s, 1e-6);
                let error = largest_difference(&single.solution, &exact);
                assert!(error <= single.error_estimate_mm + round_off, "{contrast}: {error:e}");
                assert!(single.iterations <= out.iterations + 1, "{contrast} {nu}");
            }
        }
    }
}

#[test]
fn a_cycle_in_single_precision_takes_forces_in_any_unit() {
    let s = elastic_box(BoxCase { contrast: 263.0, ..BoxCase::default() });
    let mg = Multigrid::new(&s.a, &s.nodes, &s.normals, &deep(CyclePrecision::Single)).unwrap();
    let n = s.b.len();
    let r = scattered(n, 3);
    let mut plain = vec![[0.0; 3]; n];
    mg.apply(&r, &mut plain);
    // Powers of two scale every number exactly.
    for exponent in [-900, -100, 100, 900] {
        let factor = 2.0_f64.powi(exponent);
        let scaled: Vec<_> = r.iter().map(|row| row.map(|v| factor * v)).collect();
        let mut z = vec![[0.0; 3]; n];
        mg.apply(&scaled, &mut z);
        assert!(z.as_flattened().iter().zip(plain.as_flattened()).all(|(z, p)| *z == factor * p));
    }
    let mut z = vec![[1.0; 3]; n];
    mg.apply(&vec![[0.0; 3]; n], &mut z);
    assert!(z.as_flattened().iter().all(|v| *v == 0.0));
}

#[test]
fn cycle_is_symmetric_and_positive() {
    use CyclePrecision::{Double, Single};
    for (contrast, precision, rounding) in
        [(263.0, Double, 1e-12), (1e8, Double, 1e-12), (263.0, Single, 1e-5), (1e4, Single, 1e-5)]
    {
        let case = BoxCase { contrast, sliding: true, ..BoxCase::default() };
        let s = elastic_box(case);
        let mg = Multigrid::new(&s.a, &s.nodes, &s.normals, &deep(precision)).unwrap();
        assert!(mg.level_rows().len() >= 3, "{:?}", mg.level_rows());
        let n = s.b.len();
        let (mut mr, mut ms) = (vec![[0.0; 3]; n], vec![[0.0; 3]; n]);
        for seed in 0..4 {
            let (r, t) = (scattered(n, seed), scattered(n, seed + 10));
            mg.apply(&r, &mut mr);
            mg.apply(&t, &mut ms);
            let (left, right) = (dot(&mr, &t), dot(&r, &ms));
            let scale = (dot(&mr, &r) * dot(&ms, &t)).sqrt();
            assert!(dot(&mr, &r) > 0.0);
            assert!((left - right).abs() <= rounding * scale, "{left:e} {right:e}");
        }
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    let s = elastic_box(BoxCase { cells: [14, 14, 14], sliding: true, ..BoxCase::default() });
    let run = |threads: usize, precision: CyclePrecision| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mg = Multigrid::new(&s.a, &s.nodes, &s.normals, &deep(precision)).unwrap();
            let options = PcgOptions { tolerance: 1e-6, ..PcgOptions::default() };
            pcg(&s.a, &s.b, &vec![[0.0; 3]; s.b.len()], &mg, &options, &|| false).unwrap()
        })
    };
    for precision in [CyclePrecision::Double, CyclePrecision::Single] {
        let one = run(1, precision);
        assert_eq!(one, run(2, precision));
        assert_eq!(one, run(5, precision));
    }
}

#[test]
fn sliding_nodes_stay_on_their_plane() {
    let s = elastic_box(BoxCase { sliding: true, ..BoxCase::default() });
    let out = solve_by_multigrid(&s, 1e-8);
    for &(row, n) in &s.normals {
        let along: f64 = (0..3).map(|c| n[c] * out.solution[row][c]).sum();
        assert!(along.abs() < 1e-12, "{along:e}");
    }
}

#[test]
fn single_nodes_and_islands_are_solved() {
    let k = Matrix3::new(4.0, 1.0, 0.0, 1.0, 3.0, 0.5, 0.0, 0.5, 2.0);
    for n in [1_usize, 2, 500] {
        let rows: Vec<_> =
            (0..n).map(|i| [(i, k * (1.0 + i as f64))].into_iter().collect()).collect();
        let a = block_matrix(&rows);
        let nodes: Vec<_> = (0..n).map(|i| [i as f64, 0.0, 0.0]).collect();
        let b = scattered(n, 1);
        let mg = Multigrid::new(&a, &nodes, &[], &MultigridOptions::default()).unwrap();
        let options = PcgOptions { tolerance: 1e-12, ..PcgOptions::default() };
        let out = pcg(&a, &b, &vec![[0.0; 3]; n], &mg, &options, &|| false).unwrap();
        assert!(largest_difference(&out.solution, &dense_solution(&a, &b)) < 1e-12);
    }
    let s = elastic_box(BoxCase { cells: [4, 4, 4], islands: 3, ..BoxCase::default() });
    let out = solve_by_multigrid(&s, 1e-8);
    let exact = dense_solution(&s.a, &s.b);
    assert!(largest_difference(&out.solution, &exact) <= out.error_estimate_mm);
}

#[test]
fn flat_and_thin_bodies_are_solved() {
    for cells in [[1, 1, 1], [1, 1, 8], [7, 1, 1], [8, 8, 1]] {
        let s = elastic_box(BoxCase { cells, contrast: 1.0, ..BoxCase::default() });
        let out = solve_by_multigrid(&s, 1e-8);
        let exact = dense_solution(&s.a, &s.b);
        assert!(largest_difference(&out.solution, &exact) <= out.error_estimate_mm, "{cells:?}");
    }
}

#[test]
fn wrong_input_is_named() {
    let s = elastic_box(BoxCase::default());
    let options = MultigridOptions::default();
    let short = Multigrid::new(&s.a, &s.nodes[1..], &[], &options);
    assert!(matches!(short, Err(MtmError::Length { .. })));
    let past = Multigrid::new(&s.a, &s.nodes, &[(9999, [1.0, 0.0, 0.0])], &options);
    assert!(matches!(past, Err(MtmError::IndexOutOfRange { index: 9999, .. })));
    let mut a = s.a.clone();
    let position = a.diagonal[3];
    a.blocks[position] = [0.0; 9];
    let singular = Multigrid::new(&a, &s.nodes, &[], &options);
    assert!(matches!(singular, Err(MtmError::NotPositiveDefinite { node: 3, .. })));
}
