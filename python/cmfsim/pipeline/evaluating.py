"""One case by several models, compared with the face after the operation, which is checked."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from cmfsim.errors import CaseInputError, RegistrationError
from cmfsim.evaluation.comparison import SkinComparison
from cmfsim.evaluation.models import NO_CHANGE, WHOLE, ModelComparison, compare_models
from cmfsim.evaluation.regions import skin_regions, unmoved_regions
from cmfsim.evaluation.unmoved import ThicknessChange, compare_unmoved, fitted_thickness
from cmfsim.io import Case, CaseOrPath, as_case
from cmfsim.pipeline.banding import face_landmarks
from cmfsim.pipeline.building.inputs import case_key
from cmfsim.pipeline.building.stages import BuildKeywords, build_options
from cmfsim.pipeline.building.surgery.postoperative import Postoperative, read_postoperative
from cmfsim.pipeline.predicting import named_models, predictions_of
from cmfsim.surfaces.depth import tissue_depth
from cmfsim.values.calibration import settings_digest
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding, grouped
from cmfsim.values.prediction import MODELS, Prediction
from cmfsim.values.progress import expected_stages
from cmfsim.values.surface_data import SurfaceData

# Mean distance between the faces before and after where nothing was operated on, mm, from which on
# it is reported, and from which on they are not one patient's in one frame. Registration, weight
# and expression leave 0.1 to 0.7 mm; the face of another patient of like size left 3.05 mm.
DIFFERS, OTHER_FACE = 1.0, 3.0
# Where a model moves the skin by at least this, mm, and by half of what it moves most of it by, the
# face after shows the operation (most: a coarse mesh leaves single vertices in folds, which move
# far). If it is so much nearer to the face before than to every prediction, it is a scan from
# before: two scans of one face differ by 0.15 mm.
SHOWS, HALF, MOST, UNCHANGED = 1.0, 0.5, 0.95, 0.15
if TYPE_CHECKING:
    from typing_extensions import Unpack
WILCOXON_NOTE = (
    "Wilcoxon's signed-rank test vertex by vertex, as the paper has it: neighbouring vertices "
    "are not independent, so its p values are far too small; judge by the size of the "
    "difference."
)


def check_face_after(
    case: Case,
    comparison: ModelComparison,
    unmoved: SkinComparison | None,
    moved: Mapping[str, Floats],
) -> Iterator[Finding]:
    """Findings on a face after that is another patient's, in another frame, or the one before.

    They are errors, unless the case states that the face is verified.
    unmoved: The faces before and after where nothing was operated on, where it is known.
    moved: How far each model moves each vertex of the skin, (v,) mm.
    """
    given = case.postoperative
    severity = "warning" if given is not None and given.verified else "error"
    where = case.where("postoperative")
    change = comparison.statistics[NO_CHANGE].mean
    if unmoved is not None:
        differs = unmoved.statistics.mean
        what = f"by {differs:.2f} mm on average where nothing was operated on"
    else:
        differs = change - max(float(np.quantile(size, MOST)) for size in moved.values())
        what = f"by {change:.2f} mm on average, more than any model moves the skin"
    if differs > (DIFFERS if unmoved is not None else OTHER_FACE):
        yield Finding(
            "postoperative-other-face",
            f"the faces before and after the operation differ {what}",
            severity=severity if differs > OTHER_FACE else "warning",
            where=where,
        )
    if _is_unchanged(comparison):
        yield Finding(
            "postoperative-unchanged",
            "the face after the operation is the face before: where the plan moves the skin "
            f"most, they differ by {change:.2f} mm on average",
            severity=severity,
            where=where,
        )


def _is_unchanged(comparison: ModelComparison) -> bool:
    """Whether the face after is far nearer to the face before than to every prediction."""
    still = np.abs(comparison.errors[NO_CHANGE])
    for model in comparison.models:
        off = np.abs(comparison.errors[model])
        shows = off > max(SHOWS, HALF * float(np.quantile(off, MOST)))
        if not shows.any() or np.median(still[shows]) > UNCHANGED * np.median(off[shows]):
            return False
    return True


def refuse_other_face(findings: Iterator[Finding]) -> tuple[Finding, ...]:
    """The findings; `CaseError` where one is an error."""
    found = tuple(findings)
    for finding in found:
        if finding.severity == "error":
            raise CaseInputError(
                f"{finding.where}: {finding.what} ({finding.code}): {finding.why}; {finding.fix}"
            )
    return found


@dataclass(frozen=True, eq=False)
class CaseEvaluation:
    """The comparison of models with one patient's outcome.

    Attributes
    ----------
    predictions : tuple of Prediction
    postoperative : Postoperative
    comparison : ModelComparison
    key : str
        A digest of everything on which the result depends: inputs, models, version.
    failed : mapping of str to str
        The reason why a model has no prediction, by its name.
    unmoved : SkinComparison or None
        The face before against the face after where nothing was operated on; None where the scans
        do not show it.
    thickness : ThicknessChange or None
        The change of the soft tissue's thickness that was fitted there, if requested.
    fitted : ModelComparison or None
        The comparison with that change applied to every prediction, and to no change.
    notes : tuple of Finding
        How regions were placed; why something is missing.
    """

    predictions: tuple[Prediction, ...]
    postoperative: Postoperative
    comparison: ModelComparison
    key: str
    failed: Mapping[str, str] = field(default_factory=dict)
    unmoved: SkinComparison | None = None
    thickness: ThicknessChange | None = None
    fitted: ModelComparison | None = None
    notes: tuple[Finding, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON: errors by model and region, tests, key."""
        errors = {name: self._of(name) for name in self.comparison.errors}
        still = errors.pop(NO_CHANGE)
        names = list(errors)
        tests = {
            f"{one}, {other}": self.comparison.wilcoxon(one, other).as_dict()
            for i, one in enumerate(names)
            for other in names[i + 1 :]
        }
        first, found = self.predictions[0], self.findings
        timings = {
            name: sum(p.summary["timings"].values())
            for name, p in zip(names, self.predictions, strict=True)
        }
        return {
            "case": first.name,
            "key": self.key,
            # That of the predictions: what is shown together must have the same.
            "case_key": first.summary["case_key"],
            **self._causes(),
            "models": errors,
            "failed": dict(self.failed),
            "no_change": still,
            "wilcoxon": tests,
            "notes": [WILCOXON_NOTE] if tests else [],
            "seconds": timings,
            "findings": [asdict(finding) for finding in found],
            # Of everything that led to the figures, one line for each kind.
            "warnings": [
                f"{g.severity}: {g.line}"
                for g in grouped([*(f for p in self.predictions for f in p.findings), *found])
                if g.severity != "note"
            ],
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the post-operative face and on the comparison with it."""
        compared = [f for c in self.comparison.comparisons.values() for f in c.findings]
        return tuple(dict.fromkeys([*self.postoperative.findings, *self.notes, *compared]))

    def _causes(self) -> dict[str, Any]:
        """What is no error of any model: where nothing was operated on, and the thickness."""
        found: dict[str, Any] = {"not_operated": None}
        if self.unmoved is not None:
            regions = {n: s.as_dict() for n, s in self.unmoved.regions.items()}
            whole = self.unmoved.statistics.as_dict()
            found["not_operated"] = {"regions": {WHOLE: whole, **regions}}
        if self.thickness is not None and self.fitted is not None:
            means = {
                name: {
                    WHOLE: statistics.mean,
                    **{r: t[name].mean for r, t in self.fitted.regions.items()},
                }
                for name, statistics in self.fitted.statistics.items()
            }
            found["thickness"] = {**self.thickness.as_dict(), "mean_mm": means}
        return found

    def _of(self, name: str) -> dict[str, Any]:
        comparison = self.comparison
        by_region = {region: table[name] for region, table in comparison.regions.items()}
        regions = {WHOLE: comparison.statistics[name], **by_region}
        return {
            "regions": {region: values.as_dict() for region, values in regions.items()},
            "comparison": comparison.comparisons[name].as_dict(),
        }


def evaluate(
    case: CaseOrPath,
    models: str | Sequence[str] = MODELS,
    *,
    fit_thickness: bool = False,
    **options: "Unpack[BuildKeywords]",
) -> CaseEvaluation:
    """The predictions of several models for a case, compared with the post-operative face.

    Errors are computed over the face if the case has skin landmarks before and after, otherwise
    over all of the skin (Kim et al. 2010, section 3.2).

    Parameters
    ----------
    case : Case, or path of its file or folder
        With [postoperative].
    models : str or sequence of str
    fit_thickness : bool
        Whether one change of the soft tissue's thickness is fitted where nothing was operated on,
        and every prediction is compared with it applied as well.
    **options
        As for `predict`.

    Raises
    ------
    CmfsimError
        (also `ValueError` where the input is at fault) What a stage cannot work with; a model that
        does not solve, where none of the others does; a face after that is another patient's or the
        one before, unless the case states that it is verified.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.evaluate(cmfsim.Case.load("case.toml"), ["H", "M+S"])  # doctest: +SKIP
    >>> found.comparison.statistics["M+S"].mean  # doctest: +SKIP
    1.21
    """
    case, models = as_case(case), named_models(models)
    failed = options.get("failed")
    if failed is None:
        failed = options["failed"] = {}
    expected = expected_stages(*(f"solving {model}" for model in models), "comparing the faces")
    with build_options(options, expected) as asked:
        asked.observer.stage("reading the face after the operation")
        key = evaluation_key(case, models)
        # First, for it fails at once where the case has none.
        postoperative = options.get("after") or read_postoperative(case)
        if postoperative.skin is None:
            raise CaseInputError(
                f"{case.where('postoperative')}: the case has no face to compare with: add skin or "
                "image"
            )
        predictions = tuple(predictions_of(case, models, replace(asked, after=postoperative)))
        if not predictions:
            raise next(iter(failed.values()))
        asked.observer.stage("comparing the faces")
        landmarks = face_landmarks(predictions[0].patient)
        compared = _Compared(
            predictions, postoperative.skin, postoperative.landmarks, landmarks.points
        )
        comparison = compared.models()
        unmoved, why = compared.unmoved()
        doubts = check_face_after(case, comparison, unmoved, compared.moved)
        notes = (*landmarks.findings, *why, *refuse_other_face(doubts))
        if predictions[0].patient.landmarks_are_found and postoperative.landmarks:
            unused = Finding("landmarks-after-unused", where="postoperative.landmarks")
            notes = (*notes, unused)
        thickness = fitted = None
        if fit_thickness:
            if unmoved is None:
                raise CaseInputError(
                    "a change of thickness is fitted where nothing was operated on, but "
                    f"{why[0].what if why else 'there is no such place'}: omit --fit-thickness"
                )
            depth = compared.depth()
            thickness = fitted_thickness(unmoved.signed, depth[unmoved.vertices])
            fitted = compared.models(thickness.share * depth)
        reasons = {model: str(error) for model, error in failed.items()}
        found = CaseEvaluation(
            predictions, postoperative, comparison, key, reasons, unmoved, thickness, fitted, notes
        )
        if found.findings:
            asked.observer.found(found.findings)
    return found


@dataclass(frozen=True, eq=False)
class _Compared:
    """Predictions of one patient, the face after, and landmarks that place the regions."""

    predictions: Sequence[Prediction]
    after: SurfaceData
    after_landmarks: Mapping[str, Floats]
    landmarks: Mapping[str, Floats]

    @cached_property
    def moved(self) -> dict[str, Floats]:
        """How far each model moves each vertex of the skin, mm."""
        return {p.model: np.linalg.norm(p.skin_displacements, axis=1) for p in self.predictions}

    def models(self, thickening: Floats | None = None) -> ModelComparison:
        """Every model against the face after, by regions; distances by landmarks of both."""
        before = self.predictions[0].skin_before
        patient = self.predictions[0].patient
        # Landmarks that were found automatically place regions, and no distance depends on them.
        ours = {} if patient.landmarks_are_found else patient.landmarks.get("skin", {})
        theirs = self.after_landmarks
        both = bool(ours) and bool(theirs)
        regions = skin_regions(before.vertices, self.landmarks) if self.landmarks else {}
        regions = {name: part for name, part in regions.items() if part.any()}
        return compare_models(
            before,
            {p.model: p.skin.vertices for p in self.predictions},
            self.after,
            landmarks=(ours, theirs) if both else None,
            mask="face" if "face" in regions else None,
            regions=regions,
            thickening=thickening,
        )

    def unmoved(self) -> tuple[SkinComparison | None, tuple[Finding, ...]]:
        """The comparison where nothing was operated on, or why there is none."""
        if not self.landmarks:
            return None, ()
        before = self.predictions[0].skin_before
        most = np.max([*self.moved.values()], axis=0)
        regions = unmoved_regions(before.vertices, self.landmarks)
        reason = "the simulated tissue ends below the forehead"
        try:
            found = compare_unmoved(before, self.after, regions, most)
        except RegistrationError as error:
            found, reason = None, str(error)
        return found, () if found is not None else (_not_shown(reason),)

    def depth(self) -> Floats:
        """Depth of the soft tissue under each vertex of the skin before, mm."""
        first = self.predictions[0]
        bones = [segment.surface for segment in first.patient.segments]
        return tissue_depth(first.skin_before.vertices, bones)


def _not_shown(reason: str) -> Finding:
    return Finding(
        "not-operated-none",
        f"the error where nothing was operated on is not known: {reason}",
        where="postoperative",
    )


def evaluation_key(case: Case, models: Sequence[str]) -> str:
    """The SHA-256 of what an evaluation depends on: the case, as `case_key`, and the models."""
    return settings_digest({"case": case_key(case), "models": sorted(models)})
