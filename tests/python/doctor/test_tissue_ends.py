"""Where tissue ends: planes that fix it close to what moves, borders that leave it loose."""

import numpy as np
from diagnosed_heads import diagnosis, image_case

import cmfsim
from cmfsim import Anatomy, BoneSegment, ImageData, NodeKinds, SurfaceData
from cmfsim.meshing.levels import TissueRegion
from cmfsim.pipeline.building.tissue.nodes import loose_ends, near_ends
from head_case import HeadCase


def block(lower=None, upper=None, *, loose=(), gap=5.0):
    """Tissue that fills an image, a bone in it, and what is fixed there."""
    labels = np.ones((10, 10, 10), dtype=np.uint8)
    mesh = cmfsim.mesh_from_labels(labels, (4.0, 4.0, 4.0), edge_length=8.0)
    nodes = np.asarray(mesh.nodes)
    skin = ImageData(np.ones((10, 10, 10), dtype=np.float32), (4.0, 4.0, 4.0))
    kind = np.zeros(len(nodes), dtype=np.uint8)
    ends = {"x": (0, nodes[:, 0].max()), "z": (2, nodes[:, 2].min())}
    border = np.zeros(len(nodes), dtype=bool)
    for axis in range(3):
        for end in (nodes[:, axis].min(), nodes[:, axis].max()):
            border |= np.abs(nodes[:, axis] - end) < 0.5
    kind[border] = 1
    for name in loose:
        axis, end = ends[name]
        kind[np.abs(nodes[:, axis] - end) < 0.5] = 0
    low = 0.0 if lower is None else lower + gap
    corners = np.array([[15.0, 15, low], [25, 15, low], [15, 25, low], [15, 15, low + 3.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.uint32)
    chin = BoneSegment("chin", skin, SurfaceData(corners, faces))
    kinds = NodeKinds(kind, np.full(len(nodes), -1, dtype=np.int16), ("chin",))
    anatomy = Anatomy(skin, {"skull": skin})
    region = TissueRegion((0.0, 100.0, 0.0), (0.0, 1.0, 0.0), lower=lower, upper=upper)
    return [*near_ends(anatomy, region, [chin]), *loose_ends(mesh, kinds, anatomy)]


def test_a_bone_that_moves_close_to_a_plane_that_fixes_is_reported():
    (finding,) = block(lower=2.0)
    assert finding.code == "segment-near-end"
    assert "within 5.0 mm of the plane z = 2.0 mm below" in finding.what
    assert "image ends" in finding.why
    assert not block(lower=-30.0, gap=30.0)
    (past,) = block(lower=2.0, gap=-3.0)
    assert "reaches 3.0 mm past" in past.what


def test_tissue_that_ends_loose_on_a_border_is_reported():
    (finding,) = block(loose=("x",))
    assert finding.code == "tissue-ends-loose"
    assert "left border" in finding.what
    assert 'fixed_borders = ["left"]' in finding.fix
    assert not block()


def test_the_doctor_reports_a_chin_that_moves_close_to_the_end_of_image_or_region(tmp_path):
    """The image of the case ends at z = 1370 mm, menton lies at 1427 mm."""
    head = image_case(tmp_path, 2.5)
    assert "segment-near-end" not in {f.code for f in diagnosis(tmp_path, head)}
    head.skull["menton"] = np.array([3.0, -140.0, 1384.0])
    (finding,) = [f for f in diagnosis(tmp_path, head) if f.code == "segment-near-end"]
    assert "14.0 mm below the landmark menton" in finding.what
    head = HeadCase()
    head.replace("[tissue]", "[region]\nlower = 1415\n\n[tissue]")
    (finding,) = [f for f in diagnosis(tmp_path, head) if f.code == "segment-near-end"]
    assert "end at 1415.0 mm" in finding.what
