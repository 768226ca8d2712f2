"""Draws the extension's icon: a profile, and the same profile with its jaw advanced.

python slicer/make_icon.py      # CmfSim.png and CmfSim/Resources/Icons/CmfSim.png
"""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

PIXELS = 128
HERE = Path(__file__).parent
# The profile from the top of the head by forehead, nose, lips and chin to the neck, looking left.
PROFILE = [
    (70, 122),
    (40, 118),
    (27, 96),
    (26, 84),
    (13, 64),
    (24, 58),
    (20, 51),
    (24, 46),
    (22, 40),
    (25, 34),
    (22, 24),
    (34, 12),
    (52, 18),
    (60, 2),
]
BACK = [(108, 2), (104, 40), (122, 84), (104, 116), (70, 122)]


def smooth(points, rounds=3):
    """Corners cut off (Chaikin 1974), ends kept."""
    curve = np.array(points, dtype=float)
    for _ in range(rounds):
        cut = np.empty((2 * len(curve) - 2, 2))
        cut[0::2] = 0.75 * curve[:-1] + 0.25 * curve[1:]
        cut[1::2] = 0.25 * curve[:-1] + 0.75 * curve[1:]
        curve = np.concatenate([curve[:1], cut, curve[-1:]])
    return curve


def advanced(points, size=9.0):
    """The profile with its jaws carried forwards, fading towards nose and neck."""
    moved = np.array(points, dtype=float)
    moved[:, 0] -= size * np.exp(-(((moved[:, 1] - 36.0) / 16.0) ** 2))
    return moved


def main():
    """Writes both files."""
    figure = plt.figure(figsize=(1, 1), dpi=PIXELS)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, PIXELS)
    axes.set_ylim(0, PIXELS)
    axes.axis("off")
    for profile, colour in ((advanced(PROFILE), "#35b779"), (np.array(PROFILE), "#31446b")):
        outline = np.concatenate([smooth(profile), smooth(BACK)])
        axes.add_patch(PathPatch(Outline(outline), facecolor=colour, edgecolor="none"))
    for path in (HERE / "CmfSim.png", HERE / "CmfSim/Resources/Icons/CmfSim.png"):
        figure.savefig(path, dpi=PIXELS, transparent=True, metadata={"Software": None})


if __name__ == "__main__":
    main()
