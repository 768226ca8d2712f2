"""The file of the planning page: closed to the network, and of the content's own numbers."""

import base64
import dataclasses
import gzip
import hashlib
import json
import re

import numpy as np
import pytest

import cmfsim
import cmfsim.planning.page.content
from cmfsim.planning.page.document import joined_scripts

pytest.importorskip("skimage")
pytest.importorskip("meshio")


def test_the_page_allows_its_own_script_and_no_network(page_file):
    text = page_file.read_text(encoding="utf-8")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    script = re.search(r'<script type="module">(.*?)</script>', text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert f"'sha256-{digest}'" in policy
    assert "unsafe" not in policy
    assert "connect-src" not in policy
    addresses = set(re.findall(r"""(?:src|href)=["']?([^"'\s>]+)""", text))
    assert not addresses
    assert not re.search(r"https?://(?!www\.w3\.org)", script)
    assert "not a medical device" in text
    assert page_file.stat().st_size < 12e6


def test_equal_content_gives_equal_bytes(content):
    first, second = (cmfsim.page_text(content) for _ in range(2))
    assert first == second


def test_numbers_that_are_not_finite_are_refused(content):
    arrays = {**content.arrays, "nodes": np.full((4, 3), np.nan, dtype=np.float32)}
    with pytest.raises(cmfsim.CaseError, match="'nodes' of the page holds numbers"):
        cmfsim.page_text(dataclasses.replace(content, arrays=arrays))


def test_packed_numbers_are_those_of_the_content(content, page_file):
    text = page_file.read_text(encoding="utf-8")
    packed = re.search(r'id="page-numbers">([^<]*)<', text)[1]
    block = gzip.decompress(base64.b64decode(packed))
    table = json.loads(re.search(r'id="page-values">([^<]*)<', text)[1])["arrays"]
    assert [entry["name"] for entry in table] == list(content.arrays)
    for entry in table:
        given = content.arrays[entry["name"]]
        count = int(np.prod(entry["shape"]))
        found = np.frombuffer(block, entry["type"], count, entry["start"])
        np.testing.assert_array_equal(found.reshape(given.shape), given)


def test_scripts_that_cannot_be_joined_are_refused():
    with pytest.raises(cmfsim.CaseError, match=r"main\.js → a\.js → main\.js"):
        joined_scripts(
            {
                "main.js": 'import { a } from "./a.js";\n',
                "a.js": 'import { b } from "./main.js";\nexport const a = 1;\n',
            }
        )
    with pytest.raises(cmfsim.CaseError, match=r"no script 'b\.js'"):
        joined_scripts({"main.js": 'import { b } from "./b.js";\n'})
    with pytest.raises(cmfsim.CaseError, match=r"a\.js and main\.js both define 'a'"):
        joined_scripts(
            {"main.js": 'import { a } from "./a.js";\nconst a = 2;\n', "a.js": "const a = 1;\n"}
        )


def test_a_skin_too_fine_for_a_page_is_refused_and_a_fine_face_simplified(
    planning, reference, errors, monkeypatch
):
    fine = cmfsim.planning.page.content
    monkeypatch.setattr(fine, "FACE_TRIANGLES", 8_000)
    found = cmfsim.page_content(planning, reference, errors)
    assert len(found.arrays["face_triangles"]) <= 8_100
    text = next(f.what for f in found.findings if f.where == "face")
    away = float(re.search(r"at most ([0-9.]+) mm away", text)[1])
    assert away < 2.0
    monkeypatch.setattr(fine, "MOST_NODES", 1000)
    with pytest.raises(cmfsim.CaseError, match="use a larger edge_length"):
        cmfsim.page_content(planning, reference, errors)
