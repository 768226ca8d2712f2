"""Ways to predict a face: how fine, with which element and kinematics; and sweeps of them."""

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from types import MappingProxyType
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS
from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import as_positive, as_whole, check_one_of, keep
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import CONTACTS, SolverOptions
from cmfsim.values.tissue_data import MIXINGS

# What a patient's model is built from; all else is chosen when it is solved.
BUILD_FIELDS = ("edge_length", "samples", "mixing")
# Characters of a hash that name a file: collisions among a few hundred are out of question.
KEY_LENGTH = 16
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


@dataclass(frozen=True)
class Choice:
    """The settings of a prediction that a sweep varies.

    Attributes
    ----------
    edge_length : float, mm
        Of the tets, as `[mesh]` of a case takes it.
    element, kinematics, method, contact : str
        As `SolverOptions` takes them.
    tolerance : float
        Relative error bound of iterative methods.
    contact_tolerance : float
        Largest gap of a node in contact, mm.
    samples : int
        Points in a tet that a muscle's surface crosses.
    mixing : str
        "moduli" (Kim et al. 2010) or "stiffness".
    model : str
        "H", "M", "H+S" or "M+S".

    Raises
    ------
    CaseError
        (also `ValueError`) An invalid name or number.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.Choice(edge_length=6.0, element="p2").changes(cmfsim.Choice())
    {'edge_length': 6.0, 'element': 'p2'}
    """

    edge_length: float = 4.0
    element: str = "p1"
    kinematics: str = "linear"
    method: str = "auto"
    tolerance: float = 1e-8
    contact: str = "bilateral"
    contact_tolerance: float = 1e-4
    samples: int = 64
    mixing: str = "moduli"
    model: str = "M+S"

    def __post_init__(self) -> None:
        keep(self, edge_length=as_positive("edge_length", self.edge_length))
        keep(self, samples=as_whole("samples", self.samples, 1))
        check_one_of("mixing", self.mixing, MIXINGS)
        check_one_of("model", self.model, MODELS)
        # SolverOptions knows what its own may be.
        self.options(SolverOptions())

    def options(self, given: SolverOptions) -> SolverOptions:
        """Solver options with the values of this choice; the others are as given."""
        named = {f.name for f in fields(SolverOptions)}
        return replace(given, **{k: v for k, v in asdict(self).items() if k in named})

    def case(self, given: Case) -> Case:
        """A case with the settings of this choice; muscles only if the model has them."""
        muscles = None
        if self.model.startswith("M"):
            muscles = replace(
                given.muscles or CaseMuscles(), samples=self.samples, mixing=self.mixing
            )
        mesh = replace(given.mesh, edge_length=self.edge_length)
        return replace(given, mesh=mesh, muscles=muscles, solver=self.options(given.solver))

    def changes(self, base: "Choice") -> dict[str, Any]:
        """The settings that differ from another choice, by name."""
        other = asdict(base)
        return {name: value for name, value in asdict(self).items() if other[name] != value}

    def key(self, of: str) -> str:
        """A key of the solution of this choice, for the case (and version) that `of` identifies."""
        return _hash(of, asdict(self))

    def build_key(self, of: str) -> str:
        """A key of the build of this choice: choices with the same build have the same key."""
        muscles = self.model.startswith("M")
        names = BUILD_FIELDS if muscles else ("edge_length",)
        return _hash(of, {"muscles": muscles, **{name: getattr(self, name) for name in names}})


def case_choice(case: Case) -> Choice:
    """The settings of a case: the defaults of the package where its file has none.

    Returns
    -------
    Choice
        Its model is "M+S".

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.case_choice(cmfsim.Case.load("case.toml")).edge_length  # doctest: +SKIP
    4.0
    """
    muscles = case.muscles or CaseMuscles()
    named = {f.name for f in fields(Choice)}
    solver = {k: v for k, v in case.solver.as_dict().items() if k in named}
    return Choice(
        edge_length=case.mesh.edge_length, samples=muscles.samples, mixing=muscles.mixing, **solver
    )


def _hash(of: str, values: Mapping[str, Any]) -> str:
    text = json.dumps([of, dict(values)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def reference_choice(
    base: Choice, edge_length: float, *, kinematics: str = "hyperelastic"
) -> Choice:
    """The reference of a sweep: quadratic tets, large deformation, many samples; else as the base.

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
    grid = itertools.product(sorted(edges, reverse=True), elements, kinematics)
    choices = [
        base,
        *(replace(base, edge_length=edge, element=of, kinematics=by) for edge, of, by in grid),
        *(choice for name, values in factors.items() for choice in _varied(base, name, values)),
        *(_early(base, kinematics) if "tolerance" in factors else ()),
    ]
    return list(dict.fromkeys(choices))


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
