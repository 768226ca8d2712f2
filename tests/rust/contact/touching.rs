//! Parts that may touch, against closed forms: pressed together, slid on each other, pulled apart, and on bone.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, Vec3, at, isotropic, joined, largest, largest_difference, near_exact,
    plan, plane, rigid, sliding, solver, sphere, surface, tensors,
};
use mtm_core::{
    Against, Boundary, Conflicts, ContactMode, ContactOptions, ErrorKind, Gap, Method, Motion,
    RigidMotion, Segment, Solution, StaticOptions, Surface, TetMesh, Tissue, TouchingPair,
};

const POISSON: f64 = 0.3;
/// What may be left between parts that touch, mm.
const CLOSE: f64 = 5e-3;

/// Two blocks, one over the other: their mesh and its parts.
struct Blocks {
    mesh: Arc<TetMesh>,
    /// Nodes of the bottom of the lower block and of the lid of the upper one.
    base: Vec<u32>,
    lid: Vec<u32>,
    /// Boundary triangles of the upper block's bottom and the lower block's top, and their nodes.
    above: Vec<[u32; 3]>,
    below: Vec<[u32; 3]>,
}

impl Blocks {
    /// Blocks of `cells` by 4 x 4 x 2 mm, `gap` mm apart.
    fn new(lower: [usize; 3], upper: [usize; 3], gap: f64) -> Self {
        let size = [4.0, 4.0, 2.0];
        let (mut nodes, mut tets) = BoxShape { cells: lower, size, jitter: 0.0 }.tets();
        let first = nodes.len() as u32;
        let (above, more) = BoxShape { cells: upper, size, jitter: 0.0 }.tets();
        nodes.extend(above.iter().map(|[x, y, z]| [*x, *y, z + 2.0 + gap]));
        tets.extend(more.iter().map(|tet| tet.map(|j| j + first)));
        let mesh = meshes::checked((nodes, tets));
        let at_height = |z: f64, from: u32, to: u32| -> Vec<u32> {
            let there = |j: &u32| (mesh.nodes()[*j as usize][2] - z).abs() < 1e-9;
            (from..to).filter(there).collect()
        };
        let n = mesh.n_nodes() as u32;
        let (base, top) = (at_height(0.0, 0, first), at_height(2.0, 0, first));
        let (bottom, lid) = (at_height(2.0 + gap, first, n), at_height(4.0 + gap, first, n));
        let faces = |of: &[u32]| -> Vec<[u32; 3]> {
            let all = mesh.boundary_triangles();
            all.iter().copied().filter(|t| t.iter().all(|j| of.contains(j))).collect()
        };
        let (above, below) = (faces(&bottom), faces(&top));
        Self { mesh, base, lid, above, below }
    }

    /// Both blocks may touch each other; the lid belongs to a segment.
    fn boundary(&self) -> Arc<Boundary> {
        let nodes = |triangles: &[[u32; 3]]| {
            let mut nodes: Vec<u32> = triangles.iter().flatten().copied().collect();
            nodes.sort_unstable();
            nodes.dedup();
            nodes
        };
        let pairs = vec![
            TouchingPair {
                nodes: nodes(&self.above),
                against: Against::Tissue(self.below.clone()),
            },
            TouchingPair {
                nodes: nodes(&self.below),
                against: Against::Tissue(self.above.clone()),
            },
        ];
        touching(vec![joined("lid", self.lid.clone()), joined("base", self.base.clone())], pairs)
    }

    /// Lower and upper tets with their own moduli.
    fn tissue(&self, lower: f64, upper: f64) -> Arc<Tissue> {
        let middle =
            |t: &[u32; 4]| t.iter().map(|j| self.mesh.nodes()[*j as usize][2]).sum::<f64>();
        let young = |t| if middle(t) < 8.0 { lower } else { upper };
        let each = |t| mtm_core::Elastic { young: young(t), poisson: POISSON };
        Arc::new(Tissue::isotropic(&self.mesh.tets().iter().map(each).collect::<Vec<_>>()).unwrap())
    }

    /// The lid as `motion` has it, sides free, the base spread by as much as the lid is: see `pressed`.
    fn solve(&self, tissue: &Arc<Tissue>, lid: Motion, base: Motion) -> Solution {
        let solver = solver(&tensors(&self.mesh, tissue), &self.boundary(), options()).unwrap();
        solver.solve(&plan([("lid", lid), ("base", base)]), None, GO_ON).unwrap()
    }
}

fn touching(segments: Vec<Segment>, pairs: Vec<TouchingPair>) -> Arc<Boundary> {
    let boundary = Boundary::new(vec![], segments, Conflicts::Refuse).unwrap();
    Arc::new(boundary.with_touching(pairs).unwrap())
}

fn options() -> StaticOptions {
    StaticOptions::default()
}

/// u = −ν ε (x, y) and ε z over a floor that stays, of nodes at heights `z`: compression by ε = −`strain`.
fn compressed(mesh: &TetMesh, strain: f64, z: impl Fn(f64) -> f64) -> Vec<[f64; 3]> {
    let side = POISSON * strain;
    mesh.nodes().iter().map(|x| [side * x[0], side * x[1], z(x[2])]).collect()
}

/// Springs in series: blocks of the same modulus share the shortening that the gap leaves, and spread alike.
#[test]
fn blocks_pressed_together_share_the_strain() {
    for gap in [0.0, 0.3] {
        let blocks = Blocks::new([4, 4, 2], [4, 4, 2], gap);
        let strain = 0.1;
        let way =
            |z: f64| if z < 2.0 + 0.5 * gap { -strain * z } else { -gap - strain * (z - gap) };
        let exact = compressed(&blocks.mesh, strain, way);
        let motion = |nodes: &[u32]| Motion::Nodes(at(&exact, nodes));
        let tissue = isotropic(0.01, POISSON);
        let found = blocks.solve(&tissue, motion(&blocks.lid), motion(&blocks.base));
        let e = largest_difference(&found.displacements, &exact);
        assert!(e <= 2.0 * CLOSE, "gap {gap}: {e} mm");
        assert!(found.touching.converged && found.touching.penetration() <= CLOSE);
        // Both pairs together bear the pressure E ε on 16 mm².
        let force: f64 = found.touching.forces.iter().sum();
        assert!((force - 0.01 * strain * 16.0).abs() < 0.01 * force, "{force} N");
        assert!(found.touching.forces.iter().all(|f| *f >= 0.0));
        assert!(found.residual < 1e-6, "{}", found.residual);
    }
}

/// The same with meshes that do not match, one twice as fine, and moduli 1 : 3: E₁ ε₁ = E₂ ε₂.
#[test]
fn blocks_of_other_meshes_and_moduli_press_alike() {
    let blocks = Blocks::new([3, 3, 2], [6, 6, 3], 0.0);
    let tissue = blocks.tissue(0.01, 0.03);
    let (soft, stiff) = (0.09, 0.03);
    // The ends of both are free to spread: only their heights are given, by smooth plates.
    let lid =
        Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 0.0, -2.0 * (soft + stiff)]));
    let found = blocks.solve(&tissue, lid, Motion::Rigid(RigidMotion::identity()));
    // Glued ends make both stiffer; the middles still share the way as 3 : 1 within a tenth.
    let middle = |nodes: &[[u32; 3]]| {
        let inner = nodes.iter().flatten().filter(|j| {
            let x = blocks.mesh.nodes()[**j as usize];
            (x[0] - 2.0).abs() < 0.8 && (x[1] - 2.0).abs() < 0.8
        });
        let ways: Vec<f64> = inner.map(|j| found.displacements[*j as usize][2]).collect();
        ways.iter().sum::<f64>() / ways.len() as f64
    };
    let (below, above) = (middle(&blocks.below), middle(&blocks.above));
    assert!((below - above).abs() < 0.02, "{below} {above}");
    let share = -below / (2.0 * (soft + stiff));
    assert!((share - 0.75).abs() < 0.08, "{share}");
    assert!(found.touching.penetration() <= CLOSE);
}

/// Without friction, pressed sheets slide on each other: the upper one moves aside as if it were alone, and what it
/// presses does not follow.
#[test]
fn pressed_sheets_slide_without_friction() {
    let blocks = Blocks::new([4, 4, 2], [4, 4, 2], 0.0);
    let tissue = isotropic(0.01, POISSON);
    let shift = Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.7, -0.4, 0.0]));
    let found = blocks.solve(&tissue, shift, Motion::Rigid(RigidMotion::identity()));
    for (j, x) in blocks.mesh.nodes().iter().enumerate() {
        let upper = j >= blocks.mesh.n_nodes() / 2;
        let expected = if upper { [0.7, -0.4, 0.0] } else { [0.0; 3] };
        let e = largest_difference(&[found.displacements[j]], &[expected]);
        assert!(e <= 2.0 * CLOSE, "{x:?}: {:?}", found.displacements[j]);
    }
}

/// Nothing holds parts together that are pulled apart.
#[test]
fn parts_that_are_pulled_apart_feel_nothing() {
    let blocks = Blocks::new([3, 3, 2], [3, 3, 2], 0.0);
    let away = Motion::Rigid(rigid([1.0, 0.0, 0.0], 0.0, [0.0; 3], [0.3, 0.2, 1.5]));
    let found =
        blocks.solve(&isotropic(0.01, POISSON), away, Motion::Rigid(RigidMotion::identity()));
    assert!(largest(&found.forces) < 1e-8, "{}", largest(&found.forces));
    assert!(found.touching.forces.iter().all(|f| *f == 0.0));
}

#[test]
fn nothing_moves_where_nothing_moves() {
    let blocks = Blocks::new([3, 3, 2], [3, 3, 2], 0.0);
    let stays = || Motion::Rigid(RigidMotion::identity());
    let found = blocks.solve(&isotropic(0.01, POISSON), stays(), stays());
    assert_eq!(largest(&found.displacements), 0.0);
}

/// A block under a ball that is pressed into it, by touching and by unilateral sliding: the same Signorini problem
/// by two solvers.
#[test]
fn an_obstacle_acts_as_unilateral_sliding() {
    let shape = BoxShape { cells: [8, 8, 4], size: [8.0, 8.0, 4.0], jitter: 0.1 };
    let mesh = meshes::checked(shape.tets());
    let (base, top) = (shape.side(2, false), shape.side(2, true));
    let (vertices, triangles) = sphere(4, 6.0);
    let ball = surface((
        vertices.iter().map(|[x, y, z]| [x + 4.0, y + 4.0, z + 10.0]).collect(),
        triangles,
    ));
    let down = || Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 0.0, -0.6]));
    let tissue = isotropic(0.003, 0.4);
    let tensors = tensors(&mesh, &tissue);
    let segments = || vec![joined("base", base.clone())];

    let slide = [segments(), vec![sliding("ball", top.clone(), &ball, Gap::Uniform(0.0))]].concat();
    let mode = ContactOptions { mode: ContactMode::Unilateral, ..near_exact() };
    let unilateral =
        StaticOptions { method: Method::Pcg, contact: mode, ..StaticOptions::default() };
    let stays = || Motion::Rigid(RigidMotion::identity());
    let bounds = Arc::new(Boundary::new(vec![], slide, Conflicts::Refuse).unwrap());
    let by_sliding = solver(&tensors, &bounds, unilateral)
        .unwrap()
        .solve(&plan([("base", stays()), ("ball", down())]), None, GO_ON)
        .unwrap();

    // A ball needs a node to be a segment: one of the base's corners would move with it. It stays here, and the
    // base comes up.
    let up = Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 0.0, 0.6]));
    let against = Against::Bone { surface: ball, segment: None };
    let bounds = touching(segments(), vec![TouchingPair { nodes: top, against }]);
    let by_touching = solver(&tensors, &bounds, options())
        .unwrap()
        .solve(&plan([("base", up)]), None, GO_ON)
        .unwrap();
    assert!(by_touching.touching.converged);
    let lowered: Vec<[f64; 3]> =
        by_touching.displacements.iter().map(|u| [u[0], u[1], u[2] - 0.6]).collect();
    let e = largest_difference(&by_sliding.displacements, &lowered);
    assert!(e <= 0.03, "{e} mm of {}", largest(&lowered));
    let (a, b): (f64, f64) =
        (by_sliding.contact.forces.iter().sum(), by_touching.touching.forces.iter().sum());
    assert!((a - b).abs() < 0.03 * a, "{a} {b} N");
}

/// A ridge as sharp as a right angle, pressed along a line of nodes and between two: each of these meets now one slope
/// and now the other, and the rounds come to an end all the same.
#[test]
fn nodes_on_a_sharp_ridge_come_to_rest() {
    let shape = BoxShape { cells: [8, 8, 4], size: [8.0, 8.0, 4.0], jitter: 0.1 };
    let mesh = meshes::checked(shape.tets());
    let (base, top) = (shape.side(2, false), shape.side(2, true));
    let (tensors, columns) = (tensors(&mesh, &isotropic(0.003, 0.4)), 20);
    for ridge in [4.0, 4.37] {
        let vertices = (0..columns * columns).map(|k| {
            let (x, y) = (0.5 * (k % columns) as f64 - 5.0, 0.5 * (k / columns) as f64 - 0.75);
            [ridge + x, y, 4.0 + x.abs()]
        });
        let cells = (0..columns - 1).flat_map(|j| (0..columns - 1).map(move |i| (i, j)));
        let triangles = cells.flat_map(|(i, j)| {
            let corner = |a: usize, b: usize| ((j + b) * columns + i + a) as u32;
            [[corner(0, 0), corner(1, 1), corner(1, 0)], [corner(0, 0), corner(0, 1), corner(1, 1)]]
        });
        let against = Against::Bone {
            surface: surface((vertices.collect(), triangles.collect())),
            segment: None,
        };
        let bounds = touching(
            vec![joined("base", base.clone())],
            vec![TouchingPair { nodes: top.clone(), against }],
        );
        let up = Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.1, 0.0, 0.9]));
        let solver = solver(&tensors, &bounds, options()).unwrap();
        let found = solver.solve(&plan([("base", up)]), None, GO_ON).unwrap();
        assert!(found.touching.converged, "{} rounds", found.touching.rounds);
        assert!(found.touching.penetration() <= CLOSE, "{}", found.touching.penetration());
        let force: f64 = found.touching.forces.iter().sum();
        assert!(force > 1e-3 && found.error_estimate < 0.02, "{force} N");
        assert!(found.residual < 1e-6, "{}", found.residual);
    }
}

/// Forces between parts are equal and opposite, along the normals.
#[test]
fn forces_between_parts_balance() {
    let blocks = Blocks::new([3, 4, 2], [5, 3, 2], 0.1);
    let tilt = Motion::Rigid(rigid([0.3, 1.0, 0.2], 4.0, [2.0, 2.0, 4.0], [0.2, 0.1, -0.5]));
    let found =
        blocks.solve(&isotropic(0.01, POISSON), tilt, Motion::Rigid(RigidMotion::identity()));
    let mut sum = Vec3::zeros();
    for (j, f) in found.forces.iter().enumerate() {
        if !blocks.lid.contains(&(j as u32)) && !blocks.base.contains(&(j as u32)) {
            sum += Vec3::from(*f);
        }
    }
    let press: f64 = found.touching.forces.iter().sum();
    assert!(press > 0.0 && sum.norm() < 1e-6 * press, "{sum:?} of {press} N");
    assert!(found.touching.penetration() <= CLOSE);
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let found = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let blocks = Blocks::new([3, 4, 2], [5, 3, 2], 0.1);
            let down =
                Motion::Rigid(rigid([1.0, 0.0, 0.0], 2.0, [2.0, 2.0, 4.0], [0.0, 0.1, -0.4]));
            let tissue = isotropic(0.01, POISSON);
            meshes::bits(
                &blocks.solve(&tissue, down, Motion::Rigid(RigidMotion::identity())).displacements,
            )
        })
    };
    assert_eq!(found(1), found(3));
}

#[test]
fn what_does_not_fit_is_refused_with_its_remedy() {
    let blocks = Blocks::new([2, 2, 2], [2, 2, 2], 0.0);
    let segments = || vec![joined("lid", blocks.lid.clone()), joined("base", blocks.base.clone())];
    let with = |pair: TouchingPair| {
        let boundary = Boundary::new(vec![], segments(), Conflicts::Refuse).unwrap();
        let boundary = boundary.with_touching(vec![pair])?;
        let tensors = tensors(&blocks.mesh, &isotropic(0.01, POISSON));
        solver(&tensors, &Arc::new(boundary), options()).map(|_| ())
    };
    let tissue = |nodes: Vec<u32>, triangles: Vec<[u32; 3]>| TouchingPair {
        nodes,
        against: Against::Tissue(triangles),
    };
    let ball: Arc<Surface> = surface(plane(2, 5.0, 0.0));
    let turned: Vec<[u32; 3]> = blocks.above.iter().map(|[a, b, c]| [*a, *c, *b]).collect();
    let cases = [
        (tissue(vec![], blocks.above.clone()), "no nodes"),
        (tissue(vec![0], vec![]), "no triangles"),
        (tissue(vec![0], turned), "reverse"),
        (tissue(vec![0], vec![[0, 1, 2]]), "no triangle of the mesh's boundary"),
        (tissue(vec![9999], blocks.above.clone()), "9999"),
        (
            TouchingPair {
                nodes: vec![0],
                against: Against::Bone { surface: ball, segment: Some("nose".into()) },
            },
            "nose",
        ),
    ];
    for (pair, expected) in cases {
        let error = with(pair).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
        assert_eq!(error.kind(), ErrorKind::Boundary);
    }
    for method in [Method::Cholesky, Method::Relaxation] {
        let tensors = tensors(&blocks.mesh, &isotropic(0.01, POISSON));
        let options = StaticOptions { method, ..options() };
        let error = solver(&tensors, &blocks.boundary(), options).map(|_| ()).unwrap_err();
        assert!(error.to_string().contains("pcg"), "{error}");
    }
}
