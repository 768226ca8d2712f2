//! Tangents of a series of states.

use std::sync::Arc;

use mtm_core::internals::{LAG, PointTangents};
use mtm_core::{
    BlockMatrix, Elastic, Kinematics, MassTensors, StrainEnergy, TangentKind, TetMesh, Tissue,
};

type Block = [f64; 9];

fn values(body: &StrainEnergy, u: &[[f64; 3]], series: &mut PointTangents) -> Vec<Block> {
    let read = |matrix: &BlockMatrix| {
        (0..matrix.n_rows()).flat_map(|row| matrix.row(row).1.to_vec()).collect()
    };
    body.with_stiffness(u, TangentKind::Definite, series, read).expect("four nodes")
}

#[test]
fn definite_tangents_of_a_series_are_kept_only_where_the_tet_hardly_moves() {
    let nodes = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let mesh = Arc::new(TetMesh::new(nodes, vec![[0, 1, 2, 3]]).expect("one tet"));
    let tissue = Tissue::isotropic(&[Elastic { young: 1.0, poisson: 0.46 }]).expect("tissue");
    let tensors = Arc::new(MassTensors::new(mesh, Arc::new(tissue)).expect("tensors"));
    let body = StrainEnergy::new(tensors, Kinematics::NEO_HOOKEAN);
    let at = |x: f64| vec![[0.0; 3], [x, 0.1, 0.0], [0.0; 3], [0.0, 0.0, -0.2]];
    let fresh = |x: f64| values(&body, &at(x), &mut PointTangents::default());

    let mut series = body.begin(LAG);
    assert_eq!(values(&body, &at(0.1), &mut series), fresh(0.1));
    let near = values(&body, &at(0.1 + 0.5 * LAG), &mut series);
    assert_eq!(near, fresh(0.1), "kept");
    // Steps add up: the tangent is that of a place within the lag, not of the last state.
    let moved = values(&body, &at(0.1 + 1.5 * LAG), &mut series);
    assert_eq!(moved, fresh(0.1 + 1.5 * LAG));
    assert_ne!(moved, near);
    // Exact tangents are never kept, and none of another series is.
    let exact = body.with_stiffness(&at(0.1), TangentKind::Exact, &mut series, |_| ());
    exact.expect("four nodes");
    let after = values(&body, &at(0.1 + 0.5 * LAG), &mut series);
    assert_eq!(after, fresh(0.1 + 0.5 * LAG));
    body.end(series);
    assert_eq!(values(&body, &at(0.1), &mut body.begin(LAG)), fresh(0.1));
}
