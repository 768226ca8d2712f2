"""The files of a head that `cmfsim init` is given."""

import pytest

import head_case


@pytest.fixture
def head(tmp_path):
    """The files of the head of ellipsoids, without a case file."""
    head_case.HeadCase().write_parts(tmp_path)
    return tmp_path
