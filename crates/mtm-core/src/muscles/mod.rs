//! From muscle surfaces to fibre directions and the share of muscle in each tet.

pub mod equivalent;
pub mod fibre;
