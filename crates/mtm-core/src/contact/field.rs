//! The smooth distance field of a contact surface: the form in which sliding nodes see a triangle surface.
//!
//! Soft tissue cannot follow individual facets, nor edges sharper than its own mesh resolves. The signed
//! distance to the surface, with facets curved by the normals at their corners, is therefore sampled on a
//! lattice and interpolated by cubic B-splines. The result is a twice continuously differentiable field that
//! equals the distance where the distance is smooth, and is rounded over about one lattice spacing where it is
//! not. This is what Newton's method needs: a value, gradient and Hessian that are consistent with each other.
//!
//! Lattice points are sampled on demand, near the nodes, and only once: the value at a lattice point does not
//! depend on when it was requested, or by which thread.

use std::collections::{HashMap, HashSet};
use std::hash::BuildHasherDefault;
use std::sync::{Arc, RwLock, RwLockReadGuard};

use rayon::prelude::*;

use crate::geometry::lattice_hash::KeyHasher;
use crate::geometry::surface::Surface;
use crate::vector::{add, dot, scaled, sub};

/// Distance to the surface, relative to the lattice spacing, below which its direction is undefined.
const ON_SURFACE: f64 = 1e-9;
/// Weight of the projection onto the tangent planes at the corners when a facet is curved: one half reproduces
/// quadratic surfaces.
const CURVING: f64 = 0.5;
/// Samples per parallel task.
const SAMPLES_PER_TASK: usize = 64;

/// A lattice point, or the lowest corner of a cell.
type LatticePoint = [i32; 3];
/// Spline coefficients around a cell, four along each axis, those of x first.
type Cell = [f64; 64];
type PlaceMap<T> = HashMap<LatticePoint, T, BuildHasherDefault<KeyHasher>>;
type PlaceSet = HashSet<LatticePoint, BuildHasherDefault<KeyHasher>>;

/// The field at a point.
#[derive(Debug, Clone, Copy)]
pub struct FieldValue {
    /// Distance from the surface, out of the bone, mm.
    pub distance: f64,
    /// Its gradient, of length one except where the surface is sharper than the lattice resolves.
    pub gradient: [f64; 3],
    /// Its Hessian, 1/mm.
    pub hessian: [[f64; 3]; 3],
}

/// Smooth distance field of a surface.
#[derive(Debug)]
pub struct Field {
    surface: Arc<Surface>,
    /// A lattice point, mm.
    origin: [f64; 3],
    /// Lattice spacing, mm.
    spacing: f64,
    lattice: RwLock<Samples>,
}

/// The samples and coefficients computed so far.
#[derive(Debug, Default)]
struct Samples {
    samples: PlaceMap<f64>,
    cells: PlaceMap<Box<Cell>>,
}

/// The field, evaluated around the points it was requested for.
pub struct ReadyField<'a> {
    field: &'a Field,
    lattice: RwLockReadGuard<'a, Samples>,
}

impl Field {
    /// The field of `surface` on the lattice through `origin` with the given spacing, mm.
    pub fn new(surface: Arc<Surface>, origin: [f64; 3], spacing: f64) -> Self {
        Self { surface, origin, spacing, lattice: RwLock::new(Samples::default()) }
    }

    /// The field of another surface, on the same lattice.
    pub fn of(&self, surface: Surface) -> Self {
        Self::new(Arc::new(surface), self.origin, self.spacing)
    }

    /// The triangle surface.
    pub fn surface(&self) -> &Surface {
        &self.surface
    }

    /// Lattice spacing, mm.
    pub fn spacing(&self) -> f64 {
        self.spacing
    }

    /// The field prepared at `points`, mm; parallel, bitwise identical for any number of threads.
    pub fn at(&self, points: &[[f64; 3]]) -> ReadyField<'_> {
        let mut missing: Vec<LatticePoint> = {
            let lattice = self.read();
            let asked: PlaceSet = points.iter().map(|&p| self.cell_of(p).0).collect();
            asked.into_iter().filter(|cell| !lattice.cells.contains_key(cell)).collect()
        };
        if !missing.is_empty() {
            missing.sort_unstable();
            self.fill(&missing);
        }
        ReadyField { field: self, lattice: self.read() }
    }

    /// Samples and coefficients of `cells`.
    fn fill(&self, cells: &[LatticePoint]) {
        let mut wanted = PlaceSet::default();
        {
            let lattice = self.read();
            for cell in cells {
                for knot in knots(*cell) {
                    for at in star(knot) {
                        if !lattice.samples.contains_key(&at) {
                            wanted.insert(at);
                        }
                    }
                }
            }
        }
        let mut wanted: Vec<LatticePoint> = wanted.into_iter().collect();
        wanted.sort_unstable();
        let found: Vec<f64> =
            wanted.par_iter().with_min_len(SAMPLES_PER_TASK).map(|&at| self.sample(at)).collect();
        let mut lattice = self.lattice.write().unwrap_or_else(std::sync::PoisonError::into_inner);
        lattice.samples.extend(wanted.into_iter().zip(found));
        let made: Vec<(LatticePoint, Box<Cell>)> = cells
            .par_iter()
            .with_min_len(SAMPLES_PER_TASK)
            .map(|&cell| (cell, coefficients(&lattice.samples, cell)))
            .collect();
        lattice.cells.extend(made);
    }

    /// Signed distance of a lattice point from the surface with curved facets.
    fn sample(&self, at: LatticePoint) -> f64 {
        let point = [0, 1, 2].map(|i| self.origin[i] + self.spacing * f64::from(at[i]));
        let found = self.surface.closest_one(point);
        let t = found.triangle as usize;
        let away = sub(point, found.point);
        // Beyond a border the surface is extended along its tangent plane there.
        let (distance, outward) = if found.on_border {
            (dot(found.normal, away), found.normal)
        } else if found.distance <= ON_SURFACE * self.spacing {
            (found.signed_distance, found.normal)
        } else {
            (found.signed_distance, scaled(away, 1.0 / found.signed_distance))
        };
        let (corners, normals) = (self.surface.corners(t), self.surface.corner_normals(t));
        let mut rise = [0.0; 3];
        for k in 0..3 {
            let n: [f64; 3] = normals[k].into();
            let height = dot(sub(corners[k].into(), found.point), n);
            rise = add(rise, scaled(n, CURVING * found.barycentric[k] * height));
        }
        distance - dot(rise, outward)
    }

    fn cell_of(&self, point: [f64; 3]) -> (LatticePoint, [f64; 3]) {
        let at = [0, 1, 2].map(|i| (point[i] - self.origin[i]) / self.spacing);
        let cell = at.map(f64::floor);
        // Coordinates are limited far below what i32 holds at any sensible spacing; the cast saturates.
        (cell.map(|v| v as i32), [0, 1, 2].map(|i| at[i] - cell[i]))
    }

    fn read(&self) -> RwLockReadGuard<'_, Samples> {
        self.lattice.read().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl ReadyField<'_> {
    /// The field at one of the points it was prepared for.
    pub fn value(&self, point: [f64; 3]) -> FieldValue {
        let (place, inner) = self.field.cell_of(point);
        let Some(cell) = self.lattice.cells.get(&place) else {
            // Only points that the field was not prepared for have no cell.
            return FieldValue {
                distance: f64::NAN,
                gradient: [f64::NAN; 3],
                hessian: [[f64::NAN; 3]; 3],
            };
        };
        let [bx, by, bz] = inner.map(weights);
        let (mut distance, mut gradient, mut hessian) = (0.0, [0.0; 3], [[0.0; 3]; 3]);
        for i in 0..4 {
            // Sums over y and z of the value and its derivatives, for one x.
            let (mut v, mut vy, mut vz) = (0.0, 0.0, 0.0);
            let (mut vyy, mut vzz, mut vyz) = (0.0, 0.0, 0.0);
            for j in 0..4 {
                let row = &cell[16 * i + 4 * j..16 * i + 4 * j + 4];
                let along =
                    |w: &[f64; 4]| row[0] * w[0] + row[1] * w[1] + row[2] * w[2] + row[3] * w[3];
                let (s, sz, szz) = (along(&bz[0]), along(&bz[1]), along(&bz[2]));
                v += by[0][j] * s;
                vy += by[1][j] * s;
                vyy += by[2][j] * s;
                vz += by[0][j] * sz;
                vyz += by[1][j] * sz;
                vzz += by[0][j] * szz;
            }
            distance += bx[0][i] * v;
            gradient[0] += bx[1][i] * v;
            gradient[1] += bx[0][i] * vy;
            gradient[2] += bx[0][i] * vz;
            hessian[0][0] += bx[2][i] * v;
            hessian[1][1] += bx[0][i] * vyy;
            hessian[2][2] += bx[0][i] * vzz;
            hessian[0][1] += bx[1][i] * vy;
            hessian[0][2] += bx[1][i] * vz;
            hessian[1][2] += bx[0][i] * vyz;
        }
        let h = self.field.spacing;
        hessian[1][0] = hessian[0][1];
        hessian[2][0] = hessian[0][2];
        hessian[2][1] = hessian[1][2];
        FieldValue {
            distance,
            gradient: scaled(gradient, 1.0 / h),
            hessian: hessian.map(|row| scaled(row, 1.0 / (h * h))),
        }
    }
}

/// Cubic B-spline weights of the four knots around a position t, 0 ≤ t < 1, in a cell, with their first and
/// second derivatives with respect to t.
fn weights(t: f64) -> [[f64; 4]; 3] {
    let s = 1.0 - t;
    [
        [
            s * s * s / 6.0,
            (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0,
            (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0,
            t * t * t / 6.0,
        ],
        [-0.5 * s * s, (1.5 * t - 2.0) * t, (2.0 - 1.5 * s) * s, 0.5 * t * t],
        [s, 3.0 * t - 2.0, 3.0 * s - 2.0, t],
    ]
}

/// The knots whose splines are nonzero in a cell, in the order of [`Cell`].
fn knots(cell: LatticePoint) -> impl Iterator<Item = LatticePoint> {
    (0..64).map(move |k: i32| [cell[0] - 1 + k / 16, cell[1] - 1 + k / 4 % 4, cell[2] - 1 + k % 4])
}

/// A lattice point and its six neighbours.
fn star(at: LatticePoint) -> [LatticePoint; 7] {
    let [x, y, z] = at;
    [at, [x - 1, y, z], [x + 1, y, z], [x, y - 1, z], [x, y + 1, z], [x, y, z - 1], [x, y, z + 1]]
}

/// Coefficients of the splines around a cell: the samples minus a sixth of their second differences, which
/// reproduces cubic fields exactly (de Boor & Fix 1973).
fn coefficients(samples: &PlaceMap<f64>, cell: LatticePoint) -> Box<Cell> {
    let mut out = Box::new([0.0; 64]);
    for (value, knot) in out.iter_mut().zip(knots(cell)) {
        let [own, around @ ..] = star(knot).map(|at| samples.get(&at).copied().unwrap_or(f64::NAN));
        *value = 2.0 * own - around.iter().sum::<f64>() / 6.0;
    }
    out
}
