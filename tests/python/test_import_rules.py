"""The import rules hold, and the script that checks them finds what breaks them."""

from pathlib import Path

import pytest

import check_imports

ROOT = Path(__file__).parents[2]


def test_the_project_keeps_its_import_rules(capsys: pytest.CaptureFixture[str]) -> None:
    """No file of the project breaks a rule."""
    assert check_imports.main(ROOT) == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("file", "text", "complaint"),
    [
        ("crates/mtm-core/src/mesh.rs", "use crate::geometry::surface::Surface;", "runs upwards"),
        (
            "crates/mtm-core/src/algebra/mod.rs",
            "use crate::mesh::M;",
            "algebra may not import mesh",
        ),
        ("crates/mtm-core/src/algebra/krylov.rs", "super::super::contact::Row", "runs upwards"),
        ("crates/mtm-core/src/mesh.rs", "use crate::nowhere::N;", "none of the crate's"),
        ("crates/mtm-core/src/mesh.rs", "\nuse faer::Mat;", "mesh.rs:2: faer belongs in"),
        ("crates/mtm-core/src/contact.rs", "let t = parry3d_f64::shape();", "parry3d_f64 belongs"),
        ("crates/mtm-core/src/mesh.rs", "use pyo3::prelude::*;", "pyo3 belongs in crates/mtm-py"),
        ("crates/mtm-core/src/mesh.rs", "use crate::{error, blocks};", "one `use crate::"),
        ("crates/mtm-core/src/algebra/krylov.rs", "use super::{blocks};", "one `use super::"),
        ("crates/mtm-core/src/new.rs", "", "add new to CORE"),
        ("crates/mtm-core/src/new/deep.rs", "", "deep.rs: add new to CORE"),
        ("crates/mtm-core/src/utils.rs", "", "name the file after its subject"),
        ("python/cmfsim/case.py", "from cmfsim._core import TetMesh", "case may not import _core"),
        ("python/cmfsim/case.py", "from cmfsim import _core", "case may not import _core"),
        ("python/cmfsim/case.py", "from . import io", "case may not import io"),
        ("python/cmfsim/meshing.py", "import cmfsim.template", "meshing may not import template"),
        ("python/cmfsim/report.py", "from cmfsim.study import run", "report may not import study"),
        ("python/cmfsim/report.py", "import matplotlib", "import matplotlib inside"),
        ("python/cmfsim/new.py", "", "add it to PYTHON"),
        ("tests/python/helpers.py", "", "name the file after its subject"),
    ],
)
def test_a_broken_rule_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, text: str, complaint: str
) -> None:
    """Each rule, broken alone, fails with its file and its reason."""
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(text + "\n", encoding="utf-8")
    assert check_imports.main(tmp_path) == 1
    assert complaint in capsys.readouterr().out


@pytest.mark.parametrize(
    ("texts", "circle"),
    [
        (
            {
                "algebra/mod.rs": "pub mod krylov;\npub mod blocks;",
                "algebra/krylov.rs": "use crate::algebra::blocks::B;",
                "algebra/blocks.rs": "use super::krylov::K;",
            },
            "algebra/blocks → algebra/krylov → algebra/blocks",
        ),
        (
            {
                "contact/mod.rs": "mod seat;\nuse seat::Seat;\npub struct Sliding;",
                "contact/seat.rs": "use crate::contact::Sliding;",
            },
            "contact → contact/seat → contact",
        ),
        (
            {
                "contact/mod.rs": "mod seat;\npub use seat::Seat;\npub struct Sliding;",
                "contact/seat.rs": "use super::Sliding;",
            },
            None,
        ),
    ],
)
def test_a_circle_within_a_folder_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], texts: dict[str, str], circle: str | None
) -> None:
    """Files of a folder import in one direction; a name that mod.rs passes on is no import."""
    for file, text in texts.items():
        path = tmp_path / "crates/mtm-core/src" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    assert check_imports.main(tmp_path) == (1 if circle else 0)
    if circle:
        assert f"a circle of imports: {circle}" in capsys.readouterr().out


def test_comments_and_test_modules_are_free(tmp_path: Path) -> None:
    """What is no code, or code of tests, may name any module."""
    path = tmp_path / "crates/mtm-core/src/mesh.rs"
    path.parent.mkdir(parents=True)
    path.write_text(
        "// faer::Mat\n/* pyo3::x */\n#[cfg(test)]\nmod tests {\n    use crate::statics::S;\n}\n",
        encoding="utf-8",
    )
    assert check_imports.main(tmp_path) == 0


@pytest.mark.parametrize("table", [check_imports.CORE, check_imports.PYTHON])
def test_the_tables_run_downhill(table: dict[str, frozenset[str]]) -> None:
    """No file can reach itself through the files that it may import."""
    for start, allowed in table.items():
        seen: set[str] = set()
        front = set(allowed)
        while front:
            seen |= front
            front = {n for name in front for n in table.get(name, ())} - seen
        assert start not in seen
