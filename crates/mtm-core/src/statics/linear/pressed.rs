//! Conjugate gradients under links that only push: which of them do is found on the way.
//!
//! The energy ½ xᵀA x − bᵀx + Σ ½ k ⟨goal − c·x⟩₊² is convex and piecewise quadratic. Each direction is made
//! conjugate to the last one (Polak & Ribière 1969) and followed to the minimum of the energy along it, so that
//! links may begin or cease to push in any iteration and the iterations never start again.

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::krylov::{Operator, Preconditioner};
use crate::algebra::row_sums::{advance, dot};
use crate::contact::links::Link;
use crate::vector::{add, scaled};

/// Bisections that find the minimum along a direction.
const BISECTIONS: usize = 40;
/// Largest multiple of a direction.
const FARTHEST: f64 = 1e6;

/// `matrix` with `links`: its pattern grows by the blocks that they couple.
pub fn with_links(matrix: &BlockMatrix, links: &[Link]) -> BlockMatrix {
    let mut more = vec![Vec::new(); matrix.n_rows()];
    let pairs = |link: &Link| {
        let (k, ends) = (link.stiffness, link.ends.clone());
        let with = move |a| ends.clone().into_iter().map(move |b| (k, a, b));
        link.ends.clone().into_iter().flat_map(with)
    };
    for (_, (row, _), (column, _)) in links.iter().flat_map(pairs) {
        more[row as usize].push(column);
    }
    let (mut row_start, mut columns) = (vec![0], Vec::with_capacity(matrix.columns.len()));
    for (j, more) in more.iter_mut().enumerate() {
        more.extend_from_slice(matrix.row(j).0);
        more.sort_unstable();
        more.dedup();
        columns.append(more);
        row_start.push(columns.len());
    }
    let mut out = BlockMatrix::from_pattern(row_start, columns);
    for j in 0..matrix.n_rows() {
        let (columns, blocks) = matrix.row(j);
        for (&column, block) in columns.iter().zip(blocks) {
            *out.block_mut(j, column) = *block;
        }
    }
    for (k, (row, a), (column, b)) in links.iter().flat_map(pairs) {
        let block = out.block_mut(row as usize, column);
        for (i, value) in block.iter_mut().enumerate() {
            *value += k * a[i / 3] * b[i % 3];
        }
    }
    out
}

/// Such an energy.
pub(crate) struct Pressed<'a> {
    /// A, on the vectors without components along the normals of held rows.
    pub a: &'a dyn Operator,
    pub preconditioner: &'a dyn Preconditioner,
    pub links: &'a [Link],
}

/// The end of the iterations.
pub(crate) struct PressedEnd {
    /// Displacements of the rows, mm.
    pub x: Vec<[f64; 3]>,
    /// Energy norm of the residual before each iteration.
    pub history: Vec<f64>,
    /// Whether A has no positive curvature along a direction.
    pub is_indefinite: bool,
}

impl Pressed<'_> {
    /// Displacements from `x` on, with forces `r` = b − A x there, until the energy norm of the residual has
    /// fallen to `share` of the first, or after `most` iterations.
    pub fn solve(
        &self,
        mut x: Vec<[f64; 3]>,
        mut r: Vec<[f64; 3]>,
        (share, most): (f64, usize),
    ) -> PressedEnd {
        let n = x.len();
        let mut along: Vec<f64> = self.links.iter().map(|link| link.along(&x)).collect();
        let [mut g, mut z, mut p, mut q, mut before] = [0; 5].map(|_| vec![[0.0; 3]; n]);
        let (mut last, mut history) = (0.0, Vec::new());
        let mut is_indefinite = false;
        loop {
            g.copy_from_slice(&r);
            for (link, s) in self.links.iter().zip(&along) {
                link.add(link.push(*s), &mut g);
            }
            self.a.project(&mut g);
            self.preconditioner.apply(&g, &mut z);
            self.a.project(&mut z);
            let size = dot(&z, &g);
            history.push(size.max(0.0).sqrt());
            if size <= 0.0 || history.len() > most || size <= (share * history[0]).powi(2) {
                break;
            }
            let mut turn =
                if last > 0.0 { ((size - dot(&z, &before)) / last).max(0.0) } else { 0.0 };
            if turn > 0.0 && size + turn * dot(&p, &g) <= 0.0 {
                turn = 0.0;
            }
            for (p, z) in p.iter_mut().zip(&z) {
                *p = add(*z, scaled(*p, turn));
            }
            self.a.multiply_into(&p, &mut q);
            let curvature = dot(&p, &q);
            if curvature <= self.a.least_curvature(&p) {
                is_indefinite = true;
                break;
            }
            let ways: Vec<f64> = self.links.iter().map(|link| link.along(&p)).collect();
            let step = self.lowest((dot(&p, &r), curvature), &along, &ways);
            advance(step, &p, &q, &mut x, &mut r);
            for (s, way) in along.iter_mut().zip(&ways) {
                *s += step * way;
            }
            std::mem::swap(&mut before, &mut g);
            last = size;
        }
        PressedEnd { x, history, is_indefinite }
    }

    /// The multiple of a direction at which the energy is lowest; `pull`: the forces without links along it.
    fn lowest(&self, (pull, curvature): (f64, f64), along: &[f64], ways: &[f64]) -> f64 {
        let force = |t: f64| {
            let each = self.links.iter().zip(along.iter().zip(ways));
            let push: f64 = each.map(|(link, (s, way))| link.push(s + t * way) * way).sum();
            pull - t * curvature + push
        };
        let mut high = 1.0;
        while force(high) > 0.0 && high < FARTHEST {
            high *= 2.0;
        }
        let mut low = 0.0;
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (low + high);
            if force(middle) > 0.0 {
                low = middle;
            } else {
                high = middle;
            }
        }
        0.5 * (low + high)
    }
}
