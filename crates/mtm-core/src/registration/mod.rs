//! Registration: maps that bring landmarks or points to others.

pub mod icp;
pub mod nearest;
pub mod rigid;
pub mod spread;
pub mod thin_plate;
