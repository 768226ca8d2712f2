"""Bumpy balls for bones: at any fineness, moved, cut, and with vertices that slid along them."""

import numpy as np

import cmfsim
from benches.scenes import meshes


def pebble(level=4, seed=0, centre=(0.0, 0.0, 0.0)):
    """A bumpy ball without any symmetry, by a formula, at any fineness."""
    vertices, triangles = meshes.icosphere(level, 1.0)
    # Vertices of one fineness that are vertices of the next would sit in the noise of the latter.
    vertices = vertices @ meshes.rotation((1, 2, 3), 10.0 * level).T
    rng = np.random.default_rng(seed)
    radius = np.full(len(vertices), 20.0)
    axes = rng.normal(size=(7, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    for axis, sharp in zip(axes, rng.uniform(2, 6, 7), strict=True):
        radius += 4.0 * np.exp(sharp * (vertices @ axis - 1.0))
    return cmfsim.SurfaceData(
        vertices * radius[:, None] * [1.3, 1.0, 0.7] + np.asarray(centre), triangles
    )


def moved(surface, matrix):
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return cmfsim.SurfaceData(vertices, surface.triangles)


def joined(*surfaces):
    """One surface of several."""
    starts = np.cumsum([0] + [len(s.vertices) for s in surfaces])
    return cmfsim.SurfaceData(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate(
            [np.asarray(s.triangles) + n for s, n in zip(surfaces, starts[:-1], strict=True)]
        ),
    )


def without(surface, keep):
    """The triangles whose corners are all kept."""
    kept = np.asarray(surface.triangles)[keep[np.asarray(surface.triangles)].all(axis=1)]
    used, triangles = np.unique(kept, return_inverse=True)
    return cmfsim.SurfaceData(np.asarray(surface.vertices)[used], triangles.reshape(-1, 3))


def apart(found, true, centre):
    rest = cmfsim.decompose_motion(found @ np.linalg.inv(true), centre)
    return float(np.linalg.norm(rest.translation)), rest.angle


def slid(surface, size, seed=0):
    """Vertices of a fitted template: they slid along the surface by `size` mm (median).

    The slip has a part that all share, as a fit that is off has, so that it turns vertices' own
    rigid fit.
    """
    vertices = np.asarray(surface.vertices)
    index = cmfsim.Surface(surface.vertices, surface.triangles)
    normals = np.asarray(index.vertex_normals)
    rng = np.random.default_rng(seed)
    waves = 2.0 * np.pi / np.ptp(vertices, axis=0).max() * rng.normal(size=(3, 3))
    slip = np.cos((vertices - vertices.mean(axis=0)) @ waves.T + rng.uniform(0, 6, 3)) + [0, 0, 1]
    slip -= (slip * normals).sum(axis=1, keepdims=True) * normals
    slip *= size / np.median(np.linalg.norm(slip, axis=1))
    return cmfsim.SurfaceData(index.closest(vertices + slip)[0], surface.triangles)


def operated_bone(before, motion, *, slip=0.0, scale=1.0, cut=None, noise=0.0, seed=0):
    """The bone after: slid, cut flat (axis, share of the vertices), scaled, moved, noisy.

    The size is about the middle of the vertices before, where the motion takes it.
    """
    here = np.asarray(before.vertices)
    middle = here.mean(axis=0)
    vertices = np.array((slid(before, slip, seed) if slip else before).vertices)
    if cut is not None:
        axis, share = cut
        vertices[:, axis] = np.minimum(vertices[:, axis], np.quantile(here[:, axis], 1.0 - share))
    vertices = middle + scale * (vertices - middle)
    vertices = vertices @ motion[:3, :3].T + motion[:3, 3]
    rng = np.random.default_rng(seed + 1)
    vertices += rng.normal(0.0, noise, vertices.shape)
    return cmfsim.SurfaceData(vertices, before.triangles)
