"""What the planning page measures and mirrors, and that everybody can use it."""

import numpy as np
import pytest
from planning_steps import settle

from browser_page import serious_faults

pytest.importorskip("skimage")
pytest.importorskip("meshio")


def test_the_mirror_image_is_at_the_plane_between_the_corners_of_the_eyes(opened, planning):
    skin = planning.patient.landmarks["skin"]
    left, right = (
        np.array([skin[f"{name}_{side}"] for name in ("exocanthion", "endocanthion")])
        for side in "LR"
    )
    normal = (left - right).sum(axis=0)
    normal /= np.linalg.norm(normal)
    middle = (left + right).mean(axis=0) / 2.0
    plane = opened.evaluate("cmfsimPage.mirror.plane")
    np.testing.assert_allclose(plane["normal"], normal, atol=1e-6)
    assert abs((np.array(plane["point"]) - middle) @ normal) < 1e-4
    opened.get_by_label("Mirror image").check()
    settle(opened)
    (part,) = opened.evaluate("cmfsimPage.mirror.parts(null)")
    matrix = np.array(part["motion"]).reshape(4, 4)
    mirrored = left @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(
        mirrored, left - 2.0 * ((left - middle) @ normal)[:, None] * normal, atol=1e-4
    )
    motions = opened.evaluate("cmfsimPage.face.sitePlaces(cmfsimPage.motions)")
    off = (np.array(motions["subnasale"]) - middle) @ normal
    side = "" if abs(off) < 0.05 else " left" if off > 0.0 else " right"
    assert f"subnasale {abs(off):.1f} mm{side}" in opened.locator(".controls").inner_text()
    opened.get_by_label("Mirror image").uncheck()


def test_a_measured_point_of_bone_moves_with_its_segment(opened):
    opened.locator("#show-skin").fill("0")
    opened.get_by_role("checkbox", name="Measure").check()
    opened.get_by_label("Handles").uncheck()
    opened.get_by_role("button", name="Front", exact=True).click()
    settle(opened)
    places = opened.evaluate(
        """() => {
          const { camera, overlay, bones, ruler } = cmfsimPage;
          const at = (p) => camera.project(p, overlay.clientWidth, overlay.clientHeight);
          const bone = cmfsimPage.surfaces().findIndex((_, i) => i && bones[i - 1].segment === 0);
          const { places } = cmfsimPage.surfaces()[bone];
          // The foremost vertex of the segment, and a point beside it.
          let front = 0;
          for (let i = 3; i < places.length; i += 3) {
            if (places[i + 1] < places[front + 1]) front = i;
          }
          ruler.clicked(at(places.slice(front, front + 3)));
          ruler.clicked(at([places[front] + 2, places[front + 1], places[front + 2]]));
          return [ruler.places(), ruler.points.map((p) => p.number), bone];
        }"""
    )
    before, numbers, bone = np.array(places[0]), places[1], places[2]
    assert numbers[0] == bone
    was = opened.evaluate("cmfsimPage.motions[0]")
    motion = np.array(was).reshape(4, 4)
    motion[:3, 3] += (1.0, -4.0, 2.0)
    opened.evaluate("m => cmfsimPage.preview({segment: 0, motion: m})", motion.ravel().tolist())
    settle(opened)
    after = np.array(opened.evaluate("cmfsimPage.ruler.places()"))
    np.testing.assert_allclose(after[0] - before[0], (1.0, -4.0, 2.0), atol=1e-4)
    opened.get_by_role("checkbox", name="Measure").uncheck()
    opened.get_by_label("Handles").check()
    opened.locator("#show-skin").fill("1")


def test_the_page_has_no_serious_fault_of_accessibility(opened):
    assert serious_faults(opened) == []
