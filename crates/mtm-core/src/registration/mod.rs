//! Registration: maps that bring landmarks or points to others.

pub mod thin_plate;
