//! Every kind of wrong input, and every numerical failure, gives its own error with index and value.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, boundary, isotropic, joined, plan, plane, sliding, solver, stays,
    surface, tensors,
};
use mtm_core::{
    Elastic, ErrorKind, FibreElastic, FibreLaw, Gap, MassTensors, Method, Mixing, Motion, MtmError,
    Preset, Result, RigidMotion, StaticOptions, Surface, SurfaceMotion, TetMesh, Tissue,
    WindingTree,
};

const BAD: [f64; 3] = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY];

/// The error of `outcome`, checked: its family, whether the input is at fault, every `part` in its text.
fn refused<T>(outcome: Result<T>, kind: ErrorKind, input: bool, parts: &[&str]) -> MtmError {
    let Err(error) = outcome else { panic!("accepted; expected an error with {parts:?}") };
    let text = error.to_string();
    for part in parts {
        assert!(text.contains(part), "no {part:?} in: {text}");
    }
    assert_eq!(error.kind(), kind, "{text}");
    assert_eq!(error.is_input(), input, "{text}");
    error
}

/// The variant of an error and its text.
macro_rules! assert_refused {
    ($outcome:expr, $variant:pat, $kind:ident, $($part:expr),* $(,)?) => {
        let error = refused($outcome, ErrorKind::$kind, true, &[$($part),*]);
        assert!(matches!(error, $variant), "{error:?}");
    };
}

/// A numerical outcome: the input is not at fault.
macro_rules! assert_failed {
    ($outcome:expr, $variant:pat, $kind:ident, $($part:expr),* $(,)?) => {
        let error = refused($outcome, ErrorKind::$kind, false, &[$($part),*]);
        assert!(matches!(error, $variant), "{error:?}");
    };
}

mod problems; // after the macros, which it uses

fn tet() -> Vec<[f64; 3]> {
    vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
}

fn cube() -> (BoxShape, Arc<MassTensors>) {
    let shape = BoxShape::cube(3);
    let tensors = tensors(&shape.mesh(), &isotropic(0.01, 0.4));
    (shape, tensors)
}

#[test]
fn empty_arrays_are_named() {
    use MtmError::Empty;
    assert_refused!(TetMesh::new(vec![], vec![[0; 4]]), Empty { .. }, Mesh, "nodes is empty");
    assert_refused!(TetMesh::new(tet(), vec![]), Empty { .. }, Mesh, "tets is empty");
    assert_refused!(Surface::new(vec![], vec![[0; 3]]), Empty { .. }, Mesh, "surface vertices");
    assert_refused!(Surface::new(tet(), vec![]), Empty { .. }, Mesh, "surface triangles");
    assert_refused!(Tissue::isotropic(&[]), Empty { .. }, Material, "tissue constants");
    assert_refused!(Tissue::from_stiffness(vec![]), Empty { .. }, Material, "tissue constants");
    let m = FibreElastic { young_along: 1.0, young_across: 1.0, poisson: 0.3 };
    let law = FibreLaw::Spencer;
    assert_refused!(
        Tissue::transversely_isotropic(&[m], &[], law),
        Empty { .. },
        Material,
        "fibre is empty"
    );
    let preset = Preset::from_name("kim2010").unwrap();
    let none = Tissue::mixture(&[], &[[1.0, 0.0, 0.0]], preset, Mixing::Moduli);
    assert_refused!(none, Empty { .. }, Material, "tissue constants");
}

#[test]
fn values_that_are_not_finite_are_named_with_their_row() {
    use MtmError::{NotFinite, OutOfRange};
    for bad in BAD {
        let shown = format!("{bad}");
        let mut nodes = tet();
        nodes[2][1] = bad;
        assert_refused!(
            TetMesh::new(nodes.clone(), vec![[0, 1, 2, 3]]),
            NotFinite { .. },
            Mesh,
            "nodes[2]",
            &shown
        );
        assert_refused!(
            Surface::new(nodes, vec![[0, 1, 2]]),
            NotFinite { .. },
            Mesh,
            "surface vertices[2]",
            &shown
        );
        let good = Elastic { young: 1.0, poisson: 0.3 };
        for (rows, what) in [
            ([good, Elastic { young: bad, ..good }], "young[1]"),
            ([good, Elastic { poisson: bad, ..good }], "poisson[1]"),
        ] {
            assert_refused!(Tissue::isotropic(&rows), OutOfRange { .. }, Material, what, &shown);
        }
        let m = FibreElastic { young_along: 1.0, young_across: 2.0, poisson: 0.3 };
        let fibres = [[1.0, 0.0, 0.0], [0.0, bad, 0.0]];
        assert_refused!(
            Tissue::transversely_isotropic(&[m], &fibres, FibreLaw::Spencer),
            NotFinite { .. },
            Material,
            "fibre[1]",
            &shown
        );
        let mut c = meshes::any_stiffness(1);
        (c[1][4], c[4][1]) = (bad, bad);
        let rows = vec![meshes::any_stiffness(2), c];
        assert_refused!(
            Tissue::from_stiffness(rows),
            NotFinite { .. },
            Material,
            "stiffness[1]",
            &shown
        );
        let preset = Preset::from_name("kim2010").unwrap();
        let outcome = Tissue::mixture(&[0.5, bad], &[[1.0, 0.0, 0.0]], preset, Mixing::Stiffness);
        assert_refused!(outcome, OutOfRange { .. }, Material, "fraction[1]", &shown);

        let (shape, tensors) = cube();
        let mut u = vec![[0.0; 3]; 64];
        u[5][2] = bad;
        assert_refused!(
            tensors.internal_force(&u),
            NotFinite { .. },
            Mesh,
            "displacements[5]",
            &shown
        );
        let bounds = boundary(shape.side(0, false), vec![joined("jaw", shape.side(0, true))]);
        let solver = solver(&tensors, &bounds, StaticOptions::default()).unwrap();
        let still = plan([("jaw", stays())]);
        assert_refused!(
            solver.solve(&still, Some(&u), GO_ON),
            NotFinite { .. },
            Boundary,
            "loads[5]",
            &shown
        );
        let mut rows = vec![[0.0; 3]; 16];
        rows[3][0] = bad;
        assert_refused!(
            solver.solve(&plan([("jaw", Motion::Nodes(rows))]), None, GO_ON),
            NotFinite { .. },
            Boundary,
            "plan[\"jaw\"][3]",
            &shown
        );
        let mut matrix = *RigidMotion::identity().matrix();
        matrix[1][3] = bad;
        assert_refused!(
            RigidMotion::new("jaw", &matrix),
            MtmError::Plan { .. },
            Boundary,
            "\"jaw\"",
            "[1][3]",
            &shown
        );
        let sheet = surface(plane(2, 1.0, 0.0));
        let mut moved = sheet.vertices().to_vec();
        moved[4][2] = bad;
        assert_refused!(
            SurfaceMotion::new((*sheet).clone(), moved),
            NotFinite { .. },
            Boundary,
            "moved vertices[4]",
            &shown
        );
    }
}

#[test]
fn arrays_of_wrong_length_say_both_lengths() {
    use MtmError::Length;
    let (shape, tensors) = cube();
    let u = vec![[0.0; 3]; 63];
    let text = ["displacements", "63", "64"];
    assert_refused!(tensors.internal_force(&u), Length { .. }, Mesh, text[0], text[1], text[2]);
    assert_refused!(tensors.strain(&u), Length { .. }, Mesh, "63", "64");
    let bounds = boundary(shape.side(0, false), vec![]);
    let solver = solver(&tensors, &bounds, StaticOptions::default()).unwrap();
    assert_refused!(
        solver.solve(&plan([]), Some(&u), GO_ON),
        Length { .. },
        Boundary,
        "loads has 63",
        "64"
    );
    let rows = [Elastic { young: 1.0, poisson: 0.3 }; 5];
    let tissue = Arc::new(Tissue::isotropic(&rows).unwrap());
    assert_refused!(
        MassTensors::new(shape.mesh(), tissue),
        Length { .. },
        Material,
        "tissue has 5",
        "162"
    );
    let m = [FibreElastic { young_along: 1.0, young_across: 2.0, poisson: 0.3 }; 3];
    assert_refused!(
        Tissue::transversely_isotropic(&m, &[[1.0, 0.0, 0.0]; 2], FibreLaw::Spencer),
        Length { .. },
        Material,
        "fibre has 2",
        "3"
    );
    let sheet = surface(plane(2, 1.0, 0.0));
    assert_refused!(
        SurfaceMotion::new((*sheet).clone(), vec![[0.0; 3]; 8]),
        Length { .. },
        Boundary,
        "moved vertices has 8",
        "9"
    );
}

#[test]
fn indices_past_the_end_are_named_with_row_and_count() {
    use MtmError::IndexOutOfRange;
    let tets = vec![[0, 1, 2, 3], [0, 1, 2, 4]];
    assert_refused!(
        TetMesh::new(tet(), tets),
        IndexOutOfRange { .. },
        Mesh,
        "tets[1]",
        "node 4",
        "there are 4",
        "numbered from 1"
    );
    // What −1 becomes in an unsigned index.
    assert_refused!(
        TetMesh::new(tet(), vec![[0, 1, 2, u32::MAX]]),
        IndexOutOfRange { .. },
        Mesh,
        "4294967295"
    );
    assert_refused!(
        Surface::new(tet(), vec![[0, 1, 2], [0, 1, 4]]),
        IndexOutOfRange { .. },
        Mesh,
        "surface triangles[1]",
        "vertex 4"
    );
    let (shape, tensors) = cube();
    let sheet = surface(plane(2, 9.0, 0.0));
    for (fixed, segments, what) in [
        (vec![0, 64], vec![], "fixed[1]"),
        (vec![], vec![joined("jaw", vec![0, 1, 99])], "joined[\"jaw\"][2]"),
        (
            shape.side(0, false),
            vec![sliding("jaw", vec![60, 64], &sheet, Gap::Rest)],
            "sliding[\"jaw\"][1]",
        ),
    ] {
        let bounds = boundary(fixed, segments);
        assert_refused!(
            solver(&tensors, &bounds, StaticOptions::default()),
            IndexOutOfRange { .. },
            Boundary,
            what,
            "there are 64"
        );
    }
    let bounds = boundary(shape.side(0, false), vec![]);
    let solver = solver(&tensors, &bounds, StaticOptions::default()).unwrap();
    assert_refused!(
        solver.plan_operator(Some(vec![3, 64]), None, GO_ON),
        IndexOutOfRange { .. },
        Boundary,
        "nodes[1]",
        "64"
    );
}

#[test]
fn broken_tets_are_named() {
    use MtmError::{DegenerateTet, DuplicateNode, DuplicateTet, InvertedTet, UnusedNode};
    assert_refused!(
        TetMesh::new(tet(), vec![[0, 1, 2, 3], [0, 3, 2, 3]]),
        DuplicateNode { tet: 1, node: 3, .. },
        Mesh,
        "tet 1 names node 3 twice"
    );
    let mut nodes = tet();
    nodes.push([1.0, 1.0, 1.0]);
    let good = [0, 1, 2, 3];
    assert_refused!(
        TetMesh::new(nodes.clone(), vec![good, [1, 2, 4, 3]]),
        InvertedTet { tet: 1, count: 1, .. },
        Mesh,
        "tet 1 is inverted",
        "-3.33",
        "[1, 2, 4, 3]"
    );
    nodes[4] = [0.5, 0.5, 1e-14];
    assert_refused!(
        TetMesh::new(nodes.clone(), vec![good, [0, 1, 2, 4]]),
        DegenerateTet { tet: 1, .. },
        Mesh,
        "tet 1 is degenerate",
        "longest edge"
    );
    nodes[4] = [-1.0; 3];
    assert_refused!(
        TetMesh::new(nodes.clone(), vec![good]),
        UnusedNode { node: 4, count: 1 },
        Mesh,
        "node 4 belongs to no tet"
    );
    let twice = vec![good, [0, 2, 1, 4], [1, 2, 0, 3]];
    assert_refused!(
        TetMesh::new(nodes, twice),
        DuplicateTet { first: 0, second: 2, .. },
        Mesh,
        "tets 0 and 2",
        "[0, 1, 2, 3]"
    );
    // So large or small that products overflow or vanish: no panic, and no wrong "good".
    for size in [1e-160, 1e160] {
        let nodes = tet().iter().map(|x| x.map(|v| size * v)).collect();
        assert!(TetMesh::new(nodes, vec![good]).is_err(), "{size:e}");
    }
}

#[test]
fn broken_triangles_are_named() {
    use MtmError::{DegenerateTriangle, OutOfRange};
    let mut vertices = tet();
    vertices.push([0.5, 0.5, 0.0]);
    for triangle in [[1, 1, 2], [1, 4, 2]] {
        assert_refused!(
            Surface::new(vertices.clone(), vec![[0, 1, 2], triangle]),
            DegenerateTriangle { triangle: 1, .. },
            Mesh,
            "triangle 1 of surface",
            "area"
        );
    }
    for angle in [-0.1, 4.0, f64::NAN] {
        assert_refused!(
            Surface::with_crease_angle(vertices.clone(), vec![[0, 1, 2]], angle),
            OutOfRange { .. },
            Mesh,
            "crease angle",
            &format!("{angle}")
        );
    }
    let sheet = Surface::new(vertices, vec![[0, 1, 2]]).unwrap();
    for beta in [0.5, f64::NAN] {
        assert_refused!(
            WindingTree::with_beta(&sheet, beta),
            OutOfRange { .. },
            Mesh,
            "beta",
            &format!("{beta}")
        );
    }
}

#[test]
fn inadmissible_materials_are_named_with_tet_and_value() {
    use MtmError::{
        AsymmetricStiffness, FibreNotUnit, IndefiniteMaterial, OutOfRange, UnknownName,
    };
    let good = Elastic { young: 1.0, poisson: 0.3 };
    for (bad, what, value) in [
        (Elastic { young: 0.0, ..good }, "young[1]", "0"),
        (Elastic { young: -2.5, ..good }, "young[1]", "-2.5"),
        (Elastic { poisson: 0.5, ..good }, "poisson[1]", "0.5"),
        (Elastic { poisson: -1.0, ..good }, "poisson[1]", "-1"),
        (Elastic { poisson: 0.7, ..good }, "poisson[1]", "0.7"),
    ] {
        assert_refused!(
            Tissue::isotropic(&[good, bad]),
            OutOfRange { .. },
            Material,
            what,
            value,
            "allowed"
        );
    }
    // The paper's Table 1 with Picinbono's law: smallest eigenvalue −0.026 MPa.
    let m = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
    let error = refused(
        Tissue::transversely_isotropic(&[m], &[[1.0, 0.0, 0.0]], FibreLaw::Picinbono),
        ErrorKind::Material,
        true,
        &["tet 0", "indefinite", "young_along 0.5", "young_across 0.79", "picinbono"],
    );
    let IndefiniteMaterial { eigenvalue, .. } = error else { panic!("{error}") };
    assert!((eigenvalue + 0.026).abs() < 0.001, "{eigenvalue}");
    assert!(Tissue::transversely_isotropic(&[m], &[[1.0, 0.0, 0.0]], FibreLaw::Spencer).is_ok());

    let mut c = meshes::any_stiffness(1);
    c[3][3] = -1.0;
    assert_refused!(
        Tissue::from_stiffness(vec![meshes::any_stiffness(2), c]),
        IndefiniteMaterial { tet: 1, .. },
        Material,
        "tet 1",
        "smallest eigenvalue -"
    );
    let mut c = meshes::any_stiffness(1);
    c[0][4] += 0.1;
    assert_refused!(
        Tissue::from_stiffness(vec![c]),
        AsymmetricStiffness { tet: 0, row: 0, column: 4, .. },
        Material,
        "C[0][4]",
        "C[4][0]"
    );
    for fibre in [[0.0; 3], [0.7, 0.7, 0.0], [2.0, 0.0, 0.0]] {
        assert_refused!(
            Tissue::transversely_isotropic(&[m], &[fibre], FibreLaw::Spencer),
            FibreNotUnit { tet: 0, .. },
            Material,
            "fibre[0] has length"
        );
    }
    let preset = Preset::from_name("kim2010").unwrap();
    for p in [-0.1, 1.1] {
        let outcome = Tissue::mixture(&[0.3, p], &[[1.0, 0.0, 0.0]], preset, Mixing::Moduli);
        assert_refused!(outcome, OutOfRange { .. }, Material, "fraction[1]", &format!("{p}"));
    }
    assert_refused!(FibreLaw::from_name("hooke"), UnknownName { .. }, Material, "hooke", "spencer");
    assert_refused!(Mixing::from_name("x"), UnknownName { .. }, Material, "\"x\"", "moduli");
    assert_refused!(Preset::from_name("kim"), UnknownName { .. }, Material, "kim2010-swapped");
    assert_refused!(Method::from_name("lu"), UnknownName { .. }, Solver, "\"lu\"", "cholesky");
}
