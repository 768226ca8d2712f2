//! The tests of the core, one folder per folder of the core: one program, so that it is linked once.
#![allow(clippy::unwrap_used, clippy::panic)]

mod meshes;

mod bad_input;
mod properties;

mod algebra {
    mod cholesky {
        mod dense;
        mod normal;
        mod sweep;
        mod symmetric;
    }
    mod elastic_box;
    mod error_bound;
    mod krylov;
    #[cfg(target_os = "linux")]
    mod memory;
    mod ordering;
    mod pool;
    mod precision;
    mod simd;
}
mod contact {
    mod creases;
    mod field;
    mod overlap;
    mod settling;
    mod sliding;
    mod touching;
    mod unilateral;
}
mod geometry {
    mod motion;
    mod surface;
    mod tube;
    mod winding;
}
mod mechanics {
    mod bar;
    mod barrier;
    mod convergence;
    mod density;
    mod element_limits;
    mod elements;
    mod part;
    mod patch;
    mod polar;
    mod series;
    mod squeezed;
}
mod meshing {
    mod distance;
    mod lattice;
    mod level;
    mod pieces;
    mod stuffing;
}
mod muscles {
    mod direction;
    mod equivalent;
    mod fibre;
    mod sequence;
    mod sides;
    mod tet_tree;
}
mod registration {
    mod fits;
}
mod statics {
    mod agreement;
    mod error_estimate;
    mod hinged_body;
    mod options;
    mod pressed;
    mod projected_product;
    mod reaction;
    mod unstable;
}
