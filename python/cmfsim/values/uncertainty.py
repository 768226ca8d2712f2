"""The sources of uncertainty of a prediction, each with its prior and its origin.

A prior is a standard deviation. Moduli have it on their logarithm, since they are positive and
spread over orders of magnitude; the rest is linear. "assumed" means that no publication was found
that gives the figure.
"""

from dataclasses import dataclass
from typing import Any

from cmfsim.values.checks import as_positive


@dataclass(frozen=True)
class Source:
    """A source of uncertainty.

    sd: Standard deviation, above 0.
    unit: "log": of the natural logarithm; "1", "share", "degrees" or "mm".
    reference: Where the standard deviation comes from.
    """

    name: str
    sd: float
    unit: str
    reference: str

    def __post_init__(self) -> None:
        as_positive(f"sd of {self.name}", self.sd)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"sd": self.sd, "unit": self.unit, "reference": self.reference}


_MODULI = "spread of the published values in docs/moduli.md"
_EXECUTION = (
    "24 bimaxillary patients, plan against CT after the operation, √(mean² + SD²) of the absolute "
    "differences (PMC8432567, 2021)"
)

# Of the material; only ratios of moduli matter, so that fat, along and across together count once.
TISSUE = (
    Source("fat modulus", 0.45, "log", _MODULI),
    Source("muscle modulus along", 1.1, "log", _MODULI),
    Source("muscle modulus across", 1.1, "log", _MODULI),
    Source("fat Poisson's ratio", 0.05, "1", "assumed: 0.40 here, 0.43 to 0.49 in other models"),
    Source("muscle Poisson's ratio", 0.03, "1", "assumed: models of the face use 0.4 to 0.49"),
    Source("muscle fraction", 0.2, "share", "assumed: muscles of a template, not of the patient"),
    Source("fibre direction about L", 10.0, "degrees", "assumed"),
    Source("fibre direction about P", 10.0, "degrees", "assumed"),
    Source("fibre direction about S", 10.0, "degrees", "assumed"),
)
# Of each segment that the plan moves, about the middle of what is joined to it.
PLAN = (
    Source("to the left", 0.82, "mm", _EXECUTION),
    Source("backwards", 1.10, "mm", _EXECUTION),
    Source("upwards", 1.27, "mm", _EXECUTION),
    Source("pitch", 1.78, "degrees", _EXECUTION),
    Source("roll", 0.59, "degrees", _EXECUTION),
    Source("yaw", 0.71, "degrees", _EXECUTION),
)
# Along the normal of the skin, without a solve.
ADDED = (
    Source("thickness change", 0.05, "share", "assumed: share of the depth of the soft tissue"),
    Source("segmentation threshold", 0.25, "mm", "assumed: half a voxel of 0.5 mm"),
    Source("scan noise", 0.2, "mm", "assumed: noise of a surface scan"),
    Source(
        "form of the model", 0.5, "mm", "assumed: half the mean error on virtual patients P1 to P4"
    ),
)
# What no derivative gives, and what stands for it.
NOT_COVERED = (
    (
        "bilateral or unilateral contact, and the extent of the sliding region: these are "
        "discrete choices; predict again with the other one to see its effect"
    ),
    (
        "errors of single landmarks: cmfsim sensitivity draws them; here, the muscle fraction "
        "and direction represent them"
    ),
    (
        "segmentation threshold of bone, contact of the lips, and errors of the model's form "
        "that are larger in one place than in another: only a calibration shows their effect"
    ),
)


def band_sources() -> dict[str, Any]:
    """The sources and their priors, as plain values: part of what a calibration belongs to."""
    groups = {"tissue": TISSUE, "plan": PLAN, "added": ADDED}
    return {
        kind: {source.name: {"sd": source.sd, "unit": source.unit} for source in sources}
        for kind, sources in groups.items()
    }
