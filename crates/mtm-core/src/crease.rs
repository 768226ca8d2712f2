//! Walls that hold a sliding node: one plane as a rule, two where it lies in a crease of the moved
//! surface, three where it rests in a corner.
//!
//! Between two walls of a concave surface the closest point jumps, and a node that is held by one plane
//! at a time may leave each wall through the other for ever. Held by both planes it slides along the
//! crease, on both walls at once: each wall taken on leaves it less freedom, so taking on ends.

use std::sync::Arc;

use crate::curvature::curvatures;
use crate::mesh::{add, dot, norm, scaled, sub};
use crate::motion::RigidMotion;
use crate::surface::{Closest, Surface};

/// Times a node leaves its walls before the wall it finds is taken on as well: most find their wall
/// sooner, and their answer has one plane.
const JUMPS: u8 = 3;
/// Share of a wall's normal that no other wall has, below which it is the same wall (12°): the crease of
/// flatter walls is ill placed, and their normals turn little enough to follow.
const SAME_WALL: f64 = 0.2;
/// Cosine between a wall's normal and the way to a node from which that way leads along the wall.
const FACING: f64 = 0.5;
/// Most walls of a node: a third leaves it no freedom.
const MOST_WALLS: usize = 3;

/// Constraint of one sliding node by one wall.
#[derive(Debug, Clone, Copy)]
pub struct ContactRow {
    /// Index among the sliding nodes; rows of one node follow each other.
    pub node: usize,
    /// Unit normal of the wall.
    pub normal: [f64; 3],
    /// Closest point of the wall, mm.
    pub point: [f64; 3],
}

/// Where the surface that one node slides on lies: the contact surface, shifted and thickened.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Seat {
    /// Shift of the node's surface from the contact surface, mm.
    pub offset: [f64; 3],
    /// Distance that the node keeps from it, out of the bone, mm.
    pub gap: f64,
}

/// Closest point of the surface that one node slides on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Foot {
    pub point: [f64; 3],
    pub normal: [f64; 3],
    pub triangle: u32,
    /// Weights of the triangle's corners.
    pub barycentric: [f64; 3],
    pub on_border: bool,
    /// Distance of the node from its surface, negative behind it, mm.
    pub gap: f64,
}

impl Foot {
    /// Distance of `at` along the normal, mm.
    pub fn height(&self, at: [f64; 3]) -> f64 {
        dot(self.normal, sub(at, self.point))
    }
}

/// A contact surface under a plan.
pub(crate) enum MovedSurface {
    /// Queries are carried back to the surface at rest, whose index serves every plan.
    Rigid(Arc<Surface>, RigidMotion),
    /// A surface with new vertices.
    Moved(Surface),
    /// The segment has no sliding nodes.
    Unused,
}

impl MovedSurface {
    /// Closest point to a node at `at`; on a crease, with the normal of the wall that faces it most.
    pub fn foot(&self, seat: &Seat, at: [f64; 3]) -> Foot {
        self.ask(seat, at, |surface, at| surface.facing(at, &surface.closest_one(at)))
    }

    /// Closest point of the wall that `triangle` belongs to.
    pub fn foot_from(&self, seat: &Seat, at: [f64; 3], triangle: u32) -> Foot {
        self.ask(seat, at, |surface, at| surface.closest_from(at, triangle))
    }

    fn ask(
        &self,
        seat: &Seat,
        at: [f64; 3],
        closest: impl Fn(&Surface, [f64; 3]) -> Closest,
    ) -> Foot {
        let own = sub(at, seat.offset);
        let (found, point, normal) = match self {
            Self::Rigid(rest, rigid) => {
                let found = closest(rest, rigid.apply_inverse(own));
                (found, rigid.apply(found.point), rigid.rotate(found.normal))
            }
            Self::Moved(surface) => {
                let found = closest(surface, own);
                (found, found.point, found.normal)
            }
            Self::Unused => {
                let found = Foot {
                    point: at,
                    normal: [0.0; 3],
                    triangle: 0,
                    barycentric: [0.0; 3],
                    on_border: false,
                    gap: 0.0,
                };
                return found;
            }
        };
        let away = sub(own, point);
        let distance = if found.on_border { dot(normal, away) } else { found.signed_distance };
        // Out of the bone: along the closest distance; the normal stands in past a border, on the
        // surface itself, and over a crease, where that way leads along the wall.
        let straight = scaled(away, 1.0 / distance);
        let faces = !found.on_border && dot(straight, normal) > FACING;
        let outward = if faces { straight } else { normal };
        Foot {
            point: add(add(point, seat.offset), scaled(outward, seat.gap)),
            normal,
            triangle: found.triangle,
            barycentric: found.barycentric,
            on_border: found.on_border,
            gap: distance - seat.gap,
        }
    }

    /// Principal curvatures of the normal field at a foot, 1/mm, with their directions.
    pub fn curvatures(&self, foot: &Foot) -> [(f64, [f64; 3]); 2] {
        match self {
            Self::Rigid(rest, rigid) => curvatures(rest, foot.triangle, foot.barycentric)
                .map(|(curvature, axis)| (curvature, rigid.rotate(axis))),
            Self::Moved(surface) => curvatures(surface, foot.triangle, foot.barycentric),
            Self::Unused => [(0.0, [0.0; 3]); 2],
        }
    }

    /// Where a closest point of the surface at rest lies now.
    pub fn carried(&self, rest: &Closest) -> [f64; 3] {
        match self {
            Self::Rigid(_, rigid) => rigid.apply(rest.point),
            Self::Moved(surface) => surface.point_at(rest.triangle, rest.barycentric),
            Self::Unused => rest.point,
        }
    }

    pub fn mean_edge(&self) -> f64 {
        match self {
            Self::Rigid(surface, _) => surface.mean_edge_length(),
            Self::Moved(surface) => surface.mean_edge_length(),
            Self::Unused => 0.0,
        }
    }
}

/// The walls of one sliding node.
#[derive(Debug, Clone)]
pub(crate) struct Walls {
    /// A foot on each; at least one.
    pub feet: Vec<Foot>,
    jumps: u8,
}

impl Walls {
    /// One wall.
    pub fn new(foot: Foot) -> Self {
        Self { feet: vec![foot], jumps: 0 }
    }

    /// Feet on the same walls for a node at `at`, whose closest point is `nearest`.
    pub fn feet_at(
        &self,
        surface: &MovedSurface,
        seat: &Seat,
        at: [f64; 3],
        nearest: Foot,
    ) -> Vec<Foot> {
        match self.feet.as_slice() {
            [_] => vec![nearest],
            several => several.iter().map(|f| surface.foot_from(seat, at, f.triangle)).collect(),
        }
    }

    /// Goes on with `feet`; walls that have become one are one.
    pub fn follow(&mut self, feet: &[Foot]) {
        self.feet.clear();
        for &foot in feet {
            if self.feet.is_empty() || own_share(&self.feet, foot.normal) > SAME_WALL {
                self.feet.push(foot);
            }
        }
    }

    /// Lets go of the walls that pull while others push; whether there were any.
    pub fn let_go(&mut self, forces: &[f64]) -> bool {
        let push = forces.iter().filter(|&&f| f >= 0.0).count();
        if push == 0 || push == forces.len() {
            return false;
        }
        let mut force = forces.iter();
        self.feet.retain(|_| force.next().is_none_or(|&f| f >= 0.0));
        true
    }

    /// Notes that the node, now at `at` with closest point `nearest` off its gap by more than the
    /// limit, may have left its walls; whether the wall it found was taken on.
    pub fn leave(
        &mut self,
        surface: &MovedSurface,
        seat: &Seat,
        at: [f64; 3],
        nearest: Foot,
    ) -> bool {
        let feet: Vec<Foot> =
            self.feet.iter().map(|f| surface.foot_from(seat, at, f.triangle)).collect();
        if feet.iter().any(|f| norm(sub(f.normal, nearest.normal)) <= SAME_WALL) {
            return false;
        }
        self.jumps += 1;
        if self.jumps < JUMPS {
            return false;
        }
        self.jumps = 0;
        self.follow(&feet);
        let dependent = own_share(&self.feet, nearest.normal) <= SAME_WALL;
        if dependent || self.feet.len() == MOST_WALLS {
            // The new wall stands in for the one most like it.
            let like = |f: &Foot| dot(f.normal, nearest.normal);
            let most = (0..self.feet.len()).max_by(|&a, &b| {
                like(&self.feet[a]).total_cmp(&like(&self.feet[b])).then(b.cmp(&a))
            });
            self.feet.remove(most.unwrap_or(0));
        }
        self.feet.push(nearest);
        let all = std::mem::take(&mut self.feet);
        self.follow(&all);
        true
    }
}

/// Contact forces on one sliding node.
#[derive(Debug, Clone, Default)]
pub(crate) struct Push {
    /// Force of each wall, N.
    pub forces: Vec<f64>,
    normals: Vec<[f64; 3]>,
}

impl Push {
    /// Adds the force of one more wall.
    pub fn add(&mut self, normal: [f64; 3], force: f64) {
        self.forces.push(force);
        self.normals.push(normal);
    }

    /// Unit vector and force along it of all walls together; `otherwise` where there is none.
    ///
    /// The force is positive where the walls push, and the vector then points out of the bone.
    pub fn along(&self, otherwise: [f64; 3]) -> ([f64; 3], f64) {
        if let ([normal], [force]) = (self.normals.as_slice(), self.forces.as_slice()) {
            return (*normal, *force);
        }
        let (mut total, mut outward) = ([0.0; 3], [0.0; 3]);
        for (&normal, &force) in self.normals.iter().zip(&self.forces) {
            total = add(total, scaled(normal, force));
            outward = add(outward, normal);
        }
        let length = norm(total);
        if length == 0.0 {
            return (otherwise, 0.0);
        }
        let push = self.forces.iter().all(|&f| f >= 0.0);
        let pull = self.forces.iter().all(|&f| f <= 0.0);
        let signed = if push || (!pull && dot(total, outward) >= 0.0) { length } else { -length };
        (scaled(total, 1.0 / signed), signed)
    }
}

/// Length of the part of a unit normal that the walls do not span.
fn own_share(walls: &[Foot], normal: [f64; 3]) -> f64 {
    let mut axes: Vec<[f64; 3]> = Vec::with_capacity(MOST_WALLS);
    for n in walls.iter().map(|f| f.normal).chain([normal]) {
        let rest = axes.iter().fold(n, |rest, &q| sub(rest, scaled(q, dot(q, rest))));
        let length = norm(rest);
        axes.push(scaled(rest, 1.0 / length.max(f64::MIN_POSITIVE)));
        if axes.len() > walls.len() {
            return length;
        }
    }
    0.0
}
