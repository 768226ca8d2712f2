//! Contact about a known equilibrium: how its conditions change, to first order, as bone segments move on.

use crate::contact::{ContactResult, ContactRow, SlidingNode};
use crate::geometry::motion::RigidMotion;
use crate::vector::{add, dot, scaled, sub};

/// How the motion x ↦ R x + t of a segment changes: Ṙ and ṫ, mm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rate {
    turn: [[f64; 3]; 3],
    shift: [f64; 3],
}

impl Rate {
    /// The rate with the rows (Ṙ | ṫ).
    pub fn new(rows: &[[f64; 4]; 3]) -> Self {
        Self { turn: rows.map(|[a, b, c, _]| [a, b, c]), shift: rows.map(|row| row[3]) }
    }

    /// Unit field `column` of a plan operator: entry (r, c) of R − I about `centre`, or component of the shift.
    pub fn unit(column: usize, centre: [f64; 3]) -> Self {
        let (mut turn, mut shift) = ([[0.0; 3]; 3], [0.0; 3]);
        if column < 9 {
            turn[column / 3][column % 3] = 1.0;
            shift[column / 3] = -centre[column % 3];
        } else {
            shift[column - 9] = 1.0;
        }
        Self { turn, shift }
    }

    /// Ṙ x + ṫ of a point at rest, mm.
    pub fn at(&self, x: [f64; 3]) -> [f64; 3] {
        add(self.turned(x), self.shift)
    }

    /// Ṙ v of a vector at rest.
    pub fn turned(&self, v: [f64; 3]) -> [f64; 3] {
        self.turn.map(|row| dot(row, v))
    }
}

/// Contact at equilibrium.
pub(crate) struct ContactEquilibrium<'a> {
    pub state: &'a ContactResult,
    pub sliding: &'a [SlidingNode],
    /// Motion of each segment.
    pub motions: &'a [RigidMotion],
}

/// Derivatives of the contact conditions with respect to one parameter.
#[derive(Debug, Clone)]
pub(crate) struct Slope {
    /// Of every row, mm.
    pub offsets: Vec<f64>,
    /// Of every spring, mm.
    pub goals: Vec<f64>,
}

impl ContactEquilibrium<'_> {
    /// No change.
    pub fn still(&self) -> Slope {
        Slope {
            offsets: vec![0.0; self.state.rows.len()],
            goals: vec![0.0; self.state.springs.len()],
        }
    }

    /// Adds the change of the conditions as `segment` moves at `rate`. A row follows its surface along its
    /// normal, n·u = n·w(p), where w is the displacement of the point p of the segment. The force f n turns with
    /// the surface, and as the node slides on it: f H (u − w) + f (R − R₀) R₀ᵀ n across the normal. The first
    /// term is a spring that moves with the surface, the second a load, which is added to the rows of `field`.
    pub fn add(&self, segment: usize, rate: &Rate, slope: &mut Slope, field: &mut [[f64; 3]]) {
        let mut ways = vec![[0.0; 3]; self.sliding.len()];
        for (row, offset) in self.state.rows.iter().zip(&mut slope.offsets) {
            if self.sliding[row.node].segment == segment {
                ways[row.node] = rate.at(self.foot(row));
                *offset += dot(row.normal, ways[row.node]);
            }
        }
        for (spring, goal) in self.state.springs.iter().zip(&mut slope.goals) {
            if self.sliding[spring.node].segment == segment {
                *goal += dot(spring.axis, ways[spring.node]);
            }
        }
        for (i, node) in self.sliding.iter().enumerate() {
            if node.segment == segment && self.state.active[i] {
                let turn = rate.turned(self.motions[segment].rotate_inverse(self.state.normals[i]));
                self.push(i, turn, field);
            }
        }
    }

    /// The conditions at a plan in which nothing moves, continued from this state; `places`: position of each node
    /// at rest.
    pub fn at_rest(&self, places: &[[f64; 3]], field: &mut [[f64; 3]]) -> Slope {
        let state = self.state;
        let mut slope = self.still();
        let mut reached = vec![[0.0; 3]; self.sliding.len()];
        for (row, offset) in state.rows.iter().zip(&mut slope.offsets) {
            let node = &self.sliding[row.node];
            let foot = self.foot(row);
            *offset = dot(row.normal, sub(foot, places[node.node as usize]));
            reached[row.node] = sub(self.motions[node.segment].apply(foot), foot);
        }
        for (spring, goal) in state.springs.iter().zip(&mut slope.goals) {
            *goal = dot(spring.axis, sub(state.displacements[spring.node], reached[spring.node]));
        }
        for (i, node) in self.sliding.iter().enumerate().filter(|(i, _)| state.active[*i]) {
            let normal = state.normals[i];
            let back = self.motions[node.segment].rotate_inverse(normal);
            self.push(i, sub(back, normal), field);
        }
        slope
    }

    /// The point of the segment at rest that a held node slides on, mm.
    fn foot(&self, row: &ContactRow) -> [f64; 3] {
        self.motions[self.sliding[row.node].segment].apply_inverse(row.point)
    }

    /// Adds the load of sliding node `i` whose normal turns by `turn`, only across the normal: the component
    /// along it belongs to the row.
    fn push(&self, i: usize, turn: [f64; 3], field: &mut [[f64; 3]]) {
        let (normal, force) = (self.state.normals[i], self.state.forces[i]);
        let across = sub(turn, scaled(normal, dot(normal, turn)));
        let row = &mut field[self.sliding[i].row as usize];
        *row = add(*row, scaled(across, force));
    }
}
