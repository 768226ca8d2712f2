"""Planning from the face: the bone movements whose predicted face is closest to a desired one."""

from cmfsim.planning.face_planning.planning import FacePlan as FacePlan
from cmfsim.planning.face_planning.planning import FaceSearch as FaceSearch
from cmfsim.planning.face_planning.planning import plan_for_face as plan_for_face
from cmfsim.planning.face_planning.targets import MeasureTarget as MeasureTarget
from cmfsim.planning.face_planning.targets import PointTarget as PointTarget
from cmfsim.planning.face_planning.targets import SurfaceTarget as SurfaceTarget
from cmfsim.planning.face_planning.targets import Target as Target
