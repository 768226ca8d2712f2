//! Springs between rows: the interaction of touching nodes in one round.

use crate::vector::{add, dot, scaled};

/// A spring between an unknown node and up to three others, or none: ½ k (c·u − goal)².
#[derive(Debug, Clone)]
pub struct Link {
    /// Row and coefficient of each unknown node.
    pub ends: Vec<(u32, [f64; 3])>,
    /// k, N/mm.
    pub stiffness: f64,
    /// mm.
    pub goal: f64,
}

impl Link {
    /// c·x of rows x, mm.
    pub fn along(&self, x: &[[f64; 3]]) -> f64 {
        self.ends.iter().map(|(row, c)| dot(*c, x[*row as usize])).sum()
    }

    /// k (goal − c·x): the force that the spring exerts along c at x, N.
    pub fn pull(&self, x: &[[f64; 3]]) -> f64 {
        self.stiffness * (self.goal - self.along(x))
    }

    /// The force at c·x = `along` of a link that only pushes, N.
    pub fn push(&self, along: f64) -> f64 {
        (self.stiffness * (self.goal - along)).max(0.0)
    }

    /// Adds c times `force`, N, to rows y.
    pub fn add(&self, force: f64, y: &mut [[f64; 3]]) {
        for (row, c) in &self.ends {
            y[*row as usize] = add(y[*row as usize], scaled(*c, force));
        }
    }
}
