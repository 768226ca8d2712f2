"""Who placed a landmark, as the description of its point states it in a file."""

import re
from dataclasses import dataclass

# A missing or doubtful site whose expected error has fallen to this, mm, need not be placed.
GOOD_ERROR = 4.0
# And a doubt is lifted only if placed sites have lowered the expected error to this share of it:
# sites far away say nothing of it.
CLEARED_SHARE = 0.75
# A missing site is filled in up to this expected error, mm; above `GOOD_ERROR` it is doubtful.
MOST_ERROR = 8.0
# A site that follows others is brought onto its surface if that is as near as this, mm.
SURFACE_REACH = 12.0
# What the description of every point that no person has placed or accepted contains.
UNPLACED = "not placed by a person"
ERROR = re.compile(r"expected error (\d+(?:\.\d+)?) mm")
DOUBT = re.compile(r"; doubtful: (.*)$", re.DOTALL)
# Origins of a point, with the words of its description; those that a person answers for first.
PLACED, ACCEPTED = "placed", "accepted"
ORIGINS = {
    PLACED: "placed by hand",
    ACCEPTED: "proposed by cmfsim, accepted by a person",
    "proposed": f"proposed by cmfsim, {UNPLACED}",
    "moved": f"moved by cmfsim with the sites that were placed, {UNPLACED}",
    "filled": f"filled in by cmfsim from the other sites, {UNPLACED}",
}


@dataclass(frozen=True)
class SiteState:
    """Where a landmark comes from.

    Attributes
    ----------
    origin : str
        A key of `ORIGINS`.
    error : float, mm
        Expected distance from where a person would place it; 0 where one did.
    doubt : str
        The reason to check it; empty if there is none.
    """

    origin: str = PLACED
    error: float = 0.0
    doubt: str = ""

    @property
    def by_person(self) -> bool:
        """Whether a person placed or accepted it."""
        return self.origin in {PLACED, ACCEPTED}

    @property
    def description(self) -> str:
        """The description of its point in a file."""
        text = ORIGINS[self.origin]
        if self.by_person:
            return text
        doubt = f"; doubtful: {self.doubt}" if self.doubt else ""
        return f"{text}; expected error {self.error:.1f} mm{doubt}"


def site_state(description: str) -> SiteState:
    """The state in the description of a point: one that says nothing was placed by a person."""
    if UNPLACED not in description:
        accepted = description.startswith(ORIGINS[ACCEPTED])
        return SiteState(ACCEPTED if accepted else PLACED)
    origin = next((o for o, text in ORIGINS.items() if description.startswith(text)), "proposed")
    error, doubt = ERROR.search(description), DOUBT.search(description)
    return SiteState(origin, float(error[1]) if error else 0.0, doubt[1] if doubt else "")
