"""Real heads as anatomies: closed surfaces turned into levels, and their landmarks."""

import functools
import itertools
import json
import os
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

import cmfsim
from benches.scenes import meshes

HEADS = ("atlas_head", "ct_phantom")
# Levels are right to this many voxels from the surface, and clipped beyond.
BAND = 2


def data_folder():
    """The folder of real data; skips the test where there is none."""
    beside = Path(__file__).parents[2].parent / "shared" / "data"
    folder = Path(os.environ.get("CMFSIM_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"needs the real data: {folder} is absent (set CMFSIM_DATA)")
    return folder


@functools.cache
def landmarks(head, kind="skull"):
    """Landmarks of a head: label to (3,) LPS mm."""
    path = data_folder() / head / f"{kind}_landmarks.mrk.json"
    markup = json.loads(path.read_text(encoding="utf-8"))["markups"][0]
    assert markup["coordinateSystem"] == "LPS"
    return MappingProxyType(
        {p["label"]: np.array(p["position"], dtype=float) for p in markup["controlPoints"]}
    )


@functools.cache
def read_ply(head, name):
    """A surface of a head as SurfaceData."""
    pv = pytest.importorskip("pyvista")
    mesh = pv.read(data_folder() / head / f"{name}.ply")
    triangles = mesh.regular_faces
    return cmfsim.SurfaceData(np.asarray(mesh.points, dtype=float), triangles)


@functools.cache
def core_surface(head, name):
    """The same, ready to be searched."""
    surface = read_ply(head, name)
    return cmfsim.Surface(surface.vertices, surface.triangles)


def level_of(surface, spacing, origin, shape):
    """Signed distance of a closed surface on a grid, positive inside, clipped to a narrow band."""
    pv = pytest.importorskip("pyvista")
    ndimage = pytest.importorskip("scipy.ndimage")
    stencil = pytest.importorskip("vtkmodules.vtkImagingStencil")
    faces = np.column_stack([np.full(len(surface.triangles), 3), surface.triangles]).ravel()
    to_stencil = stencil.vtkPolyDataToImageStencil()
    to_stencil.SetInputData(pv.PolyData(np.asarray(surface.vertices), faces.astype(np.int64)))
    to_stencil.SetOutputSpacing([spacing] * 3)
    to_stencil.SetOutputOrigin(list(origin))
    to_stencil.SetOutputWholeExtent([v for n in shape for v in (0, n - 1)])
    paint = stencil.vtkImageStencilToImage()
    paint.SetInputConnection(to_stencil.GetOutputPort())
    paint.SetInsideValue(1)
    paint.SetOutsideValue(0)
    paint.SetOutputScalarTypeToUnsignedChar()
    paint.Update()
    inside = np.asarray(pv.wrap(paint.GetOutput()).active_scalars).reshape(shape, order="F") > 0
    block = np.ones((3, 3, 3), dtype=bool)
    band = ndimage.binary_dilation(inside, block, BAND) & ~ndimage.binary_erosion(
        inside, block, BAND, border_value=0
    )
    limit = BAND * spacing
    level = np.where(inside, limit, -limit).astype(np.float32)
    index = np.argwhere(band)
    points = np.asarray(origin) + index * spacing
    closest, normals, _ = surface.closest(points)
    distance = np.einsum("na,na->n", closest - points, normals)
    size = np.linalg.norm(closest - points, axis=1)
    # The stencil decides the side but in the layer where rounding might: there the normal does.
    side = np.where(size < 0.5 * spacing, np.sign(distance), np.where(inside[band], 1.0, -1.0))
    level[band] = np.clip(side * size, -limit, limit)
    return level


@functools.cache
def anatomy(head, spacing=2.0):
    """A head as levels of its closed skin, cranium and mandible."""
    surfaces = {name: core_surface(head, name) for name in ("skin", "cranium", "mandible")}
    vertices = surfaces["skin"].vertices
    origin = np.floor(vertices.min(0)) - 3 * spacing
    shape = tuple(np.ceil((vertices.max(0) - origin) / spacing + 4).astype(int).tolist())
    levels = {
        name: cmfsim.ImageData(level_of(s, spacing, origin, shape), [spacing] * 3, origin)
        for name, s in surfaces.items()
    }
    return cmfsim.Anatomy(
        levels["skin"], {"cranium": levels["cranium"], "mandible": levels["mandible"]}
    )


@functools.cache
def cut(head):
    """Le Fort I, BSSO and genioplasty with their default options."""
    plan = {"genioplasty": {}, "bsso": {}, "le_fort_1": {}}
    return cmfsim.cut_bones(anatomy(head).bones, plan, landmarks=landmarks(head))


def tissue_mesh(head, edge=6.0, *, posterior, spacing=2.0):
    """Soft tissue of a head as voxels cut into Kuhn's six tets: nodes and tets.

    What lies behind the coronal plane y = posterior is left out. Boundary nodes are drawn onto
    bones as far as the tets stay whole.
    """
    whole = anatomy(head, spacing)
    low, high = whole.skin.lowest, whole.skin.highest
    counts = np.floor((high - low) / edge).astype(int)
    centres = low + edge * (0.5 + np.stack(np.indices(counts), axis=-1).reshape(-1, 3))
    level = np.minimum(whole.skin.sample(centres), posterior - centres[:, 1])
    for bone in whole.bones.values():
        level = np.minimum(level, -bone.sample(centres))
    nodes, tets = voxel_tets((level > 0.0).reshape(counts), low, edge)
    outer = meshes.outer_nodes(tets)
    outer = outer[nodes[outer, 1] < nodes[:, 1].max()]
    target, nearest = nodes.copy(), np.full(len(nodes), 0.9 * edge)
    for name in whole.bones:
        found, _, _ = core_surface(head, name).closest(nodes[outer])
        distance = np.linalg.norm(found - nodes[outer], axis=1)
        nearer = distance < nearest[outer]
        target[outer[nearer]] = found[nearer]
        nearest[outer[nearer]] = distance[nearer]
    whole_volume, part = meshes.volumes(nodes, tets), np.ones((len(nodes), 1))
    for _ in range(50):
        moved = nodes + part * (target - nodes)
        squeezed = meshes.volumes(moved, tets) < 0.15 * whole_volume
        if not squeezed.any():
            break
        part[np.unique(tets[squeezed])] *= 0.7
    return moved, tets


def voxel_tets(cells, origin, edge):
    """The largest face-connected part of the cells that hold, each cut into Kuhn's six tets."""
    ndimage = pytest.importorskip("scipy.ndimage")
    labels, _ = ndimage.label(cells)
    cells = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    corner = np.argwhere(cells)
    shape = np.array(cells.shape) + 1
    tets = []
    for order in itertools.permutations(range(3)):
        path = [corner]
        for axis in order:
            path.append(path[-1] + np.eye(3, dtype=int)[axis])
        tets.append(np.stack([np.ravel_multi_index(tuple(p.T), shape) for p in path], axis=1))
    used, tets = np.unique(np.concatenate(tets), return_inverse=True)
    nodes = np.stack(np.unravel_index(used, shape), axis=1) * edge + np.asarray(origin)
    return nodes, meshes.oriented(nodes, tets.reshape(-1, 4))
