//! Isosurface stuffing: tets of good shape inside a level image (Labelle & Shewchuk 2007).
//!
//! A body-centred cubic lattice covers the image, finer where the tissue or a gap in it is thin. The zero set
//! of the level cuts it; vertices near the cut move onto it, so that no slivers remain. Where cubes of two
//! sizes meet at the surface the bound on the angles does not hold, and `improve` restores it.

pub mod cut;
pub mod distance;
pub mod improve;
pub mod lattice;
pub mod level;
pub mod parts;

use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};
use crate::mesh::TetMesh;
use crate::vector::{add, cross, norm, scaled, sub};

use cut::cut;
use distance::{core_squared, squared_distance, thin_parts};
use improve::improve;
use lattice::{Lattice, Octree};
use level::LevelImage;
use parts::{Dropped, keep_bodies};

/// Deepest refinement: edges an eighth of the edge length.
pub const MAX_REFINEMENTS: u32 = 3;
/// Maximum number of coarse cubes of a lattice; more than that means an edge length in the wrong units.
const MAX_CUBES: f64 = 1e8;
/// No point is further from the lattice than √5/4 of its edge, so that a sheet thicker than twice that is
/// always found; slightly more, as a margin for unfavourable positions.
const THIN_RADIUS: f64 = 0.6;
/// Edges and corners of up to 90° are not sheets: a ball leaves √2 − 1 of its radius in them.
const THIN_SLACK: f64 = 0.5;
/// Shortest edge created by refinement, in units of the mean size of a voxel.
const LEAST_EDGE_IN_VOXELS: f64 = 0.7;
/// Steps along a normal in search of the surface, and bisection steps that then locate it.
const ERROR_STEPS: usize = 20;
const ERROR_HALVINGS: usize = 12;

/// How a level image is filled with tets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StuffingOptions {
    /// Longest edge of the lattice, mm: the edge of its cubes.
    pub edge_length: f64,
    /// How many times the edge may be halved where the tissue or a gap is thin; 0 keeps one size.
    pub refinements: u32,
    /// Volume below which a body separate from the largest is a speck and is removed, mm³.
    pub least_body: f64,
}

impl Default for StuffingOptions {
    fn default() -> Self {
        Self { edge_length: 3.0, refinements: 1, least_body: 0.0 }
    }
}

/// How many times the edge is halved at each voxel of a level image, in the order of its values.
#[derive(Debug, Clone, Copy, Default)]
pub struct Halvings<'a> {
    /// Maximum for thin places there; as in the options if none.
    pub allowed: Option<&'a [u8]>,
    /// Minimum, thin or not, in the cubes that contain the voxel's centre; none for no minimum.
    pub needed: Option<&'a [u8]>,
}

/// A mesh, with what was removed from it and how closely it follows its level.
#[derive(Debug, Clone)]
pub struct Stuffed {
    /// The mesh.
    pub mesh: TetMesh,
    /// Bodies that were removed because they were too small.
    pub dropped: Dropped,
    /// Poor tets at the surface that were removed.
    pub dropped_tets: usize,
    /// Volume inside the level image, mm³.
    pub level_volume: f64,
    /// Mean distance of the boundary triangles' centroids from the zero set, mm.
    pub boundary_error_mean: f64,
    /// Largest of these distances, mm; at most the edge length if the zero set is out of reach.
    pub boundary_error_max: f64,
}

/// The mesh of `level`, with dihedral angles of at least 10°.
///
/// # Errors
/// Options or numbers of halvings out of range, no tissue in the image or none that the lattice resolves, an
/// edge length so small that the lattice would become too large.
pub fn stuff(
    level: &LevelImage,
    options: &StuffingOptions,
    halvings: &Halvings<'_>,
) -> Result<Stuffed> {
    check(options)?;
    check_halvings(halvings, level.values().len(), options.refinements)?;
    let cover = Cover::new(level, options)?;
    let lattice = Lattice::new(&cover.tree(level, options, halvings));
    let mut stuffed = cut(&lattice, level, cover.origin, cover.unit);
    drop(lattice);
    let allowed = "below about the thickness of the tissue, or more refinements: no tet fits";
    let is_filled = !stuffed.tets.is_empty();
    ErrorKind::Mesh.require(is_filled, "edge_length", options.edge_length, allowed)?;
    let dropped_tets = improve(&mut stuffed, level);
    let dropped = keep_bodies(&mut stuffed, options.least_body);
    let mesh = TetMesh::new(stuffed.nodes, stuffed.tets)?;
    let (boundary_error_mean, boundary_error_max) =
        boundary_error(&mesh, level, options.edge_length);
    Ok(Stuffed {
        mesh,
        dropped,
        dropped_tets,
        level_volume: level.volume(),
        boundary_error_mean,
        boundary_error_max,
    })
}

/// Mean and largest distance of the centroids of boundary triangles from the zero set along their normals.
fn boundary_error(mesh: &TetMesh, level: &LevelImage, reach: f64) -> (f64, f64) {
    let errors: Vec<f64> = mesh
        .boundary_triangles()
        .par_iter()
        .map(|triangle| {
            let [a, b, c] = triangle.map(|v| mesh.nodes()[v as usize]);
            let normal = cross(sub(b, a), sub(c, a));
            let centroid = scaled(add(add(a, b), c), 1.0 / 3.0);
            // Outwards if the centroid lies inside, inwards if it lies outside.
            let inside = level.value(centroid) > 0.0;
            let sense = if inside { 1.0 } else { -1.0 } / norm(normal);
            let at = |d: f64| level.value(add(centroid, scaled(normal, d * sense))) > 0.0;
            let step = reach / ERROR_STEPS as f64;
            let beyond = (1..=ERROR_STEPS).map(|s| s as f64 * step).find(|&d| at(d) != inside);
            let Some(mut high) = beyond else { return reach };
            let mut low = high - step;
            for _ in 0..ERROR_HALVINGS {
                let middle = 0.5 * (low + high);
                if at(middle) == inside { low = middle } else { high = middle }
            }
            0.5 * (low + high)
        })
        .collect();
    let sum: f64 = errors.iter().sum();
    (sum / errors.len() as f64, errors.iter().copied().fold(0.0, f64::max))
}

fn check(options: &StuffingOptions) -> Result<()> {
    let kind = ErrorKind::Mesh;
    let (edge, refinements) = (options.edge_length, options.refinements);
    kind.require(edge > 0.0 && edge.is_finite(), "edge_length", edge, "above 0 mm and finite")?;
    let are_few = refinements <= MAX_REFINEMENTS;
    kind.require(are_few, "refinements", f64::from(refinements), "0 to 3")?;
    kind.require(options.least_body >= 0.0, "least_body", options.least_body, "0 mm³ or more")?;
    Ok(())
}

fn check_halvings(halvings: &Halvings<'_>, n_voxels: usize, refinements: u32) -> Result<()> {
    let kind = ErrorKind::Mesh;
    for (what, counts) in
        [("allowed refinements", halvings.allowed), ("needed refinements", halvings.needed)]
    {
        let found = counts.map_or(n_voxels, <[u8]>::len);
        kind.require_length(what, found, n_voxels, "one per voxel of the level image")?;
    }
    let needed = halvings.needed.unwrap_or_default();
    if let Some(index) = needed.iter().position(|&count| u32::from(count) > refinements) {
        let allowed = "0 to the refinements of the options: request fewer or allow more";
        let found = f64::from(needed[index]);
        return Err(kind.out_of_range("needed refinements", index, found, allowed));
    }
    Ok(())
}

/// Coarse cubes over the inside of an image.
struct Cover {
    origin: [f64; 3],
    counts: [usize; 3],
    edge: f64,
    unit: f64,
}

impl Cover {
    fn new(level: &LevelImage, options: &StuffingOptions) -> Result<Self> {
        let grid = level.grid();
        let (low, high) = inside_bounds(level)
            .ok_or(MtmError::Empty { what: "tissue of the image", kind: ErrorKind::Mesh })?;
        let edge = options.edge_length;
        // The surface lies up to one voxel beyond the last voxel inside; one additional cube on every side.
        let margin = grid.spacing.map(|s| s + edge);
        let origin = [0, 1, 2].map(|a| low[a] - margin[a]);
        let counts = [0, 1, 2].map(|a| ((high[a] + margin[a] - origin[a]) / edge).ceil().max(1.0));
        let are_few = counts.iter().product::<f64>() <= MAX_CUBES;
        let allowed = "large enough for at most 1e8 cubes over the tissue; check the units";
        ErrorKind::Mesh.require(are_few, "edge_length", edge, allowed)?;
        let unit = edge / f64::from(2_u32 << options.refinements);
        Ok(Self { origin, counts: counts.map(|c| c as usize), edge, unit })
    }

    /// The octree over the cubes near tissue, refined where the tissue or a gap in it is thin, or where
    /// requested.
    fn tree(
        &self,
        level: &LevelImage,
        options: &StuffingOptions,
        halvings: &Halvings<'_>,
    ) -> Octree {
        let active = self.active(level);
        let mut tree = Octree::new(self.counts, options.refinements, &active);
        if options.refinements == 0 {
            return tree;
        }
        let grid = level.grid();
        for (index, &count) in halvings.needed.unwrap_or_default().iter().enumerate() {
            if count > 0 {
                tree.refine(self.place(grid.centre(index)), tree.coarse_size() >> count);
            }
        }
        let values = level.values();
        // The longest edge has the largest reach.
        let most = core_squared(grid, THIN_RADIUS * self.edge);
        let to_outside = squared_distance(grid, most, |index| values[index] <= 0.0);
        let to_inside = squared_distance(grid, most, |index| values[index] > 0.0);
        let voxel = grid.spacing.iter().product::<f64>().cbrt();
        for refinement in 0..options.refinements {
            let edge = self.edge / f64::from(1_u32 << refinement);
            // Anything finer than the image is noise.
            if 0.5 * edge < LEAST_EDGE_IN_VOXELS * voxel {
                break;
            }
            let size = tree.coarse_size() >> (refinement + 1);
            for squared in [&to_outside, &to_inside] {
                let thin = thin_parts(grid, squared, THIN_RADIUS * edge, THIN_SLACK);
                let may = |index: &usize| {
                    thin[*index]
                        && halvings.allowed.is_none_or(|a| u32::from(a[*index]) > refinement)
                };
                for index in (0..grid.len()).filter(may) {
                    self.refine_round(&mut tree, grid.centre(index), 0.5 * edge, size);
                }
            }
        }
        tree.balance();
        tree
    }

    /// Refines the cubes at a point and at the corners of a box around it.
    fn refine_round(&self, tree: &mut Octree, point: [f64; 3], reach: f64, size: i32) {
        for corner in 0..8 {
            let side = [0, 1, 2].map(|a| if corner >> a & 1 == 1 { reach } else { -reach });
            tree.refine(self.place(add(point, side)), size);
        }
    }

    /// The unit cube that holds a point.
    fn place(&self, point: [f64; 3]) -> [i32; 3] {
        [0, 1, 2].map(|a| ((point[a] - self.origin[a]) / self.unit).floor() as i32)
    }

    /// Whether each cube, or one next to it, holds a voxel inside or next to one.
    fn active(&self, level: &LevelImage) -> Vec<bool> {
        let grid = level.grid();
        let ([_, ny, nz], [nx, cy, cz]) = (grid.shape, self.counts);
        // Voxels from one before each cube to one after it, including the neighbouring cubes.
        let spans = [0, 1, 2].map(|a| {
            let span = |cube: usize| {
                let low = self.origin[a] + (cube as f64 - 1.0) * self.edge;
                let voxel = |x: f64| (x - grid.origin[a]) / grid.spacing[a];
                let first = (voxel(low).floor() - 1.0).max(0.0);
                let last =
                    (voxel(low + 3.0 * self.edge).ceil() + 1.0).min(grid.shape[a] as f64 - 1.0);
                let end = (last.max(-1.0) + 1.0) as usize;
                (first as usize).min(end)..end
            };
            (0..self.counts[a]).map(span).collect::<Vec<_>>()
        });
        let rows = level.values().par_chunks(nz).flat_map_iter(|row| {
            spans[2].iter().map(move |span| row[span.clone()].iter().any(|&v| v > 0.0))
        });
        let along_k: Vec<bool> = rows.collect();
        // One axis after another: no voxel is looked at for each cube that it is near to.
        let along_j: Vec<bool> = (0..grid.shape[0] * cy * cz)
            .into_par_iter()
            .map(|c| {
                spans[1][c / cz % cy]
                    .clone()
                    .any(|j| along_k[(c / (cy * cz) * ny + j) * cz + c % cz])
            })
            .collect();
        (0..nx * cy * cz)
            .into_par_iter()
            .map(|c| spans[0][c / (cy * cz)].clone().any(|i| along_j[i * cy * cz + c % (cy * cz)]))
            .collect()
    }
}

/// Smallest box around the voxel centres inside.
fn inside_bounds(level: &LevelImage) -> Option<([f64; 3], [f64; 3])> {
    let inside = level.values().par_iter().enumerate().filter(|(_, v)| **v > 0.0);
    let centres = inside.map(|(index, _)| level.grid().centre(index));
    centres.map(|x| (x, x)).reduce_with(|(a, b), (c, d)| {
        ([0, 1, 2].map(|i| a[i].min(c[i])), [0, 1, 2].map(|i| b[i].max(d[i])))
    })
}
