"""How far landmarks are off that follow those placed by hand.

On the two real heads with landmarks (the folder named by CMFSIM_DATA): sites that are placed lie
where the operator put them, and only the others are measured. A second table shows which deviations
make the placed sites of each head likeliest. Two minutes.

    python -m benches.accuracy.placed_sites --markdown docs/landmarks.md
"""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import cmfsim
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from cmfsim.io import read_landmark_file, read_surface
from cmfsim.pipeline.proposing import ProposedHead, filled_landmarks
from cmfsim.registration.closest import robust_similarity
from cmfsim.registration.proposed.shape_model.model import SITES
from cmfsim.registration.proposed.shape_model.site_covariance import average_sites, prior_covariance
from cmfsim.values.landmark_sites import JAW_SITES
from cmfsim.values.proposed_landmarks import ProposedLandmarks, SiteState

NAME = "benches/accuracy/placed_sites.py"
HEADS = {"ct_phantom": "CT phantom", "atlas_head": "atlas head"}
# What counts as close, mm.
CLOSE = 4.0
# How far the sites of a doubtful jaw are moved, and their expected error, mm.
SHIFT, DOUBTFUL = np.array([0.0, 4.0, 12.0]), 10.0
THREE = (("skull", "nasion"), ("skull", "pogonion"), ("skull", "gonion_L"))
OF_JAW = (("skull", "menton"), ("skull", "gonion_L"), ("skull", "infradentale"))
# Deviations of which the likelihood is stated: each site's own, mm, and factors on those of shape.
OWN, SHARES = (1.0, 1.5, 2.0, 2.5, 3.0), (0.7, 1.0, 1.4)
SEVEN = (
    *(("skull", n) for n in ("nasion", "supradentale", "menton", "gonion_L", "gonion_R")),
    ("skull", "zygomatic_arch_L"),
    ("skin", "pronasale"),
)


def main() -> None:
    """Measures, and prints the table or puts it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--markdown", type=Path, help="page whose marked place is filled")
    options = parser.parse_args()
    data = data_folder()
    rows = [
        "| head | what is known | measured sites | mean, mm | within 4 mm | expected, mm |",
        "|---|---|---|---|---|---|",
        *(row for folder, name in HEADS.items() for row in _rows(data / folder, name)),
    ]
    likely = [
        f"| head | {' | '.join(f'own {own:g} mm' for own in OWN)} |",
        f"|---{'|---' * len(OWN)}|",
        *(row for folder, name in HEADS.items() for row in _likelihoods(data / folder, name)),
    ]
    publish(options.markdown, NAME, "\n".join([*rows, "", *likely]))


def _likelihoods(folder: Path, name: str) -> Iterator[str]:
    """The logarithm of the likelihood of a head's sites, by the deviations of the prior."""
    found = {
        kind: read_landmark_file(folder / f"{kind}_landmarks.mrk.json").points
        for kind in ("skull", "skin")
    }
    mean = average_sites()
    places = np.array([found[kind][label] for kind, label in SITES])
    linear, offset, _ = robust_similarity(places, mean, np.ones(len(mean)), 6.0)
    away = (places @ linear.T + offset - mean).ravel()
    for share in SHARES:
        values = []
        for own in OWN:
            prior = prior_covariance(own, share)
            spread = np.linalg.slogdet(prior)[1]
            values.append(-0.5 * (away @ np.linalg.solve(prior, away) + spread))
        yield f"| {name}, shape × {share:g} | {' | '.join(f'{v:.0f}' for v in values)} |"


def _rows(folder: Path, name: str) -> Iterator[str]:
    bones = {part: read_surface(folder / f"{part}.ply") for part in ("cranium", "mandible")}
    skin = read_surface(folder / "skin.ply")
    truth = {
        (kind, label): point
        for kind in ("skull", "skin")
        for label, point in read_landmark_file(folder / f"{kind}_landmarks.mrk.json").points.items()
    }
    found = cmfsim.propose_landmarks(bones, skin)
    shifted = dataclasses.replace(
        found,
        skull={
            label: dataclasses.replace(
                site, point=site.point + SHIFT, error=DOUBTFUL, doubt="it was moved"
            )
            if label.startswith(JAW_SITES)
            else site
            for label, site in found.skull.items()
        },
    )
    nothing = ProposedLandmarks({}, {})
    for what, proposed, placed, of_jaw in (
        ("all proposed", found, (), False),
        ("all proposed, 3 placed", found, THREE, False),
        ("the jaw moved by 12.6 mm and doubtful: its sites", shifted, (), True),
        *((f"the same, {k} of the jaw placed", shifted, OF_JAW[:k], True) for k in range(1, 4)),
        ("none proposed, 7 placed", nothing, SEVEN, False),
    ):
        head = ProposedHead(None, bones, skin, proposed)  # type: ignore[arg-type]  # is not used
        after = filled_landmarks(head, {key: (truth[key], SiteState()) for key in placed})
        sites = {("skull", n): s for n, s in after.skull.items()}
        sites |= {("skin", n): s for n, s in after.skin.items()}
        counted = [
            key
            for key in sites
            if key not in placed
            and not (of_jaw and (key[0] == "skin" or not key[1].startswith(JAW_SITES)))
        ]
        off = np.array([np.linalg.norm(sites[key].point - truth[key]) for key in counted])
        expected = np.mean([sites[key].error for key in counted])
        yield (
            f"| {name} | {what} | {len(off)} | {off.mean():.1f} | "
            f"{100 * np.mean(off <= CLOSE):.0f} % | {expected:.1f} |"
        )


if __name__ == "__main__":
    main()
