//! Which tets the surface of a muscle crosses, and which lie wholly inside.

use crate::mesh::TetMesh;
use crate::muscles::equivalent::aligned_box::AlignedBox;
use crate::muscles::equivalent::shape::{InsideTest, MuscleShape, Side};
use crate::muscles::equivalent::tet_tree::{Branch, TetTree};
use crate::vector::Vec3;

/// Product of the numbers of triangles and tets of a branch above which its halves go to different threads.
const PARALLEL_PAIRS: usize = 1 << 16;

/// A tet that contains part of a muscle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Touch {
    pub tet: u32,
    /// Where the triangles that may cross the tet start in [`Touches::triangles`].
    first: u32,
    /// How many there are.
    count: u32,
    /// Whether the tet lies wholly inside the muscle.
    pub is_whole: bool,
}

/// The tets that contain part of a muscle.
#[derive(Debug, Default)]
pub(super) struct Touches {
    pub tets: Vec<Touch>,
    triangles: Vec<u32>,
    /// Number of points whose side was evaluated.
    pub evaluations: usize,
    /// Number of tets that were examined individually.
    pub looked_at: usize,
}

impl Touch {
    fn whole(tet: u32) -> Self {
        Self { tet, first: 0, count: 0, is_whole: true }
    }
}

impl Touches {
    /// Triangles that may cross the tet.
    pub fn triangles(&self, touch: &Touch) -> &[u32] {
        &self.triangles[touch.first as usize..(touch.first + touch.count) as usize]
    }

    fn joined(mut self, other: Self) -> Self {
        let shift = self.triangles.len() as u32;
        self.tets.extend(other.tets.iter().map(|t| Touch { first: t.first + shift, ..*t }));
        self.triangles.extend_from_slice(&other.triangles);
        self.evaluations += other.evaluations;
        self.looked_at += other.looked_at;
        self
    }
}

/// The tets and their boxes, and the muscle that goes through them.
pub(super) struct Passage<'a> {
    pub mesh: &'a TetMesh,
    pub boxes: &'a [AlignedBox],
    pub tree: &'a TetTree,
    pub muscle: &'a MuscleShape<'a>,
    pub stop: &'a (dyn Fn() -> bool + Sync),
}

impl Passage<'_> {
    /// The tets that contain part of the muscle, or some of them once `stop` returns true.
    ///
    /// A branch of tets whose box no triangle meets is decided by one evaluation if the winding number allows;
    /// its tets are then not examined.
    pub fn touches(&self) -> Touches {
        let all: Vec<u32> = (0..self.muscle.corners.len() as u32).collect();
        self.visit(0, &all)
    }

    fn visit(&self, at: usize, triangles: &[u32]) -> Touches {
        let mut found = Touches::default();
        let Some(branch) = self.tree.branch(at) else { return found };
        if !branch.bounds.meets(&self.muscle.bounds) {
            return found;
        }
        let near: Vec<u32> = self.near(triangles, &branch.bounds);
        if near.is_empty() && self.muscle.test == InsideTest::Winding {
            found.evaluations += 1;
            let (centre, radius) = (branch.bounds.centre(), branch.bounds.radius());
            match self.muscle.side_of(&centre, radius) {
                Side::Inside => {
                    found.tets.extend(self.tree.tets(branch).iter().map(|&t| Touch::whole(t)));
                    return found;
                }
                Side::Outside => return found,
                Side::Mixed => {}
            }
        }
        match branch.halves(at) {
            None => self.look_at(branch, &near, &mut found),
            Some([first, second]) => {
                let (left, right) = (|| self.visit(first, &near), || self.visit(second, &near));
                let pairs = (near.len() + 1) * self.tree.tets(branch).len();
                let (left, right) = if pairs > PARALLEL_PAIRS {
                    if (self.stop)() {
                        return found;
                    }
                    rayon::join(left, right)
                } else {
                    (left(), right())
                };
                found = found.joined(left).joined(right);
            }
        }
        found
    }

    fn near(&self, triangles: &[u32], bounds: &AlignedBox) -> Vec<u32> {
        let meets = |&&t: &&u32| self.muscle.boxes[t as usize].meets(bounds);
        triangles.iter().filter(meets).copied().collect()
    }

    /// Decides the tets of a leaf individually.
    fn look_at(&self, leaf: &Branch, triangles: &[u32], found: &mut Touches) {
        for &tet in self.tree.tets(leaf) {
            let bounds = &self.boxes[tet as usize];
            if !bounds.meets(&self.muscle.bounds) {
                continue;
            }
            found.looked_at += 1;
            let corners =
                self.mesh.tets()[tet as usize].map(|v| Vec3::from(self.mesh.nodes()[v as usize]));
            let faces = faces(&corners);
            let first = found.triangles.len();
            for &t in triangles {
                if self.muscle.boxes[t as usize].meets(bounds)
                    && may_cross(&corners, &faces, &self.muscle.corners[t as usize])
                {
                    found.triangles.push(t);
                }
            }
            let count = (found.triangles.len() - first) as u32;
            if count == 0 {
                found.evaluations += 1;
                let centroid = corners.iter().sum::<Vec3>() / 4.0;
                let radius = corners.iter().map(|c| (c - centroid).norm()).fold(0.0, f64::max);
                match self.muscle.side_of(&centroid, radius) {
                    Side::Inside => found.tets.push(Touch::whole(tet)),
                    Side::Outside => {}
                    Side::Mixed => found.tets.push(Touch { is_whole: false, ..Touch::whole(tet) }),
                }
            } else {
                found.tets.push(Touch { tet, first: first as u32, count, is_whole: false });
            }
        }
    }
}

/// Outward normals of a tet's faces, and their offsets.
fn faces([a, b, c, d]: &[Vec3; 4]) -> [(Vec3, f64); 4] {
    let face = |p: &Vec3, q: &Vec3, r: &Vec3| {
        let normal = (q - p).cross(&(r - p));
        (normal, normal.dot(p))
    };
    [face(b, c, d), face(a, d, c), face(a, b, d), face(a, c, b)]
}

/// False only if a face of the tet, or the plane of the triangle, separates the two.
fn may_cross(tet: &[Vec3; 4], faces: &[(Vec3, f64); 4], triangle: &[Vec3; 3]) -> bool {
    if faces.iter().any(|(n, offset)| triangle.iter().all(|p| n.dot(p) > *offset)) {
        return false;
    }
    let [a, b, c] = triangle;
    let normal = (b - a).cross(&(c - a));
    let sides = tet.map(|p| normal.dot(&(p - a)));
    !(sides.iter().all(|&s| s > 0.0) || sides.iter().all(|&s| s < 0.0))
}
