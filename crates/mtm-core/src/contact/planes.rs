//! The surfaces that candidate nodes may touch, linearised about a state: one tangent plane per node.

use crate::boundary::Motion;
use crate::vector::{add, dot, norm, scaled, sub};

/// Length of the mean of two unit normals below which they are opposed, and have no meaningful mean.
const LEAST_MEAN: f64 = 0.5;
/// Factors on the share by which a plane follows its surface: if the surface oscillates, and if it does not.
const STEADIER: f64 = 0.7;
const FREER: f64 = 1.2;

/// The position of a candidate relative to its surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Meeting {
    /// g, mm.
    pub gap: f64,
    /// Closest point of the surface, mm.
    pub point: [f64; 3],
    /// Unit vector away from the surface.
    pub normal: [f64; 3],
    /// Nodes of the closest triangle, with the weights of the closest point; none on bone.
    pub facing: Option<([u32; 3], [f64; 3])>,
}

/// The gap of a candidate about some state: g(u) = offset + Σ cⱼ·uⱼ.
#[derive(Debug, Clone, Default)]
pub(crate) struct Plane {
    /// Gap at the state of linearisation, mm.
    pub gap: f64,
    /// Unit vector away from the surface.
    pub normal: [f64; 3],
    /// mm.
    pub offset: f64,
    /// Nodes with the derivative of the gap with respect to each.
    pub ends: Vec<(u32, [f64; 3])>,
    /// Share by which the plane follows the surface; 1 unless it oscillates.
    turn: f64,
    /// By how much the normal and the gap, mm, of the surface last differed from those of the plane.
    swing: ([f64; 3], f64),
    /// Whether the candidate was beyond the border in a late round before.
    came_back: bool,
}

impl Plane {
    /// The plane of candidate `node`, found at `meeting` under displacements `u` of all nodes.
    pub fn new(node: u32, meeting: &Meeting, u: &[[f64; 3]]) -> Self {
        let Meeting { gap, normal, facing, .. } = *meeting;
        let mut ends = vec![(node, normal)];
        if let Some((nodes, weights)) = facing {
            ends.extend((0..3).map(|k| (nodes[k], scaled(normal, -weights[k]))));
        }
        let here: f64 = ends.iter().map(|(j, c)| dot(*c, u[*j as usize])).sum();
        Self { gap, normal, offset: gap - here, ends, turn: 1.0, ..Self::default() }
    }

    /// Rotates the plane to another normal about the node positions under displacements `u`, with another gap
    /// there.
    fn turn_to(&mut self, normal: [f64; 3], gap: f64, u: &[[f64; 3]]) {
        for (_, c) in &mut self.ends {
            *c = scaled(normal, dot(*c, self.normal));
        }
        self.normal = normal;
        self.offset = 0.0;
        self.offset = gap - self.at(u);
    }

    /// g under displacements `u` of all nodes, mm.
    pub fn at(&self, u: &[[f64; 3]]) -> f64 {
        self.ends.iter().fold(self.offset, |gap, (j, c)| gap + dot(*c, u[*j as usize]))
    }
}

/// The surface of every candidate as its tangent plane at a state; nothing for candidates beyond a border.
#[derive(Debug)]
pub(crate) struct Planes {
    pub at: Vec<Option<Plane>>,
}

impl Meeting {
    /// Moves the plane of a node at `place` from its bone under motion `from` to the bone under motion `to`; a
    /// plane on a deformed segment stays as it is.
    pub fn carry(&mut self, from: &Motion, to: &Motion, place: [f64; 3]) {
        let (Motion::Rigid(from), Motion::Rigid(to)) = (from, to) else { return };
        let before = dot(self.normal, sub(place, self.point));
        self.point = to.apply(from.apply_inverse(self.point));
        self.normal = to.rotate(from.rotate_inverse(self.normal));
        self.gap += dot(self.normal, sub(place, self.point)) - before;
    }
}

impl Planes {
    /// Largest depth of a candidate behind its surface at the state of the planes, mm.
    pub fn deepest(&self) -> f64 {
        self.at.iter().flatten().fold(0.0, |m, p| m.max(-p.gap))
    }

    /// Damps planes that oscillate: if a surface lies alternately on either side of what the planes `before`
    /// predicted, the planes follow it by a smaller share. [`Plane::gap`] remains the gap that was found.
    ///
    /// A candidate that came back to its surface, and that its plane pushes beyond the border again, keeps that
    /// plane for as long as it pushes: it would come back for ever. Losing a plane that does not push changes
    /// nothing.
    ///
    /// `u`: displacements of all nodes. `pushes`: whether the plane of a candidate does.
    pub fn steady(&mut self, before: &Self, u: &[[f64; 3]], pushes: impl Fn(usize) -> bool) {
        for (i, (now, before)) in self.at.iter_mut().zip(&before.at).enumerate() {
            let Some(before) = before else {
                now.iter_mut().for_each(|now| now.came_back = true);
                continue;
            };
            let Some(now) = now else {
                let stays = before.came_back && pushes(i);
                *now = stays.then(|| Plane { gap: before.at(u), ..before.clone() });
                continue;
            };
            now.came_back = before.came_back;
            let foreseen = before.at(u);
            now.swing = (sub(now.normal, before.normal), now.gap - foreseen);
            let (turned, jumped) = before.swing;
            let is_back = dot(now.swing.0, turned) < 0.0 || now.swing.1 * jumped < 0.0;
            now.turn = (before.turn * if is_back { STEADIER } else { FREER }).min(1.0);
            let sum = add(scaled(now.normal, now.turn), scaled(before.normal, 1.0 - now.turn));
            let length = norm(sum);
            if length > LEAST_MEAN {
                let gap = now.turn * now.gap + (1.0 - now.turn) * foreseen;
                now.turn_to(scaled(sum, 1.0 / length), gap, u);
            }
        }
    }

    /// Gap of each candidate at the state of the planes, mm; none beyond the border of its surface.
    pub fn gaps(&self) -> Vec<Option<f64>> {
        self.at.iter().map(|p| p.as_ref().map(|p| p.gap)).collect()
    }
}
