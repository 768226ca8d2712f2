"""The page "Extending cmfsim" shows the code that is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
EXCERPTS = re.findall(r"^`(crates/\S+\.rs)`\n\n```rust\n(.*?)```$", PAGE, re.MULTILINE | re.DOTALL)
NAMED_FILE = r"`((?:crates|python|tests|benches)/[\w/]+\.(?:rs|py))`"


def test_every_block_of_rust_has_its_file():
    assert len(EXCERPTS) == PAGE.count("```rust\n") >= 5


@pytest.mark.parametrize(("path", "code"), EXCERPTS, ids=lambda value: value.split("\n")[0][-40:])
def test_excerpts_are_verbatim(path, code):
    """Each excerpt stands in its file, indentation included."""
    assert code in (ROOT / path).read_text(encoding="utf-8")


def test_named_files_exist():
    names = re.findall(NAMED_FILE, PAGE)
    assert len(names) >= 5
    assert [name for name in names if not (ROOT / name).is_file()] == []
