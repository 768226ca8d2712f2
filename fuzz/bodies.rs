//! What the fuzz targets run, from bytes to checks; tests/rust/properties.rs runs it on seeded bytes.
//!
//! Bytes become small meshes, tissues, surfaces, boundaries and plans, many of them wrong. Each must be
//! refused with an error or give finite numbers; nothing may panic or hang.

#![allow(dead_code)] // each target uses one of the bodies

use std::sync::Arc;

use mtm_core::{
    Boundary, Conflicts, ContactMode, ContactOptions, Elastic, FibreElastic, FibreLaw, Gap,
    MassTensors, Method, Mixing, Motion, MtmError, Plan, Preset, RigidMotion, Segment,
    StaticOptions, StaticSolver, Surface, SurfaceMotion, TetMesh, Tissue, WindingTree,
};

/// Most iterations of a method: an input that converges slowly is an error, not a hang.
const ITERATIONS: usize = 400;

/// Reads values from bytes; past the end come zeros.
pub struct Bytes<'a>(pub &'a [u8]);

impl Bytes<'_> {
    fn byte(&mut self) -> u8 {
        let Some((&first, rest)) = self.0.split_first() else { return 0 };
        self.0 = rest;
        first
    }

    fn below(&mut self, n: usize) -> usize {
        usize::from(self.byte()) % n
    }

    /// Mostly a tame number; now and then any bits at all, or an extreme.
    fn number(&mut self) -> f64 {
        match self.byte() {
            0..=239 => f64::from(i16::from_le_bytes([self.byte(), self.byte()])) / 4096.0,
            240..=243 => f64::from_bits(u64::from_le_bytes([0; 8].map(|_: u8| self.byte()))),
            244..=247 => 0.0,
            248 => f64::NAN,
            249 => f64::INFINITY,
            250 => f64::MAX,
            251 => -f64::MAX,
            252 => f64::MIN_POSITIVE,
            253 => 1e-160,
            254 => 1e160,
            255 => 1e9,
        }
    }

    fn row(&mut self) -> [f64; 3] {
        [self.number(), self.number(), self.number()]
    }

    fn rows(&mut self, n: usize) -> Vec<[f64; 3]> {
        (0..n).map(|_| self.row()).collect()
    }

    /// A positive modulus, or any number.
    fn modulus(&mut self) -> f64 {
        match self.byte() {
            0..=229 => 10_f64.powi(self.below(12) as i32 - 6) * (1.0 + f64::from(self.byte())),
            _ => self.number(),
        }
    }

    fn poisson(&mut self) -> f64 {
        match self.byte() {
            0..=229 => f64::from(self.byte()) / 512.0,
            _ => self.number(),
        }
    }

    /// An index that is nearly always in range.
    fn index(&mut self, n: usize) -> u32 {
        if self.byte() > 252 {
            u32::from_le_bytes([0; 4].map(|_: u8| self.byte()))
        } else {
            self.below(n.max(1)) as u32
        }
    }

    fn indices(&mut self, most: usize, n: usize) -> Vec<u32> {
        (0..self.below(most + 1)).map(|_| self.index(n)).collect()
    }

    /// A mesh: a strip of cubes, six tets each, with some of its numbers overwritten; or raw rows.
    fn mesh(&mut self) -> Result<TetMesh, MtmError> {
        if self.byte() > 230 {
            let n = self.below(9);
            let nodes = self.rows(n);
            let tets = (0..self.below(6)).map(|_| [0; 4].map(|_: u8| self.index(n))).collect();
            return TetMesh::new(nodes, tets);
        }
        let cubes = 1 + self.below(3);
        let scale = [1.0, 1e-3, 1e3, 37.0][self.below(4)];
        let mut nodes = Vec::new();
        for i in 0..=cubes {
            for corner in 0..4 {
                let [y, z] = [f64::from(corner % 2), f64::from(corner / 2)];
                nodes.push([i as f64 * scale, y * scale, z * scale]);
            }
        }
        let mut tets = Vec::new();
        for i in 0..cubes as u32 {
            // Bit 2 is the step along x, bits 0 and 1 those along y and z.
            for [a, b] in [[4, 5], [4, 6], [1, 5], [1, 3], [2, 6], [2, 3]] {
                let mut tet = [0, a, b, 7].map(|v| 4 * i + v);
                let x = tet.map(|v| nodes[v as usize]);
                let e = [1, 2, 3].map(|k| [0, 1, 2].map(|c| x[k][c] - x[0][c]));
                let volume = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1])
                    - e[0][1] * (e[1][0] * e[2][2] - e[1][2] * e[2][0])
                    + e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]);
                if volume < 0.0 {
                    tet.swap(2, 3);
                }
                tets.push(tet);
            }
        }
        for _ in 0..self.below(3) {
            let (at, axis) = (self.below(nodes.len()), self.below(3));
            nodes[at][axis] += 0.1 * scale * self.number();
        }
        if self.byte() > 240 {
            let (at, corner) = (self.below(tets.len()), self.below(4));
            tets[at][corner] = self.index(nodes.len());
        }
        TetMesh::new(nodes, tets)
    }

    fn tissue(&mut self, n_tets: usize) -> Result<Tissue, MtmError> {
        let rows = if self.byte() > 128 { n_tets } else { 1 };
        match self.below(5) {
            0 | 1 => {
                let rows: Vec<Elastic> = (0..rows)
                    .map(|_| Elastic { young: self.modulus(), poisson: self.poisson() })
                    .collect();
                Tissue::isotropic(&rows)
            }
            2 => {
                let moduli: Vec<FibreElastic> = (0..rows)
                    .map(|_| FibreElastic {
                        young_along: self.modulus(),
                        young_across: self.modulus(),
                        poisson: self.poisson(),
                    })
                    .collect();
                let fibre: Vec<[f64; 3]> = (0..rows).map(|_| self.direction()).collect();
                let law = if self.byte() > 200 { FibreLaw::Picinbono } else { FibreLaw::Spencer };
                Tissue::transversely_isotropic(&moduli, &fibre, law)
            }
            3 => {
                let fraction: Vec<f64> =
                    (0..rows).map(|_| f64::from(self.byte()) / 250.0).collect();
                let fibre: Vec<[f64; 3]> = (0..rows).map(|_| self.direction()).collect();
                let mixing = if self.byte() > 128 { Mixing::Moduli } else { Mixing::Stiffness };
                Tissue::mixture(&fraction, &fibre, Preset::from_name("kim2010")?, mixing)
            }
            _ => {
                let mut c = [[0.0; 6]; 6];
                for i in 0..6 {
                    c[i][i] = self.modulus();
                    for j in 0..i {
                        let v = 0.01 * self.number();
                        (c[i][j], c[j][i]) = (v, v);
                    }
                }
                Tissue::from_stiffness(vec![c; rows])
            }
        }
    }

    fn direction(&mut self) -> [f64; 3] {
        let v = self.row();
        let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        if self.byte() > 240 { v } else { v.map(|x| x / length) }
    }

    fn surface(&mut self) -> Result<Surface, MtmError> {
        if self.byte() > 200 {
            let n = self.below(8);
            let vertices = self.rows(n);
            let triangles = (0..self.below(8)).map(|_| [0; 3].map(|_: u8| self.index(n))).collect();
            return Surface::new(vertices, triangles);
        }
        let (n, reach) = (1 + self.below(3), [2.0, 10.0, 4000.0][self.below(3)]);
        let mut vertices = Vec::new();
        for i in 0..=n {
            for j in 0..=n {
                let at = |k: usize| (2.0 * k as f64 / n as f64 - 1.0) * reach;
                let height = if self.byte() > 220 { 0.1 * self.number() } else { 0.0 };
                vertices.push([at(i), at(j), height]);
            }
        }
        let mut triangles = Vec::new();
        for i in 0..n {
            for j in 0..n {
                let a = (i * (n + 1) + j) as u32;
                let (b, d) = (a + n as u32 + 1, a + 1);
                triangles.extend([[a, b, b + 1], [a, b + 1, d]]);
            }
        }
        Surface::new(vertices, triangles)
    }

    fn boundary(&mut self, n_nodes: usize) -> Result<Boundary, MtmError> {
        // The far end of the strip, or what the bytes say.
        let fixed = if self.byte() > 60 {
            (n_nodes.saturating_sub(4)..n_nodes).map(|j| j as u32).collect()
        } else {
            self.indices(6, n_nodes)
        };
        let mut segments = Vec::new();
        for s in 0..self.below(3) {
            let slides = self.byte() > 100;
            let contact = if slides { Some(Arc::new(self.surface()?)) } else { None };
            let gap = match self.below(4) {
                0 => Gap::Rest,
                1 => Gap::Uniform(self.number()),
                2 => Gap::PerNode((0..self.below(4)).map(|_| self.number()).collect()),
                _ => Gap::Uniform(0.0),
            };
            segments.push(Segment {
                name: if self.byte() > 250 { "s0".into() } else { format!("s{s}") },
                joined: self.indices(4, n_nodes),
                sliding: if slides { self.indices(4, n_nodes) } else { Vec::new() },
                contact,
                gap,
            });
        }
        let conflicts = if self.byte() > 128 { Conflicts::Resolve } else { Conflicts::Refuse };
        Boundary::new(fixed, segments, conflicts)
    }

    fn rigid(&mut self) -> Result<RigidMotion, MtmError> {
        let mut matrix = *RigidMotion::identity().matrix();
        let (sin, cos) = self.number().sin_cos();
        let (a, b) = [(0, 1), (1, 2), (0, 2)][self.below(3)];
        if self.byte() > 100 {
            (matrix[a][a], matrix[b][b], matrix[a][b], matrix[b][a]) = (cos, cos, -sin, sin);
        }
        for row in matrix.iter_mut().take(3) {
            row[3] = 0.2 * self.number();
        }
        if self.byte() > 245 {
            let (i, j) = (self.below(4), self.below(4));
            matrix[i][j] = self.number();
        }
        RigidMotion::new("s0", &matrix)
    }

    fn plan(&mut self, boundary: &Boundary) -> Result<Plan, MtmError> {
        let mut plan = Vec::new();
        for segment in boundary.segments() {
            if self.byte() > 250 {
                continue;
            }
            let motion = match self.below(8) {
                0 => {
                    let spare = usize::from(self.byte() > 240);
                    let rows = self.rows(segment.joined.len() + spare);
                    Motion::Nodes(rows.iter().map(|v| v.map(|x| 0.1 * x)).collect())
                }
                1 => {
                    let surface = match &segment.contact {
                        Some(surface) => (**surface).clone(),
                        None => self.surface()?,
                    };
                    let moved = surface
                        .vertices()
                        .iter()
                        .map(|v| {
                            let d = if self.byte() > 128 { self.row() } else { [0.0; 3] };
                            [0, 1, 2].map(|i| v[i] + 0.05 * d[i])
                        })
                        .collect();
                    Motion::Surface(Arc::new(SurfaceMotion::new(surface, moved)?))
                }
                _ => Motion::Rigid(self.rigid()?),
            };
            plan.push((segment.name.clone(), motion));
        }
        if self.byte() > 250 {
            plan.push(("other".into(), Motion::Rigid(RigidMotion::identity())));
        }
        Ok(plan)
    }

    fn options(&mut self) -> StaticOptions {
        let mode = if self.byte() > 128 { ContactMode::Unilateral } else { ContactMode::Bilateral };
        let mut contact = ContactOptions { mode, max_iterations: 40, ..Default::default() };
        let mut options = StaticOptions {
            method: [Method::Auto, Method::Cholesky, Method::Pcg, Method::Relaxation]
                [self.below(4)],
            max_iterations: Some(ITERATIONS),
            ..Default::default()
        };
        if self.byte() > 250 {
            options.tolerance = self.number();
            contact.tolerance = self.number();
            contact.max_iterations = self.below(3);
            options.memory_limit = Some(self.below(3) << 9);
        }
        options.contact = contact;
        options
    }
}

fn finite(what: &str, values: &[f64]) {
    assert!(values.iter().all(|v| v.is_finite()), "{what} is not finite: {values:?}");
}

/// An error must name itself in words and a family.
fn said(error: &MtmError) {
    assert!(!error.to_string().is_empty());
    let _ = (error.kind(), error.is_input());
}

/// Every constructor, alone: refuses or gives finite numbers. Returns whether all accepted.
pub fn constructors(data: &[u8]) -> bool {
    let outcome = construct(&mut Bytes(data));
    if let Err(error) = &outcome {
        said(error);
    }
    outcome.is_ok()
}

fn construct(bytes: &mut Bytes<'_>) -> Result<(), MtmError> {
    if bytes.byte() > 128 {
        let surface = bytes.surface()?;
        let points: Vec<[f64; 3]> =
            bytes.rows(3).into_iter().filter(|p| p.iter().all(|v| v.abs() < 1e9)).collect();
        finite("area", &[surface.area(), surface.mean_edge_length()]);
        for c in surface.closest(&points) {
            finite("closest", &[c.distance, c.signed_distance]);
            finite("closest point", &c.point);
            finite("normal", &c.normal);
        }
        finite("winding number", &WindingTree::new(&surface).winding_number(&points));
        let moved = bytes.rows(surface.vertices().len());
        finite("motion", SurfaceMotion::new(surface, moved)?.displacement(&points).as_flattened());
        return Ok(());
    }
    let mesh = Arc::new(bytes.mesh()?);
    finite("volumes", mesh.volumes());
    let quality = mesh.quality();
    finite("angles", &quality.min_dihedral);
    finite("edge ratios", &quality.edge_ratio);
    let tissue = Arc::new(bytes.tissue(mesh.n_tets())?);
    let smallest = tissue.smallest_eigenvalues();
    assert!(smallest.iter().all(|&v| v > 0.0), "an indefinite material passed: {smallest:?}");
    let tensors = MassTensors::new(mesh.clone(), tissue)?;
    let ones = vec![[1.0; 3]; mesh.n_nodes()];
    tensors.internal_force(&ones)?;
    bytes.boundary(mesh.n_nodes())?.kinds(mesh.n_nodes())?;
    Ok(())
}

/// A whole scene and several plans: refuses or gives finite numbers that obey the constraints. Returns
/// whether any plan was solved.
pub fn plans(data: &[u8]) -> bool {
    match run_plans(&mut Bytes(data)) {
        Ok(solved) => solved > 0,
        Err(error) => {
            said(&error);
            false
        }
    }
}

fn run_plans(bytes: &mut Bytes<'_>) -> Result<usize, MtmError> {
    let mesh = Arc::new(bytes.mesh()?);
    let tissue = Arc::new(bytes.tissue(mesh.n_tets())?);
    let tensors = Arc::new(MassTensors::new(mesh.clone(), tissue)?);
    let boundary = Arc::new(bytes.boundary(mesh.n_nodes())?);
    let options = bytes.options();
    let solver = StaticSolver::new(tensors, boundary.clone(), options, &|| false)?;
    let mut solved = 0;
    for _ in 0..1 + bytes.below(3) {
        let plan = bytes.plan(&boundary)?;
        let loads = (bytes.byte() > 200).then(|| bytes.rows(mesh.n_nodes()));
        match solver.solve(&plan, loads.as_deref(), &|| false) {
            Err(error) => said(&error),
            Ok(found) => {
                solved += 1;
                finite("displacements", found.displacements.as_flattened());
                finite("forces", found.forces.as_flattened());
                finite("contact forces", &found.contact.forces);
                finite("gaps", &found.contact.gaps);
                finite("residual", &[found.residual, found.error_estimate, found.contact_gap()]);
                for &j in boundary.fixed() {
                    assert_eq!(found.displacements[j as usize], [0.0; 3], "fixed node {j} moved");
                }
                let limit = options.contact.tolerance * mesh.diagonal();
                assert!(found.contact_gap() <= limit, "gap {:e} mm", found.contact_gap());
            }
        }
        match solver.plan_operator(None, None, &|| false) {
            Err(error) => said(&error),
            Ok(operator) => {
                if let Ok(u) = operator.apply(&plan) {
                    finite("operator", u.as_flattened());
                }
            }
        }
    }
    Ok(solved)
}
