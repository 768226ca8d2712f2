//! Equilibrium of a body under a plan: options, linear solves, Newton's method, plan operators, first-order changes.

pub(crate) mod linear;
pub(crate) mod newton;
pub mod options;
pub mod plans;
pub(crate) mod reduction;
pub mod restraint;
pub mod solution;
pub mod solver;
