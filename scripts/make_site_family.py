"""Makes the family of heads from which landmarks follow one another, site_family.npz.

Run it after a change of the shapes in cmfsim.phantom (10 minutes):
python scripts/make_site_family.py
"""

import dataclasses
from pathlib import Path

import numpy as np

import cmfsim
from cmfsim.phantom import PARAMETER_RANGES
from cmfsim.registration import site_covariance
from cmfsim.values.checks import Floats
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS

# Heads of the family. Its parameters are 11; more heads change standard deviations by 5 %.
HEADS = 200
# Openings of mouth and lips that `HeadParameters.random` leaves closed.
OPENINGS = ("lip_gap", "bite_gap")


def main() -> None:
    """Writes the file and prints its size."""
    places = np.stack([family_head(seed) for seed in range(1, HEADS + 1)])
    path = Path(site_covariance.__file__).with_name(site_covariance.FILE)
    site_covariance.write_family(path, places)
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} kB")


def family_head(seed: int) -> Floats:
    """The landmarks of a synthetic person, skull before skin, mm."""
    rng = np.random.default_rng((seed, 1))
    gaps = {name: float(rng.uniform(*PARAMETER_RANGES[name])) for name in OPENINGS}
    head = cmfsim.make_head(dataclasses.replace(cmfsim.HeadParameters.random(seed), **gaps))
    return np.array(
        [
            *(head.skull_landmarks[name] for name in SKULL_LANDMARKS),
            *(head.skin_landmarks[name] for name in SKIN_LANDMARKS),
        ]
    )


if __name__ == "__main__":
    main()
