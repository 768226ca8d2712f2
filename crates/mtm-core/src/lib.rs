//! Mass-tensor mechanics of soft tissue: materials, tensors, sliding contact, exact re-planning.
//!
//! # How a scene is solved
//!
//! ```text
//! nodes, tets ─ TetMesh ─┐
//! constants ─── Tissue ──┴─ MassTensors ─┐
//! node kinds, contact surfaces ─ Boundary ┴─ StaticSolver ─ solve(plan) ─ Solution
//!                                                         └ plan_operator ─ PlanOperator(plan)
//! ```
//!
//! Each stage is one value, built from the values before it and never changed afterwards.
//!
//! # Folders
//!
//! From the ground up; each folder imports only those above it in this list, which
//! `scripts/check_imports.py` checks:
//!
//! | Folder | Contents |
//! |---|---|
//! | `error`, `vector`, `mesh` | the error type, vectors in space, the tetrahedral mesh |
//! | `geometry` | triangles, closed surfaces, winding numbers, rigid motions |
//! | `algebra` | block matrices, Cholesky, conjugate gradients, multigrid |
//! | `mechanics` | materials, mass tensors, strain energy and its laws |
//! | `boundary` | node kinds, segments, plans |
//! | `meshing` | tetrahedra from label images, cracks, signed distances, connected pieces |
//! | `muscles` | fibre directions and the share of muscle in each tet |
//! | `registration` | rigid fits, ICP, thin-plate splines |
//! | `contact` | sliding nodes, their surfaces and the contact solver |
//! | `statics` | the solvers: linear, Newton's method, plan operators, first-order changes |
//!
//! # Units and signs
//!
//! mm, N, MPa; radians. Unknown 3·node + axis. Internal force = K u: the external force required at a node to
//! maintain the deformation, zero at free nodes in equilibrium, and at joined nodes the force that the bone
//! exerts. Voigt order xx, yy, zz, yz, xz, xy with engineering shears. Surfaces have outward normals; those of
//! contact surfaces point out of the bone, into the tissue.
//!
//! # Reproducibility
//!
//! Results are bitwise identical for any number of threads.
//!
//! # Example
//!
//! ```
//! use std::sync::Arc;
//! use mtm_core::{Boundary, Conflicts, Elastic, Gap, MassTensors, Motion, Segment, StaticOptions,
//!                StaticSolver, TetMesh, Tissue};
//!
//! # fn main() -> mtm_core::Result<()> {
//! let nodes = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
//! let mesh = Arc::new(TetMesh::new(nodes, vec![[0, 1, 2, 3]])?);
//! let tissue = Arc::new(Tissue::isotropic(&[Elastic { young: 0.003, poisson: 0.46 }])?);
//! let tensors = Arc::new(MassTensors::new(mesh, tissue)?);
//! let bone = Segment {
//!     name: "maxilla".into(),
//!     joined: vec![0, 1, 2],
//!     sliding: vec![],
//!     contact: None,
//!     gap: Gap::Uniform(0.0),
//! };
//! let boundary = Arc::new(Boundary::new(vec![], vec![bone], Conflicts::Refuse)?);
//! let solver = StaticSolver::new(tensors, boundary, StaticOptions::default(), &|| false)?;
//! let plan = vec![("maxilla".to_string(), Motion::Nodes(vec![[0.0, 0.0, 2.0]; 3]))];
//! let solution = solver.solve(&plan, None, &|| false)?;
//! assert!((solution.displacements[3][2] - 2.0).abs() < 1e-12);
//! # Ok(())
//! # }
//! ```

mod algebra;
mod boundary;
mod contact;
mod error;
mod geometry;
mod mechanics;
mod mesh;
mod meshing;
mod muscles;
mod registration;
mod statics;
mod vector;

/// Parts that only the tests of this crate open; they may change in any version.
#[doc(hidden)]
pub mod internals {
    pub use crate::algebra::cholesky::{
        DenseSymmetric, FactorPreconditioner, NormalFactor, Progress, ROWS_TO_SHARE, Rough,
        RowForces, RowKey, TailFlexibility, conjugate_gradients, hopeless,
    };
    pub use crate::algebra::constraints::{Constraint, projected};
    pub use crate::algebra::error_bound::tridiagonal_extremes;
    pub use crate::algebra::krylov::Operator;
    #[cfg(target_os = "linux")]
    pub use crate::algebra::memory::kept;
    pub use crate::algebra::multigrid::precision::Stored;
    pub use crate::algebra::ordering::postorder;
    pub use crate::algebra::simd;
    pub use crate::contact::Spring;
    pub use crate::contact::field::{Field, FieldValue};
    pub use crate::contact::links::Link;
    pub use crate::contact::overlap::{Overlap, depth_in};
    pub use crate::mechanics::density::{Density, volumetric, without_negative};
    pub use crate::mechanics::hyperelastic::{PointResponse, PointTangent, Tangent, barrier};
    pub use crate::mechanics::polar::Polar;
    pub use crate::mechanics::strain_energy::{LAG, Part, PointTangents};
    pub use crate::meshing::stuffing::distance::thin_parts;
    pub use crate::meshing::stuffing::lattice::{Octree, neighbours};
    pub use crate::muscles::equivalent::aligned_box::AlignedBox;
    pub use crate::muscles::equivalent::direction::DirectionSum;
    pub use crate::muscles::equivalent::sequence::{Sequence, place};
    pub use crate::muscles::equivalent::shape::MuscleShape;
    pub use crate::muscles::equivalent::tet_tree::TetTree;
    pub use crate::statics::linear::pressed::with_links;
    pub use crate::statics::linear::projected_product::ProjectedProduct;
    pub use crate::statics::linear::unstable::{at_fault, carry_on};
    pub use crate::statics::plans::reaction::krylov::Krylov;
}

pub use algebra::blocks::BlockMatrix;
pub use algebra::cholesky::Symbolic;
pub use algebra::krylov::{PcgOptions, PcgOutcome, Preconditioner, pcg};
pub use algebra::memory::HugePages;
pub use algebra::multigrid::{CyclePrecision, Multigrid, MultigridOptions};
pub use algebra::pool;
pub use boundary::{
    Against, Boundary, Conflicts, Gap, Motion, NodeKind, Plan, Segment, TouchingPair,
};
pub use contact::{ContactMode, ContactOptions, ContactResult};
pub use error::{ErrorKind, MtmError, Result, Shortfall};
pub use geometry::decimation::decimated;
pub use geometry::motion::{RigidMotion, SurfaceMotion, rigid_matrix};
pub use geometry::smoothing::smoothed;
pub use geometry::surface::{Closest, Surface};
pub use geometry::triangle::{DEGENERATE_AREA, Feature};
pub use geometry::tube::{TubeEnd, tube_levels};
pub use geometry::winding::{WindingTree, winding_number_exact};
pub use mechanics::element::{Element, ElementNodes};
pub use mechanics::hyperelastic::HyperelasticLaw;
pub use mechanics::kinematics::Kinematics;
pub use mechanics::material::{
    Elastic, FibreElastic, FibreLaw, Lame, Mixing, Preset, Spencer, Voigt,
};
pub use mechanics::strain_energy::{EnergyState, StrainEnergy, TangentKind};
pub use mechanics::tensors::{EdgeTensors, MassTensors, tet_tensor};
pub use mechanics::tissue::{TetMaterial, Tissue};
pub use mesh::{MeshQuality, TetMesh};
pub use meshing::crack::{Parted, part};
pub use meshing::pieces::{Joined, Pieces, pieces};
pub use meshing::signed_distance::signed_distance;
pub use meshing::stuffing::distance::squared_distance;
pub use meshing::stuffing::level::{Grid, LevelImage};
pub use meshing::stuffing::{Halvings, Stuffed, StuffingOptions, stuff};
pub use muscles::equivalent::{
    InsideTest, MOST_SAMPLES, MeanDirection, Muscle, MuscleShares, MuscleVolume, SamplingCounts,
    SamplingOptions, SamplingTimings, Share, TetShares, sample_muscles,
};
pub use muscles::fibre::{MOST_BOXES, MuscleFibres, MuscleKind, NearFibres, OrientedBox};
pub use registration::icp::{Fixed, IcpFit, IcpMethod, IcpOptions, icp};
pub use registration::nearest::PointTree;
pub use registration::rigid::{RigidFit, RigidFitOptions, rigid_fit};
pub use registration::thin_plate::{Folds, ThinPlateSpline};
pub use statics::options::{Interrupt, Method, StaticOptions};
pub use statics::plans::replan::PlanOperator;
pub use statics::plans::response::Change;
pub use statics::solution::{Solution, Timings, TouchResult};
pub use statics::solver::StaticSolver;
