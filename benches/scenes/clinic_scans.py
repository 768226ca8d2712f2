"""What clinics add to a CT: a soft rest, an oxygen mask, plates, contrast agent, a bandage."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy import ndimage

from benches.scenes import ct_variants as variants
from benches.scenes import scanner_effects as effects
from cmfsim import ImageData

Points = Mapping[str, np.ndarray]
# The skin's threshold, HU.
SKIN = -300.0
SIDES = (("L", 1.0), ("R", -1.0))


def _rounded(image: ImageData, values: np.ndarray) -> ImageData:
    return image.with_values(np.round(values).astype(np.int16))


def _outside(image: ImageData) -> np.ndarray:
    """How far voxels lie from the head, mm; 0 in it."""
    body = ndimage.binary_fill_holes(image.values > SKIN)
    found: np.ndarray = ndimage.distance_transform_edt(~body, sampling=np.asarray(image.spacing))
    return found


def with_soft_rest(
    image: ImageData, skull: Points, skin: Points, thickness: float = 9.0
) -> ImageData:
    """A rest of 110 HU, 60 mm wide, before and under the chin, without a gap."""
    chin, low = skin["pogonion"], skull["menton"][2] - 14.0
    x, y, z = image.axes()
    values = np.asarray(image.values, np.float32).copy()
    near = (np.abs(x - chin[0]) < 30.0) & (y > chin[1] - thickness) & (y < chin[1] + 40.0)
    near = near & (z < chin[2] + 4.0) & (z > low)
    noise = np.random.default_rng(0).normal(0.0, 8.0, values.shape)
    outside = _outside(image) > 0.0
    rest = near & outside & (values < 110.0)
    values[rest] = (110.0 + noise)[rest]
    values[near & ~outside & (values < 0.0)] = 60.0
    return _rounded(image, values)


def with_mask(image: ImageData, skin: Points) -> ImageData:
    """An oxygen mask over nose and mouth: a shell of 2 mm with a soft rim on the skin."""
    nose, top = skin["pronasale"], skin["nasion"][2] - 8.0
    middle = 0.5 * (top + skin["pogonion"][2])
    x, y, z = image.axes()
    values = np.asarray(image.values, np.float32).copy()
    away = ((x - skin["subnasale"][0]) / 40.0) ** 2 + ((z - middle) / (top - middle)) ** 2
    dome = np.abs(y - (nose[1] - 14.0 + 38.0 * away))
    out = _outside(image)
    rim = (dome < 5.0) & (out < 3.5)
    values[((dome < 1.1) | rim) & (out > 0.0) & (away < 1.35)] = 60.0
    return _rounded(image, values)


def with_plates(image: ImageData, skull: Points) -> ImageData:
    """Four plates of titanium on the maxilla and two on the chin, with screws of 6.5 mm."""
    lip, low = skull["mid_philtrum"], skull["menton"][2] + 10.0
    plates = [(lip[0] + s * a, lip[2] + b) for s in (1, -1) for a, b in ((14, 4), (26, 0))]
    plates += [(skull["pogonion"][0] + a, low) for a in (-9, 9)]
    pieces = [
        effects.on_bone(image, "titanium", plates, size)
        for size in ((12.0, 1.2, 3.0), (3.0, 1.2, 14.0))
    ]
    x, y, z = (a.ravel() for a in image.axes())
    filled = np.zeros(image.values.shape)
    for a, c in ((a + p, c + q) for a, c in plates for p in (-4, 4) for q in (4, -5)):
        column = image.values[np.argmin(np.abs(x - a)), :, np.argmin(np.abs(z - c))]
        bone = np.flatnonzero(column > 300)
        if not len(bone):
            continue
        part = 1.0
        places = (a, y[bone[0]] + 2.5, c)
        for axis, size, place, step in zip(
            image.axes(), (2.0, 6.5, 2.0), places, image.spacing, strict=True
        ):
            part = part * np.clip((0.5 * size - np.abs(axis - place)) / step + 0.5, 0.0, 1.0)
        filled = np.maximum(filled, part)
    pieces.append(effects.Pieces("titanium", filled))
    return effects.with_metal_scanned(image, pieces, top=effects.EXTENDED)


def _filled(
    image: ImageData, values: np.ndarray, way: Sequence[np.ndarray], radius: float, hu: float
) -> np.ndarray:
    """The values with a vessel along a way, in soft tissue alone."""
    for start, end in pairwise(way):
        along = end - start
        away = [a - b for a, b in zip(image.axes(), start, strict=True)]
        share = sum(a * n for a, n in zip(away, along, strict=True)) / (along @ along)
        share = np.clip(share, 0.0, 1.0)
        gaps = [a - share * n for a, n in zip(away, along, strict=True)]
        weight = np.clip(radius + 0.5 - np.sqrt(sum(g * g for g in gaps)), 0.0, 1.0)
        soft = (values > -150.0) & (values < 250.0)
        values = np.where(soft, np.maximum(values, values + weight * (hu - values)), values)
    return values


def with_contrast(image: ImageData, skull: Points, skin: Points) -> ImageData:
    """Contrast agent in carotids, jugulars, facial, temporal and maxillary vessels."""
    values = np.asarray(image.values, np.float32)
    for side, s in SIDES:
        angle, joint = skull[f"gonion_{side}"], skull[f"supraglenoid_{side}"]
        low, high = skull[f"sub_m2_{side}"], skull[f"supra_m2_{side}"]
        wing, lip = skin[f"alare_{side}"], skin[f"cheilion_{side}"]
        for radius, hu, way in (
            (3.5, 350.0, [angle + [-12 * s, 12, -60], angle + [-10 * s, 12, 0],
                          joint + [-12 * s, 10, -15], joint + [-25 * s, 12, 5]]),
            (6.0, 280.0, [angle + [-4 * s, 18, -60], angle + [-4 * s, 18, 0],
                          joint + [-10 * s, 16, -10]]),
            (4.0, 280.0, [angle + [-3 * s, 2, -50], angle + [3 * s, 6, 0],
                          joint + [3 * s, 6, -10]]),
            (1.5, 400.0, [angle + [-10 * s, 8, -5], low + [2 * s, 8, -24], lip + [6 * s, 14, 0],
                          wing + [3 * s, 10, 0], skull["nasion"] + [8 * s, 4, 0]]),
            (2.0, 250.0, [low + [3 * s, 16, -24], lip + [14 * s, 20, 4], wing + [12 * s, 16, 4]]),
            (1.5, 400.0, [joint + [3 * s, 4, -15], joint + [4 * s, 2, 20],
                          joint + [-4 * s, -15, 60]]),
            (2.0, 400.0, [angle + [-8 * s, 0, 40], high + [-2 * s, 25, 18]]),
        ):  # fmt: skip
            values = _filled(image, values, way, radius, hu)
    return _rounded(image, values)


def with_bandage(image: ImageData, skull: Points) -> ImageData:
    """Cloth of 5 mm and −250 HU round the forehead, and from the chin to the vertex."""
    _, y, z = image.axes()
    out = _outside(image)
    brow, chin = skull["supraglabella"][2], skull["menton"]
    wound = ((z > brow - 5.0) & (z < brow + 45.0)) | (
        (np.abs(y - chin[1] - 22.0) < 25.0) & (z > chin[2] - 40.0)
    )
    cloth = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal(out.shape), 1.0)
    values = np.asarray(image.values, np.float32).copy()
    layer = wound & (out > 0.0) & (out < 5.0)
    values[layer] = np.maximum(values, -250.0 + 120.0 * cloth / cloth.std())[layer]
    return _rounded(image, values)


def in_thick_slices(image: ImageData, thickness: float = 5.0) -> ImageData:
    """Slices so thick, mm, each a mean over what it covers."""
    x, y, z = (float(s) for s in image.spacing)
    blurred = ndimage.gaussian_filter(
        np.asarray(image.values, np.float32), (0.0, 0.0, 0.4 * thickness / z)
    )
    return variants.resampled(_rounded(image, blurred), (x, y, thickness))
