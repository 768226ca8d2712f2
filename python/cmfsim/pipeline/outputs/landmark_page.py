"""The page of landmarks of a head: what was proposed, what a person has placed, what follows."""

from pathlib import Path

from cmfsim.io import replace_text
from cmfsim.pipeline.proposing import GivenSites, ProposedHead, head_distribution
from cmfsim.planning.landmark_page.page import PageSite, landmark_content, landmark_page_text
from cmfsim.planning.page import PageContent
from cmfsim.registration.proposed.shape_model.site_covariance import PLACED_STD, SiteDistribution
from cmfsim.registration.proposed.template_head import average_head
from cmfsim.values.proposed_landmarks import ProposedLandmarks, SiteState

PAGE_FILE = "landmarks.html"


def head_content(
    name: str, head: ProposedHead, placed: GivenSites | None = None, *, built_for: str = ""
) -> PageContent:
    """The content of the page of a head of a case of this name.

    placed: Sites that a person has placed or accepted already.
    built_for: The state of the case.
    """
    distribution = head_distribution(head)
    average = average_head()
    surfaces = {**head.bones, **({} if head.skin is None else {"skin": head.skin})}
    sites = [
        site
        for site in _sites(head.landmarks, distribution, placed or {})
        if site.kind == "skull" or head.skin is not None
    ]
    kept = 3 * len(sites)
    skin = {} if average.skin is None else {"skin": average.skin}
    return landmark_content(
        name,
        surfaces,
        sites,
        distribution.covariance[:kept, :kept],
        ({**average.bones, **skin}, {"skull": average.skull, "skin": average.skin_landmarks}),
        placed_std=PLACED_STD,
        built_for=built_for,
    )


def _sites(
    found: ProposedLandmarks, distribution: SiteDistribution, placed: GivenSites
) -> list[PageSite]:
    errors = distribution.errors
    proposed = {"skull": found.skull, "skin": found.skin}
    missing = {"skull": found.missing_skull, "skin": found.missing_skin}
    sites = []
    for key, point, error in zip(distribution.names, distribution.mean, errors, strict=True):
        kind, name = key
        site = proposed[kind].get(name)
        if site is None:
            state = SiteState("filled", float(error))
        else:
            state = SiteState("proposed", site.error, site.doubt)
        own = placed.get(key)
        sites.append(
            PageSite(
                kind,
                name,
                point,
                state,
                "" if site else missing[kind].get(name, "it was not found"),
                None if own is None else own[0],
                "placed" if own is None else own[1].origin,
            )
        )
    return sites


def write_landmark_page(path: Path, content: PageContent) -> int:
    """The size in bytes of a page of landmarks, written in one step; `CaseError` if not finite."""
    return replace_text(path, landmark_page_text(content))
