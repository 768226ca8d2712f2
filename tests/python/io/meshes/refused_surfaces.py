"""Files of surfaces from their content, and how the reader must refuse them."""

import pytest

import cmfsim


def saved(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refused(path, match):
    with pytest.raises(cmfsim.CaseError, match=match) as caught:
        cmfsim.read_surface(path)
    assert isinstance(caught.value, ValueError)
    assert path.name in str(caught.value)
