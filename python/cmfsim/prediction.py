"""What a model predicts for a patient: the value that evaluation and report are made from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.case import Finding
from cmfsim.checks import Floats, check_one_of
from cmfsim.model import PatientModel
from cmfsim.musculature import Musculature
from cmfsim.scene import Scene, SceneResult, SurfaceData

__all__ = ["MODELS", "Prediction"]

# Models of the paper (3.2): homogeneous or with muscles, without or with sliding at teeth and
# mucosa.
MODELS = ("H", "M", "H+S", "M+S")


@dataclass(frozen=True, eq=False)
class Prediction:
    """The face that one model predicts for one patient and plan.

    Attributes
    ----------
    model : str
        "H", "M", "H+S" or "M+S".
    patient : PatientModel
    scene : Scene
        What was solved.
    result : SceneResult
    summary : mapping
        Counts, timings, versions, hashes, and what was left out because the scene did not need it:
        plain values, ready for JSON.
    """

    model: str
    patient: PatientModel
    scene: Scene
    result: SceneResult
    summary: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_one_of("model", self.model, MODELS)
        object.__setattr__(self, "summary", MappingProxyType(dict(self.summary)))

    @property
    def name(self) -> str:
        """The name of the patient's case."""
        return self.patient.name

    @property
    def skin_nodes(self) -> NDArray[np.uint32]:
        """The nodes on the skin, (k,): vertex i of both skins is node i of these."""
        return self.patient.skin_nodes

    @property
    def skin_before(self) -> SurfaceData:
        """The patient's skin before the operation, as the mesh has it."""
        return self.patient.skin

    @property
    def skin(self) -> SurfaceData:
        """The predicted skin: the vertices and triangles of `skin_before`, moved."""
        before = self.skin_before
        return SurfaceData(np.asarray(before.vertices) + self.skin_displacements, before.triangles)

    @property
    def skin_displacements(self) -> Floats:
        """How each vertex of the skin moves, (k, 3) mm."""
        return np.asarray(self.result.displacements)[self.skin_nodes]

    @property
    def muscles(self) -> Musculature | None:
        """The muscles that were used; None in a homogeneous model."""
        return self.patient.muscles if self.model.startswith("M") else None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What every stage noticed."""
        return self.patient.findings
