//! From material constants to forces and stiffness of a body.

pub mod density;
pub mod element;
pub mod hyperelastic;
pub mod kinematics;
pub mod material;
pub(crate) mod nodal_pressure;
pub(crate) mod polar;
pub(crate) mod quadratic;
pub mod strain_energy;
pub mod tensors;
pub mod tissue;
