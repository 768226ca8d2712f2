"""The prediction of a model for a patient, on which evaluation and report are based."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseInputError
from cmfsim.values.checks import AnyPath, Floats, Frozen, check_one_of, keep, listing
from cmfsim.values.finding import Finding, counted_findings
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.progress import no_progress
from cmfsim.values.scene import Scene, SceneResult
from cmfsim.values.skin_motion import carried_points
from cmfsim.values.solver_options import MODELS
from cmfsim.values.surface_data import MovedSurface, SurfaceData

if TYPE_CHECKING:
    from cmfsim.values.musculature import Musculature
    from cmfsim.values.skin_band import SkinBand

__all__ = ["MODELS", "Prediction"]


def _above(room: str) -> Any:
    """A room above the values, loaded when a method that draws or writes is called."""
    return import_module(f"cmfsim.{room}")


@dataclass(frozen=True, eq=False)
class Prediction(Frozen):
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
        Counts, timings, versions, hashes, and the stages that were skipped because the scene did
        not need them: plain values, ready for JSON.
    predicted_by : callable, optional
        The function that made this prediction from a patient and a model.
    band : SkinBand or None
        How far to trust the skin, if requested (`predict_with_band`).
    """

    model: str
    patient: PatientModel
    scene: Scene
    result: SceneResult
    summary: Mapping[str, Any] = field(default_factory=dict)
    predicted_by: Callable[[PatientModel, str], Prediction] | None = field(default=None, repr=False)
    band: SkinBand | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_one_of("model", self.model, MODELS)
        keep(self, summary=self.summary)

    def __repr__(self) -> str:
        """Patient, plan, how far the skin moves, how it was solved and what was found."""
        solved = self.result.summary
        moved = np.linalg.norm(self.skin_displacements, axis=1)
        error = solved.get("error_estimate")
        rows = {
            "plan": self.scene.plan_text(),
            "skin": f"moves up to {moved.max(initial=0.0):.1f} mm",
            "mesh": f"{self.scene.n_nodes} nodes, {self.scene.n_tets} tets",
            "solution": str(solved.get("method", ""))
            + (f", estimated error {error:.1g} mm" if error is not None else ""),
            "band": "yes" if self.band is not None else "",
            "findings": counted_findings(self.findings),
        }
        return listing(f"Prediction of {self.model} for {self.name!r}", rows)

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

    @cached_property
    def skin(self) -> SurfaceData:
        """The predicted skin: the vertices and triangles of `skin_before`, moved."""
        before = self.skin_before
        return SurfaceData(before.vertices + self.skin_displacements, before.triangles)

    @cached_property
    def skin_displacements(self) -> Floats:
        """How each vertex of the skin moves, (k, 3) mm: as its node, except where the tissue ends.

        Next to the planes on which the tissue ends, and is fixed, it moves as the skin before them
        (`SkinEnd`).
        """
        moved = self.patient.skin_field(self.result.displacements)
        moved.setflags(write=False)
        return moved

    def carried(self, points: ArrayLike) -> Floats:
        """How points on or near the skin move, (k, 3) mm: as `carried_points` has it.

        Parameters
        ----------
        points : (k, 3) float64, mm
            Before the operation: landmarks, or the vertices of any surface of the patient's skin.
        """
        return carried_points(self.skin_before, self.skin_displacements, points)

    def replan(self, plan: Mapping[str, ArrayLike | MovedSurface]) -> Prediction:
        """The prediction of the same model for the same patient under another plan, solved exactly.

        The patient is not built again; the equations are set up and factorised again. Findings say
        where motions are implausible, or teeth and bones meet that did not. For many
        plans use `planning_model`, which keeps the factorisation.

        Parameters
        ----------
        plan : mapping of str to (4, 4) float64, mm, (j, 3) float64, mm, or MovedSurface
            Segments by name; those that are not named stay.

        Raises
        ------
        CaseError
            (also `ValueError`) A segment that the patient does not have; a prediction that was put
            together by hand and does not record how it was made.
        BoundaryError, ContactError, SolverError
            As `solve_scene`.

        Examples
        --------
        >>> import cmfsim
        >>> motion = cmfsim.rigid_motion(translation=(0, -4, 0))
        >>> other = prediction.replan({"maxilla": motion})
        """
        if self.predicted_by is None:
            why = "this prediction does not record how it was made: use predict or predict_patient"
            raise CaseInputError(why)
        checked = _above("pipeline.building.case_checks").given_plan
        return self.predicted_by(checked(self.patient.with_plan(plan)), self.model)

    @property
    def face_before(self) -> SurfaceData:
        """The patient's face in full detail, as given or segmented; otherwise as in the mesh."""
        return self.patient.face or self.skin_before

    @property
    def face_colours(self) -> NDArray[np.uint8] | None:
        """Red, green, blue of the vertices of `face`, (v, 3), if the case has a 3D photo."""
        return self.patient.face_colours

    @cached_property
    def face(self) -> SurfaceData:
        """The predicted face: the vertices and triangles of `face_before`, carried by the skin."""
        before = self.face_before
        return SurfaceData(before.vertices + self.carried(before.vertices), before.triangles)

    @property
    def bones(self) -> dict[str, tuple[SurfaceData, Floats]]:
        """The bone segments after the operation: `planned_bones` of the patient."""
        return self.patient.planned_bones

    @property
    def parts(self) -> dict[str, dict[str, tuple[SurfaceData, Floats]]]:
        """The surfaces by kind and name, each with its vertices after the operation, (v, 3) mm.

        "skin" is the face; "bones" are the segments; "muscles", where the model has some, stay.
        """
        found = {"skin": {"skin": (self.face_before, self.face.vertices)}, "bones": self.bones}
        if (muscles := self.muscles) is not None:
            found["muscles"] = {m.name: (m.surface, m.surface.vertices) for m in muscles}
        return found

    def save(self, folder: AnyPath) -> list[str]:
        """The names of the files that `cmfsim predict` writes, written to a folder.

        Those of `write_prediction`, with pictures and `report.html`. The folder is created if
        necessary; results of another plan in it are removed.

        Raises
        ------
        OSError
            The folder cannot be created or written to.
        """
        write = _above("pipeline.outputs.results").write_results
        written = write(Path(folder), [self], [self.model], stage=no_progress)
        return [*written.predictions[0].files, *filter(None, [written.report])]

    def plot(self, screenshot: AnyPath | None = None) -> None:
        """Opens a window with skin, bones and muscles, as `cmfsim view` does, or writes a picture.

        Parameters
        ----------
        screenshot : path, optional
            Ends in `.png`: nothing is opened.

        Raises
        ------
        CaseError
            (also `ValueError`) PyVista, OpenGL or a screen is missing; another ending.
        """
        window, title = _above("pictures.window"), f"{self.name}, {self.model} - cmfsim"
        window.view_parts(window.prediction_parts(self.parts), title=title, screenshot=screenshot)

    def animate(self, path: AnyPath) -> None:
        """Writes an animation of the face, from the front and the left: before, after, and back.

        Parameters
        ----------
        path : path
            Ends in `.gif`, or in `.mp4` where ffmpeg is installed.

        Raises
        ------
        CaseError
            (also `ValueError`) Another ending; a face that does not move; Pillow, PyVista, OpenGL
            or ffmpeg is missing.
        """
        animate = _above("pictures.faces").animate_face
        animate(path, self.face_before, self.face.vertices, self.face_colours)

    def to_pyvista(self) -> Any:
        """The prediction as a `pyvista.MultiBlock`, in LPS mm, after the operation.

        Blocks: "skin", bone segments and muscles by name, and "tissue" (tets). Each has the point
        data `displacement`, (n, 3) mm: subtract it for the place before. The tissue has `force`,
        (n, 3) N, as well.

        Raises
        ------
        CaseError
            (also `ValueError`) PyVista is missing.

        Examples
        --------
        >>> prediction.to_pyvista()["skin"].plot(scalars="displacement")  # doctest: +SKIP
        """
        return _above("pictures.window").prediction_blocks(self)

    def _repr_html_(self) -> str:
        return str(_above("pictures.faces").prediction_html(self))

    @property
    def muscles(self) -> Musculature | None:
        """The muscles that were used; None in a homogeneous model."""
        return self.patient.muscles if self.model.startswith("M") else None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings of every stage, including the solution."""
        solved = self.result.summary.get("findings", ())
        return (*self.patient.findings, *(Finding.from_values(entry) for entry in solved))
