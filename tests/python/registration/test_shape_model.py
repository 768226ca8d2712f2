"""The shape model fitted to the head that it is made of, in another pose and with an open mouth."""

import dataclasses

import numpy as np
import pytest

from cmfsim.registration.proposed.average_head import average_head
from cmfsim.registration.proposed.shape_model.fitted_head import fit_head
from cmfsim.registration.proposed.shape_model.model import HINGE
from cmfsim.registration.proposed.shape_model.samples import samples_of
from cmfsim.values.motion import rigid_motion
from cmfsim.values.surface_data import joined_surface

pytest.importorskip("scipy")

OPENING = rigid_motion(angle=14.0, axis=(1, 0, 0), centre=HINGE)
NOD = rigid_motion(angle=25.0, axis=(1, 0, 0), centre=(0, 0, 0))


def _moved(surface, matrix):
    vertices = np.asarray(surface.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    return dataclasses.replace(surface, vertices=vertices)


@pytest.fixture(scope="module")
def nodding():
    """The fit to undivided bone and skin that nod by 25° with the mouth open."""
    head = average_head()
    jaw = _moved(head.bones["mandible"], OPENING)
    bone = joined_surface([head.bones["cranium"], jaw])
    return fit_head(samples_of(_moved(bone, NOD), _moved(head.skin, NOD)))


def test_a_nodding_head_with_an_open_mouth_has_its_sites(nodding):
    for name, place in average_head().skull.items():
        if name in {"nasion", "suborbital_L", "supraglenoid_R", "menton", "infradentale"}:
            jaw = name in {"menton", "infradentale"}
            own = OPENING[:3, :3] @ place + OPENING[:3, 3] if jaw else place
            gap = nodding.sites["skull", name] - NOD[:3, :3] @ own
            assert np.linalg.norm(gap) < 2.0 * nodding.errors["skull", name], name


def test_a_known_site_moves_its_neighbours_and_lowers_their_errors(nodding):
    site, beside, far = ("skull", "menton"), ("skull", "pogonion"), ("skull", "glabella")
    found = nodding.distribution.given({site: nodding.sites[site] + [6.0, 0.0, 0.0]})
    places = dict(zip(found.names, found.mean, strict=True))
    errors = dict(zip(found.names, found.errors, strict=True))
    assert errors[beside] < nodding.errors[beside]
    assert places[beside][0] > nodding.sites[beside][0]
    shift = np.linalg.norm(places[far] - nodding.sites[far])
    assert shift < np.linalg.norm(places[beside] - nodding.sites[beside])
