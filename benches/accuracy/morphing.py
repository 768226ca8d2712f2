"""Distance of a template's muscles from those of other phantom people: morphing.py [PEOPLE].

Prints a Markdown table with one line per person (`HeadParameters.random`, seeds from 1): distance
of the muscles' vertices from the true surfaces before and after the morph by the skull landmarks,
mm, the mean over all muscles and that of the worst, and the median leave-one-out distance of the
landmarks.
"""

import sys

import numpy as np

import cmfsim

# One in so many vertices is asked for.
STEP = 20


def distances(muscles: cmfsim.Musculature, person: cmfsim.PhantomHead) -> list[float]:
    """Mean distance of each muscle's vertices from the person's own, mm."""
    return [
        float(np.abs(true.level(np.asarray(muscles[name].surface.vertices)[::STEP])).mean())
        for name, true in person.muscles.items()
    ]


def main(people: int) -> None:
    """Prints the table."""
    template = cmfsim.MuscleTemplate.load("default")
    print("| person | before, mean | after, mean | after, worst muscle | leave-one-out, median |")
    print("|---:|---:|---:|---:|---:|")
    for seed in range(1, people + 1):
        person = cmfsim.make_head(cmfsim.HeadParameters.random(seed))
        morphed = template.morph(person.skull_landmarks)
        before, after = distances(template.musculature, person), distances(morphed, person)
        check = morphed.leave_one_out
        left_out = np.nan if check is None else np.median(list(check.distances))
        print(
            f"| {seed} | {np.mean(before):.2f} | {np.mean(after):.2f} | {max(after):.2f} | "
            f"{left_out:.2f} |"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4)
