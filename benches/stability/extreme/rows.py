"""A case of the suite, the result of a method, and the tolerances of every suite."""

from __future__ import annotations

import signal
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

EPS = float(np.finfo(np.float64).eps)
# Error over the largest displacement that is allowed however well the case is conditioned.
ERROR_LIMIT = 1e-9
# Allowed error over ε κ, where that is more than `ERROR_LIMIT`: κ of the equilibrated matrix.
CONDITION_FACTOR = 10.0
# The true error of an iterative method may be this many times what it reports, beside
# the round-off that every method has.
BOUND_FACTOR = 1.0
# Residual of a direct solve over its round-off, ε ‖|K| |u|‖ / ‖b‖ (times E_t/E_l for soft fibres,
# whose modulus Spencer's constants give as a difference of large ones).
RESIDUAL_FACTOR = 10.0
# Error above which an answer has no digits worth having: it must be refused, whatever κ is.
WORTHLESS = 1e-3
# Sweeps that the relaxation gets before it must give up. It needs about as many as κ says.
SWEEPS = 4000
# Seconds after which a solve counts as hanging.
PATIENCE = 60

ALL = ("cholesky", "pcg", "relaxation")
FAST = ("cholesky", "pcg")


@dataclass(frozen=True)
class Case:
    """One line of the suite: how to build it, what solves it, and what must come out.

    Attributes
    ----------
    group, name : str
    parameter : str
        The extreme value, in words.
    build : callable
    methods : tuple of str
    refusal : tuple of str
        Words that the error must hold; empty where the case has a solution.
    tolerance : float
        Asked of the iterative methods.
    quick : bool
        Whether `--quick` runs it.
    """

    group: str
    name: str
    parameter: str
    build: Callable[[], Any]
    methods: tuple[str, ...] = FAST
    refusal: tuple[str, ...] = ()
    tolerance: float = 1e-9
    quick: bool = True

    @property
    def key(self) -> str:
        """A name that no other case has."""
        return f"{self.group}: {self.name}, {self.parameter}"


@dataclass(frozen=True)
class Row:
    """What one method made of one case; numbers are None where it was refused.

    Attributes
    ----------
    condition : float or None
        κ₂ of the equilibrated matrix.
    reference : str
        "closed form" or "32 digits".
    residual, true_residual : float or None
        As reported, and with 32 digits.
    error : float or None
        Largest nodal error over the largest displacement.
    error_estimate : float or None
        As reported, over the largest displacement.
    distance : float or None, mm
        How far a held node is from its place on the moved surface.
    tangential : float or None
        Largest force across the normals of the contact over the largest contact force.
    least_volume : float or None
        Smallest volume of a tet over its volume at rest.
    deflection : float or None
        Of the tip of a panel over that of a finer mesh.
    allowed : float or None
        The error that the acceptance rule allows.
    verdict : str
        "ok", "refused: …" or "WRONG: …".
    passed : bool
        Whether the verdict is the wanted one.
    """

    group: str
    name: str
    parameter: str
    method: str
    condition: float | None = None
    reference: str = ""
    residual: float | None = None
    true_residual: float | None = None
    error: float | None = None
    error_estimate: float | None = None
    allowed: float | None = None
    iterations: int | None = None
    distance: float | None = None
    tangential: float | None = None
    least_volume: float | None = None
    deflection: float | None = None
    seconds: float = 0.0
    verdict: str = ""
    passed: bool = False


@contextmanager
def patience(seconds: int) -> Iterator[None]:
    """A TimeoutError after some seconds, where the platform has alarms."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(_number: int, _frame: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
