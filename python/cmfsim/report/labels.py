"""The labels of figures and methods in a report, with their units."""

from collections.abc import Mapping

# How a distance between skins was measured, by the method of `compare_skins`.
MEASURES: Mapping[str, str] = {
    "landmarks": "from the corresponding point given by a spline through the skin landmarks, as "
    "in the paper",
    "closest": "from the closest point, which ignores skin that slid along itself: smaller than "
    "through landmarks",
}

# mm³ in a cm³, and one in a hundred.
CUBIC, PERCENT = 1e-3, 100.0

# Label and factor of each figure, by its key in the summary.
Labels = Mapping[str, tuple[str, float]]

MESH: Labels = {
    "n_nodes": ("nodes", 1),
    "n_tets": ("tets", 1),
    "mean_edge": ("mean edge, mm", 1.0),
    "volume": ("volume, cm³", CUBIC),
    "volume_error": ("volume relative to the tissue, %", PERCENT),
    "boundary_error_mean": ("mean distance from the surface, mm", 1.0),
    "boundary_error_max": ("largest distance from the surface, mm", 1.0),
    "min_dihedral": ("smallest dihedral angle, °", 1.0),
    "max_dihedral": ("largest dihedral angle, °", 1.0),
    "edge_ratio": ("longest over shortest edge of the worst tet", 1.0),
    "dropped_parts": ("removed bodies (too small)", 1),
    "dropped_volume": ("volume of removed bodies, cm³", CUBIC),
    "dropped_tets": ("poor tets removed at the surface", 1),
}
MUSCLES: Labels = {
    "template": ("template", 1),
    "smoothing": ("smoothing of the spline", 1.0),
    "fit": ("moved into the tissue", 1),
    "blur": ("blur of the shares of muscle, mm", 1.0),
    "preset": ("constants of fat and muscle", 1),
    "mixing": ("quantity mixed in a tet", 1),
    "inside": ("inside test", 1),
    "muscles": ("muscles", 1),
    "muscle_volume": ("volume of all muscles in the tissue, cm³", CUBIC),
    "muscle_tets": ("tets that contain muscle", 1),
    "pairs": ("pairs of tet and muscle checked", 1),
    "crossed": ("tets that a muscle's surface crosses", 1),
    "samples": ("points in each of these", 1),
    "samples_per_crossed_tet": ("points in each of these", 1),
    "points": ("points in total", 1),
    "seed": ("random seed of the points", 1),
}


def labelled(values: Mapping[str, object], labels: Labels) -> dict[str, object]:
    """Numbers and names of a summary by label, in the order of the labels; others by key."""
    out: dict[str, object] = {}
    keys = [*(k for k in labels if k in values), *(k for k in values if k not in labels)]
    for key in keys:
        value = values[key]
        label, factor = labels.get(key, (key.replace("_", " "), 1))
        if isinstance(value, str | bool) or (isinstance(value, int) and factor == 1):
            out[label] = value
        elif isinstance(value, int | float):
            out[label] = value * factor
    return out
