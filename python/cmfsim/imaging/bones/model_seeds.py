"""Seeds of mandible and cranium by the model of shape, for heads without landmarks."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import third_party
from cmfsim.imaging.bones.bone import Bone
from cmfsim.imaging.morphology import Block, Mask, Volume, ndimage
from cmfsim.imaging.skins.skin import Skin
from cmfsim.imaging.working_grid import MARGIN, Working
from cmfsim.registration.proposed.shape_model.fitted_head import FittedHead, fit_head
from cmfsim.registration.proposed.shape_model.model import MANDIBLE, SKIN
from cmfsim.registration.proposed.shape_model.samples import HeadSamples
from cmfsim.values.checks import Floats
from cmfsim.values.shown_region import ShownRegion, box_region

# Points of bone and of skin that the model is fitted to, and the grid they are taken from, mm.
BONE_POINTS, SKIN_POINTS, STEP = 3000, 2500, 2.0
# Blur from which normals are taken, in voxels of that grid.
BLUR = 1.2
# A seed lies this near to its bone of the model and by so much nearer than to the other, mm of the
# average head.
NEAR, CLEAR = 7.0, 5.0
# All bone higher or farther back in the average head is no mandible's, mm; and the box of the flood
# ends above the joints at this height.
ABOVE, BEHIND, BOX_TOP = 15.0, 12.0, 35.0
# The bite is looked for within so many deviations of the model, in layers of this height that are
# smoothed over the one below, mm. Within this range beside it are crowns, with so many times the
# bone at least.
SPREAD, LAYER, SOFT = 3.0, 0.5, 1.0
CROWNS, CONTRAST = (2.0, 12.0), 1.25
BITE_SITES = ("supradentale", "infradentale", "occlusal_line_L", "occlusal_line_R")
# Error of a click, mm.
CLICK = 2.0


def fitted_to(
    work: Working, bone: Bone, skin: Skin, clicks: Mapping[str, Floats] | None
) -> FittedHead:
    """The model fitted to bone and skin of an image, and to what sites of the skull are given.

    Raises
    ------
    LandmarkError
        (also `ValueError`) It fits nowhere.
    """
    on_bone = _border(bone.mask, work, BONE_POINTS)
    on_skin = _border(skin.mask, work, SKIN_POINTS)
    last = work.origin + work.spacing * (np.array(work.hu.shape) - 1.0)
    low = np.where(work.border[0], work.origin, -np.inf)
    high = np.where(work.border[1], last, np.inf)
    shown = box_region(low, high)
    if work.shown is not None:
        near = work.shown.depths(on_skin[0]).min(axis=0) < MARGIN
        shown = shown.and_behind(ShownRegion(work.shown.normals[near], work.shown.places[near]))
    head = fit_head(HeadSamples(*on_bone, *on_skin, shown).without_ends())
    known = {("skull", name): place for name, place in (clicks or {}).items()}
    known = {site: place for site, place in known.items() if site in head.sites}
    return head.conditioned(known, CLICK) if known else head


def _border(mask: Mask, work: Working, count: int) -> tuple[Floats, Floats]:
    """Points on the border of a mask and its outward unit normals, (n, 3) each."""
    steps = np.maximum(np.round(STEP / work.spacing).astype(int), 1)
    coarse = mask[:: steps[0], :: steps[1], :: steps[2]]
    spacing = work.spacing * steps
    level = ndimage().gaussian_filter(coarse.astype(np.float32), BLUR, mode="nearest")
    inner = ndimage().binary_erosion(coarse, border_value=1)
    places = np.argwhere(coarse & ~inner)
    generator = np.random.default_rng(0)
    if len(places) > count:
        places = places[np.sort(generator.choice(len(places), count, replace=False))]
    gradient = np.empty((len(places), 3))
    shape = np.array(coarse.shape)
    for axis in range(3):
        step = np.eye(3, dtype=int)[axis]
        after = np.minimum(places + step, shape - 1)
        before = np.maximum(places - step, 0)
        rise = level[tuple(after.T)] - level[tuple(before.T)]
        gradient[:, axis] = rise / np.maximum((after - before)[:, axis], 1) / spacing[axis]
    steepness = np.linalg.norm(gradient, axis=1)
    sound = steepness > 1e-3
    places, gradient, steepness = places[sound], gradient[sound], steepness[sound]
    normals: Floats = -gradient / steepness[:, None]
    beyond = np.clip((level[tuple(places.T)] - 0.5) / steepness, -STEP, STEP)
    points: Floats = work.origin + spacing * places + beyond[:, None] * normals
    return points, normals


def model_box(work: Working, head: FittedHead) -> Block:
    """The part of the grid from its lower end to above the joints of the jaw."""
    sides, depths = (-75.0, 75.0), (-110.0, 15.0)
    top = np.array([[x, y, BOX_TOP] for x in sides for y in depths])
    height = float(head.state.out(top)[:, 2].max())
    end = int((height - work.origin[2]) / work.spacing[2])
    across, along, layers = work.hu.shape
    return slice(0, across), slice(0, along), slice(0, min(max(end, 2), layers))


def model_seeds(work: Working, domain: Mask, head: FittedHead) -> NDArray[np.int32]:
    """1 where the bone is clearly the mandible's, 2 the rest's, 0 to be flooded.

    Parameters
    ----------
    work : Working
        The block of the domain.
    domain : (nx, ny, nz) bool
        Bone.
    head : FittedHead
    """
    spatial = third_party("scipy.spatial", "jaws are separated", "imaging")
    # Every second voxel: the flood reaches the others.
    index = np.argwhere(domain[::2, ::2, ::2]) * 2
    places = head.state.into(work.origin + work.spacing * index)
    own, parts = head.state.points(head.model), head.model.parts
    distances = [
        spatial.cKDTree(own[taken]).query(places, distance_upper_bound=NEAR + CLEAR)[0]
        for taken in (parts == MANDIBLE, (parts != MANDIBLE) & (parts != SKIN))
    ]
    jaw, rest = (np.minimum(distance, NEAR + CLEAR) for distance in distances)
    kinds = np.zeros(len(index), dtype=np.int32)
    kinds[(jaw < NEAR) & (rest - jaw >= CLEAR)] = 1
    kinds[(rest < NEAR) & (jaw - rest >= CLEAR)] = 2
    kinds[(places[:, 2] > ABOVE) | (places[:, 1] > BEHIND)] = 2
    seeds = np.zeros(domain.shape, dtype=np.int32, order="F")
    seeds[tuple(index.T)] = kinds
    return seeds


def bite_sites(
    work: Working, dense: Volume, head: FittedHead, before_ramus: float
) -> tuple[dict[str, Floats], bool]:
    """The model's sites of the tooth rows, moved to the bite where the image shows it, and whether.

    Parameters
    ----------
    work : Working
        The block of `dense`.
    dense : (nx, ny, nz) float32
        How much bone each voxel holds.
    head : FittedHead
    before_ramus : float, mm
        Of the end of the rows in front of the sites at the ramus.
    """
    sites = {name: head.sites["skull", name] for name in BITE_SITES}
    front = 0.5 * (sites["supradentale"] + sites["infradentale"])
    left, right = sites["occlusal_line_L"], sites["occlusal_line_R"]
    normal = np.cross(left - front, right - front)
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    errors = [
        SPREAD * head.deviation([("skull", name) for name in pair], normal)
        for pair in (BITE_SITES[:2], BITE_SITES[2:])
    ]
    index = np.argwhere(dense > 0.0)
    places = work.origin + work.spacing * index
    back = 0.5 * float(left[1] + right[1])
    low, high = sorted((float(left[0]), float(right[0])))
    heights = (places - front) @ normal
    taken = (places[:, 0] > low) & (places[:, 0] < high) & (places[:, 1] < back - before_ramus)
    taken &= np.abs(heights) < max(errors) + CROWNS[1]
    along = (places[taken, 1] - front[1]) / (back - front[1])
    soft = max(SOFT, 0.5 * float(work.spacing.max()))
    shifts = bite_shifts(heights[taken], along, dense[tuple(index[taken].T)], errors, soft)
    if shifts is None:
        return sites, False
    moves = np.repeat(shifts, 2)
    return {n: sites[n] + move * normal for n, move in zip(BITE_SITES, moves, strict=True)}, True


def bite_shifts(
    heights: Floats, along: Floats, dense: Floats, reach: Sequence[float], soft: float
) -> tuple[float, float] | None:
    """How far the bite lies above a plane at the incisors and at the ends of the rows, mm.

    Between two rows of crowns is a layer with less bone than in either. None where no layer within
    reach is poorer than its neighbours, as without teeth.

    Parameters
    ----------
    heights : (n,) float64, mm
        Of voxels of the rows over the plane.
    along : (n,) float64
        0 at the incisors, 1 at the ends.
    dense : (n,) float64
        How much bone each holds.
    reach : (2,) float, mm
        At incisors and ends.
    soft : float, mm
        Over which layers are smoothed.
    """
    half = max(reach) + CROWNS[1]
    edges = np.arange(-half, half + LAYER, LAYER)
    middles = 0.5 * (edges[1:] + edges[:-1])
    away = middles - middles[:, None]
    beside = [(sign * away > CROWNS[0]) & (sign * away < CROWNS[1]) for sign in (-1.0, 1.0)]
    planes = []
    for rise in np.arange(-sum(reach), sum(reach) + LAYER, LAYER):
        counts, _ = np.histogram(heights - rise * along, edges, weights=dense)
        profile = ndimage().gaussian_filter1d(counts, soft / LAYER, mode="constant")
        crowns = np.min([np.where(side, profile, 0.0).max(axis=1) for side in beside], axis=0)
        taken = (np.abs(middles) <= reach[0]) & (np.abs(middles + rise) <= reach[1])
        # A layer that is poor because the jaw ends there has no crowns beyond it.
        taken &= crowns > CONTRAST * profile
        planes += [(profile[k], middles[k], middles[k] + rise) for k in np.flatnonzero(taken)]
    if not planes:
        return None
    costs, fronts, ends = np.array(planes).T
    ties = costs <= 1.02 * costs.min() + 1e-9
    return float(fronts[ties].mean()), float(ends[ties].mean())
