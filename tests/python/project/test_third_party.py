"""The licence check: what it allows, what it refuses, and what it finds in the wheel."""

import shutil
from pathlib import Path

import pytest

import third_party

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("MIT", True),
        ("MIT OR Apache-2.0", True),
        ("MIT/Apache-2.0", True),
        ("GPL-3.0-only", False),
        ("LGPL-2.1-or-later", False),
        ("MIT OR Apache-2.0 OR LGPL-2.1-or-later", True),
        ("MIT AND GPL-3.0-only", False),
        ("(MIT OR Apache-2.0) AND Unicode-3.0", True),
        ("(GPL-3.0-only OR MIT) AND (AGPL-3.0-only OR Zlib)", True),
        ("MIT AND (GPL-3.0-only OR AGPL-3.0-only)", False),
        ("Apache-2.0 WITH LLVM-exception", True),
        ("GPL-3.0-only WITH Classpath-exception-2.0", False),
        ("MIT MIT", False),
        ("", False),
    ],
)
def test_one_choice_of_every_part_must_be_allowed(expression, expected):
    """SPDX: OR leaves a choice, AND does not, WITH belongs to its licence."""
    assert third_party.is_allowed(expression) is expected


def test_a_crate_under_another_licence_is_named():
    """A new dependency cannot bring its licence along unseen."""
    package = {"name": "other", "version": "1.0.0", "license": "GPL-3.0-only"}
    (problem,) = third_party.crate_problems({"packages": [package]})
    assert "other 1.0.0" in problem
    assert "GPL-3.0-only" in problem
    (problem,) = third_party.crate_problems({"packages": [{**package, "license": None}]})
    assert "states no licence" in problem


def test_every_python_package_of_the_project_has_a_licence_that_is_allowed():
    """Extras and development tools too."""
    names = third_party.python_packages()
    assert {"numpy", "SimpleITK", "scipy", "meshio", "jinja2"} <= set(names)
    assert list(third_party.python_problems()) == []


@pytest.fixture(scope="module")
def sources():
    if shutil.which("cargo") is None:
        pytest.skip("needs cargo")
    return third_party.metis_sources(third_party.cargo_metadata(offline=False))


def test_no_file_of_metis_under_the_lgpl_gets_into_the_wheel(sources):
    """GKlib's sorting, regular expressions and options are under it."""
    assert list(third_party.lesser_gpl_files(sources)) == []
    names = {path.name for path in third_party.compiled_files(sources)}
    assert len(names) == 29
    assert "ometis.c" in names
    assert names.isdisjoint({"gkregex.c", "getopt.c", "sort.c"})
    lesser = [path for path in sources.rglob("*.[ch]") if third_party.is_lesser_gpl(path)]
    assert {path.name for path in lesser} >= {"gkregex.c", "getopt.c", "gk_mksort.h"}


def test_a_file_under_the_lgpl_is_found(sources, tmp_path, monkeypatch):
    """Were the guards lost, or getopt.c compiled, the check would fail."""
    monkeypatch.setattr(third_party, "METIS_GUARDS", tmp_path / "sorting.h")
    (tmp_path / "sorting.h").write_text("", encoding="utf-8")
    (found,) = third_party.lesser_gpl_files(sources)
    assert "gk_mksort.h" in found
    monkeypatch.setattr(third_party, "METIS_BUILD", tmp_path / "build.rs")
    (tmp_path / "build.rs").write_text('["getopt.c"]', encoding="utf-8")
    assert any("getopt.c" in problem for problem in third_party.lesser_gpl_files(sources))


def test_the_notices_name_every_crate_of_the_lock_that_is_compiled_in():
    """The committed file; `make lint` compares all of it with what cargo says."""
    text = (ROOT / third_party.NOTICES).read_text(encoding="utf-8")
    for part in ("faer 0.", "rayon 1.", "parry3d-f64 0.", "pyo3 0.", "METIS 5.1", "GKlib", "numpy"):
        assert f"| {part}" in text
    assert "metis-sys" not in text
    assert "Permission is hereby granted" in text
    assert "Apache License" in text
    assert "University of Minnesota" in text
