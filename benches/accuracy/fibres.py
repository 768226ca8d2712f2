"""Angle between box directions and true fibres on the phantom's muscles: fibres.py [SPACING].

Prints a Markdown table: over points drawn uniformly in the volume of each muscle of the left side,
the median and the 95th percentile of the angle, for as many boxes as the shape needs and for the
single box of Kim et al. (2010). Sheets are those that `MuscleFibres.is_sheet` flags.
"""

import sys

import numpy as np

import cmfsim
from benches.scenes.angles import angle_of_lines

# Points asked per muscle, and points drawn per point that is expected inside.
POINTS, SURPLUS = 2000, 1.3


def main(spacing: float) -> None:
    """Prints the table."""
    head = cmfsim.make_head()
    print("| muscle | kind | extents' ratio | boxes | median, P95 | one box: median, P95 |")
    print("|---|---|---|---|---|---|")
    for name, muscle in head.muscles.items():
        if muscle.side == "R":
            continue
        data = head.surface(name, spacing)
        surface = cmfsim.Surface(data.vertices, data.triangles)
        points = points_inside(surface)
        truth = muscle.fibre(points)
        shaped = cmfsim.MuscleFibres(surface, muscle.kind)
        cells = [
            angles(fibres.directions(points), truth)
            for fibres in (shaped, cmfsim.MuscleFibres(surface, "strap", 1))
        ]
        sheet = ", flagged" if shaped.is_sheet else ""
        print(
            f"| {name} | {muscle.kind}{sheet} | {shaped.sheet_ratio:.2f} "
            f"| {len(shaped.boxes[0])} | {' | '.join(cells)} |",
            flush=True,
        )


def points_inside(surface: cmfsim.Surface) -> np.ndarray:
    """Points drawn uniformly in the volume of a closed surface, (k, 3) mm."""
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    volume = surface.volume
    if volume is None:
        raise ValueError("the surface is open: it has no volume to draw points in")
    count = int(SURPLUS * POINTS * np.prod(high - low) / volume)
    points = np.random.default_rng(0).uniform(low, high, (count, 3))
    return points[surface.winding_number(points) > 0.5][:POINTS]


def angles(found: np.ndarray, truth: np.ndarray) -> str:
    """Median and 95th percentile of the angle between unit vectors of any sign, in words."""
    median, p95 = np.percentile(angle_of_lines(found, truth), [50, 95])
    return f"{median:.1f}°, {p95:.1f}°"


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0)
