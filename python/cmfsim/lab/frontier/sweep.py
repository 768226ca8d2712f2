"""The runs of a sweep: one factor at a time from a base, and a grid of the three main ones."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from types import MappingProxyType
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS
from cmfsim.errors import CaseInputError
from cmfsim.lab.frontier.choice import Choice
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import CONTACTS
from cmfsim.values.tissue_data import MIXINGS

# Edge lengths of the grid, mm.
EDGES = (10.0, 8.0, 6.0, 5.0, 4.0)
# Each varied by itself from the base. Edge length, element and kinematics are in the grid.
FACTORS: Mapping[str, tuple[Any, ...]] = MappingProxyType(
    {
        "method": tuple(name for name in METHODS if name != "auto"),
        "tolerance": (1e-2, 1e-4, 1e-6, 1e-10),
        "contact_tolerance": (1e-3, 1e-5, 1e-7),
        "contact": CONTACTS,
        "samples": (1, 4, 16, 256),
        "mixing": MIXINGS,
        "model": MODELS,
    }
)
# Tolerances at which Newton's method is stopped early, over the largest motion.
EARLY = (1e-1, 1e-2)
# A reference is sampled beyond what the sweep tells apart. Its Newton's method ends where only some
# tets at the cuts still move: the face is then within thousandths of a millimetre of its end.
REFERENCE_SAMPLES = 256
REFERENCE_TOLERANCE = 0.1


def reference_choice(
    base: Choice, edge_length: float, *, kinematics: str = "hyperelastic"
) -> Choice:
    """The reference of a sweep: quadratic tets, large deformation, many samples.

    base: Its contact, its tolerance, mixing and model are the reference's.
    edge_length: mm.
    kinematics: "corotational" where a hyperelastic solution is out of reach.
    """
    return replace(
        base,
        edge_length=edge_length,
        element="p2",
        kinematics=kinematics,
        tolerance=max(base.tolerance, REFERENCE_TOLERANCE),
        samples=max(base.samples, REFERENCE_SAMPLES),
    )


def sweep_choices(
    base: Choice,
    *,
    edges: Sequence[float] = EDGES,
    elements: Sequence[str] = ELEMENTS,
    kinematics: Sequence[str] = KINEMATICS,
    factors: Mapping[str, Sequence[Any]] = FACTORS,
) -> list[Choice]:
    """The base, the full grid of edges, elements and kinematics, and each factor by itself.

    Parameters
    ----------
    base : Choice
    edges : sequence of float, mm
    elements, kinematics : sequence of str
        With `edges` the grid.
    factors : mapping of str to sequence
        Values of each attribute of `Choice` that is varied by itself. `tolerance` is that of
        iterative methods: it is varied with `method="pcg"`, and with it kinematics of large
        deformation are stopped early.

    Returns
    -------
    list of Choice
        Each once: the base, the grid from large tets to small, the rest.

    Raises
    ------
    CaseError
        (also `ValueError`) A factor that a choice does not have; a value that it cannot have.

    Examples
    --------
    >>> import cmfsim
    >>> choices = cmfsim.sweep_choices(cmfsim.Choice(), edges=[6.0], factors={"samples": (16,)})
    >>> len(choices), choices[-1].changes(choices[0])
    (11, {'samples': 16})
    """
    known = tuple(f.name for f in fields(Choice))
    for name in factors:
        if name not in known:
            raise CaseInputError(f"factor {name!r} is unknown: use one of {', '.join(known)}")
    choices = [
        base,
        *_grid(base, edges, elements, kinematics),
        *(choice for name, values in factors.items() for choice in _varied(base, name, values)),
        *(_early(base, kinematics) if "tolerance" in factors else ()),
    ]
    return list(dict.fromkeys(choices))


def _grid(
    base: Choice, edges: Sequence[float], elements: Sequence[str], kinematics: Sequence[str]
) -> Iterator[Choice]:
    for edge_length in sorted(edges, reverse=True):
        for element in elements:
            for name in kinematics:
                yield replace(base, edge_length=edge_length, element=element, kinematics=name)


def _varied(base: Choice, name: str, values: Sequence[Any]) -> Iterator[Choice]:
    if name == "tolerance":
        base = replace(base, method="pcg")
        yield base
    for value in values:
        yield replace(base, **{name: value})


def _early(base: Choice, kinematics: Sequence[str]) -> Iterator[Choice]:
    """Large deformation that stops early: what the last steps fix is a few tets, not the face."""
    for name in kinematics:
        if name != "linear":
            for tolerance in EARLY:
                yield replace(base, kinematics=name, tolerance=tolerance)
