"""Scans that nobody here has, composed of what is here: two heads of other shapes, scanned badly.

Each has the anatomy as it is and the scan of it, with landmarks that go along: what a person would
place, and what a perfect scan would show.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage
from skimage.measure import marching_cubes

from benches.scenes import ct_variants as variants
from benches.scenes import scanner_effects as effects
from benches.scenes import warped_heads
from benches.scenes.warped_heads import KnownHead, Move, Points
from cmfsim import ImageData, SurfaceData
from cmfsim.io.images.image_files import read_image_file
from cmfsim.meshing.levels import anatomy_from_surfaces
from cmfsim.pipeline.proposing import read_template_head
from cmfsim.values.landmark_sites import JAW_SITES

Truth = tuple[Points, Points]
# HU of soft tissue, bone and teeth where a head has surfaces alone, and their noise.
TISSUE, BONE, TEETH, NOISE = 40.0, 900.0, 1900.0, 15.0
# Crowns reach so far above and below the occlusal plane, mm.
CROWNS = 10.0


@dataclass(frozen=True, eq=False)
class Scanned:
    """A scan of a head and its landmarks."""

    image: ImageData
    truth: Truth

    def moved(self, move: Move) -> "Scanned":
        """The head warped by a motion of points, found backwards on every fourth voxel."""
        step, low = np.asarray(self.image.spacing), np.asarray(self.image.lowest)
        shape = np.array(self.image.values.shape)
        few = [np.linspace(0, n - 1, n // 4) for n in shape]
        places = low + step * np.stack(np.meshgrid(*few, indexing="ij"), axis=-1).reshape(-1, 3)
        source = places.copy()
        for _ in range(12):
            source += places - move(source)
        away = ((source - places) / step).reshape(*map(len, few), 3)
        index = np.indices(self.image.values.shape, dtype=np.float32)
        coarse = [i * (len(f) - 1) / (n - 1) for i, f, n in zip(index, few, shape, strict=True)]
        for axis in range(3):
            index[axis] += ndimage.map_coordinates(away[..., axis], coarse, order=1)
        values = ndimage.map_coordinates(
            np.asarray(self.image.values, np.float32), index, order=1, cval=-1000.0
        )
        return Scanned(_rounded(self.image, values), _moved(self.truth, move))

    def changed(self, image: ImageData) -> "Scanned":
        """The same head in another image."""
        return Scanned(image, self.truth)


def _rounded(image: ImageData, values: np.ndarray) -> ImageData:
    return image.with_values(np.round(values).clip(-1024, 3071).astype(np.int16))


def _moved(truth: Truth, move: Move) -> Truth:
    skull, skin = ({n: move(p[None])[0] for n, p in sites.items()} for sites in truth)
    return skull, skin


def known_head(data: Path, name: str) -> KnownHead:
    """A real head's surfaces and landmarks."""
    head = read_template_head(data / name)
    if head.skin is None:
        raise FileNotFoundError(f"{data / name}: no skin")
    return KnownHead(head.bones, head.skin, (head.skull, head.skin_landmarks))


def scanned_head(data: Path, name: str) -> Scanned:
    """A CT of a real head: its own, or one made of its surfaces in voxels of 1 mm."""
    head = known_head(data, name)
    own = data / name / "ct.nii.gz"
    if own.is_file():
        return Scanned(read_image_file(own).image, head.truth)
    anatomy = anatomy_from_surfaces(head.skin, dict(head.bones), spacing=1.0)
    skin = anatomy.skin
    bone = np.maximum.reduce([level.values for level in anatomy.bones.values()])
    bite, up = variants.occlusal_plane(head.truth[0])
    height = sum((a - b) * u for a, b, u in zip(skin.axes(), bite, up, strict=True))
    front = skin.axes()[1] < float(head.truth[0]["occlusal_line_L"][1])
    dense = np.where((np.abs(height) < CROWNS) & front, TEETH, BONE)
    # A voxel that a surface crosses has a part of both.
    part = np.clip(0.5 + skin.values, 0.0, 1.0), np.clip(0.5 + bone, 0.0, 1.0)
    values = -1000.0 + (TISSUE + 1000.0) * part[0]
    values += part[1] * (dense - values)
    values += np.random.default_rng(0).normal(0.0, NOISE, values.shape)
    shape = np.pad(values, 12, constant_values=-1000.0)
    image = ImageData(shape, skin.spacing, np.asarray(skin.lowest) - 12.0 * skin.spacing)
    return Scanned(_rounded(image, shape), head.truth)


def _low(head: Points) -> Move:
    """How much of a motion of the lower jaw each point makes, as in `warped_heads`."""
    bite = 0.5 * (head["supradentale"] + head["infradentale"])
    band = warped_heads.BAND
    return lambda p: np.asarray(1.0 / (1.0 + np.exp((p[:, 2:] - bite[2]) / band)))


def _opened(head: Scanned, degrees: float) -> Scanned:
    skull = head.truth[0]
    image = variants.with_mouth_open(head.image, skull, degrees)

    def lower(points: Points, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        by = variants.opening(skull, degrees)
        moved = {n: by.turn @ (p - by.joint) + by.joint for n, p in points.items()}
        # As the image: what comes to lie behind the joints moves less.
        return {
            n: p + by.front(moved[n])[0] * (moved[n] - p) if n.startswith(names) else p
            for n, p in points.items()
        }

    skin = {n: variants.opened(p[None], skull, degrees)[0] for n, p in head.truth[1].items()}
    # Its corners are half-way between the lips, wherever the closed mouth had them.
    for name in ("cheilion_L", "cheilion_R"):
        below = lower(head.truth[1], (name,))[name]
        skin[name] = 0.5 * (head.truth[1][name] + below)
    return Scanned(image, (lower(skull, JAW_SITES), skin))


def _without_upper_teeth(head: Scanned, seed: int) -> Scanned:
    bite, up = variants.occlusal_plane(head.truth[0])
    left = head.truth[0]["occlusal_line_L"]
    x, y, z = (a - b for a, b in zip(head.image.axes(), bite, strict=True))
    height = x * up[0] + y * up[1] + z * up[2]
    row = (height > -1.5) & (height < CROWNS + 1.0) & (np.abs(x) < 34.0)
    row = row & (y + bite[1] < left[1] - 2.0) & (head.image.values > 200)
    noise = np.random.default_rng(seed).normal(40.0, 20.0, row.shape)
    return head.changed(_rounded(head.image, np.where(row, noise, head.image.values)))


def _bone_places(head: Scanned, heights: tuple[float, float]) -> list[tuple[float, float]]:
    """Places (x, z) in front of both rows of teeth, a premolar's width apart."""
    skull = head.truth[0]
    bite = 0.5 * (skull["supradentale"] + skull["infradentale"])
    return [(bite[0] + x, bite[2] + z) for x in np.arange(-21.0, 22.0, 7.0) for z in heights]


def _crowns(skull: Points, per_side: int) -> list[tuple[float, float, float]]:
    """Middles of molar crowns."""
    found = []
    for letter, side in (("L", 1.0), ("R", -1.0)):
        upper, lower = skull[f"supra_m2_{letter}"], skull[f"sub_m2_{letter}"]
        middle = 0.5 * (upper + lower) - [4.0 * side, 0.0, 0.0]
        for k in range(per_side):
            place = middle + [0.0, -11.0 * (k // 2), 5.0 - 10.0 * (k % 2)]
            found.append((float(place[0]), float(place[1]), float(place[2])))
    return found


def chin_cut_and_metal(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """The image ends above the chin, and fillings of molars throw streaks."""
    pieces = effects.fillings(head.image, _crowns(head.truth[0], 1 + seed))
    image = effects.with_metal_scanned(head.image, [pieces], seed=seed)
    image = variants.with_noise(image, 25.0, seed)
    low = float(head.truth[0]["menton"][2]) + 12.0 + 6.0 * seed
    return head, head.changed(variants.cropped(image, 2, low=low))


def child(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """0.75 the size, a short lower jaw, the mouth open by 10°, voxels of 3 mm."""
    low = _low(head.truth[0])
    whole = _opened(head.moved(lambda p: p + low(p) * [0.0, 4.0 + 2.0 * seed, 0.0]), 10.0)
    truth = _moved(whole.truth, lambda p: 0.75 * p)
    anatomy = Scanned(variants.scaled(whole.image, 0.75), truth)
    blur = 0.4 * 3.0 / np.asarray(anatomy.image.spacing)
    values = ndimage.gaussian_filter(np.asarray(anatomy.image.values, np.float32), blur)
    image = variants.resampled(_rounded(anatomy.image, values), (3.0, 3.0, 3.0))
    return anatomy, anatomy.changed(variants.with_noise(image, 20.0, seed))


def orthodontic_cone_beam(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """Brackets on both rows, a round field of 16 cm, values off HU, cupping, voxels of 0.5 mm."""
    skull, skin = head.truth
    middle = (float(skull["nasion"][0]), float(skin["pronasale"][1]) + 78.0)
    image = head.image
    for axis in (0, 1):
        image = variants.cropped(image, axis, low=middle[axis] - 81.0, high=middle[axis] + 81.0)
    low, high = float(skull["menton"][2]) - 10.0, float(skull["nasion"][2]) + 8.0 + 8.0 * seed
    image = variants.cropped(image, 2, low=low, high=high)
    places = _bone_places(head, (6.0, -6.0))
    pieces = [effects.on_bone(image, "steel", places, (3.5, 2.5, 3.0))]
    upper = [place for place in places if place[1] > np.mean([z for _, z in places])]
    pieces.append(effects.on_bone(image, "steel", upper, (7.0, 0.8, 0.8)))
    image = effects.with_metal_scanned(image, pieces, seed=seed)
    scanner = effects.ConeBeam(
        slope=0.55 + 0.2 * seed, offset=780.0 - 300.0 * seed, cupping=100.0 + 50.0 * seed,
        noise=70.0, radius=80.0, middle=middle, seed=seed,
    )  # fmt: skip
    image = variants.resampled(image, (0.5, 0.5, 0.5))
    return head, head.changed(effects.cone_beam(image, scanner))


def cadaver(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """No upper teeth, the mouth open by 15° and 20°, blurred noise of soft tissue."""
    anatomy = _opened(_without_upper_teeth(head, seed), 10.0 + 5.0 * seed)
    noise = np.random.default_rng(seed).standard_normal(anatomy.image.values.shape)
    noise = ndimage.gaussian_filter(noise, 1.0)
    values = anatomy.image.values + 40.0 * noise / noise.std()
    return anatomy, anatomy.changed(_rounded(anatomy.image, values))


def _filled(head: Scanned, inside: np.ndarray, hu: float) -> Scanned:
    """Something of a density where there is air outside the head, and in it where it is denser."""
    values = np.asarray(head.image.values)
    return head.changed(head.image.with_values(np.where(inside & (values < hu), hu, values)
                                               .astype(np.int16)))  # fmt: skip


def arms_beside(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """Both forearms beside the head, against its sides: tissue, and two bones in each."""
    x, y, z = head.image.axes()
    skull = head.truth[0]
    found = head
    for letter, side in (("L", 1.0), ("R", -1.0)):
        joint = skull[f"supraglenoid_{letter}"]
        a, b = joint[0] + side * 50.0, joint[1] + 30.0 + 5.0 * seed
        arm = np.hypot(x - a, y - b) < 32.0 + 0.0 * z
        found = _filled(found, arm, TISSUE)
        for at in (-12.0, 12.0):
            found = _filled(found, np.hypot(x - a, y - b - at) < 6.0 + 0.0 * z, BONE)
    return head, found


def half_head(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """The left half, with 2 cm and more of the right one."""
    middle = float(head.truth[0]["nasion"][0])
    return head, head.changed(variants.one_side(head.image, middle, 15.0 + 5.0 * seed))


def teeth_in_contact(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """The lower teeth pressed onto the upper ones, and fillings across both rows."""
    low = _low(head.truth[0])
    anatomy = head.moved(lambda p: p + low(p) * [0.0, 0.0, 1.5 + 0.5 * seed])
    pieces = effects.fillings(anatomy.image, _crowns(anatomy.truth[0], 4), 5.0)
    return anatomy, anatomy.changed(effects.with_metal_scanned(anatomy.image, [pieces], seed=seed))


def hearing_aid(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """Plastic and a battery of steel behind and in one ear."""
    joint = head.truth[0]["supraglenoid_R"]
    x, y, z = (a - b for a, b in zip(head.image.axes(), joint, strict=True))
    _, j, k = _index(head, joint + [0.0, 14.0, 0.0])
    skin = np.flatnonzero(head.image.values[:, j, k] > -300)
    out = float(head.image.axes()[0].ravel()[skin[0]] - joint[0])
    case = (np.abs(x - out) < 5.0) & (np.abs(y - 18.0) < 5.0) & (np.abs(z - 2.0) < 14.0)
    shown = _filled(head, case, 150.0)
    a, b, c = (float(v) for v in joint + [out, 18.0, -6.0])
    piece = effects.Pieces("steel", effects.fillings(head.image, [(a, b, c)], 3.0).filled)
    return head, shown.changed(effects.with_metal_scanned(shown.image, [piece], seed=seed))


def _index(head: Scanned, place: np.ndarray) -> tuple[int, ...]:
    step, low = np.asarray(head.image.spacing), np.asarray(head.image.lowest)
    return tuple(int(i) for i in np.round((place - low) / step))


def tubes(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """A tube from the floor of the nose out of a nostril, and past the corner of the mouth."""
    nose, lip = head.truth[1]["subnasale"], head.truth[1]["cheilion_L"]
    x, y, z = head.image.axes()
    away = np.full(head.image.values.shape, np.inf)
    inner = nose + [6.0, 60.0, 4.0]
    for a, b in ((inner, nose + [6.0, 4.0, 0.0]), (nose + [6.0, -4.0, -3.0], lip + [6.0, -5, -8.0]),
                 (lip + [6.0, -5.0, -8.0], lip + [40.0, 10.0, -25.0])):  # fmt: skip
        for share in np.linspace(0.0, 1.0, 40):
            p = a + share * (b - a)
            away = np.minimum(away, np.sqrt((x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2))
    values = np.where(away < 4.5, np.maximum(head.image.values, 200.0), head.image.values)
    values = np.where(away < 2.5 + 0.25 * seed, -1000.0, values)
    return head, head.changed(_rounded(head.image, values))


def neck_collar(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """A rigid collar: foam round the neck up to the chin and the angles of the jaw, and a shell."""
    skull = head.truth[0]
    body = ndimage.binary_fill_holes(head.image.values > -300)
    away = ndimage.distance_transform_edt(~body, sampling=np.asarray(head.image.spacing))
    y, z = head.image.axes()[1:]
    top = float(skull["menton"][2]) + 4.0 + (y - skull["menton"][1]) * 0.35
    below = z < np.minimum(top, float(skull["gonion_L"][2]) + 8.0 * seed)
    foam = _filled(head, below & (away > 0.0) & (away < 9.0), -850.0)
    return head, _filled(foam, below & (away >= 9.0) & (away < 12.0), 60.0)


def turned_and_tilted(head: Scanned, seed: int) -> tuple[Scanned, Scanned]:
    """The head turned by 20° about the vertical; the slices are tilted when it is written."""
    image, motion = variants.turned(head.image, (0.0, 0.0, 20.0 if seed % 2 else -20.0))
    turned = Scanned(image, _moved(head.truth, lambda p: p @ motion[:3, :3].T + motion[:3, 3]))
    return turned, turned


SCANS: Mapping[str, Callable[[Scanned, int], tuple[Scanned, Scanned]]] = {
    "chin cut off, metal": chin_cut_and_metal,
    "child, mouth open, voxels of 3 mm": child,
    "orthodontic cone beam": orthodontic_cone_beam,
    "cadaver, mouth open, no upper teeth": cadaver,
    "forearms beside the head": arms_beside,
    "half a head and 2 cm": half_head,
    "teeth in contact, metal across both rows": teeth_in_contact,
    "hearing aid": hearing_aid,
    "tubes in the nose": tubes,
    "neck collar": neck_collar,
    "head turned by 20°, tilted gantry": turned_and_tilted,
}
RARE = [*SCANS][4:]
# Slices of these are written as DICOM, tilted by so many degrees.
TILTS = {"head turned by 20°, tilted gantry": 18.0}


def as_surfaces(head: KnownHead) -> KnownHead:
    """What a program exports: steps of voxels, 10 000 triangles, holes, no spine."""
    skull = head.truth[0]
    bite = 0.5 * (skull["supradentale"] + skull["infradentale"])
    spine = float(skull["gonion_L"][1]) + 12.0

    def shown(points: np.ndarray) -> np.ndarray:
        return np.asarray((points[:, 2] > bite[2] + 15.0) | (points[:, 1] < spine))

    bones = {name: warped_heads.where(bone, shown) for name, bone in _stepped(head).items()}
    skin = bones.pop("skin")
    found = KnownHead(bones, skin, head.truth)
    found = found.mapped(lambda s: warped_heads.fewer(s, 10_000))
    holed = {n: warped_heads.holed(b) for n, b in found.bones.items()}
    return KnownHead(holed, found.skin, head.truth)


def _stepped(head: KnownHead) -> dict[str, SurfaceData]:
    """The surfaces between voxels of 1 mm that are in or out, as marching cubes give them."""
    anatomy = anatomy_from_surfaces(head.skin, dict(head.bones), spacing=1.0)
    found = {}
    for name, level in {**anatomy.bones, "skin": anatomy.skin}.items():
        inside = np.pad(level.values > 0.0, 1)
        points, triangles, *_ = marching_cubes(
            inside.astype(np.float32), 0.5, gradient_direction="ascent"
        )
        places = np.asarray(level.lowest) + (points - 1.0) * np.asarray(level.spacing)
        found[name] = SurfaceData(places, triangles.astype(np.uint32))
    return found


def unseen(data: Path, seeds: tuple[int, ...] = (1, 2)) -> Iterator[tuple[str, str, int]]:
    """The kinds of scan, with the head and seed of each; of the rarer ones the first seed alone."""
    heads = ("ct_phantom", "atlas_head")
    for kind in (*SCANS, "surfaces of a skull with skin"):
        for seed in seeds[:1] if kind in RARE else seeds:
            if (data / heads[(seed + 1) % 2]).is_dir():
                yield kind, heads[(seed + 1) % 2], seed


def made(data: Path, kind: str, head: str, seed: int) -> tuple[Scanned | KnownHead, ...]:
    """The anatomy and the scan of it."""
    known = known_head(data, head)
    bumps = warped_heads.bumps(known, 10 + seed)
    if kind in SCANS:
        return SCANS[kind](scanned_head(data, head).moved(bumps), seed)
    clean = known.moved(bumps)
    return clean, as_surfaces(clean)
