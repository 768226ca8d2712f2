"""The files of a head that `cmfsim init` is given."""

import pytest

import cmfsim
import head_case
from cmfsim.registration.proposed import proposal


@pytest.fixture
def no_landmarks(monkeypatch):
    """Ellipsoids are refused as no head: at once, not after ten seconds in ten positions."""

    def refuse(_):
        raise cmfsim.LandmarkError("they are not a head")

    monkeypatch.setattr(proposal, "fit_head", refuse)


@pytest.fixture
def head(tmp_path):
    """The files of the head of ellipsoids, without a case file."""
    head_case.HeadCase().write_parts(tmp_path)
    return tmp_path
