"""The landmarks proposed for a head, with their expected errors, and who placed each of a file."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from cmfsim.values.checks import Floats, keep
from cmfsim.values.finding import Finding

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
    """Where a landmark comes from: a key of `ORIGINS`, and the reason to check it, if any.

    error: mm. Expected distance from where a person would place it; 0 where one did.
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


@dataclass(frozen=True, eq=False)
class ProposedSite:
    """A proposed landmark (3,), mm, on the surface of the bone or skin, in the frame of the head.

    Error, doubt and origin are those of its `SiteState`.
    """

    point: Floats
    error: float
    doubt: str = ""
    origin: str = "proposed"

    @property
    def state(self) -> SiteState:
        """Where it comes from."""
        return SiteState(self.origin, self.error, self.doubt)

    def doubted(self, reason: str, least: float = 0.0) -> "ProposedSite":
        """The site with a further reason to check it, and at least this expected error, mm."""
        doubt = "; ".join(filter(None, (self.doubt, reason)))
        return replace(self, error=max(self.error, least), doubt=doubt)


@dataclass(frozen=True, eq=False)
class ProposedLandmarks:
    """Landmarks that were found automatically, in the order of the lists; the missing with reasons.

    impossible_jaw: Why the bone taken for the mandible cannot be one; empty if it can.
    doubtful_jaw: Everything that speaks against it, including doubts; empty if nothing does.
    separation: mapping of str to (3,), mm. Where the jaws of an image can be separated again.
    """

    skull: Mapping[str, ProposedSite]
    skin: Mapping[str, ProposedSite]
    missing_skull: Mapping[str, str] = field(default_factory=dict)
    missing_skin: Mapping[str, str] = field(default_factory=dict)
    impossible_jaw: str = ""
    doubtful_jaw: str = ""
    separation: Mapping[str, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("skull", "skin", "missing_skull", "missing_skin", "separation"):
            keep(self, **{name: getattr(self, name)})

    @property
    def points(self) -> dict[str, Mapping[str, Floats]]:
        """The places alone, under "skull" and "skin" where there are any."""
        kinds = (("skull", self.skull), ("skin", self.skin))
        return {
            kind: MappingProxyType({name: site.point for name, site in sites.items()})
            for kind, sites in kinds
            if sites
        }

    def apart(self, others: Mapping[str, Floats]) -> dict[str, float]:
        """How far sites of the skull lie from other places of theirs, mm."""
        return {
            name: float(np.linalg.norm(site.point - others[name]))
            for name, site in self.skull.items()
            if name in others
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """A note of what was done, a warning for each doubtful site and one for missing ones."""
        return tuple(self._findings())

    def _findings(self) -> Iterator[Finding]:
        sites = {**self.skull, **{f"{name} (skin)": site for name, site in self.skin.items()}}
        typical = sorted(s.error for s in sites.values() if s.origin == "proposed")
        count = len(typical)
        yield from _following(sites)
        if count and count == len(sites):
            what = (
                f"{count} landmarks were found automatically; none was placed by hand; expected "
                f"error {typical[count // 2]:.1f} mm (median), {typical[-1]:.1f} mm (largest)"
            )
            yield Finding("landmarks-proposed", what, where="landmarks")
        if self.doubtful_jaw:
            verdict = "is none" if self.impossible_jaw else "is doubtful"
            what = f"the part taken for the mandible {verdict}: {self.doubtful_jaw}"
            yield Finding("jaw-doubtful", what, where="landmarks.skull")
        for kind, own in (("skull", self.skull), ("skin", self.skin)):
            for name, site in own.items():
                if site.doubt:
                    place = ", ".join(f"{x:.1f}" for x in site.point)
                    what = f"{name} ({kind}) at ({place}) is doubtful: {site.doubt}"
                    yield Finding("landmark-doubtful", what, where=f"landmarks.{kind}")
        why = "they are omitted rather than guessed; anything that needs them is refused"
        fix = "place them by hand if the image shows them"
        for kind, missing in (("skull", self.missing_skull), ("skin", self.missing_skin)):
            where = f"landmarks.{kind}"
            for reason in dict.fromkeys(missing.values()):
                names = [name for name, given in missing.items() if given == reason]
                what = f"{len(names)} {kind} landmarks were not found: {', '.join(names)}: {reason}"
                yield Finding(
                    "landmark-missing", what, severity="warning", where=where, why=why, fix=fix
                )


def _following(sites: Mapping[str, ProposedSite]) -> Iterator[Finding]:
    """Which sites follow those that a person placed, with their expected errors."""
    placed = [name for name, site in sites.items() if site.state.by_person]
    if not placed:
        return
    texts = []
    for origin, words in (("filled", "filled in"), ("moved", "moved")):
        names = [f"{n} ({s.error:.1f} mm)" for n, s in sites.items() if s.origin == origin]
        if names:
            texts.append(f"{len(names)} were {words} (expected error): {', '.join(names)}")
    what = f"{len(placed)} landmarks were placed by hand, and others follow them: "
    what += "; ".join(texts) or "none had to be moved"
    yield Finding("landmarks-filled", what, where="landmarks")
