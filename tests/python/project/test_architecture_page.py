"""The page about the architecture is that of the sources, and names no room that is not there."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_the_page_and_its_picture_are_what_the_script_writes():
    path = ROOT / "scripts/make_architecture_page.py"
    spec = importlib.util.spec_from_file_location("make_architecture_page", path)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    there = (ROOT / script.PAGE).read_text(encoding="utf-8")
    text, picture = script.page(there)
    assert there == text
    assert (ROOT / script.PICTURE).read_text(encoding="utf-8") == picture


def test_every_folder_of_the_package_and_the_core_has_a_row():
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    for folder in ("python/cmfsim", "crates/mtm-core/src"):
        rooms = [p.name for p in (ROOT / folder).iterdir() if p.is_dir() and p.name[0].isalpha()]
        assert len(rooms) >= 9
        assert [r for r in rooms if f"| `{r}` |" not in text] == []
