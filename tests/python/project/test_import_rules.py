"""The import rules hold, and the script that checks them finds what breaks them."""

from pathlib import Path

import pytest

import check_imports

ROOT = Path(__file__).parents[3]


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
        (
            "crates/mtm-core/src/mesh.rs",
            "struct Row;\npub(crate) enum Row {}",
            "mesh.rs:2: Row is defined in crates/mtm-core/src/mesh.rs:1",
        ),
        ("crates/mtm-core/src/new/deep.rs", "", "deep.rs: add new to CORE"),
        ("crates/mtm-core/src/utils.rs", "", "name the file after its subject"),
        ("python/cmfsim/errors.py", "from cmfsim import values", "errors may not import values"),
        ("python/cmfsim/values/scene.py", "from .. import io", "values may not import io"),
        ("python/cmfsim/meshing/a.py", "import cmfsim.imaging", "meshing may not import imaging"),
        ("python/cmfsim/report.py", "from cmfsim.study import run", "report may not import study"),
        ("python/cmfsim/cli/new.py", "from cmfsim import TetMesh", "cli may not import cmfsim"),
        ("python/cmfsim/report.py", "import matplotlib", "import matplotlib inside"),
        ("python/cmfsim/new.py", "", "add new to PYTHON"),
        ("python/cmfsim/io/a.py", "from cmfsim.io.a import b", "io/a → io/a"),
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


def test_a_circle_of_files_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two files of a folder that import each other, and a third that does no harm."""
    folder = tmp_path / "python/cmfsim/io"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("from cmfsim.io.b import x\n", encoding="utf-8")
    (folder / "b.py").write_text("import cmfsim.io.a\n", encoding="utf-8")
    (folder / "c.py").write_text("from cmfsim.io import a\n", encoding="utf-8")
    assert check_imports.main(tmp_path) == 1
    printed = capsys.readouterr().out
    assert "io/a → io/b → io/a" in printed
    assert "io/c" not in printed


def test_too_many_entries_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A reader holds so many files and folders in mind, and no more."""
    package = tmp_path / "python/cmfsim"
    for folder, most in (("", check_imports.LARGE_FOLDERS[""]), ("io", check_imports.MOST_ENTRIES)):
        (package / folder).mkdir(parents=True, exist_ok=True)
        for number in range(most + 1):
            (package / folder / f"entry{number}.py").touch()
    (package / "io/entry0.pyi").touch()
    assert check_imports.main(tmp_path) == 1
    printed = capsys.readouterr().out
    most = check_imports.MOST_ENTRIES
    assert f"python/cmfsim/io: {most + 1} files and folders, at most {most}" in printed
    most = check_imports.LARGE_FOLDERS[""]
    assert f"python/cmfsim: {most + 2} files and folders, at most {most}" in printed


def test_too_many_imports_between_entries_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each pair of entries counts once, also for an import inside a function."""
    package = tmp_path / "python/cmfsim"
    (package / "io").mkdir(parents=True)
    (package / "io/a.py").write_text("from cmfsim import errors, values\n", encoding="utf-8")
    (package / "io/b.py").write_text(
        "def f():\n    from cmfsim.values.scene import Scene\n", encoding="utf-8"
    )
    (package / "__init__.py").write_text("from cmfsim import errors, io\n", encoding="utf-8")
    monkeypatch.setattr(check_imports, "MOST_PYTHON_PAIRS", 2)
    assert check_imports.main(tmp_path) == 0
    monkeypatch.setattr(check_imports, "MOST_PYTHON_PAIRS", 1)
    assert check_imports.main(tmp_path) == 1
    printed = capsys.readouterr().out
    assert "python/cmfsim: 2 imports between entries, at most 1" in printed


def test_the_core_runs_downhill() -> None:
    """No file can reach itself through the files that it may import."""
    table = check_imports.CORE
    for start, allowed in table.items():
        seen: set[str] = set()
        front = set(allowed)
        while front:
            seen |= front
            front = {n for name in front for n in table.get(name, ())} - seen
        assert start not in seen
