//! The position of each sliding node on its contact surface under a plan: gap, normal and curvature there.

use rayon::prelude::*;

use super::Sliding;
use super::field::{Field, FieldValue};
use crate::boundary::Motion;
use crate::error::Result;
use crate::geometry::motion::RigidMotion;
use crate::geometry::surface::Closest;
use crate::vector::{dot, norm, scaled, sub};

/// Length of the gradient of the distance by which a gap is divided at least, while a node passes such a place.
const LEAST_SLOPE: f64 = 0.1;
/// Length of the gradient at rest below which the field does not resolve the bone at a node: a spike or a sheet
/// thinner than about 0.4 lattice spacings, around whose middle the field is a bowl. A node cannot follow a level
/// of that bowl, whose radius is a fraction of a millimetre.
const RESOLVED_SLOPE: f64 = 0.3;

/// Difference from its gap at rest, over the lattice spacing, up to which a node counts as lying at that gap.
const AT_REST: f64 = 0.05;
/// Reach of a surface over the lattice spacing of its field.
const REACH: f64 = 1.5;

/// The surface that one node slides on: a level set of its segment's field, shifted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Seat {
    /// Shift from the contact surface, mm.
    pub offset: [f64; 3],
    /// Value of the field on it, mm.
    level: f64,
    /// Where the field does not resolve the bone: the unit normal of the plane through the node, or at its gap, on
    /// which it slides instead.
    plane: Option<[f64; 3]>,
}

/// The local shape of a surface at a node.
#[derive(Debug, Clone, Copy)]
pub(super) struct LocalShape {
    /// Distance of the node from its surface, negative behind it, mm, to first order.
    pub gap: f64,
    /// Unit normal, out of the bone.
    pub normal: [f64; 3],
    /// Length of the gradient of the field.
    length: f64,
    /// The same, at least [`LEAST_SLOPE`]: the gap and the Hessian are divided by it.
    slope: f64,
    /// Hessian of the distance over the slope, 1/mm.
    pub hessian: [[f64; 3]; 3],
}

impl LocalShape {
    /// A plane with the unit `normal`, `gap` mm behind a node.
    fn plane(gap: f64, normal: [f64; 3]) -> Self {
        Self { gap, normal, length: 1.0, slope: 1.0, hessian: [[0.0; 3]; 3] }
    }

    /// Distance in terms of the field, mm: smooth, whereas `gap` is divided by the slope.
    pub fn level(&self) -> f64 {
        self.gap * self.slope
    }

    /// Multiplier of the level that corresponds to a force along the normal, N.
    pub fn multiplier(&self, force: f64) -> f64 {
        force / self.slope
    }

    /// Rate of change of the level along `way`.
    pub fn level_rate(&self, way: [f64; 3]) -> f64 {
        self.length * dot(self.normal, way)
    }
}

/// Contact surfaces under a plan, and the position of each node on them.
pub(super) struct Seats<'a> {
    sliding: &'a Sliding,
    surfaces: Vec<MovedSurface<'a>>,
    seats: Vec<Seat>,
    /// Positions of the nodes if they were attached to their segment, mm.
    pub clinging: Vec<[f64; 3]>,
}

/// A contact surface under a plan.
enum MovedSurface<'a> {
    /// Points are moved back to the field at rest, whose samples can be used for every plan.
    Rigid(&'a Field, RigidMotion),
    /// A surface with new vertices.
    Deformed(Field),
    /// The segment has no sliding nodes.
    Unused,
}

impl<'a> Seats<'a> {
    /// The surfaces of `sliding` moved by `motions`, one per segment.
    ///
    /// A node without a prescribed gap slides on the contact surface shifted through the node, by the node's
    /// offset at rest, moved with the segment. However far the node is from the contact surface, the shifted
    /// surface is equally smooth, while the surface at constant distance may fold.
    pub fn new(sliding: &'a Sliding, motions: &[&Motion]) -> Result<Self> {
        let surfaces = sliding
            .fields
            .iter()
            .zip(motions)
            .map(|(field, motion)| {
                Ok(match (field, motion) {
                    (None, _) | (_, Motion::Nodes(_)) => MovedSurface::Unused,
                    (Some(field), Motion::Rigid(rigid)) => MovedSurface::Rigid(field, *rigid),
                    (Some(field), Motion::Surface(motion)) => {
                        MovedSurface::Deformed(field.of(motion.carry(field.surface())?))
                    }
                })
            })
            .collect::<Result<Vec<_>>>()?;
        let clinging = sliding.clinging(motions);
        let seats = vec![Seat { offset: [0.0; 3], level: 0.0, plane: None }; clinging.len()];
        let mut out = Self { sliding, surfaces, seats, clinging };
        let feet: Vec<[f64; 3]> = (0..out.seats.len()).map(|i| out.foot(i)).collect();
        for (i, (gap, &foot)) in sliding.gaps.iter().zip(&feet).enumerate() {
            if gap.is_none() {
                out.seats[i].offset = sub(out.clinging[i], foot);
            }
        }
        // A node that lies at its gap stays there at rest, whatever error the field makes.
        let levels = out.touches(&out.clinging.clone());
        for (i, (touch, gap)) in levels.iter().zip(&sliding.gaps).enumerate() {
            let near = AT_REST * out.spacing(sliding.nodes[i].segment);
            if touch.length < RESOLVED_SLOPE {
                out.seats[i].plane = Some(out.normal_at(i, feet[i]));
                out.seats[i].level = gap.unwrap_or(0.0);
                continue;
            }
            out.seats[i].level = match *gap {
                None => touch.level(),
                Some(gap) if (sliding.rest_distance(i) - gap).abs() <= near => {
                    touch.level() + gap - sliding.rest_distance(i)
                }
                Some(gap) => gap,
            };
        }
        Ok(out)
    }

    /// Current position of the closest point of node `i` at rest, mm.
    fn foot(&self, i: usize) -> [f64; 3] {
        let rest = &self.sliding.rest[i];
        match &self.surfaces[self.sliding.nodes[i].segment] {
            MovedSurface::Rigid(_, rigid) => rigid.apply(rest.point),
            MovedSurface::Deformed(field) => {
                field.surface().point_at(rest.triangle, rest.barycentric)
            }
            MovedSurface::Unused => rest.point,
        }
    }

    /// Current unit normal of the triangles at the `foot` of node `i`.
    fn normal_at(&self, i: usize, foot: [f64; 3]) -> [f64; 3] {
        match &self.surfaces[self.sliding.nodes[i].segment] {
            MovedSurface::Rigid(_, rigid) => rigid.rotate(self.sliding.rest[i].normal),
            MovedSurface::Deformed(field) => field.surface().closest_one(foot).normal,
            MovedSurface::Unused => self.sliding.rest[i].normal,
        }
    }

    /// The local surface of each node at its position in `at`, mm.
    pub fn touches(&self, at: &[[f64; 3]]) -> Vec<LocalShape> {
        let mut out = Vec::with_capacity(at.len());
        // Nodes are ordered by segment.
        for chunk in self.sliding.nodes.chunk_by(|a, b| a.segment == b.segment) {
            let first = out.len();
            let seats = &self.seats[first..first + chunk.len()];
            let own: Vec<[f64; 3]> = at[first..first + chunk.len()]
                .iter()
                .zip(seats)
                .map(|(&x, seat)| sub(x, seat.offset))
                .collect();
            match &self.surfaces[chunk[0].segment] {
                MovedSurface::Rigid(field, rigid) => {
                    let back: Vec<[f64; 3]> = own.iter().map(|&x| rigid.apply_inverse(x)).collect();
                    let turn = |value: FieldValue| FieldValue {
                        distance: value.distance,
                        gradient: rigid.rotate(value.gradient),
                        hessian: turned(rigid, &value.hessian),
                    };
                    felt(field, &back, seats, turn, &mut out);
                }
                MovedSurface::Deformed(field) => felt(field, &own, seats, |value| value, &mut out),
                MovedSurface::Unused => {
                    out.extend(own.iter().map(|_| LocalShape::plane(0.0, [0.0, 0.0, 1.0])));
                }
            }
        }
        for (i, seat) in self.seats.iter().enumerate() {
            if let Some(normal) = seat.plane {
                let away = sub(sub(at[i], seat.offset), self.foot(i));
                out[i] = LocalShape::plane(dot(normal, away) - seat.level, normal);
            }
        }
        out
    }

    /// Closest point of the moved triangle surface to node `i` at `at`, and its distance beyond the border, mm,
    /// if it is beyond one.
    pub fn closest(&self, i: usize, at: [f64; 3]) -> (Closest, Option<f64>) {
        let own = sub(at, self.seats[i].offset);
        let found = match &self.surfaces[self.sliding.nodes[i].segment] {
            MovedSurface::Rigid(field, rigid) => rigid.closest(field.surface(), own),
            MovedSurface::Deformed(field) => field.surface().closest_one(own),
            MovedSurface::Unused => {
                Closest { point: own, on_border: false, ..self.sliding.rest[i] }
            }
        };
        let away = sub(own, found.point);
        let past = norm(sub(away, scaled(found.normal, dot(found.normal, away))));
        (found, found.on_border.then_some(past))
    }

    /// Largest intermediate distance of nodes from their surfaces, mm: further away, or behind thin bone, the
    /// nearest surface may be another one.
    pub fn reach(&self) -> f64 {
        let spacings = (0..self.surfaces.len()).map(|s| self.spacing(s));
        REACH * spacings.fold(f64::INFINITY, f64::min)
    }

    /// Lattice spacing of the field of segment `s`, mm.
    fn spacing(&self, s: usize) -> f64 {
        self.field(s).map_or(f64::INFINITY, Field::spacing)
    }

    /// Mean edge of the surface of segment `s`, mm.
    pub fn mean_edge(&self, s: usize) -> f64 {
        self.field(s).map_or(0.0, |field| field.surface().mean_edge_length())
    }

    fn field(&self, s: usize) -> Option<&Field> {
        match &self.surfaces[s] {
            MovedSurface::Rigid(field, _) => Some(field),
            MovedSurface::Deformed(field) => Some(field),
            MovedSurface::Unused => None,
        }
    }
}

/// Adds the local surfaces of nodes at `points` of the field; `turn` rotates values to the current orientation
/// of the surface.
fn felt(
    field: &Field,
    points: &[[f64; 3]],
    seats: &[Seat],
    turn: impl Fn(FieldValue) -> FieldValue + Sync,
    out: &mut Vec<LocalShape>,
) {
    let ready = field.at(points);
    out.par_extend(points.par_iter().zip(seats).with_min_len(64).map(|(&point, seat)| {
        let value = turn(ready.value(point));
        let length = norm(value.gradient);
        let slope = length.max(LEAST_SLOPE);
        LocalShape {
            gap: (value.distance - seat.level) / slope,
            normal: scaled(value.gradient, 1.0 / length.max(f64::MIN_POSITIVE)),
            slope,
            length,
            hessian: value.hessian.map(|row| scaled(row, 1.0 / slope)),
        }
    }));
}

/// R H Rᵀ.
fn turned(rigid: &RigidMotion, hessian: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    // R H, row by row since H is symmetric; the same again from the other side.
    let half: Vec<[f64; 3]> = hessian.iter().map(|&row| rigid.rotate(row)).collect();
    let column = |c: usize| rigid.rotate([half[0][c], half[1][c], half[2][c]]);
    [column(0), column(1), column(2)]
}
