//! The generated shell as values of the core: what the benches start from.

#![allow(dead_code)] // each bench that includes this file uses a part of it

use std::sync::Arc;

use mtm_core::{
    BlockMatrix, Boundary, Conflicts, FibreElastic, FibreLaw, Gap, MassTensors, Motion, Plan,
    RigidMotion, Segment, Surface, TetMesh, Tissue,
};

use super::shell::Shell;

/// Sizes in tets when `MTM_BENCH_SIZES` does not say otherwise.
const DEFAULT_SIZES: &str = "20000,80000";
/// The segment that the plans move.
pub const MAXILLA: &str = "maxilla";

/// Sizes in tets from `MTM_BENCH_SIZES`, comma-separated.
pub fn sizes() -> Vec<usize> {
    let text = std::env::var("MTM_BENCH_SIZES").unwrap_or_else(|_| DEFAULT_SIZES.into());
    text.split(',')
        .map(|s| s.trim().parse().expect("MTM_BENCH_SIZES holds numbers of tets"))
        .collect()
}

pub fn mesh(shell: &Shell) -> Arc<TetMesh> {
    Arc::new(TetMesh::new(shell.nodes.clone(), shell.tets.clone()).expect("a sound mesh"))
}

/// Fat and muscle with fibres: the contrast and anisotropy of Kim et al. (2010).
pub fn tissue(shell: &Shell) -> Arc<Tissue> {
    let rows: Vec<FibreElastic> = (0..shell.tets.len())
        .map(|t| FibreElastic {
            young_along: shell.young_along[t],
            young_across: shell.young_across[t],
            poisson: shell.poisson[t],
        })
        .collect();
    let tissue = Tissue::transversely_isotropic(&rows, &shell.fibre, FibreLaw::Spencer);
    Arc::new(tissue.expect("sound materials"))
}

/// Skull and mandible fixed, the maxilla joined; teeth and mucosa sliding, or left free.
pub fn boundary(shell: &Shell, sliding: bool) -> Arc<Boundary> {
    let contact = sliding.then(|| {
        let (vertices, triangles) =
            (shell.contact_vertices.clone(), shell.contact_triangles.clone());
        Arc::new(Surface::new(vertices, triangles).expect("a sound contact surface"))
    });
    let maxilla = Segment {
        name: MAXILLA.into(),
        joined: shell.joined.clone(),
        sliding: if sliding { shell.sliding.clone() } else { Vec::new() },
        contact,
        gap: Gap::Rest,
    };
    let boundary = Boundary::new(shell.fixed.clone(), vec![maxilla], Conflicts::Resolve);
    Arc::new(boundary.expect("sound node kinds"))
}

/// The shell's bone motion with its translation grown by `step` per cent: no two plans alike.
pub fn plan(shell: &Shell, step: usize) -> Plan {
    let mut matrix = shell.motion;
    for row in matrix.iter_mut().take(3) {
        row[3] *= 1.0 + 0.01 * step as f64;
    }
    let motion = RigidMotion::new(MAXILLA, &matrix).expect("a rigid motion");
    vec![(MAXILLA.into(), Motion::Rigid(motion))]
}

/// Rows and columns of the nodes that move as the forces say, and those nodes.
pub fn reduced(tensors: &MassTensors, boundary: &Boundary) -> (BlockMatrix, Vec<u32>) {
    let n = tensors.mesh().n_nodes();
    let mut row_of = vec![Some(0_u32); n];
    let prescribed = boundary.segments().iter().flat_map(|s| &s.joined).chain(boundary.fixed());
    for &j in prescribed {
        row_of[j as usize] = None;
    }
    let mut unknowns = Vec::new();
    for (j, row) in row_of.iter_mut().enumerate() {
        if let Some(row) = row {
            *row = unknowns.len() as u32;
            unknowns.push(j as u32);
        }
    }
    let (mut start, mut columns, mut blocks) = (vec![0], Vec::new(), Vec::new());
    for &j in &unknowns {
        let (ks, values) = tensors.matrix().row(j as usize);
        for (&k, block) in ks.iter().zip(values) {
            if let Some(column) = row_of[k as usize] {
                columns.push(column);
                blocks.push(*block);
            }
        }
        start.push(columns.len());
    }
    let mut matrix = BlockMatrix::from_pattern(start, columns);
    matrix.blocks = blocks;
    (matrix, unknowns)
}
