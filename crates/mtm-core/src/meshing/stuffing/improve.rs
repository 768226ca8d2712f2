//! Better shapes for the few poor tets of a graded lattice: their nodes are moved, and tets that stay poor are
//! removed.
//!
//! Nodes move one after another, each to the position that is best for the worst tet around it; nodes on the
//! surface stay on it. Tets that are still poor lie at the surface, where a tet can be removed: the mesh stays
//! conforming, and the surface moves by less than the height of that tet.

use crate::mesh::Incidence;
use crate::vector::{add, distinct, dot, norm, scaled, sub};

use super::cut::{Cut, shape};
use super::level::LevelImage;

/// Smallest dihedral angle above which a tet is not improved, radians: somewhat above the required minimum.
const GOAL: f64 = 15.0 * std::f64::consts::PI / 180.0;
/// Smallest dihedral angle of the result, radians.
pub const LEAST_DIHEDRAL: f64 = 10.0 * std::f64::consts::PI / 180.0;
/// Number of passes over the poor tets.
const ROUNDS: usize = 12;
/// Lengths of a move, relative to the node's shortest edge, tried one after another.
const STEPS: [f64; 4] = [0.3, 0.15, 0.07, 0.03];
/// Improvement below which a move is not worthwhile, radians.
const LEAST_GAIN: f64 = 1e-4;
/// Newton steps that move a point back to the surface.
const PROJECTIONS: usize = 8;
/// Distance from the surface, relative to the node's shortest edge, at which the surface counts as reached.
const ON_SURFACE: f64 = 1e-3;

/// Improves `cut` in place until no tet is below `LEAST_DIHEDRAL`; returns the number of tets removed.
pub fn improve(cut: &mut Cut, level: &LevelImage) -> usize {
    let before = cut.tets.len();
    while smooth(cut, level) < LEAST_DIHEDRAL && drop_poor(cut) {}
    before - cut.tets.len()
}

/// Moves the nodes of poor tets; returns the worst remaining quality.
fn smooth(cut: &mut Cut, level: &LevelImage) -> f64 {
    let stars = Incidence::new(cut.nodes.len(), &cut.tets);
    let shape_of = |cut: &Cut, t: u32| shape(cut.tets[t as usize].map(|v| cut.nodes[v as usize]));
    let mut poor: Vec<u32> =
        (0..cut.tets.len() as u32).filter(|&t| shape_of(cut, t) < GOAL).collect();
    for _ in 0..ROUNDS {
        let nodes = distinct(poor.iter().flat_map(|&t| cut.tets[t as usize]));
        let mut moved = false;
        for &node in &nodes {
            moved |= move_node(cut, level, stars.of(node as usize), node);
        }
        // Moves may have made other tets poor, but never poorer than the worst adjacent one was.
        poor = distinct(nodes.iter().flat_map(|&v| stars.of(v as usize)).copied());
        poor.retain(|&t| shape_of(cut, t) < GOAL);
        if !moved {
            break;
        }
    }
    poor.iter().map(|&t| shape_of(cut, t)).fold(f64::INFINITY, f64::min)
}

/// Moves one node to a better position, if there is one.
fn move_node(cut: &mut Cut, level: &LevelImage, star: &[u32], node: u32) -> bool {
    let start = cut.nodes[node as usize];
    let worst_at = |place: [f64; 3], at_least: f64| {
        let mut worst = f64::INFINITY;
        for &t in star {
            let x =
                cut.tets[t as usize].map(|v| if v == node { place } else { cut.nodes[v as usize] });
            worst = worst.min(shape(x));
            if worst <= at_least {
                break;
            }
        }
        worst
    };
    let shortest = star
        .iter()
        .flat_map(|&t| cut.tets[t as usize])
        .filter(|&v| v != node)
        .map(|v| norm(sub(cut.nodes[v as usize], start)))
        .fold(f64::INFINITY, f64::min);
    let (mut place, mut worst) = (start, worst_at(start, f64::NEG_INFINITY));
    for step in STEPS {
        for direction in directions() {
            let mut candidate = add(place, scaled(direction, step * shortest));
            if cut.on_surface[node as usize] {
                match projected(level, candidate, shortest) {
                    Some(on_surface) => candidate = on_surface,
                    None => continue,
                }
            }
            let found = worst_at(candidate, worst);
            if found > worst + LEAST_GAIN {
                (place, worst) = (candidate, found);
            }
        }
    }
    cut.nodes[node as usize] = place;
    place != start
}

/// The 6 directions along the axes and the 8 diagonals, unit length.
fn directions() -> impl Iterator<Item = [f64; 3]> {
    let diagonal = 1.0 / 3.0_f64.sqrt();
    let side = |bits: usize, a: usize| if bits >> a & 1 == 1 { 1.0 } else { -1.0 };
    (0..6)
        .map(move |d| {
            let mut axis = [0.0; 3];
            axis[d / 2] = side(d, 0);
            axis
        })
        .chain((0..8).map(move |d| [0, 1, 2].map(|a| diagonal * side(d, a))))
}

/// The point of the zero set near `point`, along the gradients; none if it is not within `reach`.
fn projected(level: &LevelImage, point: [f64; 3], reach: f64) -> Option<[f64; 3]> {
    let mut x = point;
    for _ in 0..PROJECTIONS {
        let value = level.value(x);
        let gradient = level.gradient(x);
        let square = dot(gradient, gradient);
        if square == 0.0 {
            return None;
        }
        let step = value / square;
        // A clipped level underestimates the distance, a steep one overestimates it: half an edge is far
        // enough.
        let length = (step * square.sqrt()).abs();
        let scale = if length > 0.5 * reach { 0.5 * reach / length } else { 1.0 };
        x = sub(x, scaled(gradient, step * scale));
        if length < ON_SURFACE * reach {
            return (norm(sub(x, point)) <= reach).then_some(x);
        }
    }
    None
}

/// Removes tets below the limit that have a face on the boundary; returns whether there was one.
fn drop_poor(cut: &mut Cut) -> bool {
    let stars = Incidence::new(cut.nodes.len(), &cut.tets);
    let tets = &cut.tets;
    let is_poor = |tet: &[u32; 4]| shape(tet.map(|v| cut.nodes[v as usize])) < LEAST_DIHEDRAL;
    let on_boundary = |t: usize| {
        (0..4).any(|opposite| {
            let face: Vec<u32> = (0..4).filter(|&v| v != opposite).map(|v| tets[t][v]).collect();
            !stars.of(face[0] as usize).iter().any(|&other| {
                other as usize != t && face.iter().all(|v| tets[other as usize].contains(v))
            })
        })
    };
    let keep: Vec<bool> = (0..tets.len()).map(|t| !(is_poor(&tets[t]) && on_boundary(t))).collect();
    let dropped = keep.iter().filter(|k| !**k).count();
    if dropped == 0 {
        return false;
    }
    let mut kept = keep.iter();
    cut.tets.retain(|_| *kept.next().expect("one per tet"));
    // Nodes behind a removed tet are on the boundary now, but not on the zero set: they may move freely.
    cut.compress();
    true
}
