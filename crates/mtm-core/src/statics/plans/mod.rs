//! One body under many plans: contact that changes with them, columns solved once, changes to first order.

pub(crate) mod about;
pub(crate) mod frozen;
pub(crate) mod reaction;
pub mod replan;
pub mod response;
pub(crate) mod settling;
