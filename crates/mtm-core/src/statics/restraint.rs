//! Whether the body is constrained: which parts could move without deforming, and along which rigid modes.
//!
//! A stiffness matrix with a free rigid mode or a hinge is singular, but rounding can hide this from the
//! factorisation. The parts are therefore found from the geometry, before anything is factorised.

use nalgebra::{DMatrix, Matrix6, SMatrix, SymmetricEigen, Vector3, Vector6};

use crate::error::{MtmError, Result};
use crate::geometry::forest::Forest;
use crate::mesh::TetMesh;
use crate::vector::{cross, distinct, dot, norm, scaled, sub};

/// Eigenvalue of a part's restraint, relative to the largest, below which a rigid mode counts as free.
const FREE_MODE: f64 = 1e-10;
/// Maximum number of parts in a chain of touching parts whose joint motion is analysed (six unknowns each).
const MAX_JOINT_PARTS: usize = 150;

/// How the body is constrained.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Support {
    /// Fixed and joined nodes suffice: sliding nodes may even be released.
    ByPrescribed,
    /// Sliding nodes are needed: without their normal constraint a part could drift.
    WithSliding,
}

/// One rigid part: tets joined over whole faces.
struct RigidPart {
    nodes: Vec<u32>,
    centre: [f64; 3],
    radius: f64,
}

/// How the prescribed nodes, and the sliding nodes with their unit normals, constrain the body.
///
/// # Errors
/// `Unconstrained` with the free modes of the first part that is not constrained.
pub fn check(
    mesh: &TetMesh,
    prescribed: impl Fn(usize) -> bool,
    sliding: &[(u32, [f64; 3])],
) -> Result<Support> {
    let n = mesh.n_nodes();
    let mut grounded: Vec<bool> = (0..n).map(prescribed).collect();
    grow(mesh, &mut grounded);
    if grounded.iter().all(|&g| g) {
        return Ok(Support::ByPrescribed);
    }
    let parts = parts(mesh, &grounded);
    if free_parts(mesh, &parts, grounded.clone(), &[]).is_ok() {
        return Ok(Support::ByPrescribed);
    }
    free_parts(mesh, &parts, grounded, sliding)?;
    Ok(Support::WithSliding)
}

/// Grounds every node of a tet that has three grounded ones: three nodes of a tet are never collinear.
fn grow(mesh: &TetMesh, grounded: &mut [bool]) {
    let mut count = vec![0_u8; mesh.n_tets()];
    let mut queue: Vec<u32> =
        (0..grounded.len()).filter(|&j| grounded[j]).map(|j| j as u32).collect();
    while let Some(j) = queue.pop() {
        for &t in mesh.tets_of_node(j as usize) {
            count[t as usize] += 1;
            if count[t as usize] == 3 {
                for &k in &mesh.tets()[t as usize] {
                    if !grounded[k as usize] {
                        grounded[k as usize] = true;
                        queue.push(k);
                    }
                }
            }
        }
    }
}

/// Face-connected groups of the tets that still have a node not grounded.
fn parts(mesh: &TetMesh, grounded: &[bool]) -> Vec<RigidPart> {
    let open = |t: usize| mesh.tets()[t].iter().any(|&v| !grounded[v as usize]);
    let mut forest = Forest::new(mesh.n_tets());
    for t in (0..mesh.n_tets()).filter(|&t| open(t)) {
        for other in mesh.face_neighbours(t).filter(|&other| open(other as usize)) {
            forest.join(t, other as usize);
        }
    }
    let numbers = forest.numbered();
    let mut order: Vec<usize> = (0..mesh.n_tets()).filter(|&t| open(t)).collect();
    order.sort_by_key(|&t| numbers[t]);
    let mut parts = Vec::new();
    for tets in order.chunk_by(|&s, &t| numbers[s] == numbers[t]) {
        let nodes = distinct(tets.iter().flat_map(|&t| mesh.tets()[t]));
        let count = nodes.len() as f64;
        let mut centre = [0.0; 3];
        for &j in &nodes {
            for i in 0..3 {
                centre[i] += mesh.nodes()[j as usize][i] / count;
            }
        }
        let radius =
            nodes.iter().map(|&j| norm(sub(mesh.nodes()[j as usize], centre))).fold(0.0, f64::max);
        parts.push(RigidPart { nodes, centre, radius });
    }
    parts
}

/// Checks that all parts are constrained: each is tested alone, then those that share nodes jointly.
fn free_parts(
    mesh: &TetMesh,
    parts: &[RigidPart],
    mut grounded: Vec<bool>,
    sliding: &[(u32, [f64; 3])],
) -> Result<()> {
    let mut normal: Vec<Option<[f64; 3]>> = vec![None; mesh.n_nodes()];
    for &(node, n) in sliding {
        normal[node as usize] = Some(n);
    }
    // A constrained part grounds its nodes, which may constrain the next part.
    let mut open: Vec<usize> = (0..parts.len()).collect();
    loop {
        let before = open.len();
        open.retain(|&p| {
            let held = free_modes(&restraint(mesh, &parts[p], &grounded, &normal)).is_empty();
            if held {
                for &j in &parts[p].nodes {
                    grounded[j as usize] = true;
                }
            }
            !held
        });
        if open.is_empty() {
            return Ok(());
        }
        if open.len() == before {
            break;
        }
    }
    let Some(first) = touching(mesh, parts, &open, &grounded).into_iter().find(|chain| {
        chain.len() == 1
            || chain.len() > MAX_JOINT_PARTS
            || !held_jointly(mesh, parts, chain, &grounded, &normal)
    }) else {
        return Ok(());
    };
    let part = &parts[first[0]];
    let modes = free_modes(&restraint(mesh, part, &grounded, &normal));
    let what = if parts.len() == 1 && part.nodes.len() == mesh.n_nodes() {
        "the body".to_owned()
    } else if open.len() == 1 {
        "a part of the body".to_owned()
    } else {
        format!("a part of the body (the first of {})", open.len())
    };
    Err(MtmError::Unconstrained {
        what,
        modes: describe(&modes, part),
        nodes: part.nodes.len(),
        node: part.nodes[0] as usize,
    })
}

/// Rigid modes of a part at `x`: three translations, three rotations over the radius.
fn modes_at(part: &RigidPart, x: [f64; 3]) -> SMatrix<f64, 3, 6> {
    let r = scaled(sub(x, part.centre), 1.0 / part.radius);
    SMatrix::<f64, 3, 6>::from_row_slice(&[
        1.0, 0.0, 0.0, 0.0, r[2], -r[1], //
        0.0, 1.0, 0.0, -r[2], 0.0, r[0], //
        0.0, 0.0, 1.0, r[1], -r[0], 0.0,
    ])
}

/// Σ (constraint rows)ᵀ (constraint rows) on the six rigid modes of a part.
fn restraint(
    mesh: &TetMesh,
    part: &RigidPart,
    grounded: &[bool],
    normal: &[Option<[f64; 3]>],
) -> Matrix6<f64> {
    let mut gram = Matrix6::zeros();
    for &j in &part.nodes {
        let j = j as usize;
        let modes = modes_at(part, mesh.nodes()[j]);
        if grounded[j] {
            gram += modes.transpose() * modes;
        } else if let Some(n) = normal[j] {
            let row = Vector3::from(n).transpose() * modes;
            gram += row.transpose() * row;
        }
    }
    gram
}

fn free_modes(gram: &Matrix6<f64>) -> Vec<Vector6<f64>> {
    let eigen = SymmetricEigen::new(*gram);
    let limit = FREE_MODE * eigen.eigenvalues.max();
    (0..6)
        .filter(|&i| eigen.eigenvalues[i] <= limit)
        .map(|i| eigen.eigenvectors.column(i).into_owned())
        .collect()
}

/// The free parts in chains that share nodes; the chains, and the parts in each, in ascending order.
fn touching(
    mesh: &TetMesh,
    parts: &[RigidPart],
    open: &[usize],
    grounded: &[bool],
) -> Vec<Vec<usize>> {
    let mut forest = Forest::new(open.len());
    let mut owner: Vec<Option<usize>> = vec![None; mesh.n_nodes()];
    for (at, &p) in open.iter().enumerate() {
        for &j in parts[p].nodes.iter().filter(|&&j| !grounded[j as usize]) {
            match owner[j as usize] {
                None => owner[j as usize] = Some(at),
                Some(other) => forest.join(at, other),
            }
        }
    }
    let mut chains: Vec<Vec<usize>> = vec![Vec::new(); open.len()];
    for (chain, &p) in forest.numbered().into_iter().zip(open) {
        chains[chain as usize].push(p);
    }
    chains.retain(|chain| !chain.is_empty());
    chains
}

/// Whether parts that share nodes constrain each other: six unknowns per part, equal motion at shared nodes.
fn held_jointly(
    mesh: &TetMesh,
    parts: &[RigidPart],
    open: &[usize],
    grounded: &[bool],
    normal: &[Option<[f64; 3]>],
) -> bool {
    let size = 6 * open.len();
    let mut gram = DMatrix::<f64>::zeros(size, size);
    let mut owner: Vec<Option<usize>> = vec![None; mesh.n_nodes()];
    for (at, &p) in open.iter().enumerate() {
        let own = restraint(mesh, &parts[p], grounded, normal);
        let mut block = gram.view_mut((6 * at, 6 * at), (6, 6));
        block += own;
        for &j in &parts[p].nodes {
            let j = j as usize;
            let Some(first) = owner[j] else {
                owner[j] = Some(at);
                continue;
            };
            let a = modes_at(&parts[open[first]], mesh.nodes()[j]);
            let b = modes_at(&parts[p], mesh.nodes()[j]);
            for (r, c, block) in [
                (first, first, a.transpose() * a),
                (at, at, b.transpose() * b),
                (first, at, -(a.transpose() * b)),
                (at, first, -(b.transpose() * a)),
            ] {
                let mut view = gram.view_mut((6 * r, 6 * c), (6, 6));
                view += block;
            }
        }
    }
    let values = SymmetricEigen::new(gram).eigenvalues;
    values.min() > FREE_MODE * values.max()
}

/// The free modes in words: translations first, then rotations with their axis.
fn describe(modes: &[Vector6<f64>], part: &RigidPart) -> String {
    if modes.len() == 6 {
        return "all six rigid modes are free: no node of it is fixed, joined or sliding".into();
    }
    // Combinations without rotation are translations: the null space of the rotation rows.
    let k = modes.len();
    let rotation = DMatrix::from_fn(3, k, |i, j| modes[j][3 + i]);
    let svd = SymmetricEigen::new(rotation.transpose() * &rotation);
    let mut words = Vec::new();
    for c in 0..k {
        let weights = svd.eigenvectors.column(c);
        let mut mode = Vector6::zeros();
        for (j, m) in modes.iter().enumerate() {
            mode += m * weights[j];
        }
        let t = [mode[0], mode[1], mode[2]];
        let w = scaled([mode[3], mode[4], mode[5]], 1.0 / part.radius);
        if svd.eigenvalues[c] < 1e-8 {
            words.push(format!("translation along {}", direction(t)));
        } else {
            // A velocity t + w × (x − centre) vanishes along an axis through centre + w × t / |w|².
            let offset = scaled(cross(w, t), 1.0 / dot(w, w));
            let p = [0, 1, 2].map(|i| part.centre[i] + offset[i]);
            words.push(format!(
                "rotation about {} through ({:.4}, {:.4}, {:.4})",
                direction(w),
                shown(p[0]),
                shown(p[1]),
                shown(p[2])
            ));
        }
    }
    words.sort_by_key(|w| !w.starts_with("translation"));
    format!("free rigid modes: {}", words.join("; "))
}

fn direction(v: [f64; 3]) -> String {
    let unit = scaled(v, 1.0 / norm(v).max(f64::MIN_POSITIVE));
    for (axis, name) in ["x", "y", "z"].iter().enumerate() {
        if unit[axis].abs() > 1.0 - 1e-9 {
            return (*name).to_owned();
        }
    }
    format!("({:.3}, {:.3}, {:.3})", shown(unit[0]), shown(unit[1]), shown(unit[2]))
}

/// `value` without the negative sign of a zero left by rounding.
fn shown(value: f64) -> f64 {
    if value.abs() < 5e-5 { 0.0 } else { value }
}
