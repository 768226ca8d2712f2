//! One contact problem: its conditions about a state, its steps, and what a state leaves open.

use crate::contact::pairs::BORDER_REACH;
use crate::contact::seat::{LocalShape, Seats};
use crate::contact::{
    Body, Constraints, ContactMode, ContactOptions, ContactResult, ContactRow, ContactStart,
    Response, Sliding, Spring,
};
use crate::error::{MtmError, Result};
use crate::vector::{Vec3, add, dot, norm, scaled, sub};

/// Maximum number of nodes listed in an error.
const NAMED_NODES: usize = 10;
/// Share of a node's own stiffness below which a step ignores the change of direction of its contact force;
/// second, the same for a step that may be the last, and for a plan operator: what is ignored there delays the
/// end, and stays as an error that the imbalance of single nodes does not show.
const SPRING_SHARE: f64 = 1e-2;
const FINE_SPRING_SHARE: f64 = 1e-3;
/// Limits of the relative accuracy of a step, which is what the last step left open, over the spacing of the
/// surfaces: the next conditions differ by about as much.
const ROUGH_SHARE: f64 = 0.1;
const FINE_SHARE: f64 = 1e-4;
/// Smallest relative error of the forces of springs in a step, which the next step corrects; and their error in
/// what may be the last step, over the imbalance allowed at its end.
const SPRING_ERROR: f64 = 1e-3;
const LAST_SPRING_SHARE: f64 = 0.01;
/// Maximum number of moves along the normals that bring nodes back onto their surfaces.
const RETRACTIONS: usize = 8;
/// Distance up to which nodes are moved back, over the reach of the surfaces: from further away they may meet
/// the wrong surface.
const MOST_RETRACTION: f64 = 10.0;
/// Share of the tolerance by which the remaining tangential force may move a node on its own.
pub(super) const BALANCE_SHARE: f64 = 0.1;
/// Gap and imbalance too small to be visible on a face, in mm and over the diagonal of the mesh: a state within
/// these limits is returned even if the steps run out.
const UNSEEN: f64 = 0.02;
const UNSEEN_SHARE: f64 = 1e-4;

/// A state of the sliding nodes.
pub(super) struct ContactIterate {
    pub displacements: Vec<[f64; 3]>,
    pub touches: Vec<LocalShape>,
    /// Forces of the bone; none before the first response of the body.
    pub reactions: Vec<[f64; 3]>,
    /// Contact forces along the normals, 0 for nodes in the air.
    pub forces: Vec<f64>,
}

/// One contact problem.
pub(super) struct ContactProblem<'a> {
    pub sliding: &'a Sliding,
    pub seats: &'a Seats<'a>,
    pub options: &'a ContactOptions,
}

impl ContactProblem<'_> {
    pub fn count(&self) -> usize {
        self.sliding.nodes.len()
    }

    pub fn is_unilateral(&self) -> bool {
        self.options.mode == ContactMode::Unilateral
    }

    /// Distance, mm, by which the remaining tangential force may move each node on its own.
    pub fn balance(&self) -> f64 {
        BALANCE_SHARE * self.sliding.gap_limit(self.options)
    }

    /// Gap and imbalance too small to be visible on a face, mm.
    pub fn unseen(&self) -> f64 {
        UNSEEN.min(UNSEEN_SHARE * self.sliding.diagonal).max(self.options.allowed)
    }

    pub fn places(&self, displacements: &[[f64; 3]]) -> Vec<[f64; 3]> {
        self.sliding.positions.iter().zip(displacements).map(|(x, u)| add(*x, *u)).collect()
    }

    pub fn start(&self, begin: Option<&ContactStart>) -> ContactIterate {
        let (places, reactions) = match begin {
            Some(begin) => (&begin.places, begin.reactions.clone()),
            None => (&self.seats.clinging, vec![[0.0; 3]; self.count()]),
        };
        let displacements: Vec<[f64; 3]> =
            places.iter().zip(&self.sliding.positions).map(|(p, x)| sub(*p, *x)).collect();
        let touches = self.seats.touches(&self.places(&displacements));
        let forces = along(&reactions, &touches);
        ContactIterate { displacements, touches, reactions, forces }
    }

    /// Which nodes are held: all of them, or those whose pressure outweighs their gap.
    pub fn held(&self, state: &ContactIterate, before: Option<&[bool]>) -> Vec<bool> {
        if !self.is_unilateral() {
            return vec![true; self.count()];
        }
        let limit = self.sliding.gap_limit(self.options);
        (0..self.count())
            .map(|i| {
                let (gap, force) = (state.touches[i].gap, state.forces[i]);
                match before {
                    // No contact force is known yet.
                    None => gap <= limit,
                    Some(before) if before[i] => force >= 0.0,
                    Some(_) => gap < -limit,
                }
            })
            .collect()
    }

    /// The response of the body to the conditions linearised about `state`.
    pub fn step(
        &self,
        state: &ContactIterate,
        active: &[bool],
        reach: f64,
        (share, spring_share): (f64, f64),
        body: &mut dyn Body,
    ) -> Result<Response> {
        let rows = self.rows(state, active);
        let offsets: Vec<f64> = rows
            .iter()
            .map(|r| dot(r.normal, sub(r.point, self.sliding.positions[r.node])))
            .collect();
        let least = if share == 0.0 { FINE_SPRING_SHARE } else { SPRING_SHARE };
        let mut springs = self.springs(state, active, least);
        if reach == 0.0 {
            springs.retain(|s| s.stiffness > 0.0);
        }
        loop {
            let conditions = Constraints {
                rows: &rows,
                offsets: &offsets,
                springs: &springs,
                about: &state.displacements,
                share,
                spring_share,
                reach,
            };
            match body.respond(&conditions) {
                // The contact forces drive their nodes by more than the body can resist: solve without that
                // effect.
                Err(MtmError::NotPositiveDefinite { .. })
                    if springs.iter().any(|s| s.stiffness < 0.0) =>
                {
                    springs.retain(|s| s.stiffness > 0.0);
                }
                answer => return answer,
            }
        }
    }

    /// Relative accuracy of the next step, `left` mm from a solution, and that of the forces of its springs.
    ///
    /// `accurate`: whether the step is solved within the tolerance of the solver.
    pub fn shares(&self, left: f64, accurate: bool) -> (f64, f64) {
        if accurate {
            // What the springs leave open must fit into the balance.
            let needed = LAST_SPRING_SHARE * self.balance() / left;
            return (0.0, needed.clamp(SPRING_ERROR, ROUGH_SHARE));
        }
        let share = match self.options.mode {
            // Small forces decide which nodes lift off.
            ContactMode::Unilateral => FINE_SHARE,
            ContactMode::Bilateral => (left / self.seats.reach()).clamp(FINE_SHARE, ROUGH_SHARE),
        };
        (share, share.max(SPRING_ERROR))
    }

    /// The state with nodes that have left their surfaces moved back onto them; none if they are near enough,
    /// or too far away.
    pub fn put_back(&self, response: &Response, active: &[bool]) -> Option<ContactIterate> {
        let reach = self.seats.reach();
        let mut displacements = response.displacements.clone();
        let mut touches = self.seats.touches(&self.places(&displacements));
        let gap = farthest(&touches, active);
        if gap <= reach || gap > MOST_RETRACTION * reach {
            return None;
        }
        for _ in 0..RETRACTIONS {
            for i in (0..self.count()).filter(|&i| active[i]) {
                let back = scaled(touches[i].normal, touches[i].gap);
                displacements[i] = sub(displacements[i], back);
            }
            touches = self.seats.touches(&self.places(&displacements));
        }
        (farthest(&touches, active) <= reach)
            .then(|| self.reached(displacements, touches, response.reactions.clone(), active))
    }

    fn rows(&self, state: &ContactIterate, active: &[bool]) -> Vec<ContactRow> {
        (0..self.count())
            .filter(|&i| active[i])
            .map(|i| {
                let touch = &state.touches[i];
                let place = add(self.sliding.positions[i], state.displacements[i]);
                let point = sub(place, scaled(touch.normal, touch.gap));
                ContactRow { node: i, normal: touch.normal, point }
            })
            .collect()
    }

    /// How the contact forces change direction as held nodes slide: −f H across the normals.
    ///
    /// `least`: share of a node's own stiffness below which the springs are omitted.
    fn springs(&self, state: &ContactIterate, active: &[bool], least: f64) -> Vec<Spring> {
        let mut out = Vec::new();
        for i in (0..self.count()).filter(|&i| active[i] && state.forces[i] != 0.0) {
            let touch = &state.touches[i];
            let own = self.sliding.stiffness[i];
            for (curvature, axis) in curvatures(touch) {
                let stiffness = -state.forces[i] * curvature;
                if stiffness.abs() > least * own {
                    let goal = dot(axis, state.displacements[i]);
                    out.push(Spring { node: i, axis, stiffness, goal });
                }
            }
        }
        out
    }

    pub fn reached(
        &self,
        displacements: Vec<[f64; 3]>,
        touches: Vec<LocalShape>,
        reactions: Vec<[f64; 3]>,
        active: &[bool],
    ) -> ContactIterate {
        let mut forces = along(&reactions, &touches);
        for (force, held) in forces.iter_mut().zip(active) {
            if !held {
                *force = 0.0;
            }
        }
        ContactIterate { displacements, touches, reactions, forces }
    }

    /// Largest gap of a held node, and largest distance, mm, by which the tangential force would move a node.
    pub fn left(&self, state: &ContactIterate, active: &[bool]) -> (f64, f64) {
        let (mut gap, mut unbalanced) = (0.0_f64, 0.0_f64);
        for (i, &held) in active.iter().enumerate() {
            let (own_gap, own_way) = self.left_of(state, i, held);
            gap = gap.max(own_gap);
            unbalanced = unbalanced.max(own_way);
        }
        (gap, unbalanced)
    }

    /// The same for node `i`: a node in the air may be above its surface, and must be free of any force.
    fn left_of(&self, state: &ContactIterate, i: usize, held: bool) -> (f64, f64) {
        let (touch, reaction) = (&state.touches[i], state.reactions[i]);
        let (gap, left) = if held {
            let across = sub(reaction, scaled(touch.normal, dot(reaction, touch.normal)));
            (touch.gap.abs(), across)
        } else {
            ((-touch.gap).max(0.0), reaction)
        };
        (gap, norm(left) / self.sliding.stiffness[i])
    }

    pub fn end(
        &self,
        state: ContactIterate,
        active: &[bool],
        unbalanced: f64,
        converged: bool,
        iterations: usize,
    ) -> Result<ContactResult> {
        let places = self.places(&state.displacements);
        let closest: Vec<_> =
            places.iter().enumerate().map(|(i, &x)| self.seats.closest(i, x)).collect();
        for (i, (found, past)) in closest.iter().enumerate().filter(|(i, _)| active[*i]) {
            let s = self.sliding.nodes[i].segment;
            let reach = BORDER_REACH * self.seats.mean_edge(s);
            if let Some(past) = past.filter(|&past| past > reach) {
                return Err(MtmError::ContactSurface {
                    segment: self.sliding.names[s].clone(),
                    problem: format!(
                        "is open and node {} ends {past:.4} mm past its border, near ({:.3}, {:.3}, \
                         {:.3}) (allowed {reach:.4} mm): extend or close the surface there, or let \
                         the node be free",
                        self.sliding.nodes[i].node, found.point[0], found.point[1], found.point[2]
                    ),
                });
            }
        }
        let rows = self.rows(&state, active);
        let springs = self.springs(&state, active, FINE_SPRING_SHARE);
        Ok(ContactResult {
            nodes: self.sliding.nodes.iter().map(|n| n.node).collect(),
            points: closest.iter().map(|(found, _)| found.point).collect(),
            normals: state.touches.iter().map(|t| t.normal).collect(),
            gaps: state.touches.iter().map(|t| t.gap).collect(),
            displacements: state.displacements,
            reactions: state.reactions,
            forces: state.forces,
            rows,
            springs,
            active: active.to_vec(),
            iterations,
            unbalanced,
            at_rest: None,
            converged,
        })
    }

    /// The error for steps that ran out far from a solution, with the nodes that are furthest from one.
    ///
    /// `left`: the largest gap, and by how much the tangential force would move a node, mm.
    pub fn far(
        &self,
        state: &ContactIterate,
        active: &[bool],
        iterations: usize,
        (gap, unbalanced): (f64, f64),
    ) -> MtmError {
        let badness = |i: usize| {
            let (gap, way) = self.left_of(state, i, active[i]);
            gap + way
        };
        let mut order: Vec<usize> = (0..self.count()).collect();
        order.sort_by(|&a, &b| badness(b).total_cmp(&badness(a)).then(a.cmp(&b)));
        let nodes = order.iter().take(NAMED_NODES);
        let nodes = nodes.map(|&i| self.sliding.nodes[i].node as usize).collect();
        MtmError::ContactNotConverged { iterations, nodes, gap, unbalanced }
    }
}

/// Largest gap of a held node, mm.
pub(super) fn farthest(touches: &[LocalShape], active: &[bool]) -> f64 {
    let held = touches.iter().zip(active).filter(|(_, held)| **held);
    held.fold(0.0, |m, (touch, _)| m.max(touch.gap.abs()))
}

/// Component of each reaction along the normal of its node.
pub(super) fn along(reactions: &[[f64; 3]], touches: &[LocalShape]) -> Vec<f64> {
    reactions.iter().zip(touches).map(|(r, t)| dot(*r, t.normal)).collect()
}

/// Principal curvatures of the level through a node, 1/mm, with their unit directions across the normal.
fn curvatures(touch: &LocalShape) -> [(f64, [f64; 3]); 2] {
    let [x, y] = across(&Vec3::from(touch.normal));
    let times = |a: &Vec3, b: &Vec3| -> f64 {
        (0..3).map(|i| a[i] * (0..3).map(|j| touch.hessian[i][j] * b[j]).sum::<f64>()).sum()
    };
    let (xx, yy, xy) = (times(&x, &x), times(&y, &y), times(&x, &y));
    let (sin, cos) = (0.5 * (2.0 * xy).atan2(xx - yy)).sin_cos();
    let (one, two) = (x * cos + y * sin, y * cos - x * sin);
    let (mean, half) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    [(mean + half, one.into()), (mean - half, two.into())]
}

/// Two unit vectors that form an orthonormal basis with the unit vector `n`.
fn across(n: &Vec3) -> [Vec3; 2] {
    // Starting from the axis of the smallest component of n keeps the cross product away from zero.
    let mut axis = Vec3::zeros();
    axis[n.abs().imin()] = 1.0;
    let one = n.cross(&axis).normalize();
    [one, n.cross(&one)]
}
