"""The lips of a mesh separated at its seam: where the crack runs, and what each lip is."""

import numpy as np
import pytest

import cmfsim
import lip_head
from cmfsim.errors import CaseError
from cmfsim.meshing.lips.seam import seam_faces
from cmfsim.surfaces.topology import connected_labels, edges_of

pytest.importorskip("scipy", reason="needs scipy (pip install '.[imaging]')")

EDGE, HEIGHT = 4.0, 10.0


@pytest.fixture(scope="module")
def mouth():
    """Anatomy, seam, mesh before and after it is separated, and its boundary."""
    anatomy, whole = lip_head.tissue(EDGE)
    seam = cmfsim.lip_seam(anatomy, lip_head.ARCHES, lip_head.landmarks())
    mesh = cmfsim.part_mesh(whole, seam.surface)
    return anatomy, seam, whole, mesh


@pytest.fixture(scope="module")
def kinds(mouth):
    """Kinds of the separated mesh: what lies on a jaw slides on it, but for its far ends."""
    _, _, _, mesh = mouth
    nodes = np.asarray(mesh.nodes)
    border = np.unique(mesh.boundary_triangles())
    names = ("cranium", "mandible")
    kind = np.zeros(len(nodes), dtype=np.uint8)
    segment = np.full(len(nodes), -1, dtype=np.int16)
    surfaces = [mouth[0].bones[name] for name in names]
    for number, level in enumerate(surfaces):
        on = border[level.sample(nodes[border]) > -1.0]
        kind[on], segment[on] = 3, number
    deep = border[nodes[border, 1] > lip_head.TEETH + 12.0]
    kind[deep], segment[deep] = 1, -1
    return cmfsim.NodeKinds(kind, segment, names)


@pytest.fixture(scope="module")
def lips(mouth, kinds):
    _, seam, _, mesh = mouth
    return cmfsim.lip_regions(
        mesh.nodes, mesh.boundary_triangles(), kinds, seam.surface, height=HEIGHT
    )


def areas(nodes, triangles):
    a, b, c = (nodes[triangles[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def test_the_mesh_is_separated_where_the_seam_is_and_nowhere_else(mouth):
    anatomy, seam, whole, mesh = mouth
    nodes, triangles = np.asarray(mesh.nodes), np.asarray(mesh.boundary_triangles())
    assert np.asarray(mesh.volumes).min() > 0.0
    assert np.asarray(mesh.volumes).sum() == pytest.approx(
        np.asarray(whole.volumes).sum(), rel=1e-3
    )
    faces = triangles[seam_faces(nodes, triangles)]
    skin_before = areas(np.asarray(whole.nodes), np.asarray(whole.boundary_triangles())).sum()
    new = areas(nodes, triangles).sum() - skin_before
    assert areas(nodes, faces).sum() == pytest.approx(new, rel=0.05)
    centroids = nodes[faces].mean(axis=1)
    surface = cmfsim.Surface(seam.surface.vertices, seam.surface.triangles)
    closest, _, _ = surface.closest(centroids)
    away = np.linalg.norm(closest - centroids, axis=1)
    # Nodes lie on the sheet, and faces between them as near as it is bent.
    corners, _, _ = surface.closest(nodes[np.unique(faces)])
    assert np.linalg.norm(corners - nodes[np.unique(faces)], axis=1).max() < 0.02 * EDGE
    assert np.median(away) < 0.01 * EDGE
    assert away.max() < 0.1 * EDGE
    # All of the sheet that lies well inside tissue is cracked, but for its own rim.
    places = np.asarray(seam.surface.vertices)
    inside = (anatomy.skin.sample(places) > 1.5) & (np.abs(places[:, 0]) < lip_head.MOUTH - EDGE)
    for bone in anatomy.bones.values():
        inside &= bone.sample(places) < -1.0
    inside &= places[:, 1] < lip_head.TEETH + 3.0
    assert np.count_nonzero(inside) > 50
    closest, _, _ = cmfsim.Surface(nodes, faces).closest(places[inside])
    assert np.linalg.norm(closest - places[inside], axis=1).max() < 0.4 * EDGE


def test_between_skin_and_teeth_no_tet_joins_the_lips(mouth):
    """Tets in front of the teeth, and not at the corners, are of one lip or the other."""
    _, seam, _, mesh = mouth
    nodes, tets = np.asarray(mesh.nodes), np.asarray(mesh.tets).astype(np.int64)
    centroids = nodes[tets].mean(axis=1)
    x, y, z = centroids.T
    near = (np.abs(x) < 12.0) & (y < lip_head.TEETH + 3.0) & (np.abs(z - lip_head.line(x)) < 6.0)
    ids = np.flatnonzero(near)
    faces = np.sort(tets[ids][:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2)
    _, face = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)
    owner = np.repeat(np.arange(len(ids)), 4)
    order = np.argsort(face.reshape(-1), kind="stable")
    same = np.diff(face.reshape(-1)[order]) == 0
    pairs = np.stack([owner[order][:-1][same], owner[order][1:][same]], axis=1)
    label = connected_labels(pairs, len(ids))
    closest, normals, _ = cmfsim.Surface(seam.surface.vertices, seam.surface.triangles).closest(
        centroids[ids]
    )
    above = np.einsum("na,na->n", centroids[ids] - closest, normals) > 0.0
    for body in np.unique(label):
        sides = np.unique(above[label == body])
        assert len(sides) == 1
    assert np.bincount(label).max() > 100


def test_each_lip_is_one_patch_from_corner_to_corner_within_its_height(mouth, lips):
    _, seam, _, mesh = mouth
    nodes = np.asarray(mesh.nodes)
    surface = cmfsim.Surface(seam.surface.vertices, seam.surface.triangles)
    border = {tuple(t) for t in np.sort(mesh.boundary_triangles(), axis=1).tolist()}
    for name, sign in (("upper", 1.0), ("lower", -1.0)):
        triangles = np.asarray(lips[name].triangles)
        assert {tuple(t) for t in np.sort(triangles, axis=1).tolist()} <= border
        label = connected_labels(edges_of(triangles.astype(np.int64)).pairs, len(triangles))
        assert label.max() == 0
        centroids = nodes[triangles].mean(axis=1)
        closest, normals, _ = surface.closest(centroids)
        away = centroids - closest
        assert np.linalg.norm(away, axis=1).max() < HEIGHT + 0.5
        assert (sign * np.einsum("na,na->n", away, normals)).min() > -1.5
        assert centroids[:, 0].min() < -lip_head.MOUTH + 4.0
        assert centroids[:, 0].max() > lip_head.MOUTH - 4.0
        # Skin in front, mucosa on the teeth, and the face towards the other lip between.
        assert centroids[:, 1].min() < lip_head.FACE + 1.0
        assert centroids[np.abs(centroids[:, 0]) < 4.0, 1].max() > lip_head.TEETH - 0.5
        assert seam_faces(nodes, mesh.boundary_triangles()).sum() > 0


def test_the_lips_share_no_node_and_release_what_slides(lips, kinds):
    upper, lower = (set(lips[name].nodes.tolist()) for name in ("upper", "lower"))
    assert upper
    assert lower
    assert not upper & lower
    assert not upper & set(lips["lower"].triangles.ravel().tolist())
    for region in lips.values():
        nodes = np.asarray(region.nodes)
        assert set(nodes.tolist()) <= set(region.triangles.ravel().tolist())
        assert np.isin(kinds.kind[nodes], (0, 3)).all()
        released = np.concatenate(list(region.released.values()))
        assert sorted(released) == sorted(nodes[kinds.kind[nodes] == 3])
    assert len(lips["upper"].released["cranium"]) > 10
    assert len(lips["lower"].released["mandible"]) > 10


def test_a_seam_beside_the_tissue_is_refused(mouth, kinds):
    _, seam, _, mesh = mouth
    far = cmfsim.SurfaceData(
        np.asarray(seam.surface.vertices) + [0.0, -80.0, 0.0], seam.surface.triangles
    )
    with pytest.raises(CaseError, match="seam between the lips"):
        cmfsim.lip_regions(mesh.nodes, mesh.boundary_triangles(), kinds, far)
    with pytest.raises(CaseError, match="height of the lips"):
        cmfsim.lip_regions(mesh.nodes, mesh.boundary_triangles(), kinds, seam.surface, height=-1.0)
