//! A face-like soft-tissue shell made by code: the case of the benches and of the peer comparison.
//!
//! The inner surface is a patch of a skull-sized ellipsoid, addressed by longitude (0° front, positive
//! to the left) and latitude (0° at the nasal floor, positive up). Tissue grows outward from it by
//! 8–24 mm: thin over the forehead, thick in cheeks and chin. A triangulated grid on the patch is
//! extruded into prisms of three tets each. Frame LPS, mm, MPa. The same number of tets gives the same
//! bits on every run.

#![allow(dead_code)] // each bench and example that includes this file uses a part of it

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::Path;

#[path = "shell_muscles.rs"]
mod muscles;

type Vec3 = [f64; 3];

/// Semi-axes of the skull ellipsoid in x, y, z, mm.
const SKULL: Vec3 = [70.0, 85.0, 100.0];
/// The patch reaches this longitude on both sides, degrees.
const LONGITUDE_MAX: f64 = 80.0;
/// Latitudes of the chin's lower border and of the hairline, degrees.
const LATITUDE: [f64; 2] = [-52.0, 46.0];
/// Width, height and thickness of the shell, mm; they turn a number of tets into an edge length.
const MIDDLE: Vec3 = [230.0, 165.0, 12.5];
/// Height of a layer over the edge length on the surface: contact deserves the finer direction.
const LAYER_RATIO: f64 = 1.4;
/// Inner nodes leave their regular place by this part of the smallest spacing.
const JITTER: f64 = 0.1;

/// Young's modulus (MPa) and Poisson's ratio of fat; Kim et al. (2010), Table 1.
const FAT: (f64, f64) = (0.003, 0.46);
/// Young's modulus of muscle along its fibres, MPa; Kim et al. (2010), Table 1.
const MUSCLE_ALONG: f64 = 0.5;
/// Young's modulus of muscle across its fibres, MPa; the isotropic case takes this, the stiffer one.
const MUSCLE_ACROSS: f64 = 0.79;
/// Poisson's ratio of muscle; Kim et al. (2010), Table 1.
const MUSCLE_POISSON: f64 = 0.43;

/// Translation of the maxilla, mm: an advancement (−y is forward).
const ADVANCEMENT: Vec3 = [0.3, -5.0, -0.2];
/// Rotation of the maxilla about the left axis through its centroid, degrees.
const PITCH: f64 = 1.3;
/// Reach of the contact surface past the sliding nodes, degrees (about 10 mm, twice the motion).
const CONTACT_MARGIN: f64 = 7.0;

/// One generated case: mesh, materials, node kinds, contact surface and a bone motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Shell {
    /// Node positions, (n, 3), mm.
    pub nodes: Vec<[f64; 3]>,
    /// Positively oriented tets, (m, 4).
    pub tets: Vec<[u32; 4]>,
    /// Isotropic Young's modulus of each tet, MPa.
    pub young: Vec<f64>,
    /// Poisson's ratio of each tet.
    pub poisson: Vec<f64>,
    /// Young's modulus of each tet along `fibre`, MPa.
    pub young_along: Vec<f64>,
    /// Young's modulus of each tet across `fibre`, MPa.
    pub young_across: Vec<f64>,
    /// Unit fibre direction of each tet; the z axis where there is no muscle.
    pub fibre: Vec<[f64; 3]>,
    /// Volume fraction of muscle in each tet, a multiple of 1/10.
    pub fraction: Vec<f64>,
    /// Nodes that stay: on skull and mandible, and through the thickness at the hairline and the
    /// posterior border.
    pub fixed: Vec<u32>,
    /// Nodes that follow the maxilla.
    pub joined: Vec<u32>,
    /// Nodes on teeth and mucosa that slide over the contact surface.
    pub sliding: Vec<u32>,
    /// Vertices of the contact surface before the motion, (v, 3), mm.
    pub contact_vertices: Vec<[f64; 3]>,
    /// Triangles of the contact surface, (t, 3); normals point from the teeth into the soft tissue.
    pub contact_triangles: Vec<[u32; 3]>,
    /// Nodes of the outer surface.
    pub skin: Vec<u32>,
    /// Rigid motion of the maxilla, row by row, mm.
    pub motion: [[f64; 4]; 4],
}

impl Shell {
    /// A shell of about `n_tets` tets (within a few per cent; at least 1000).
    pub fn generate(n_tets: usize) -> Self {
        let grid = Grid::for_tets(n_tets.max(1000));
        let nodes = grid.nodes();
        let triangles = grid.triangles();
        let tets = grid.tets(&nodes, &triangles);
        let (fraction, fibre) = muscles::sample_muscles(&nodes, &tets, &muscles::muscle_boxes());
        let mix = |fat: f64, muscle: f64| {
            fraction.iter().map(|p| fat * (1.0 - p) + muscle * p).collect::<Vec<f64>>()
        };

        let (mut fixed, mut joined, mut sliding, mut skin) = (vec![], vec![], vec![], vec![]);
        for column in 0..grid.n_columns() {
            let [lon, lat] = grid.angles(column);
            for level in 0..=grid.layers {
                let node = grid.node(column, level);
                if grid.on_border(column) || (level == 0 && on_resting_bone(lon, lat)) {
                    fixed.push(node);
                } else if level == 0 && on_maxilla(lon, lat) {
                    joined.push(node);
                } else if level == 0 && on_teeth(lon, lat, 0.0) {
                    sliding.push(node);
                }
                if level == grid.layers {
                    skin.push(node);
                }
            }
        }

        let on_contact = |column: u32| {
            let [lon, lat] = grid.angles(column as usize);
            on_teeth(lon, lat, CONTACT_MARGIN)
        };
        let mut vertex_of_column = vec![u32::MAX; grid.n_columns()];
        let (mut contact_vertices, mut contact_triangles) = (vec![], vec![]);
        for triangle in triangles.iter().filter(|t| t.iter().all(|&column| on_contact(column))) {
            contact_triangles.push(triangle.map(|column| {
                let vertex = &mut vertex_of_column[column as usize];
                if *vertex == u32::MAX {
                    *vertex = contact_vertices.len() as u32;
                    contact_vertices.push(nodes[grid.node(column as usize, 0) as usize]);
                }
                *vertex
            }));
        }

        let motion = maxilla_motion(&nodes, &joined);
        Shell {
            young: mix(FAT.0, MUSCLE_ACROSS),
            poisson: mix(FAT.1, MUSCLE_POISSON),
            young_along: mix(FAT.0, MUSCLE_ALONG),
            young_across: mix(FAT.0, MUSCLE_ACROSS),
            nodes,
            tets,
            fibre,
            fraction,
            fixed,
            joined,
            sliding,
            contact_vertices,
            contact_triangles,
            skin,
            motion,
        }
    }

    /// Writes every field as `<field>.npy` (format 1.0, little endian) into `folder`, made if absent.
    ///
    /// # Errors
    /// Those of the file system.
    pub fn write(&self, folder: &Path) -> io::Result<()> {
        fs::create_dir_all(folder)?;
        let floats = |name: &str, shape: &[usize], values: &[f64]| {
            write_npy(&folder.join(name), "<f8", shape, values.iter().map(|v| v.to_le_bytes()))
        };
        let indices = |name: &str, shape: &[usize], values: &[u32]| {
            write_npy(&folder.join(name), "<u4", shape, values.iter().map(|v| v.to_le_bytes()))
        };
        floats("nodes.npy", &[self.nodes.len(), 3], self.nodes.as_flattened())?;
        indices("tets.npy", &[self.tets.len(), 4], self.tets.as_flattened())?;
        for (name, values) in [
            ("young.npy", &self.young),
            ("poisson.npy", &self.poisson),
            ("young_along.npy", &self.young_along),
            ("young_across.npy", &self.young_across),
            ("fraction.npy", &self.fraction),
        ] {
            floats(name, &[values.len()], values)?;
        }
        floats("fibre.npy", &[self.fibre.len(), 3], self.fibre.as_flattened())?;
        for (name, nodes) in [
            ("fixed.npy", &self.fixed),
            ("joined.npy", &self.joined),
            ("sliding.npy", &self.sliding),
            ("skin.npy", &self.skin),
        ] {
            indices(name, &[nodes.len()], nodes)?;
        }
        floats(
            "contact_vertices.npy",
            &[self.contact_vertices.len(), 3],
            self.contact_vertices.as_flattened(),
        )?;
        indices(
            "contact_triangles.npy",
            &[self.contact_triangles.len(), 3],
            self.contact_triangles.as_flattened(),
        )?;
        floats("motion.npy", &[4, 4], self.motion.as_flattened())
    }
}

/// A regular grid of columns on the skull patch, each column `layers` cells high.
struct Grid {
    n_lon: usize,
    n_lat: usize,
    layers: usize,
}

impl Grid {
    fn for_tets(n_tets: usize) -> Self {
        let [width, height, thickness] = MIDDLE;
        let edge = (6.0 * width * height * thickness / (LAYER_RATIO * n_tets as f64)).cbrt();
        let layers = ((thickness / (LAYER_RATIO * edge)).round() as usize).max(2);
        let n_quads = n_tets as f64 / (6 * layers) as f64;
        let n_lon = ((n_quads * width / height).sqrt().round() as usize).max(4);
        let n_lat = ((n_quads / n_lon as f64).round() as usize).max(4);
        Grid { n_lon, n_lat, layers }
    }

    fn n_columns(&self) -> usize {
        (self.n_lon + 1) * (self.n_lat + 1)
    }

    fn node(&self, column: usize, level: usize) -> u32 {
        (column * (self.layers + 1) + level) as u32
    }

    /// Longitude and latitude of a column, degrees.
    fn angles(&self, column: usize) -> [f64; 2] {
        let (i, j) = (column / (self.n_lat + 1), column % (self.n_lat + 1));
        let lon = LONGITUDE_MAX * (2.0 * i as f64 / self.n_lon as f64 - 1.0);
        [lon, LATITUDE[0] + (LATITUDE[1] - LATITUDE[0]) * j as f64 / self.n_lat as f64]
    }

    /// Whether the column stands on the hairline or the posterior border, where the model is cut.
    fn on_border(&self, column: usize) -> bool {
        let (i, j) = (column / (self.n_lat + 1), column % (self.n_lat + 1));
        i == 0 || i == self.n_lon || j == self.n_lat
    }

    fn nodes(&self) -> Vec<Vec3> {
        let edge = MIDDLE[0] / self.n_lon as f64;
        let mut nodes = Vec::with_capacity(self.n_columns() * (self.layers + 1));
        for column in 0..self.n_columns() {
            let [lon, lat] = self.angles(column);
            let amplitude = JITTER * edge.min(thickness(lon, lat) / self.layers as f64);
            for level in 0..=self.layers {
                let mut x = tissue_point(lon, lat, level as f64 / self.layers as f64);
                let inside = level > 0
                    && level < self.layers
                    && !self.on_border(column)
                    && lat > LATITUDE[0];
                if inside {
                    for axis in 0..3 {
                        x[axis] += amplitude * hashed(3 * nodes.len() as u64 + axis as u64);
                    }
                }
                nodes.push(x);
            }
        }
        nodes
    }

    /// Triangles of columns, normals outward from the skull; diagonals alternate to prefer no direction.
    fn triangles(&self) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(2 * self.n_lon * self.n_lat);
        for i in 0..self.n_lon {
            for j in 0..self.n_lat {
                let a = (i * (self.n_lat + 1) + j) as u32;
                let (b, d) = (a + self.n_lat as u32 + 1, a + 1);
                let c = b + 1;
                let pair =
                    if (i + j) % 2 == 0 { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] };
                triangles.extend(pair);
            }
        }
        triangles
    }

    /// Three tets per prism. The diagonal of a prism's side rises from the lower column number to the
    /// higher, so neighbours agree on it.
    fn tets(&self, nodes: &[Vec3], triangles: &[[u32; 3]]) -> Vec<[u32; 4]> {
        let mut tets = Vec::with_capacity(3 * self.layers * triangles.len());
        for triangle in triangles {
            let mut columns = triangle.map(|column| column as usize);
            columns.sort_unstable();
            for level in 0..self.layers {
                let [a, b, c] = columns.map(|column| self.node(column, level));
                for mut tet in [[a, b, c, c + 1], [a, b, b + 1, c + 1], [a, a + 1, b + 1, c + 1]] {
                    if signed_volume(nodes, &tet) < 0.0 {
                        tet.swap(2, 3);
                    }
                    tets.push(tet);
                }
            }
        }
        tets
    }
}

/// Inner nodes on skull, cheek bone or mandible, which keep their place.
fn on_resting_bone(lon: f64, lat: f64) -> bool {
    lat > 15.0 || (lon.abs() > 48.0 && lat > 0.0) || (lon.abs() < 50.0 && lat < -40.0)
}

/// Inner nodes on the part of the maxilla that a Le Fort I osteotomy sets free.
fn on_maxilla(lon: f64, lat: f64) -> bool {
    lon.abs() < 35.0 && (-8.0..8.0).contains(&lat)
}

/// Inner nodes on the dental arch and its mucosa, the region grown by `margin` degrees.
fn on_teeth(lon: f64, lat: f64, margin: f64) -> bool {
    lon.abs() < 54.0 + margin && lat > -32.0 - margin && lat < -8.0 + margin
}

/// Thickness of the soft tissue, mm: 8 plus bumps at cheeks, chin and lips, 24 at most.
fn thickness(lon: f64, lat: f64) -> f64 {
    let bump = |lon_0: f64, lat_0: f64, lon_width: f64, lat_width: f64| {
        (-((lon.abs() - lon_0) / lon_width).powi(2) - ((lat - lat_0) / lat_width).powi(2)).exp()
    };
    let grown = 8.0
        + 14.0 * bump(46.0, -14.0, 24.0, 24.0)
        + 8.0 * bump(0.0, -42.0, 24.0, 13.0)
        + 4.0 * bump(0.0, -18.0, 20.0, 12.0);
    grown.min(24.0)
}

/// A point of the skull ellipsoid.
fn skull_point(lon: f64, lat: f64) -> Vec3 {
    let ((sin_lon, cos_lon), (sin_lat, cos_lat)) =
        (lon.to_radians().sin_cos(), lat.to_radians().sin_cos());
    [SKULL[0] * sin_lon * cos_lat, -SKULL[1] * cos_lon * cos_lat, SKULL[2] * sin_lat]
}

/// Outward unit normal of the skull ellipsoid.
fn skull_normal(lon: f64, lat: f64) -> Vec3 {
    let x = skull_point(lon, lat);
    unit([0, 1, 2].map(|axis| x[axis] / SKULL[axis].powi(2)))
}

/// A point at `depth` of the tissue: 0 on the bone, 1 on the skin.
fn tissue_point(lon: f64, lat: f64, depth: f64) -> Vec3 {
    add_scaled(skull_point(lon, lat), depth * thickness(lon, lat), skull_normal(lon, lat))
}

/// x ↦ R (x − c) + c + t, with c the centroid of the joined nodes.
fn maxilla_motion(nodes: &[Vec3], joined: &[u32]) -> [[f64; 4]; 4] {
    let sum = joined.iter().fold([0.0; 3], |sum, &node| add_scaled(sum, 1.0, nodes[node as usize]));
    let centre = sum.map(|s| s / joined.len() as f64);
    let (sin, cos) = PITCH.to_radians().sin_cos();
    let rotation = [[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]];
    let row = |axis: usize| {
        let [a, b, c] = rotation[axis];
        [a, b, c, centre[axis] + ADVANCEMENT[axis] - dot(rotation[axis], centre)]
    };
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

/// Writes one array in numpy's format 1.0: magic, header padded to 64 bytes, data.
fn write_npy<const N: usize>(
    path: &Path,
    kind: &str,
    shape: &[usize],
    values: impl Iterator<Item = [u8; N]>,
) -> io::Result<()> {
    const PREAMBLE: usize = 10; // magic, version and the length of the header
    let shape: String = shape.iter().map(|n| format!("{n}, ")).collect();
    let text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}");
    let length = (PREAMBLE + text.len() + 1).next_multiple_of(64) - PREAMBLE;
    let mut file = BufWriter::new(File::create(path)?);
    file.write_all(b"\x93NUMPY\x01\x00")?;
    file.write_all(&(length as u16).to_le_bytes())?;
    writeln!(file, "{text:<width$}", width = length - 1)?;
    for value in values {
        file.write_all(&value)?;
    }
    file.flush()
}

/// Volume of a tet, negative if it is inside out.
fn signed_volume(nodes: &[Vec3], tet: &[u32; 4]) -> f64 {
    let [a, b, c, d] = tet.map(|node| nodes[node as usize]);
    let [ab, ac, ad] = [b, c, d].map(|x| add_scaled(x, -1.0, a));
    dot(cross(ab, ac), ad) / 6.0
}

/// A number in [−1, 1) from a counter (Steele's splitmix64 finaliser).
fn hashed(counter: u64) -> f64 {
    let mut z = counter.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn add_scaled(a: Vec3, s: f64, b: Vec3) -> Vec3 {
    [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]]
}

fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(a: Vec3) -> Vec3 {
    a.map(|x| x / dot(a, a).sqrt())
}
