"""Solver options, and the names of the models that are solved."""

from dataclasses import dataclass
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS
from cmfsim.values.checks import Plain, as_positive, as_whole, check_one_of, keep

# Kim et al. 2010, section 3.2: homogeneous or with muscles, without or with sliding at teeth and
# mucosa.
MODELS = ("H", "M", "H+S", "M+S")
CONTACTS = ("bilateral", "unilateral")


@dataclass(frozen=True)
class SolverOptions(Plain):
    """Options of solving a scene; the defaults are those of `MassTensors` and `StaticSolver`.

    Attributes
    ----------
    method : str
        "auto", "cholesky", "pcg" or "relaxation".
    contact : str
        "bilateral" or "unilateral".
    tolerance : float
        Estimated error of the iterative methods, over the largest displacement that bones
        prescribe or, if it is larger, about that which loads cause. It says nothing of nodes that
        move far less. A solution
        whose estimated error exceeds a thousandth of its largest displacement is refused.
    max_iterations : int or None
    contact_tolerance : float, mm
        Largest distance of a node in contact from its contact surface; the force along the surface
        may still move any single node by at most a tenth of it. Between lips, 100 times as much,
        at most 0.01 mm.
    contact_iterations : int
        Newton steps of the contact solver.
    memory_limit : float or None, MB
    element : str
        "p1", "anp" or "p2", as `cmfsim.MassTensors` takes it.
    kinematics : str
        "linear", "corotational" or "hyperelastic".

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.SolverOptions(method="cholesky").contact
    'bilateral'
    """

    method: str = "auto"
    contact: str = "bilateral"
    tolerance: float = 1e-8
    max_iterations: int | None = None
    contact_tolerance: float = 1e-4
    contact_iterations: int = 50
    memory_limit: float | None = None
    element: str = "p1"
    kinematics: str = "linear"

    def __post_init__(self) -> None:
        check_one_of("method", self.method, METHODS)
        check_one_of("element", self.element, ELEMENTS)
        check_one_of("kinematics", self.kinematics, KINEMATICS)
        check_one_of("contact", self.contact, CONTACTS)
        for name in ("tolerance", "contact_tolerance"):
            as_positive(name, getattr(self, name))
        if self.memory_limit is not None:
            as_positive("memory_limit", self.memory_limit)
        if self.max_iterations is not None:
            keep(self, max_iterations=as_whole("max_iterations", self.max_iterations, 1))
        steps = as_whole("contact_iterations", self.contact_iterations, 1)
        keep(self, contact_iterations=steps)

    def header(self) -> dict[str, Any]:
        """The options as a scene file holds them: element and kinematics where unusual.

        A scene with neither therefore keeps its content and its hash.
        """
        usual = {"element": "p1", "kinematics": "linear"}
        return {k: v for k, v in self.as_dict().items() if usual.get(k) != v}
