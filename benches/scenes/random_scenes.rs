//! Random scenes with stiff and soft tissue mixed, and their solutions to 32 digits: what the error
//! estimates are measured against. Shared by `benches/stability/error_estimate.rs` and `tests/rust/statics/error_estimate.rs`,
//! whose crates hold the module `meshes`.

use std::sync::Arc;

use mtm_core::{
    Boundary, Conflicts, Elastic, Element, FibreElastic, FibreLaw, Gap, MassTensors, Method,
    Motion, MtmError, NodeKind, Plan, Result, RigidMotion, Segment, StaticOptions, StaticSolver,
    Tissue,
};

use crate::meshes::{BoxShape, GO_ON, Numbers, checked, plane, rigid, surface};

/// Corrections after which a refinement that has not converged is given up.
const MAX_CORRECTIONS: usize = 80;
/// Last correction over the displacements at which a refinement has converged.
const CONVERGED: f64 = 1e-18;
/// Work of a banded factorisation in pairs of doubles that is still worth waiting for.
const MAX_BAND_WORK: f64 = 3e9;

/// A scene with one plan.
pub struct Scene {
    pub tensors: Arc<MassTensors>,
    pub boundary: Arc<Boundary>,
    pub plan: Plan,
    pub loads: Option<Vec<[f64; 3]>>,
    /// Tolerance that the iterative method is asked for.
    pub tolerance: f64,
    /// Decades between the stiffest and the softest modulus asked for.
    pub decades: f64,
    /// Axis along which sliding nodes are held, and how far their plane moves along it, mm.
    slides: Option<(usize, f64)>,
    pub description: String,
}

impl Scene {
    /// The scene number `index` of a series: the same on every machine. Some numbers give none that holds
    /// together.
    ///
    /// `most_nodes`: 60 or more.
    pub fn random(seed: u64, index: u64, most_nodes: usize) -> Result<Self> {
        let mut draw = Draw(Numbers(seed ^ index.wrapping_mul(0x9e6c_63d0_876a_3f6b)));
        for _ in 0..20 {
            draw.0.next();
        }
        let shape = draw.shape(most_nodes);
        let decades = draw.between(0.0, 10.0);
        let (nodes, tets) = shape.tets();
        let mesh = checked((nodes, tets));
        let (pattern, young) = draw.moduli(&shape, mesh.n_tets(), decades);
        let (poisson_text, poisson) = draw.poisson(mesh.n_tets());
        let fibres = draw.chance(0.15);
        let tissue = if fibres {
            let anisotropy = draw.between(-2.0, 2.0);
            let moduli: Vec<FibreElastic> = (0..mesh.n_tets())
                .map(|t| FibreElastic {
                    young_along: young[t] * 10_f64.powf(anisotropy),
                    young_across: young[t],
                    poisson: poisson[t].min(0.49),
                })
                .collect();
            let axes: Vec<[f64; 3]> = (0..mesh.n_tets()).map(|_| draw.0.unit()).collect();
            Tissue::transversely_isotropic(&moduli, &axes, FibreLaw::Spencer)?
        } else {
            let rows: Vec<Elastic> = young
                .iter()
                .zip(&poisson)
                .map(|(&young, &poisson)| Elastic { young, poisson })
                .collect();
            Tissue::isotropic(&rows)?
        };
        let averaged = draw.chance(0.08);
        let element = if averaged { Element::NodalPressure } else { Element::Linear };
        let tensors = Arc::new(MassTensors::with_element(mesh.clone(), Arc::new(tissue), element)?);
        let softest = young.iter().fold(f64::INFINITY, |m, &e| m.min(e));
        let held = draw.holding(&shape, softest)?;
        let tolerance =
            if draw.chance(0.7) { 1e-8 } else { 10_f64.powf(draw.between(-10.0, -4.0)) };
        let description = format!(
            "{}x{}x{} cubes, {} nodes, {pattern} over {decades:.1} decades, {poisson_text}{}, {}, {}, \
             tolerance {tolerance:.0e}",
            shape.cells[0],
            shape.cells[1],
            shape.cells[2],
            mesh.n_nodes(),
            if fibres { ", fibres" } else { "" },
            element.name(),
            held.text,
        );
        Ok(Self {
            tensors,
            boundary: Arc::new(held.boundary),
            plan: held.plan,
            loads: held.loads,
            tolerance,
            decades,
            slides: held.slides,
            description,
        })
    }

    /// What `method` makes of the scene.
    pub fn solve(&self, method: Method) -> Result<mtm_core::Solution> {
        let options =
            StaticOptions { method, tolerance: self.tolerance, ..StaticOptions::default() };
        let solver =
            StaticSolver::new(self.tensors.clone(), self.boundary.clone(), options, GO_ON)?;
        solver.solve(&self.plan, self.loads.as_deref(), GO_ON)
    }

    /// The displacements that solve the equations as they are stored, by Cholesky's method refined with
    /// residuals in pairs of doubles (Dekker 1971; Demmel et al. 2006), mm.
    ///
    /// None where the corrections do not become less than rounding.
    pub fn refined(&self) -> Option<Vec<[f64; 3]>> {
        let options = StaticOptions { method: Method::Cholesky, ..StaticOptions::default() };
        let solver =
            StaticSolver::new(self.tensors.clone(), self.boundary.clone(), options, GO_ON).ok()?;
        let equations = Equations::new(self)?;
        let mut u = equations.begin();
        let still: Plan = self
            .plan
            .iter()
            .map(|(name, _)| (name.clone(), Motion::Rigid(RigidMotion::identity())))
            .collect();
        let mut before = f64::INFINITY;
        for _ in 0..MAX_CORRECTIONS {
            let r = equations.residual(&u);
            let forces: Vec<[f64; 3]> = r.iter().map(|r| r.map(|v| v.0)).collect();
            let correction = if forces.as_flattened().iter().all(|&f| f == 0.0) {
                vec![[0.0; 3]; u.len()]
            } else {
                solver.solve(&still, Some(&forces), GO_ON).ok()?.displacements
            };
            let mut largest = 0.0_f64;
            for (j, d) in correction.iter().enumerate() {
                for i in (0..3).filter(|&i| equations.free[j][i]) {
                    u[j][i] = u[j][i].plus(Pair(d[i], 0.0));
                    largest = largest.max(d[i].abs());
                }
            }
            if largest <= CONVERGED * size(&u) {
                return Some(u.iter().map(|u| u.map(|v| v.0)).collect());
            }
            if largest > 0.5 * before {
                return None;
            }
            before = largest;
        }
        None
    }

    /// The same by L D Lᵀ in pairs of doubles within the band, which shares nothing with Cholesky's method
    /// here; none where the band is too wide or a pivot is not positive.
    pub fn factored_in_pairs(&self) -> Option<Vec<[f64; 3]>> {
        let equations = Equations::new(self)?;
        let mut u = equations.begin();
        // Twice: the second correction tells that the first was exact.
        let factor = BandFactor::new(self.tensors.matrix(), &equations.free)?;
        let mut last = f64::INFINITY;
        for _ in 0..4 {
            let d = factor.solve(&equations.residual(&u));
            let mut largest = 0.0_f64;
            for (u, d) in u.iter_mut().flatten().zip(d.iter().flatten()) {
                *u = u.plus(*d);
                largest = largest.max(d.0.abs());
            }
            last = largest;
        }
        (last <= CONVERGED * size(&u)).then(|| u.iter().map(|u| u.map(|v| v.0)).collect())
    }

    /// The solution to compare with, by whichever way gives one.
    pub fn reference(&self) -> Option<Vec<[f64; 3]>> {
        self.refined().or_else(|| self.factored_in_pairs())
    }
}

/// Largest distance of a node between two fields, mm.
pub fn farthest(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    let distance =
        |(a, b): (&[f64; 3], &[f64; 3])| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt();
    a.iter().zip(b).map(distance).fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

/// Largest displacement, mm.
pub fn largest(u: &[[f64; 3]]) -> f64 {
    farthest(u, &vec![[0.0; 3]; u.len()])
}

/// What is drawn for a scene.
struct Draw(Numbers);

/// How a body is held and moved.
struct Holding {
    boundary: Boundary,
    plan: Plan,
    loads: Option<Vec<[f64; 3]>>,
    slides: Option<(usize, f64)>,
    text: &'static str,
}

impl Draw {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * 0.5 * (self.0.next() + 1.0)
    }

    fn chance(&mut self, share: f64) -> bool {
        self.between(0.0, 1.0) < share
    }

    fn below(&mut self, n: usize) -> usize {
        (self.between(0.0, n as f64) as usize).min(n - 1)
    }

    /// A bar, a plate or a block, of 50 nodes or so up to `most`.
    fn shape(&mut self, most: usize) -> BoxShape {
        let wanted = 50.0 * (most as f64 / 50.0).powf(self.between(0.0, 1.0));
        let cells = match self.below(3) {
            0 => {
                let [a, b] = [1 + self.below(3), 1 + self.below(3)];
                let length = wanted / ((a + 1) * (b + 1)) as f64;
                [(length as usize).max(2), a, b]
            }
            1 => {
                let thickness = 1 + self.below(2);
                let face = wanted / (thickness + 1) as f64;
                let wide = (self.between(0.3, 1.0) * face.sqrt()) as usize;
                let wide = wide.max(2);
                [((face / (wide + 1) as f64) as usize).max(2), wide, thickness]
            }
            _ => {
                let side = wanted.cbrt();
                let [a, b] = [0.7, 1.0].map(|least| {
                    ((self.between(least, 1.3) * side) as usize).saturating_sub(1).max(2)
                });
                [((wanted / ((a + 1) * (b + 1)) as f64) as usize).max(2), a, b]
            }
        };
        let reach = if self.chance(0.25) { 1.2 } else { 0.4 };
        let edge = 10_f64.powf(self.between(-0.3, 0.9));
        let size = cells.map(|n| n as f64 * edge * 10_f64.powf(self.between(-reach, reach)));
        BoxShape { cells, size, jitter: if self.chance(0.5) { 0.15 } else { 0.0 } }
    }

    /// Young's modulus of every tet, MPa, and the name of the pattern.
    fn moduli(&mut self, shape: &BoxShape, n: usize, decades: f64) -> (&'static str, Vec<f64>) {
        let softest = 10_f64.powf(self.between(-3.0, 0.0));
        // Six tets a cube, cubes along the last axis first.
        let [nx, ny, nz] = shape.cells;
        let cube = |t: usize| {
            let c = t / 6;
            [c / (ny * nz), (c / nz) % ny, c % nz]
        };
        let exponent = |value: f64| softest * 10_f64.powf(value);
        match self.below(8) {
            0 | 1 => {
                let young = (0..n).map(|_| exponent(self.between(0.0, decades))).collect();
                ("random tets", young)
            }
            2 | 3 => {
                let stiff = self.between(0.02, 0.98);
                let young = (0..n)
                    .map(|_| exponent(if self.chance(stiff) { decades } else { 0.0 }))
                    .collect();
                ("stiff and soft tets", young)
            }
            4 => {
                let axis = self.below(3);
                let layers: Vec<f64> =
                    (0..shape.cells[axis]).map(|_| self.between(0.0, decades)).collect();
                ("layers", (0..n).map(|t| exponent(layers[cube(t)[axis]])).collect())
            }
            5 => {
                let cubes: Vec<f64> =
                    (0..nx * ny * nz).map(|_| self.between(0.0, decades)).collect();
                ("random cubes", (0..n).map(|t| exponent(cubes[t / 6])).collect())
            }
            6 => {
                let inverse = self.chance(0.4);
                let islands: Vec<([f64; 3], f64)> = (0..1 + self.below(6))
                    .map(|_| {
                        let centre = shape.cells.map(|n| self.between(0.0, n as f64));
                        (centre, self.between(0.8, 3.0))
                    })
                    .collect();
                let young = (0..n)
                    .map(|t| {
                        let at = cube(t).map(|v| v as f64 + 0.5);
                        let within = islands.iter().any(|(c, r)| {
                            (0..3).map(|i| (at[i] - c[i]).powi(2)).sum::<f64>() < r * r
                        });
                        exponent(if within == inverse { 0.0 } else { decades })
                    })
                    .collect();
                (if inverse { "soft islands" } else { "stiff islands" }, young)
            }
            _ => ("uniform", vec![softest; n]),
        }
    }

    fn poisson(&mut self, n: usize) -> (String, Vec<f64>) {
        if self.chance(0.2) {
            return ("any ν".into(), (0..n).map(|_| self.between(0.0, 0.4999)).collect());
        }
        let nu = [0.3, 0.3, 0.46, 0.46, 0.49, 0.499, 0.4999][self.below(7)];
        (format!("ν = {nu}"), vec![nu; n])
    }

    fn loads(&mut self, n: usize, softest: f64) -> Vec<[f64; 3]> {
        let mut loads = vec![[0.0; 3]; n];
        if self.chance(0.5) {
            let at = self.below(n);
            loads[at] = self.0.point().map(|x| softest * x);
        } else {
            for f in &mut loads {
                *f = self.0.point().map(|x| softest * x);
            }
        }
        loads
    }

    fn motion(&mut self, shape: &BoxShape) -> Motion {
        let translation = self.0.point().map(|x| 5.0 * x);
        let degrees = if self.chance(0.5) { self.between(-8.0, 8.0) } else { 0.0 };
        let centre = shape.size.map(|s| 0.5 * s);
        Motion::Rigid(rigid(self.0.unit(), degrees, centre, translation))
    }

    fn holding(&mut self, shape: &BoxShape, softest: f64) -> Result<Holding> {
        let n = shape.nodes_where(|_| true).len();
        let [near, far] = [shape.side(0, false), shape.side(0, true)];
        let joined = |nodes: Vec<u32>| Segment {
            name: "bone".into(),
            joined: nodes,
            sliding: vec![],
            contact: None,
            gap: Gap::Uniform(0.0),
        };
        let named = |motion: Motion| vec![("bone".to_string(), motion)];
        let way = self.below(12);
        let (fixed, segments, plan, loads, text) = match way {
            0..=4 => {
                let motion = self.motion(shape);
                (near, vec![joined(far)], named(motion), None, "pulled at an end")
            }
            5 | 6 => {
                let middle = shape.cells[0] / 2;
                let bone = shape.nodes_where(|p| p[0] == middle && p[1] == 0);
                let motion = self.motion(shape);
                let loads = self.chance(0.3).then(|| self.loads(n, softest));
                (near, vec![joined(bone)], named(motion), loads, "pulled in the middle")
            }
            7 | 8 => (near, vec![], vec![], Some(self.loads(n, softest)), "loaded"),
            9 => {
                let last = shape.cells;
                let corners = vec![
                    shape.node([0, 0, 0]),
                    shape.node([0, last[1], 0]),
                    shape.node([0, 0, last[2]]),
                ];
                (corners, vec![], vec![], Some(self.loads(n, softest)), "loaded, held at 3 nodes")
            }
            10 => {
                let mut chosen: Vec<u32> = (0..n as u32).filter(|_| self.chance(0.08)).collect();
                chosen.retain(|j| !near.contains(j));
                if chosen.is_empty() {
                    chosen.push(far[0]);
                }
                let motion = self.motion(shape);
                (near, vec![joined(chosen)], named(motion), None, "pulled at random nodes")
            }
            _ => return self.sliding(shape, softest),
        };
        let boundary = Boundary::new(fixed, segments, Conflicts::Resolve)?;
        Ok(Holding { boundary, plan, loads, slides: None, text })
    }

    /// The side z = 0 on a plane that moves, one end fixed.
    fn sliding(&mut self, shape: &BoxShape, softest: f64) -> Result<Holding> {
        let reach = 4.0 * shape.size.iter().fold(0.0_f64, |m, &s| m.max(s)) + 20.0;
        let segment = Segment {
            name: "bone".into(),
            joined: vec![],
            sliding: shape.side(2, false),
            contact: Some(surface(plane(2, reach, 0.0))),
            gap: Gap::Rest,
        };
        let translation = [0.0, 0.0, self.between(-1.0, 1.0)];
        let motion = Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], translation));
        let n = shape.nodes_where(|_| true).len();
        let loads = self.chance(0.5).then(|| self.loads(n, softest));
        Ok(Holding {
            boundary: Boundary::new(shape.side(0, false), vec![segment], Conflicts::Resolve)?,
            plan: vec![("bone".to_string(), motion)],
            loads,
            slides: Some((2, translation[2])),
            text: "sliding on a plane",
        })
    }
}

/// The sum of two doubles that do not overlap.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pair(f64, f64);

const ZERO: Pair = Pair(0.0, 0.0);

impl Pair {
    /// a + b without error (Knuth).
    fn sum(a: f64, b: f64) -> Self {
        let s = a + b;
        let t = s - a;
        Self(s, (a - (s - t)) + (b - t))
    }

    fn plus(self, other: Self) -> Self {
        let s = Self::sum(self.0, other.0);
        let t = Self::sum(self.1, other.1);
        let s = Self::sum(s.0, s.1 + t.0);
        Self::sum(s.0, s.1 + t.1)
    }

    fn negative(self) -> Self {
        Self(-self.0, -self.1)
    }

    fn times(self, other: Self) -> Self {
        let p = self.0 * other.0;
        let e = self.0.mul_add(other.0, -p);
        Self::sum(p, e + (self.0 * other.1 + self.1 * other.0))
    }

    fn over(self, other: Self) -> Self {
        let q = self.0 / other.0;
        let r = self.plus(other.times(Self(q, 0.0)).negative());
        let second = r.0 / other.0;
        let r = r.plus(other.times(Self(second, 0.0)).negative());
        Self::sum(q, second).plus(Self(r.0 / other.0, 0.0))
    }
}

fn size(u: &[[Pair; 3]]) -> f64 {
    u.iter().flatten().fold(0.0, |m, v| m.max(v.0.abs()))
}

/// K u = f on the components that are free, in pairs of doubles.
struct Equations<'a> {
    scene: &'a Scene,
    /// Whether each component of each node is unknown.
    free: Vec<[bool; 3]>,
    prescribed: Vec<[f64; 3]>,
}

impl<'a> Equations<'a> {
    fn new(scene: &'a Scene) -> Option<Self> {
        let nodes = scene.tensors.element_nodes().positions();
        let kinds = scene.boundary.kinds(nodes.len()).ok()?;
        let motions = scene.boundary.motions(&scene.plan).ok()?;
        let mut prescribed = vec![[0.0; 3]; nodes.len()];
        for (s, motion) in motions.iter().enumerate() {
            for (j, v) in scene.boundary.joined_displacements(s, motion, nodes).ok()? {
                prescribed[j as usize] = v;
            }
        }
        let mut free = vec![[false; 3]; nodes.len()];
        for (j, kind) in kinds.iter().enumerate() {
            match (kind, scene.slides) {
                (NodeKind::Free, _) => free[j] = [true; 3],
                (NodeKind::Sliding(_), Some((axis, way))) => {
                    free[j] = [true; 3];
                    free[j][axis] = false;
                    prescribed[j][axis] = way;
                }
                _ => {}
            }
        }
        Some(Self { scene, free, prescribed })
    }

    fn begin(&self) -> Vec<[Pair; 3]> {
        self.prescribed.iter().map(|u| u.map(|v| Pair(v, 0.0))).collect()
    }

    /// f − K u where free, else zero.
    fn residual(&self, u: &[[Pair; 3]]) -> Vec<[Pair; 3]> {
        let matrix = self.scene.tensors.matrix();
        (0..u.len())
            .map(|j| {
                let mut r =
                    self.scene.loads.as_ref().map_or([ZERO; 3], |f| f[j].map(|v| Pair(v, 0.0)));
                let (columns, blocks) = matrix.row(j);
                for (&k, block) in columns.iter().zip(blocks) {
                    for i in 0..3 {
                        for c in 0..3 {
                            let force = Pair(block[3 * i + c], 0.0).times(u[k as usize][c]);
                            r[i] = r[i].plus(force.negative());
                        }
                    }
                }
                [0, 1, 2].map(|i| if self.free[j][i] { r[i] } else { ZERO })
            })
            .collect()
    }
}

/// L D Lᵀ of the free components in the order of the nodes, row by row from the first entry of each.
struct BandFactor {
    /// Free component of each unknown.
    unknowns: Vec<(usize, usize)>,
    first: Vec<usize>,
    /// Rows of L from `first` to the diagonal, which holds D.
    rows: Vec<Vec<Pair>>,
}

impl BandFactor {
    fn new(matrix: &mtm_core::BlockMatrix, free: &[[bool; 3]]) -> Option<Self> {
        let mut number = vec![[usize::MAX; 3]; free.len()];
        let mut unknowns = Vec::new();
        for (j, free) in free.iter().enumerate() {
            for i in (0..3).filter(|&i| free[i]) {
                number[j][i] = unknowns.len();
                unknowns.push((j, i));
            }
        }
        let mut rows: Vec<Vec<Pair>> = Vec::with_capacity(unknowns.len());
        let mut firsts = Vec::with_capacity(unknowns.len());
        let mut work = 0.0;
        for (n, &(j, i)) in unknowns.iter().enumerate() {
            let (columns, blocks) = matrix.row(j);
            let entries = || {
                columns.iter().zip(blocks).flat_map(|(&k, block)| {
                    let number = number[k as usize];
                    (0..3).map(move |c| (number[c], block[3 * i + c]))
                })
            };
            let first = entries().map(|(m, _)| m).filter(|&m| m <= n).min().unwrap_or(n);
            let mut row = vec![ZERO; n - first + 1];
            for (m, value) in entries().filter(|(m, _)| *m <= n) {
                row[m - first] = Pair(value, 0.0);
            }
            work += (row.len() * row.len()) as f64;
            if work > MAX_BAND_WORK {
                return None;
            }
            firsts.push(first);
            rows.push(row);
        }
        for n in 0..rows.len() {
            let (above, below) = rows.split_at_mut(n);
            let (first, row) = (firsts[n], &mut below[0]);
            // Entries of L D first, then of L.
            for m in first..n {
                let other = &above[m];
                let from = first.max(firsts[m]);
                let mut sum = row[m - first];
                for k in from..m {
                    sum = sum.plus(row[k - first].times(other[k - firsts[m]]).negative());
                }
                row[m - first] = sum;
            }
            let mut pivot = row[n - first];
            for m in first..n {
                let scaled = row[m - first];
                let entry = scaled.over(above[m][m - firsts[m]]);
                pivot = pivot.plus(scaled.times(entry).negative());
                row[m - first] = entry;
            }
            if pivot.0.is_nan() || pivot.0 <= 0.0 {
                return None;
            }
            row[n - first] = pivot;
        }
        Some(Self { unknowns, first: firsts, rows })
    }

    fn solve(&self, b: &[[Pair; 3]]) -> Vec<[Pair; 3]> {
        let mut x: Vec<Pair> = self.unknowns.iter().map(|&(j, i)| b[j][i]).collect();
        for n in 0..x.len() {
            let first = self.first[n];
            let mut sum = x[n];
            for m in first..n {
                sum = sum.plus(self.rows[n][m - first].times(x[m]).negative());
            }
            x[n] = sum;
        }
        for n in 0..x.len() {
            x[n] = x[n].over(self.rows[n][n - self.first[n]]);
        }
        for n in (0..x.len()).rev() {
            let first = self.first[n];
            for m in first..n {
                x[m] = x[m].plus(self.rows[n][m - first].times(x[n]).negative());
            }
        }
        let mut out = vec![[ZERO; 3]; b.len()];
        for (&(j, i), x) in self.unknowns.iter().zip(x) {
            out[j][i] = x;
        }
        out
    }
}

/// Whether an error is an honest refusal of the solver, not of the input.
pub fn refusal(error: &MtmError) -> bool {
    matches!(error, MtmError::NotConverged { .. } | MtmError::NotPositiveDefinite { .. })
}
