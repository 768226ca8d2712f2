//! Equilibrium of a body under a plan: options, linear solves, Newton's method, plan operators, first-order changes.

pub(crate) mod about;
pub(crate) mod confirmed;
pub(crate) mod effort;
pub(crate) mod frozen;
pub(crate) mod iterative;
pub(crate) mod newton;
pub mod options;
pub(crate) mod outcome;
pub(crate) mod projected_product;
pub(crate) mod reaction;
pub(crate) mod reduction;
pub(crate) mod refusals;
pub mod replan;
pub mod response;
pub mod restraint;
pub(crate) mod row_conditions;
pub(crate) mod settling;
pub mod solution;
pub mod solver;
pub(crate) mod system;
pub(crate) mod touching;
pub(crate) mod unstable;
