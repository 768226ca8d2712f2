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
pub(crate) struct FieldValue {
    /// Distance from the surface, out of the bone, mm.
    pub distance: f64,
    /// Its gradient, of length one except where the surface is sharper than the lattice resolves.
    pub gradient: [f64; 3],
    /// Its Hessian, 1/mm.
    pub hessian: [[f64; 3]; 3],
}

/// Smooth distance field of a surface.
#[derive(Debug)]
pub(crate) struct Field {
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
pub(crate) struct ReadyField<'a> {
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A grid of (2 n)² cells, `half` to each side, lifted to `height(x, y)`.
    fn relief(n: i32, half: f64, height: impl Fn(f64, f64) -> f64) -> Surface {
        let (side, step) = (2 * n as u32 + 1, half / f64::from(n));
        let mut vertices = Vec::new();
        for i in -n..=n {
            for j in -n..=n {
                let (x, y) = (f64::from(i) * step, f64::from(j) * step);
                vertices.push([x, y, height(x, y)]);
            }
        }
        let mut triangles = Vec::new();
        for i in 0..side - 1 {
            for j in 0..side - 1 {
                let v = i * side + j;
                triangles.push([v, v + side, v + side + 1]);
                triangles.push([v, v + side + 1, v + 1]);
            }
        }
        Surface::new(vertices, triangles).unwrap()
    }

    fn value(field: &Field, at: [f64; 3]) -> FieldValue {
        field.at(&[at]).value(at)
    }

    /// A plane is reproduced to rounding, also beyond its border, where it is extended.
    #[test]
    fn field_of_a_plane_is_its_height() {
        let plane = relief(3, 6.0, |x, y| 0.3 * x - 0.2 * y);
        let field = Field::new(Arc::new(plane), [0.1, 0.2, 0.3], 1.1);
        let n = scaled([-0.3, 0.2, 1.0], 1.0 / 1.13_f64.sqrt());
        for at in [[0.4, -1.3, 0.9], [2.0, 2.0, -1.5], [9.0, -8.0, 3.0], [0.0; 3]] {
            let found = value(&field, at);
            assert!((found.distance - dot(n, at)).abs() <= 1e-12, "{at:?}: {}", found.distance);
            for i in 0..3 {
                assert!((found.gradient[i] - n[i]).abs() <= 1e-12);
                assert!(found.hessian[i].iter().all(|h| h.abs() <= 1e-11));
            }
        }
    }

    /// On a coarse ball the facets act as if curved: distance, normal and curvature are those of the ball,
    /// although the facets themselves lie 20 times as far from it.
    #[test]
    fn field_of_a_coarse_bowl_is_that_of_the_sphere() {
        let radius = 20.0_f64;
        let bowl = relief(8, 12.0, |x, y| (radius * radius - x * x - y * y).sqrt() - radius);
        let flat = bowl.closest_one([0.75, 0.75, 1.0]);
        let centre = [0.0, 0.0, -radius];
        let true_distance = |at: [f64; 3]| {
            let away = sub(at, centre);
            (dot(away, away).sqrt() - radius, scaled(away, 1.0 / dot(away, away).sqrt()))
        };
        let facets = (flat.signed_distance - true_distance([0.75, 0.75, 1.0]).0).abs();
        let field = Field::new(Arc::new(bowl), [0.2, -0.3, 0.1], 1.0);
        for at in [[0.75, 0.75, 1.0], [3.1, -2.2, 0.3], [-4.0, 1.0, -0.2]] {
            let (found, (distance, normal)) = (value(&field, at), true_distance(at));
            assert!(
                (found.distance - distance).abs() <= 0.05 * facets,
                "{at:?} {}",
                found.distance
            );
            assert!((0..3).all(|i| (found.gradient[i] - normal[i]).abs() <= 2e-3), "{at:?}");
            let trace: f64 = (0..3).map(|i| found.hessian[i][i]).sum();
            assert!((trace - 2.0 / (radius + distance)).abs() <= 0.02 / radius * 2.0, "{trace}");
        }
    }

    /// Value, gradient and Hessian are consistent with each other, on a surface with a crease too.
    #[test]
    fn derivatives_are_those_of_the_value() {
        let field = Field::new(Arc::new(relief(6, 6.0, |x, _| x.abs())), [0.0; 3], 0.8);
        let step = 1e-5;
        for at in [[0.2, 0.3, 0.4], [-1.3, 2.0, 1.0], [0.01, -0.7, 0.2]] {
            let here = value(&field, at);
            for i in 0..3 {
                let side = |s: f64| {
                    let mut there = at;
                    there[i] += s * step;
                    value(&field, there)
                };
                let (ahead, behind) = (side(1.0), side(-1.0));
                let slope = (ahead.distance - behind.distance) / (2.0 * step);
                assert!((slope - here.gradient[i]).abs() <= 1e-8, "{slope}");
                for j in 0..3 {
                    let turn = (ahead.gradient[j] - behind.gradient[j]) / (2.0 * step);
                    assert!((turn - here.hessian[i][j]).abs() <= 1e-8, "{turn}");
                }
            }
        }
    }

    /// A field that was evaluated elsewhere before, or by other threads, is bitwise identical.
    #[test]
    fn samples_do_not_depend_on_their_order() {
        let surface = Arc::new(relief(8, 12.0, |x, y| (0.7 * x).sin() + (0.5 * y).cos()));
        let points: Vec<[f64; 3]> = (0..200)
            .map(|i| f64::from(i) * 0.77)
            .map(|t| [8.0 * t.sin(), 8.0 * (1.3 * t).cos(), 0.5 * (2.1 * t).sin()])
            .collect();
        let at_once = Field::new(surface.clone(), [0.0; 3], 0.9);
        let ready = at_once.at(&points);
        let one_by_one = Field::new(surface, [0.0; 3], 0.9);
        for &point in points.iter().rev() {
            let (a, b) = (ready.value(point), value(&one_by_one, point));
            assert_eq!(a.distance.to_bits(), b.distance.to_bits());
            assert_eq!(a.gradient.map(f64::to_bits), b.gradient.map(f64::to_bits));
        }
    }
}
