"""The face after cranio-maxillofacial surgery, by the mass-tensor model.

Lengths are mm, forces N, moduli MPa; internal forces are K u. Importing this package and solving
with it needs numpy alone. Research software: it is not a medical device.
"""

from cmfsim._core import (
    LAWS,
    METHODS,
    PRESETS,
    Boundary,
    MassTensors,
    MeshQuality,
    PlanOperator,
    Solution,
    StaticSolver,
    Surface,
    SurfaceMotion,
    TetMesh,
    Tissue,
    __version__,
)
from cmfsim.case import Anatomy, BoneSegment, Finding, ImageData, NodeKinds
from cmfsim.errors import (
    BoundaryError,
    CaseError,
    CmfsimError,
    ContactError,
    ImageError,
    LandmarkError,
    MaterialError,
    MeshError,
    RegistrationError,
    SolverError,
)
from cmfsim.io import read_plan, read_result, read_scene, write_result, write_scene
from cmfsim.phantom import HeadParameters, Muscle, PhantomHead, make_head
from cmfsim.planning import RigidMotion, decompose_motion, rigid_motion
from cmfsim.scene import (
    MovedSurface,
    Scene,
    SceneResult,
    SegmentData,
    SolverOptions,
    SurfaceData,
    TissueData,
)
from cmfsim.simulation import scene_plan, scene_solver, solve_scene

__all__ = [
    "LAWS",
    "METHODS",
    "PRESETS",
    "Anatomy",
    "BoneSegment",
    "Boundary",
    "BoundaryError",
    "CaseError",
    "CmfsimError",
    "ContactError",
    "Finding",
    "HeadParameters",
    "ImageData",
    "ImageError",
    "LandmarkError",
    "MassTensors",
    "MaterialError",
    "MeshError",
    "MeshQuality",
    "MovedSurface",
    "Muscle",
    "NodeKinds",
    "PhantomHead",
    "PlanOperator",
    "RegistrationError",
    "RigidMotion",
    "Scene",
    "SceneResult",
    "SegmentData",
    "Solution",
    "SolverError",
    "SolverOptions",
    "StaticSolver",
    "Surface",
    "SurfaceData",
    "SurfaceMotion",
    "TetMesh",
    "Tissue",
    "TissueData",
    "__version__",
    "decompose_motion",
    "make_head",
    "read_plan",
    "read_result",
    "read_scene",
    "rigid_motion",
    "scene_plan",
    "scene_solver",
    "solve_scene",
    "write_result",
    "write_scene",
]
