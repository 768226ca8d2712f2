"""The values that one stage of building a model passes to the next."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import TetMesh
from cmfsim.io import Case
from cmfsim.meshing import TissueRegion
from cmfsim.meshing.lips import LipSeam
from cmfsim.meshing.node_kinds import DentalArches
from cmfsim.pipeline.building.skin.lips import CaseLipContact
from cmfsim.pipeline.building.tissue.contacts import CaseContacts
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding
from cmfsim.values.image_data import ImageData
from cmfsim.values.lifted_tissue import LiftedTissue
from cmfsim.values.mesh_report import MeshReport
from cmfsim.values.node_kinds import NodeKinds
from cmfsim.values.proposed_landmarks import ProposedLandmarks
from cmfsim.values.surface_data import SurfaceData


@dataclass(frozen=True, eq=False)
class Head:
    """A case with what was read of it.

    landmarks: mapping of str to mapping of str to (3,), mm. "skull" and "skin".
    proposed: The landmarks, where they were found automatically.
    skin: The skin in full detail, where finding them has made it.
    colours: Of its vertices, (v, 3), where the case has a 3D photo.
    """

    case: Case
    landmarks: Mapping[str, Mapping[str, Floats]]
    anatomy: Anatomy
    proposed: ProposedLandmarks | None = None
    skin: SurfaceData | None = None
    colours: NDArray[np.uint8] | None = None

    @property
    def skull(self) -> Mapping[str, Floats]:
        """Landmarks of the skull by name, mm."""
        return self.landmarks.get("skull", {})


@dataclass(frozen=True, eq=False)
class MeshedTissue:
    """The soft tissue of a head before its bones are known to be cut.

    filled: The tets that fill it, their report and the findings on them; None where they have to
        follow the seam between the lips.
    """

    region: TissueRegion
    level: ImageData
    findings: tuple[Finding, ...]
    filled: tuple[TetMesh, MeshReport, tuple[Finding, ...]] | None = None


@dataclass(frozen=True, eq=False)
class Tissue:
    """The soft tissue of a head, the tets that fill it, and what it slides on."""

    region: TissueRegion
    level: ImageData
    mesh: TetMesh
    report: MeshReport
    arches: DentalArches | None
    seam: LipSeam | None
    contacts: CaseContacts


@dataclass(frozen=True, eq=False)
class Nodes:
    """The mesh that is solved on, and what its nodes do."""

    mesh: TetMesh
    report: MeshReport
    kinds: NodeKinds
    contacts: CaseContacts
    level: ImageData
    seam: LipSeam | None
    lips: CaseLipContact
    lifted: LiftedTissue | None
