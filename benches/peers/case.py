"""Shared by the runner and every adapter: the case, the stage clock and the result.

It needs only numpy, so that it can be loaded in the interpreter of every peer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

NEXT_TRANSLATION = np.array([0.4, -1.0, 0.6])
"""Added to the motion for the next plan, mm."""


class NotInstalled(Exception):
    """The peer is absent; the text says what to install."""


@dataclass(frozen=True)
class Case:
    """Mesh, isotropic material and prescribed nodes of one linear-elastic problem, mm and MPa."""

    nodes: np.ndarray
    """(n, 3) float64, mm"""
    tets: np.ndarray
    """(m, 4) int32, positively oriented"""
    young: np.ndarray
    """(m,) MPa"""
    poisson: np.ndarray
    """(m,)"""
    fixed: np.ndarray
    """nodes that stay"""
    joined: np.ndarray
    """nodes that follow the segment"""
    motion: np.ndarray
    """(4, 4) rigid motion of the segment, mm"""

    @classmethod
    def load(cls, folder: Path) -> Case:
        """The case that `shell_case` wrote into `folder`; sliding nodes are left free."""
        arrays = {name: np.load(folder / f"{name}.npy") for name in cls.__dataclass_fields__}
        for name in ("tets", "fixed", "joined"):
            arrays[name] = arrays[name].astype(np.int32)
        return cls(**arrays)

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.nodes)

    @property
    def lame(self) -> tuple[np.ndarray, np.ndarray]:
        """Lamé's constants λ and μ of each tet, MPa."""
        e, nu = self.young, self.poisson
        return e * nu / ((1 + nu) * (1 - 2 * nu)), e / (2 * (1 + nu))

    @property
    def next_motion(self) -> np.ndarray:
        """The second plan, which differs from `motion` by a translation."""
        motion = self.motion.copy()
        motion[:3, 3] += NEXT_TRANSLATION
        return motion

    @property
    def prescribed(self) -> np.ndarray:
        """Prescribed nodes, the fixed ones first."""
        return np.concatenate([self.fixed, self.joined])

    def prescribed_displacements(self, motion: np.ndarray) -> np.ndarray:
        """Displacements of the prescribed nodes under a plan, (k, 3), mm."""
        x = self.nodes[self.joined]
        moved = x @ motion[:3, :3].T + motion[:3, 3] - x
        return np.concatenate([np.zeros((len(self.fixed), 3)), moved])


@dataclass(frozen=True)
class Result:
    """What a peer hands back."""

    displacements: np.ndarray
    """(n, 3) mm, for `case.motion`"""
    version: str
    next_displacements: np.ndarray | None = None
    """(n, 3) mm, for `case.next_motion` with the factor kept; None where the peer keeps none"""
    notes: dict[str, object] = field(default_factory=dict)


def cpu_seconds() -> float:
    """CPU seconds of this process, all threads, and of its finished children."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


class Clock:
    """Seconds spent in named stages: wall, and CPU over all threads and child processes."""

    def __init__(self) -> None:
        """No stage timed yet."""
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Adds the time of the `with` block to `stage`."""
        wall, cpu = time.perf_counter(), cpu_seconds()
        try:
            yield
        finally:
            self.wall[stage] = self.wall.get(stage, 0.0) + time.perf_counter() - wall
            self.cpu[stage] = self.cpu.get(stage, 0.0) + cpu_seconds() - cpu
