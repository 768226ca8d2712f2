//! Stiffness of the quadratic tet from the tensors of the linear one, exact for constant C.
//!
//! The gradient of a quadratic shape function is Σ_p c_p(λ) g_p with coefficients linear in the
//! barycentric coordinates, c_p = −δ + Σ_q a_pq λ_q; so K_AB = Σ_pq w_pq T_pq, T_pq = V B_pᵀ C B_q the
//! tensors between corners and w_pq the mean of c_p^A c_q^B over the tet.

use std::sync::OnceLock;

use crate::algebra::blocks::Block;
use crate::mechanics::element::MOST_NODES;
use crate::mesh::TET_EDGES;

/// Means over the tet of c_p^A c_q^B: `[A][B][p][q]`.
type Weights = [[[[f64; 4]; 4]; MOST_NODES]; MOST_NODES];

/// c_p of each shape function as (constant, factors of λ), by corner p.
fn coefficients(node: usize) -> [(f64, [f64; 4]); 4] {
    let mut out = [(0.0, [0.0; 4]); 4];
    if node < 4 {
        out[node].0 = -1.0;
        out[node].1[node] = 4.0;
    } else {
        let [i, j] = TET_EDGES[node - 4];
        out[j].1[i] = 4.0;
        out[i].1[j] = 4.0;
    }
    out
}

/// Mean over the tet of two functions linear in λ: mean λ_i = 1/4, mean λ_i λ_j = (1 + δ_ij)/20.
fn mean(f: &(f64, [f64; 4]), g: &(f64, [f64; 4])) -> f64 {
    let mut sum = f.0 * g.0;
    for i in 0..4 {
        sum += 0.25 * (f.0 * g.1[i] + f.1[i] * g.0);
        for j in 0..4 {
            sum += f.1[i] * g.1[j] * if i == j { 0.1 } else { 0.05 };
        }
    }
    sum
}

fn weights() -> &'static Weights {
    static WEIGHTS: OnceLock<Box<Weights>> = OnceLock::new();
    WEIGHTS.get_or_init(|| {
        let mut out = Box::new([[[[0.0; 4]; 4]; MOST_NODES]; MOST_NODES]);
        for a in 0..MOST_NODES {
            for b in 0..MOST_NODES {
                let (f, g) = (coefficients(a), coefficients(b));
                for p in 0..4 {
                    for q in 0..4 {
                        out[a][b][p][q] = mean(&f[p], &g[q]);
                    }
                }
            }
        }
        out
    })
}

/// Tensor between nodes `a` and `b` of a quadratic tet whose corner tensors are `corners[p][q]`, N/mm.
pub fn quadratic_tensor(corners: &[[Block; 4]; 4], a: usize, b: usize) -> Block {
    let weights = &weights()[a][b];
    let mut out = [0.0; 9];
    for p in 0..4 {
        for q in 0..4 {
            let w = weights[p][q];
            if w != 0.0 {
                for i in 0..9 {
                    out[i] += w * corners[p][q][i];
                }
            }
        }
    }
    if a == b {
        // Symmetric in exact arithmetic; made symmetric in every bit.
        for (r, c) in [(0, 1), (0, 2), (1, 2)] {
            let mean = 0.5 * (out[3 * r + c] + out[3 * c + r]);
            out[3 * r + c] = mean;
            out[3 * c + r] = mean;
        }
    }
    out
}
