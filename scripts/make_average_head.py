"""Makes the head with which proposed landmarks are compared, average_head.npz of the package.

Run it after a change of the shapes in cmfsim.phantom: python scripts/make_average_head.py
"""

from dataclasses import replace
from pathlib import Path

import cmfsim
from cmfsim.registration.proposed import TemplateHead, measured_biases, template_head
from cmfsim.surfaces.levels import SurfaceOptions, surface_of_level

# Voxels that the surfaces are taken from, mm, and how many triangles each has at most.
SPACING, MOST_TRIANGLES = 1.5, 16_000


def main() -> None:
    """Writes the file and prints its size."""
    path = Path(template_head.__file__).with_name(template_head.FILE)
    template_head.write_average_head(path, drawn_head(cmfsim.make_head(), "synthetic head"))
    rounded = template_head.read_average_head(path)
    biases = measured_biases(rounded, rounded)
    template_head.write_average_head(path, replace(rounded, biases=biases))
    print(f"{path.name}: {path.stat().st_size / 1024:.0f} kB")


def drawn_head(head: cmfsim.PhantomHead, name: str) -> TemplateHead:
    """A synthetic head with surfaces like those of `average_head`; it takes seconds."""
    anatomy = head.anatomy(SPACING)
    options = SurfaceOptions(max_triangles=MOST_TRIANGLES)
    levels = {**anatomy.bones, "skin": anatomy.skin}
    parts = {part: surface_of_level(part, levels[part], options) for part in template_head.PARTS}
    bones = {bone: parts[bone] for bone in template_head.BONES}
    return TemplateHead(name, bones, head.skull_landmarks, parts["skin"], head.skin_landmarks)


if __name__ == "__main__":
    main()
