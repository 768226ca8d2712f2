"""What a drafted case names, where that lies, and whether the case reads as what was shown."""

from cmfsim.drafting.written.checking import (
    UNDECIDED,
    Shown,
    check_written,
    unaccounted,
)
from cmfsim.drafting.written.placing import (
    SAME,
    Draft,
    Place,
    choices_of,
    image_path,
    landmark_path,
    place_after,
    place_before,
    surface_path,
)

__all__ = [
    "SAME",
    "UNDECIDED",
    "Draft",
    "Place",
    "Shown",
    "check_written",
    "choices_of",
    "image_path",
    "landmark_path",
    "place_after",
    "place_before",
    "surface_path",
    "unaccounted",
]
