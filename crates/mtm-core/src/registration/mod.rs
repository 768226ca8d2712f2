//! Registration: maps that align landmarks or points with others.

pub mod icp;
pub mod nearest;
pub mod rigid;
pub mod spread;
pub mod thin_plate;
