"""One way to predict a face: how fine, with which element and kinematics, solved how."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.io import Case
from cmfsim.values.case_parts import CaseMuscles
from cmfsim.values.checks import as_positive, check_one_of
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import SolverOptions
from cmfsim.values.tissue_data import MIXINGS

# What a patient's model is built from; all else is chosen when it is solved.
BUILD_FIELDS = ("edge_length", "samples", "mixing")
# Characters of a hash that name a file: collisions among a few hundred are out of question.
KEY_LENGTH = 16


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
        object.__setattr__(self, "edge_length", as_positive("edge_length", self.edge_length))
        if isinstance(self.samples, bool) or not isinstance(self.samples, int) or self.samples < 1:
            raise CaseInputError(f"samples is {self.samples!r}: a whole number from 1 on is needed")
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
