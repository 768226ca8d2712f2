//! The tests of the core, one folder per folder of the core: one program, so that it is linked once.
#![allow(clippy::unwrap_used, clippy::panic)]

mod meshes;

mod bad_input;
mod properties;

mod algebra {
    mod elastic_box;
    mod krylov;
}
mod contact {
    mod creases;
    mod settling;
    mod sliding;
    mod touching;
    mod unilateral;
}
mod geometry {
    mod motion;
    mod surface;
    mod winding;
}
mod mechanics {
    mod bar;
    mod convergence;
    mod element_limits;
    mod elements;
    mod patch;
    mod squeezed;
}
mod meshing {
    mod pieces;
    mod stuffing;
}
mod muscles {
    mod equivalent;
    mod fibre;
}
mod registration {
    mod fits;
}
mod statics {
    mod agreement;
    mod error_estimate;
    mod hinged_body;
}
