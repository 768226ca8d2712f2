"""The phantom as a scanner would see it: HU with partial volume, noise, metal and a couch."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cmfsim.values.checks import Floats

# Mean HU of each tissue at about 120 kV; round figures of the textbooks (Hounsfield 1973; Bushberg
# 2012).
HOUNSFIELD: Mapping[str, float] = MappingProxyType({
    "air": -1000.0, "skin": 40.0, "fat": -90.0, "muscle": 55.0, "brain": 35.0, "cortical": 1150.0,
    "cancellous": 450.0, "tooth": 2100.0, "metal": 3071.0, "couch_shell": -50.0,
    "couch_foam": -920.0,
})  # fmt: skip
# What an image can hold, HU: 12 bits with an offset of 1024.
LOWEST, HIGHEST = -1024, 3071
# Couch: mm between the head and its shell, thickness of the shell and of the foam, half width.
COUCH_GAP, COUCH_SHELL, COUCH_FOAM, COUCH_HALF_WIDTH = 2.0, 3.0, 30.0, 130.0
# Couch: radius of its hollow, mm.
COUCH_RADIUS = 220.0
# Metal: rays of streaks from each piece, their strength in HU and their reach in mm.
STREAKS, STREAK_HU, STREAK_REACH = 14, 900.0, 35.0


def mixed(
    image: NDArray[np.float32], value: float, level: NDArray[np.float32], width: float
) -> None:
    """Paints a tissue into an image: each voxel by the share of it that lies inside.

    `width` is the size of a voxel in mm: a surface through the middle of one fills half.
    """
    share = np.clip(0.5 + level / width, 0.0, 1.0)
    image += share * (value - image)


def noisy(image: NDArray[np.float32], noise: float, seed: int) -> NDArray[np.int16]:
    """The image with Gaussian noise of `noise` HU, rounded and clipped to what a file holds."""
    if noise > 0.0:
        generator = np.random.default_rng(seed)
        image = image + noise * generator.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), LOWEST, HIGHEST).astype(np.int16)


def add_couch(image: NDArray[np.float32], axes: tuple[Floats, Floats, Floats], back: float) -> None:
    """Paints a hollow couch behind the head, whose rearmost point is at y = back."""
    x, y, _ = axes
    # A circular trough whose deepest line just clears the head.
    depth = np.sqrt(x**2 + (y - back - COUCH_GAP + COUCH_RADIUS) ** 2) - COUCH_RADIUS
    beside = np.abs(x) < COUCH_HALF_WIDTH
    behind = y > back - 0.35 * COUCH_RADIUS
    inside = np.broadcast_to(beside & behind & (depth > 0.0), image.shape)
    thick = np.broadcast_to(depth, image.shape)
    air = image < 0.5 * HOUNSFIELD["air"]
    image[inside & air & (thick < COUCH_SHELL + COUCH_FOAM)] = HOUNSFIELD["couch_foam"]
    shell = (thick < COUCH_SHELL) | ((thick > COUCH_FOAM) & (thick < COUCH_FOAM + COUCH_SHELL))
    image[inside & air & shell] = HOUNSFIELD["couch_shell"]


def add_metal(
    image: NDArray[np.float32],
    axes: tuple[Floats, Floats, Floats],
    pieces: Floats,
    spacing: Floats,
    seed: int,
) -> None:
    """Paints metal pieces and the streaks that they throw in their slices.

    A likeness, not a reconstruction: bright and dark rays whose directions the seed draws, falling
    off with distance; `pieces` holds centre and half size of each, (k, 4) mm.
    """
    generator = np.random.default_rng([seed, 1])
    x, y, z = axes
    for cx, cy, cz, half in pieces.tolist():
        near = np.flatnonzero(np.abs(z.ravel() - cz) <= half + 0.5 * spacing[2])
        radius = np.sqrt((x - cx) ** 2 + (y - cy) ** 2)[:, :, 0]
        angle = np.arctan2(y - cy, x - cx)[:, :, 0]
        rays = np.zeros_like(radius)
        for _ in range(STREAKS):
            turn = generator.uniform(0.0, np.pi)
            sign = generator.choice([-1.0, 1.0])
            # Both ends of a ray: its direction counts modulo half a turn.
            off = np.abs(np.mod(angle - turn + 0.5 * np.pi, np.pi) - 0.5 * np.pi) * radius
            rays += sign * np.exp(-((off / 1.5) ** 2))
        rays *= STREAK_HU * np.exp(-radius / STREAK_REACH)
        piece = radius <= half
        for k in near.tolist():
            image[:, :, k] += rays.astype(np.float32)
            image[:, :, k][piece] = HOUNSFIELD["metal"]
