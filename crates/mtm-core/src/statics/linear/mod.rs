//! The reduced linear system: what is kept from one plan to the next, how it is solved, how far its answer is trusted.

pub(crate) mod confirmed;
pub(crate) mod effort;
pub(crate) mod iterative;
pub(crate) mod pressed;
pub(crate) mod projected_product;
pub(crate) mod row_conditions;
pub(crate) mod system;
pub(crate) mod unstable;
