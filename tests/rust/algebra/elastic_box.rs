//! Small elastic systems, and their solutions by dense factors, for the tests of the iterative methods.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use mtm_core::BlockMatrix;

/// A reduced elastic system.
pub struct System {
    pub a: BlockMatrix,
    pub b: Vec<[f64; 3]>,
    pub nodes: Vec<[f64; 3]>,
    pub normals: Vec<(usize, [f64; 3])>,
}

/// What to build: a box of cubes of 1 mm, six tets each, held at z = 0 and pulled at the top.
#[derive(Clone, Copy)]
pub struct BoxCase {
    pub cells: [usize; 3],
    /// Stiffness of two inclusions (one afloat, one held) over that of the rest.
    pub contrast: f64,
    pub nu: f64,
    /// Whether the nodes at x = 0 slide on a tilted plane.
    pub sliding: bool,
    /// Copies of the box far apart.
    pub islands: usize,
}

impl Default for BoxCase {
    fn default() -> Self {
        Self { cells: [6, 5, 6], contrast: 263.0, nu: 0.46, sliding: false, islands: 1 }
    }
}

const YOUNG: f64 = 0.003;
const NORMAL: [f64; 3] = [0.8, 0.6, 0.0];

pub fn block_matrix(rows: &[BTreeMap<usize, Matrix3<f64>>]) -> BlockMatrix {
    let mut a = BlockMatrix {
        row_start: vec![0],
        columns: Vec::new(),
        blocks: Vec::new(),
        diagonal: Vec::new(),
    };
    for (i, row) in rows.iter().enumerate() {
        for (&j, block) in row {
            if i == j {
                a.diagonal.push(a.blocks.len());
            }
            a.columns.push(u32::try_from(j).unwrap());
            let mut flat = [0.0; 9];
            flat.copy_from_slice(block.transpose().as_slice());
            a.blocks.push(flat);
        }
        a.row_start.push(a.blocks.len());
    }
    a
}

pub fn elastic_box(case: BoxCase) -> System {
    let [nx, ny, nz] = case.cells;
    let per_island = (nx + 1) * (ny + 1) * (nz + 1);
    let id = |i: usize, j: usize, k: usize| (i * (ny + 1) + j) * (nz + 1) + k;
    let mut nodes = vec![Vector3::zeros(); per_island * case.islands];
    let mut tets = Vec::new();
    for island in 0..case.islands {
        let offset = island * per_island;
        for i in 0..=nx {
            for j in 0..=ny {
                for k in 0..=nz {
                    nodes[offset + id(i, j, k)] =
                        Vector3::new(i as f64 + 1000.0 * island as f64, j as f64, k as f64);
                }
            }
        }
        for i in 0..nx {
            for j in 0..ny {
                for k in 0..nz {
                    for path in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                        let mut at = [i, j, k];
                        let mut tet = [offset + id(i, j, k); 4];
                        for (corner, axis) in path.into_iter().enumerate() {
                            at[axis] += 1;
                            tet[corner + 1] = offset + id(at[0], at[1], at[2]);
                        }
                        let afloat = i > 0 && i < 3 && j > 0 && j < 3 && k > 1 && k < 4;
                        let held = i > 3 && j > 2 && k < 3;
                        tets.push((tet, afloat || held));
                    }
                }
            }
        }
    }
    let mut full = vec![BTreeMap::<usize, Matrix3<f64>>::new(); nodes.len()];
    for (tet, stiff) in tets {
        let young = if stiff { YOUNG * case.contrast } else { YOUNG };
        let mu = young / (2.0 * (1.0 + case.nu));
        let lambda = young * case.nu / ((1.0 + case.nu) * (1.0 - 2.0 * case.nu));
        let x = tet.map(|n| nodes[n]);
        let edges = Matrix3::from_columns(&[x[1] - x[0], x[2] - x[0], x[3] - x[0]]);
        let volume = edges.determinant().abs() / 6.0;
        let inverse = edges.try_inverse().unwrap();
        let mut g = [Vector3::zeros(); 4];
        for c in 0..3 {
            g[c + 1] = inverse.row(c).transpose();
            g[0] -= g[c + 1];
        }
        for p in 0..4 {
            for q in 0..4 {
                let block = (g[p] * g[q].transpose() * lambda
                    + g[q] * g[p].transpose() * mu
                    + Matrix3::identity() * (mu * g[p].dot(&g[q])))
                    * volume;
                *full[tet[p]].entry(tet[q]).or_insert_with(Matrix3::zeros) += block;
            }
        }
    }
    let free: Vec<usize> = (0..nodes.len()).filter(|&n| nodes[n].z > 0.5).collect();
    let mut row_of = vec![usize::MAX; nodes.len()];
    for (row, &n) in free.iter().enumerate() {
        row_of[n] = row;
    }
    let normal = Vector3::from(NORMAL);
    let slides = |n: usize| case.sliding && nodes[n].x % 1000.0 < 0.5;
    let projector = |n: usize| {
        if slides(n) {
            Matrix3::identity() - normal * normal.transpose()
        } else {
            Matrix3::identity()
        }
    };
    let mut rows = vec![BTreeMap::new(); free.len()];
    let mut b = vec![[0.0; 3]; free.len()];
    for (row, &n) in free.iter().enumerate() {
        for (&m, block) in &full[n] {
            if row_of[m] == usize::MAX {
                continue;
            }
            let mut projected = projector(n) * block * projector(m);
            if n == m && slides(n) {
                projected += normal * normal.transpose() * (block.trace() / 3.0);
            }
            rows[row].insert(row_of[m], projected);
        }
        if nodes[n].z > nz as f64 - 0.5 {
            let pull = projector(n) * Vector3::new(3e-4, 1e-4, 5e-4 + 1e-4 * nodes[n].y);
            b[row] = pull.into();
        }
    }
    let normals = free
        .iter()
        .enumerate()
        .filter(|(_, n)| slides(**n))
        .map(|(row, _)| (row, NORMAL))
        .collect();
    System {
        a: block_matrix(&rows),
        b,
        nodes: free.iter().map(|&n| nodes[n].into()).collect(),
        normals,
    }
}

/// The solution by a dense Cholesky factor with two steps of iterative refinement.
pub fn dense_solution(a: &BlockMatrix, b: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let n = 3 * a.n_rows();
    let mut dense = DMatrix::zeros(n, n);
    for i in 0..a.n_rows() {
        let (columns, blocks) = a.row(i);
        for (&j, block) in columns.iter().zip(blocks) {
            for c in 0..9 {
                dense[(3 * i + c / 3, 3 * j as usize + c % 3)] = block[c];
            }
        }
    }
    let factor = nalgebra::Cholesky::new(dense).unwrap();
    let mut x = vec![[0.0; 3]; a.n_rows()];
    for _ in 0..3 {
        let ax = a.multiply(&x);
        let r = DVector::from_iterator(
            n,
            b.as_flattened().iter().zip(ax.as_flattened()).map(|(b, y)| b - y),
        );
        let dx = factor.solve(&r);
        for (x, dx) in x.as_flattened_mut().iter_mut().zip(dx.iter()) {
            *x += dx;
        }
    }
    x
}

/// Largest distance between rows.
pub fn largest_difference(x: &[[f64; 3]], y: &[[f64; 3]]) -> f64 {
    x.iter().zip(y).map(|(x, y)| (Vector3::from(*x) - Vector3::from(*y)).norm()).fold(0.0, f64::max)
}

/// A vector that looks random and is the same everywhere.
pub fn scattered(n: usize, seed: usize) -> Vec<[f64; 3]> {
    (0..n)
        .map(|i| {
            [0, 1, 2].map(|c| {
                let t = ((3 * i + c + 1) as f64 * (seed as f64 + 0.618_033_988_75)).sin() * 43758.5;
                t - t.floor() - 0.5
            })
        })
        .collect()
}
