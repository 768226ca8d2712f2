"""Planning from the face: the bone movements whose predicted face is closest to a desired one."""

from cmfsim.planning.face_planning.planning import FacePlan, FaceSearch, plan_for_face
from cmfsim.planning.face_planning.targets import MeasureTarget, PointTarget, SurfaceTarget, Target

__all__ = [
    "FacePlan",
    "FaceSearch",
    "MeasureTarget",
    "PointTarget",
    "SurfaceTarget",
    "Target",
    "plan_for_face",
]
