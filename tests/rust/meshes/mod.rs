//! Procedural meshes, surfaces, motions and solvers that the tests share.
#![allow(dead_code)] // the bench that includes this file uses a part of it

use std::collections::HashMap;
use std::sync::Arc;

use mtm_core::{
    Boundary, Conflicts, ContactOptions, Elastic, FibreElastic, FibreLaw, Gap, MassTensors, Method,
    Motion, Plan, Result, RigidMotion, Segment, Solution, StaticOptions, StaticSolver, Surface,
    TetMesh, Tissue, Voigt,
};
use nalgebra::{Matrix3, Matrix6, Rotation3, Unit, Vector3};

pub type Vec3 = Vector3<f64>;

/// Nodes with their tets.
pub type Tets = (Vec<[f64; 3]>, Vec<[u32; 4]>);
/// Vertices with their triangles.
pub type Triangles = (Vec<[f64; 3]>, Vec<[u32; 3]>);

/// Never stops a solve.
pub const GO_ON: &(dyn Fn() -> bool + Sync) = &|| false;

/// Deterministic numbers in −1 to 1 (SplitMix64).
pub struct Numbers(pub u64);

impl Numbers {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    pub fn point(&mut self) -> [f64; 3] {
        [self.next(), self.next(), self.next()]
    }

    pub fn points(&mut self, n: usize) -> Vec<[f64; 3]> {
        (0..n).map(|_| self.point()).collect()
    }

    pub fn unit(&mut self) -> [f64; 3] {
        loop {
            let v = Vec3::from(self.point());
            if v.norm() > 0.1 {
                return v.normalize().into();
            }
        }
    }
}

/// Size of a box mesh.
#[derive(Debug, Clone, Copy)]
pub struct BoxShape {
    /// Cubes along each axis.
    pub cells: [usize; 3],
    /// Lengths along each axis, mm, from the origin.
    pub size: [f64; 3],
    /// How far inner nodes leave their place, over the smallest spacing; below 0.2 no tet inverts.
    pub jitter: f64,
}

impl BoxShape {
    /// A box of `n` cubes a side, 1 mm each, with inner nodes out of place.
    pub fn cube(n: usize) -> Self {
        Self { cells: [n; 3], size: [n as f64; 3], jitter: 0.15 }
    }

    /// Node at a lattice place.
    pub fn node(&self, [i, j, k]: [usize; 3]) -> u32 {
        let [_, ny, nz] = self.cells;
        ((i * (ny + 1) + j) * (nz + 1) + k) as u32
    }

    /// Nodes whose lattice place satisfies `keep`, ascending.
    pub fn nodes_where(&self, keep: impl Fn([usize; 3]) -> bool) -> Vec<u32> {
        let [nx, ny, nz] = self.cells;
        let mut out = Vec::new();
        for i in 0..=nx {
            for j in 0..=ny {
                for k in 0..=nz {
                    if keep([i, j, k]) {
                        out.push(self.node([i, j, k]));
                    }
                }
            }
        }
        out
    }

    /// Nodes on the six sides.
    pub fn hull(&self) -> Vec<u32> {
        let n = self.cells;
        self.nodes_where(|p| (0..3).any(|a| p[a] == 0 || p[a] == n[a]))
    }

    /// Nodes on the side `axis` = 0 or its full length.
    pub fn side(&self, axis: usize, far: bool) -> Vec<u32> {
        let end = if far { self.cells[axis] } else { 0 };
        self.nodes_where(|p| p[axis] == end)
    }

    /// The mesh: six tets a cube round its diagonal (Kuhn 1960), which fit across cubes.
    pub fn tets(&self) -> Tets {
        let [nx, ny, nz] = self.cells;
        let spacing = [0, 1, 2].map(|a| self.size[a] / self.cells[a] as f64);
        let reach = self.jitter * spacing.iter().copied().fold(f64::INFINITY, f64::min);
        let mut numbers = Numbers(7);
        let mut nodes = Vec::new();
        for i in 0..=nx {
            for j in 0..=ny {
                for k in 0..=nz {
                    let place = [i, j, k];
                    let inner = (0..3).all(|a| place[a] > 0 && place[a] < self.cells[a]);
                    let d = numbers.point();
                    nodes.push([0, 1, 2].map(|a| {
                        place[a] as f64 * spacing[a] + if inner { reach * d[a] } else { 0.0 }
                    }));
                }
            }
        }
        const WAYS: [[usize; 3]; 6] =
            [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
        let mut tets = Vec::new();
        for i in 0..nx {
            for j in 0..ny {
                for k in 0..nz {
                    for way in WAYS {
                        let mut at = [i, j, k];
                        let mut tet = [self.node(at); 4];
                        for (corner, axis) in way.into_iter().enumerate() {
                            at[axis] += 1;
                            tet[corner + 1] = self.node(at);
                        }
                        tets.push(oriented(&nodes, tet));
                    }
                }
            }
        }
        (nodes, tets)
    }

    pub fn mesh(&self) -> Arc<TetMesh> {
        checked(self.tets())
    }
}

/// `tet` with positive volume.
pub fn oriented(nodes: &[[f64; 3]], mut tet: [u32; 4]) -> [u32; 4] {
    let [a, b, c, d] = tet.map(|v| Vec3::from(nodes[v as usize]));
    if (b - a).cross(&(c - a)).dot(&(d - a)) < 0.0 {
        tet.swap(2, 3);
    }
    tet
}

pub fn checked((nodes, tets): Tets) -> Arc<TetMesh> {
    Arc::new(TetMesh::new(nodes, tets).unwrap())
}

/// Unit sphere: an icosahedron with each triangle split in four `levels` times, normals outward.
///
/// At levels 0 and 1 every vertex lies on a symmetry axis, so all its averaged normals are radial.
pub fn icosphere(levels: usize) -> Triangles {
    let g = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let mut vertices: Vec<Vec3> = Vec::new();
    for (s, t) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        vertices.push(Vec3::new(0.0, s, t * g).normalize());
        vertices.push(Vec3::new(s, t * g, 0.0).normalize());
        vertices.push(Vec3::new(t * g, 0.0, s).normalize());
    }
    let edge =
        vertices.iter().skip(1).map(|v| (v - vertices[0]).norm()).fold(f64::INFINITY, f64::min);
    let near = |a: usize, b: usize| (vertices[a] - vertices[b]).norm() < 1.1 * edge;
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    for a in 0..12 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                if near(a, b) && near(b, c) && near(c, a) {
                    let [x, y, z] = [a, b, c].map(|v| vertices[v]);
                    let out = (y - x).cross(&(z - x)).dot(&x) > 0.0;
                    let [b, c] = if out { [b, c] } else { [c, b] };
                    triangles.push([a as u32, b as u32, c as u32]);
                }
            }
        }
    }
    for _ in 0..levels {
        let mut middles: HashMap<(u32, u32), u32> = HashMap::new();
        let mut split = Vec::with_capacity(4 * triangles.len());
        for [a, b, c] in triangles {
            let mut middle = |p: u32, q: u32| {
                *middles.entry((p.min(q), p.max(q))).or_insert_with(|| {
                    vertices.push((vertices[p as usize] + vertices[q as usize]).normalize());
                    vertices.len() as u32 - 1
                })
            };
            let [ab, bc, ca] = [middle(a, b), middle(b, c), middle(c, a)];
            split.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = split;
    }
    (vertices.into_iter().map(Into::into).collect(), triangles)
}

/// Sphere of `radius` round the origin, normals outward.
pub fn sphere(levels: usize, radius: f64) -> Triangles {
    let (vertices, triangles) = icosphere(levels);
    (vertices.iter().map(|v| v.map(|x| radius * x)).collect(), triangles)
}

/// Size of a spherical shell mesh.
#[derive(Debug, Clone, Copy)]
pub struct ShellShape {
    /// Splits of the icosahedron.
    pub levels: usize,
    /// Layers of prisms through the thickness.
    pub layers: usize,
    /// Radii, mm.
    pub inner: f64,
    pub outer: f64,
}

impl ShellShape {
    fn n_columns(&self) -> usize {
        10 * (1 << (2 * self.levels)) + 2
    }

    /// Nodes on layer `layer`, in the order of the icosphere's vertices.
    pub fn layer(&self, layer: usize) -> Vec<u32> {
        let n = self.n_columns();
        (layer * n..(layer + 1) * n).map(|j| j as u32).collect()
    }

    /// The mesh: prisms over the triangles, three tets each; a side's diagonal rises from the lower
    /// vertex number to the higher, so that neighbours agree.
    pub fn tets(&self) -> Tets {
        let (directions, triangles) = icosphere(self.levels);
        let n = directions.len() as u32;
        let mut nodes = Vec::new();
        for layer in 0..=self.layers {
            let r = self.inner + (self.outer - self.inner) * layer as f64 / self.layers as f64;
            nodes.extend(directions.iter().map(|d| d.map(|x| r * x)));
        }
        let mut tets = Vec::new();
        for layer in 0..self.layers as u32 {
            for triangle in &triangles {
                let mut sorted = *triangle;
                sorted.sort_unstable();
                let [a, b, c] = sorted.map(|v| layer * n + v);
                for tet in [[a, b, c, c + n], [a, b, b + n, c + n], [a, a + n, b + n, c + n]] {
                    tets.push(oriented(&nodes, tet));
                }
            }
        }
        (nodes, tets)
    }

    pub fn mesh(&self) -> Arc<TetMesh> {
        checked(self.tets())
    }
}

/// Rectangle z = 0 from (−reach, −reach) to (reach, reach) in `n`² squares, normals +z; `skew` moves
/// inner vertices within the plane, over the spacing, and alternates the diagonals.
pub fn plane(n: usize, reach: f64, skew: f64) -> Triangles {
    let mut numbers = Numbers(11);
    let mut vertices = Vec::new();
    let spacing = 2.0 * reach / n as f64;
    for i in 0..=n {
        for j in 0..=n {
            let inner = i > 0 && j > 0 && i < n && j < n;
            let d = if inner { skew * spacing } else { 0.0 };
            vertices.push([
                i as f64 * spacing - reach + d * numbers.next(),
                j as f64 * spacing - reach + d * numbers.next(),
                0.0,
            ]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..n {
        for j in 0..n {
            let a = (i * (n + 1) + j) as u32;
            let (b, d) = (a + n as u32 + 1, a + 1);
            let c = b + 1;
            if skew == 0.0 || (i + j) % 2 == 0 {
                triangles.extend([[a, b, c], [a, c, d]]);
            } else {
                triangles.extend([[a, b, d], [b, c, d]]);
            }
        }
    }
    (vertices, triangles)
}

pub fn surface((vertices, triangles): Triangles) -> Arc<Surface> {
    Arc::new(Surface::new(vertices, triangles).unwrap())
}

/// Turn by `degrees` about `axis` through `centre`, then shift by `translation`.
pub fn rigid(axis: [f64; 3], degrees: f64, centre: [f64; 3], translation: [f64; 3]) -> RigidMotion {
    let r = Rotation3::from_axis_angle(&Unit::new_normalize(axis.into()), degrees.to_radians());
    let t = Vec3::from(translation) + Vec3::from(centre) - r * Vec3::from(centre);
    let mut matrix = [[0.0; 4]; 4];
    for i in 0..3 {
        for j in 0..3 {
            matrix[i][j] = r[(i, j)];
        }
        matrix[i][3] = t[i];
    }
    matrix[3][3] = 1.0;
    RigidMotion::new("test", &matrix).unwrap()
}

/// `points` under a rigid motion.
pub fn carried(motion: &RigidMotion, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    points.iter().map(|&x| motion.apply(x)).collect()
}

pub fn isotropic(young: f64, poisson: f64) -> Arc<Tissue> {
    Arc::new(Tissue::isotropic(&[Elastic { young, poisson }]).unwrap())
}

pub fn along_fibre(moduli: FibreElastic, fibre: [f64; 3]) -> Arc<Tissue> {
    Arc::new(Tissue::transversely_isotropic(&[moduli], &[fibre], FibreLaw::Spencer).unwrap())
}

/// A random symmetric positive definite stiffness (condition of about 30), MPa.
pub fn any_stiffness(seed: u64) -> Voigt {
    let mut numbers = Numbers(seed);
    let m = Matrix6::from_fn(|_, _| numbers.next());
    let c = m * m.transpose() + Matrix6::identity() * 0.3;
    let mut out = [[0.0; 6]; 6];
    for i in 0..6 {
        for j in 0..6 {
            out[i][j] = 0.5 * (c[(i, j)] + c[(j, i)]);
        }
    }
    out
}

/// Isotropic rows with a contrast of `contrast` between two kinds of tets in turn.
pub fn contrasting(n_tets: usize, contrast: f64) -> Arc<Tissue> {
    let rows: Vec<Elastic> = (0..n_tets)
        .map(|t| {
            let stiff = (t / 24) % 3 == 0;
            Elastic { young: if stiff { 0.003 * contrast } else { 0.003 }, poisson: 0.45 }
        })
        .collect();
    Arc::new(Tissue::isotropic(&rows).unwrap())
}

/// One uniform tissue of each kind.
pub fn tissues() -> Vec<(&'static str, Arc<Tissue>)> {
    let moduli = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
    let fibre: [f64; 3] = Vec3::new(1.0, -2.0, 0.5).normalize().into();
    vec![
        ("isotropic", isotropic(0.01, 0.46)),
        ("transversely isotropic", along_fibre(moduli, fibre)),
        ("general", Arc::new(Tissue::from_stiffness(vec![any_stiffness(3)]).unwrap())),
    ]
}

pub fn tensors(mesh: &Arc<TetMesh>, tissue: &Arc<Tissue>) -> Arc<MassTensors> {
    Arc::new(MassTensors::new(mesh.clone(), tissue.clone()).unwrap())
}

/// A segment of joined nodes.
pub fn joined(name: &str, nodes: Vec<u32>) -> Segment {
    Segment {
        name: name.into(),
        joined: nodes,
        sliding: Vec::new(),
        contact: None,
        gap: Gap::Uniform(0.0),
    }
}

/// A segment of nodes that slide on `contact`.
pub fn sliding(name: &str, nodes: Vec<u32>, contact: &Arc<Surface>, gap: Gap) -> Segment {
    Segment {
        name: name.into(),
        joined: Vec::new(),
        sliding: nodes,
        contact: Some(contact.clone()),
        gap,
    }
}

pub fn boundary(fixed: Vec<u32>, segments: Vec<Segment>) -> Arc<Boundary> {
    Arc::new(Boundary::new(fixed, segments, Conflicts::Resolve).unwrap())
}

/// A plan from pairs of names and motions.
pub fn plan<const N: usize>(motions: [(&str, Motion); N]) -> Plan {
    motions.into_iter().map(|(name, motion)| (name.to_owned(), motion)).collect()
}

pub fn stays() -> Motion {
    Motion::Rigid(RigidMotion::identity())
}

pub fn with_method(method: Method) -> StaticOptions {
    StaticOptions { method, contact: near_exact(), ..StaticOptions::default() }
}

/// Contact as exact as closed forms are compared.
pub fn near_exact() -> ContactOptions {
    ContactOptions { tolerance: 1e-8, ..ContactOptions::default() }
}

pub fn solver(
    tensors: &Arc<MassTensors>,
    boundary: &Arc<Boundary>,
    options: StaticOptions,
) -> Result<StaticSolver> {
    StaticSolver::new(tensors.clone(), boundary.clone(), options, GO_ON)
}

/// Set-up and solve in one.
pub fn solve(
    tensors: &Arc<MassTensors>,
    boundary: &Arc<Boundary>,
    options: StaticOptions,
    plan: &Plan,
    loads: Option<&[[f64; 3]]>,
) -> Result<Solution> {
    solver(tensors, boundary, options)?.solve(plan, loads, GO_ON)
}

/// Largest distance between two fields.
pub fn largest_difference(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (Vec3::from(*a) - Vec3::from(*b)).norm()).fold(0.0, f64::max)
}

/// Length of the longest vector of a field.
pub fn largest(a: &[[f64; 3]]) -> f64 {
    a.iter().map(|v| Vec3::from(*v).norm()).fold(0.0, f64::max)
}

/// u = H x + t at every node.
pub fn affine(nodes: &[[f64; 3]], h: Matrix3<f64>, t: Vec3) -> Vec<[f64; 3]> {
    nodes.iter().map(|&x| (h * Vec3::from(x) + t).into()).collect()
}

/// Rows of `field` at `nodes`.
pub fn at(field: &[[f64; 3]], nodes: &[u32]) -> Vec<[f64; 3]> {
    nodes.iter().map(|&j| field[j as usize]).collect()
}

/// Bits of a field, to compare without tolerance.
pub fn bits(field: &[[f64; 3]]) -> Vec<u64> {
    field.iter().flatten().map(|v| v.to_bits()).collect()
}
