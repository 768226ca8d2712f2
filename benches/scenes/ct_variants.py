"""Variants of a CT: effects of other scanners, patients and exports on an image."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.transform import iradon, radon

from cmfsim import ImageData

# Parts of the phantom's tooth rows, LPS mm: upper and lower, left and right, and one in front.
FILLINGS = (
    (35.0, -265.0, 378.0),
    (-30.0, -268.0, 378.0),
    (20.0, -292.0, 380.0),
    (38.0, -262.0, 362.0),
    (-34.0, -262.0, 362.0),
    (-16.0, -290.0, 366.0),
)


def coarser(image: ImageData, factors: tuple[int, int, int]) -> ImageData:
    """Means over blocks of voxels."""
    f = np.array(factors)
    n = np.array(image.values.shape) // f
    part = image.values[tuple(slice(0, a * b) for a, b in zip(n, f, strict=True))]
    blocks = part.reshape(n[0], f[0], n[1], f[1], n[2], f[2]).mean(axis=(1, 3, 5))
    origin = np.asarray(image.origin) + 0.5 * (f - 1) * np.asarray(image.spacing)
    return ImageData(np.round(blocks).astype(np.int16), image.spacing * f, origin)


def cropped(
    image: ImageData, axis: int, *, low: float = -np.inf, high: float = np.inf
) -> ImageData:
    """The part between two places along an axis, mm."""
    along = image.axes()[axis].ravel()
    kept = np.flatnonzero((along >= low) & (along <= high))
    index = [slice(None)] * 3
    index[axis] = slice(kept[0], kept[-1] + 1)
    origin = np.array(image.origin)
    origin[axis] = along[kept[0]]
    return ImageData(image.values[tuple(index)], image.spacing, origin)


def with_noise(image: ImageData, sigma: float, seed: int = 0) -> ImageData:
    """Independent noise of a standard deviation (HU) in each voxel."""
    noise = np.random.default_rng(seed).normal(0.0, sigma, image.values.shape)
    return image.with_values(np.round(image.values + noise).clip(-1024, 3071).astype(np.int16))


def with_metal(
    image: ImageData,
    places: tuple[tuple[float, float, float], ...] = FILLINGS,
    radius: float = 4.0,
    least_transmission: float = 6.0,
) -> ImageData:
    """Fillings of metal and the streaks that photon starvation makes of them.

    Each slice with metal is projected; line integrals beyond `least_transmission` (so that fewer
    than exp(−6) of the photons arrive) are cut and grow noisy, and the slice is reconstructed.
    """
    x, y, z = image.axes()
    metal = np.zeros(image.values.shape, dtype=bool)
    for a, b, c in places:
        metal |= (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 < radius**2
    values = image.values.astype(np.float64)
    rng = np.random.default_rng(1)
    for k in np.flatnonzero(metal.any(axis=(0, 1))):
        values[:, :, k] += _streaks(values[:, :, k], metal[:, :, k], image, least_transmission, rng)
    values[metal] = 3071.0
    return image.with_values(np.round(values).clip(-1024, 3071).astype(np.int16))


def _streaks(
    slice_hu: np.ndarray,
    metal: np.ndarray,
    image: ImageData,
    least_transmission: float,
    rng: np.random.Generator,
) -> np.ndarray:
    # Water attenuates 0.02 per mm at 70 keV, fillings some 20 times as much.
    size = max(slice_hu.shape)
    wide = np.full((size, size), -1000.0)
    wide[: slice_hu.shape[0], : slice_hu.shape[1]] = slice_hu
    filled = np.zeros((size, size), dtype=bool)
    filled[: metal.shape[0], : metal.shape[1]] = metal
    step = float(np.asarray(image.spacing)[0])
    mu = 0.02 * step * np.clip(1.0 + wide / 1000.0, 0.0, None)
    mu[filled] = 0.4 * step
    angles = np.linspace(0.0, 180.0, 240, endpoint=False)
    lines = radon(mu, angles, circle=False)
    bad = lines > least_transmission
    measured = np.where(bad, least_transmission + rng.normal(0.0, 0.6, lines.shape), lines)
    error = iradon(measured - lines, angles, circle=False, output_size=size)
    error[filled] = 0.0
    streaks: np.ndarray = 1000.0 * error / (0.02 * step)
    return streaks[: slice_hu.shape[0], : slice_hu.shape[1]]


def with_pillow(image: ImageData, hu: float = -200.0) -> ImageData:
    """A dense pillow under the back of the head, touching it over a palm's width."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    middle, back, height = _back_of_head(image)
    block = (
        (np.abs(x - middle) < 70.0)
        & (y > back - 12.0)
        & (y < back + 25.0)
        & (np.abs(z - height) < 45.0)
    )
    values[block & (values < hu)] = hu
    return image.with_values(values)


def with_holder(image: ImageData, hu: float = 120.0, thickness: float = 6.0) -> ImageData:
    """A shell of plastic round the back and the sides of the head, touching it."""
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    middle, back, height = _back_of_head(image)
    radius = 84.0
    centre = back + 3.0 - radius
    distance = np.hypot(x - middle, y - centre)
    shell = (distance > radius - thickness) & (distance < radius) & (y > centre + 5.0)
    shell = shell & (np.abs(z - height) < 50.0)
    values[shell & (values < hu)] = hu
    return image.with_values(values)


def _back_of_head(image: ImageData) -> tuple[float, float, float]:
    """Middle x, hindmost y and its z of the bone, 5 mm of skin added, mm."""
    bone = ndimage.binary_opening(image.values > 400)
    x, y, z = (a.ravel() for a in image.axes())
    last = np.flatnonzero(bone.any(axis=(0, 2)))[-1]
    place = np.argwhere(bone[:, last])
    return float(x[place[:, 0]].mean()), float(y[last]) + 5.0, float(z[place[:, 1]].mean())


def without_couch(image: ImageData, behind: float) -> ImageData:
    """Air behind a place, mm."""
    values = np.asarray(image.values).copy()
    values[:, (image.axes()[1] > behind).ravel()] = -1000
    return image.with_values(values)


def saturated(image: ImageData, at: float) -> ImageData:
    """Values cut off at a number of HU, as scanners and exports do."""
    return image.with_values(np.minimum(image.values, at).astype(np.int16))


def with_tube(
    image: ImageData, skin: np.ndarray, hu: float = 250.0, radius: float = 5.0
) -> ImageData:
    """A tube taped to one cheek: a hollow cylinder of plastic that touches the skin.

    `skin` holds the middle of the tube, (n, 3) mm, along the face.
    """
    values = np.asarray(image.values).copy()
    x, y, z = image.axes()
    nearest = np.full(values.shape, np.inf)
    for a, b, c in skin:
        nearest = np.minimum(nearest, np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2))
    outside = values < -300
    values[outside & (nearest < radius)] = hu
    values[outside & (nearest < radius - 2.5)] = -1000
    return image.with_values(values)


def with_pad(
    image: ImageData,
    place: tuple[float, float, float],
    width: float,
    thickness: float,
    hu: float = 40.0,
) -> ImageData:
    """A round pad that follows the skin nearest to a place (mm), without a gap.

    `width` is its diameter, and `thickness` how far it stands out, mm.
    """
    values = np.asarray(image.values).astype(np.float32)
    step, origin = np.asarray(image.spacing), np.asarray(image.origin)
    reach = width + thickness + 20.0
    low = np.maximum(((np.array(place) - reach - origin) / step).astype(int), 0)
    high = np.minimum(((np.array(place) + reach - origin) / step).astype(int), values.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    part = values[box]
    labels, count = ndimage.label(part > -300.0)
    sizes = ndimage.sum_labels(part > -300.0, labels, range(1, count + 1))
    inside = labels == 1 + np.argmax(sizes)
    out = ndimage.distance_transform_edt(~inside, sampling=step)
    index = np.stack(np.meshgrid(*map(np.arange, part.shape), indexing="ij"), axis=-1)
    points = origin + step * (low + index)
    skin = np.argwhere((out > 0.0) & (out <= step.max()))
    at = skin[np.argmin(np.linalg.norm(points[tuple(skin.T)] - place, axis=1))]
    smooth = ndimage.gaussian_filter(inside.astype(np.float32), 6.0 / step)
    normal = -np.array([d[tuple(at)] for d in np.gradient(smooth, *step)])
    normal /= np.linalg.norm(normal)
    away = points - points[tuple(at)]
    up = away @ normal
    aside = np.sqrt(np.maximum((away**2).sum(axis=-1) - up**2, 0.0))
    # Voxels at its border are filled in part.
    thin = np.clip(0.5 + (thickness + 0.5 * step.mean() - out) / step.mean(), 0.0, 1.0)
    share = thin * np.clip(0.5 + (0.5 * width - aside) / step.mean(), 0.0, 1.0)
    share[inside | (np.abs(up) > width + thickness)] = 0.0
    values[box] += share * np.maximum(hu - part, 0.0)
    return image.with_values(np.round(values).astype(np.int16))


def turned(image: ImageData, angles: tuple[float, float, float]) -> tuple[ImageData, np.ndarray]:
    """The head turned about x, y and z (degrees; x: nodding forwards), in voxels of 1.5 mm.

    With the (4, 4) motion that places of the head make.
    """
    values = np.asarray(image.values, dtype=np.float32)
    own, origin = np.asarray(image.spacing), np.asarray(image.origin)
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    middle = origin + 0.5 * own * (np.array(values.shape) - 1)
    step = np.full(3, 1.5)
    size = (1.05 * np.array(values.shape) * own / step).astype(int)
    low = middle - 0.5 * step * (size - 1)
    axes = [low[a] + step[a] * np.arange(size[a]) for a in range(3)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    back = ((places - middle) @ turn + middle - origin) / own
    seen = ndimage.map_coordinates(values, back.T, order=1, cval=-1000.0).reshape(size)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, middle - turn @ middle
    return ImageData(seen, step, low), matrix


@dataclass(frozen=True, eq=False)
class _Opening:
    """A lower jaw turned about its joints: the axis, the turn, and the occlusal plane."""

    joint: np.ndarray
    turn: np.ndarray
    bite: np.ndarray
    up: np.ndarray

    def front(self, places: np.ndarray) -> np.ndarray:
        """1 in front of the spine, 0 behind, smoothly."""
        behind = (places[..., 1:2] - self.joint[1] - 4.0) / 4.0
        return np.asarray(1.0 / (1.0 + np.exp(behind)))


def opening(place: Mapping[str, np.ndarray], degrees: float) -> _Opening:
    """How the lower jaw turns about the joints of a head with these landmarks."""
    joint = 0.5 * (place["supraglenoid_L"] + place["supraglenoid_R"]) + [0.0, 3.0, -12.0]
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    return _Opening(joint, turn, *occlusal_plane(place))


def occlusal_plane(place: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A point of the occlusal plane at the incisors, and its normal upwards."""
    bite = 0.5 * (place["supradentale"] + place["infradentale"])
    left, right = place["occlusal_line_L"], place["occlusal_line_R"]
    up = np.cross(left - right, bite - 0.5 * (left + right))
    return bite, up * np.sign(up[2]) / np.linalg.norm(up)


def opened(
    points: np.ndarray, landmarks: Mapping[str, np.ndarray], degrees: float = 15.0
) -> np.ndarray:
    """Where `with_mouth_open` moves points of the face, mm."""
    by = opening(landmarks, degrees)
    turned_points = (points - by.joint) @ by.turn.T + by.joint
    low = ((points - by.bite) @ by.up < 0.0)[:, None]
    share = by.front(turned_points) * low
    return np.asarray(points + share * (turned_points - points))


def with_mouth_open(
    image: ImageData, landmarks: Mapping[str, np.ndarray], degrees: float = 15.0
) -> ImageData:
    """The lower jaw turned about its joints, with the skin over it; air between the lips.

    What is below the occlusal plane in front of the spine turns; between it and the rest, tissue is
    stretched over a few millimetres beside the mouth.
    """
    by = opening(landmarks, degrees)
    step, origin = np.asarray(image.spacing), np.asarray(image.lowest)
    middle, back = float(landmarks["nasion"][0]), float(landmarks["occlusal_line_L"][1])
    points = origin + step * np.moveaxis(np.indices(image.values.shape), 0, -1)
    # Where turned tissue comes from.
    source = (points - by.joint) @ by.turn + by.joint
    aside = np.abs(source[..., 0] - middle)
    behind = np.clip((points[..., 1] - back - 2.0) / 8.0, 0.0, 1.0)
    low = (source - by.bite) @ by.up < 0.0
    low |= (behind > 0.5) & (aside > 30.0)
    low &= source[..., 2] < by.joint[2] + 4.0
    front = by.front(points)
    index = ((points + front * low[..., None] * (source - points)) - origin) / step
    values = np.asarray(image.values, dtype=np.float32)
    changed = ndimage.map_coordinates(
        values, np.moveaxis(index, -1, 0), order=1, mode="constant", cval=-1000.0
    )
    gap = ((points - by.bite) @ by.up < 0.0) & ~low & (front[..., 0] > 0.5)
    changed[gap & (changed > 200.0)] = 40.0
    # To the outside: tissue left there would be a skin that closes the mouth.
    mouth = gap & (np.abs(points[..., 0] - middle) < 24.0) & (points[..., 1] < back + 5.0)
    changed[mouth] = -1000.0
    return image.with_values(np.round(changed).clip(-1024, 3071).astype(np.int16))


def without_teeth(image: ImageData, landmarks: Mapping[str, np.ndarray]) -> ImageData:
    """Crowns and necks of both rows replaced by soft tissue."""
    bite, up = occlusal_plane(landmarks)
    left = landmarks["occlusal_line_L"]
    x, y, z = (a - b for a, b in zip(image.axes(), bite, strict=True))
    height = x * up[0] + y * up[1] + z * up[2]
    row = (np.abs(height) < 10.0) & (np.abs(x) < 34.0) & (y + bite[1] < left[1] - 2.0)
    noise = np.random.default_rng(0).normal(40.0, 20.0, image.values.shape)
    values = np.where(row & (image.values > 200), noise, image.values)
    return image.with_values(np.round(values).astype(np.int16))


def scaled(image: ImageData, factor: float) -> ImageData:
    """A head of another size, such as a child's."""
    spacing, lowest = np.asarray(image.spacing), np.asarray(image.lowest)
    return ImageData(image.values, factor * spacing, factor * lowest)


def resampled(image: ImageData, spacing: tuple[float, float, float]) -> ImageData:
    """The same extent in other voxels, linearly."""
    own, step = np.asarray(image.spacing), np.asarray(spacing)
    counts = np.floor((np.array(image.values.shape) - 1) * own / step).astype(int) + 1
    lines = [np.arange(n) * s / o for n, s, o in zip(counts, step, own, strict=True)]
    values = image.values
    for axis, line in enumerate(lines):
        low = np.minimum(line.astype(int), values.shape[axis] - 2)
        part = (line - low).reshape([-1 if a == axis else 1 for a in range(3)]).astype(np.float32)
        values = values.take(low, axis) * (1 - part) + values.take(low + 1, axis) * part
    return ImageData(np.round(values).astype(np.int16), step, image.lowest)


def one_side(image: ImageData, middle: float, past: float = 15.0) -> ImageData:
    """The head's left half, with a little of the right one, mm."""
    return cropped(image, 0, low=middle - past)


def with_beard(image: ImageData, landmarks: Mapping[str, np.ndarray]) -> ImageData:
    """Hair of 10 mm round the chin: tufts of between air and water."""
    values = np.asarray(image.values, dtype=np.float32)
    x, y, z = image.axes()
    body = ndimage.binary_fill_holes(values > -300.0)
    out = ndimage.distance_transform_edt(~body, sampling=np.asarray(image.spacing))
    below = 0.5 * (landmarks["supradentale"] + landmarks["mid_philtrum"])
    low = (z < below[2]) & (z > landmarks["menton"][2] - 25.0) & (y < landmarks["gonion_L"][1])
    bite = 0.5 * (landmarks["supradentale"] + landmarks["infradentale"])
    lips = (np.abs(x - bite[0]) < 27.0) & (np.abs(z - bite[2]) < 8.0)
    hair = np.random.default_rng(0).standard_normal(values.shape)
    hair = ndimage.gaussian_filter(hair, (0.7, 0.7, 1.5))
    hair = np.clip(-650.0 + 220.0 * hair / hair.std(), -1000.0, 0.0)
    grown = low & ~lips & (out > 0.0) & (out < 10.0)
    values = np.where(grown, np.maximum(values, hair), values)
    return image.with_values(np.round(values).astype(np.int16))
