"""The tables of README and docs are what the commands that they name write."""

import re
from pathlib import Path

import pytest

from benches.scenes.marked import marked, replace_marked
from benches.stability import stability

ROOT = Path(__file__).parents[3]
BENCHMARKS = (ROOT / "docs/benchmarks.md").read_text(encoding="utf-8")


def test_the_stability_page_has_every_case_and_no_wrong_verdict():
    """The page begins as the command writes it, and each case has its lines."""
    page = (ROOT / "docs/stability.md").read_text(encoding="utf-8")
    assert page.startswith(stability.INTRODUCTION)
    assert "| **" not in page
    rows = {tuple(c.strip() for c in line.split("|")[1:3]) for line in page.splitlines()}
    wanted = {(c.name, c.parameter) for suite in stability.SUITES for c in suite.cases()}
    assert wanted <= rows
    assert len(wanted) > 200


def test_the_times_of_the_readme_are_those_of_the_benchmarks():
    """Each row of README's Performance stands in the tables of docs/benchmarks.md, size by size."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    table = readme.partition("## Performance")[2].partition("## ")[0]
    rows = [line.split("|")[1:-1] for line in table.splitlines() if line.startswith("| ")]
    sizes = [re.sub(r"\D", "", cell) for cell in rows[0][1:4]]
    assert len(sizes) == 3
    for row in rows[2:]:
        name, *cells = (cell.strip() for cell in row)
        for i, size in enumerate(sizes):
            section = BENCHMARKS.partition(f"### {size} tets")[2].partition("###")[0]
            line = next(at for at in section.splitlines() if at.startswith(f"| {name} |"))
            stated = [cell.strip() for cell in line.split("|")[1:-1]]
            assert stated[5].split()[0] == cells[i], (name, size)
            if size == sizes[-1]:
                assert [stated[9], stated[8]] == cells[3:], name


def test_every_command_that_makes_a_number_is_there():
    """Files named in "Which command produces which number" exist."""
    table = BENCHMARKS.partition("## Which command")[2].partition("## ")[0]
    files = re.findall(r"benches/[\w/]+\.(?:py|rs)", table)
    modules = re.findall(r"python -m (benches[\w.]+)", table)
    files += [name.replace(".", "/") + ".py" for name in modules]
    assert len(files) >= 5
    assert [name for name in files if not (ROOT / name).is_file()] == []
    elements = marked(ROOT / "docs/benchmarks.md", "benches/stability/elements.py")
    assert elements.count("\n| 0.46 | p2 |") == 3


def test_a_marked_table_is_replaced_and_a_page_without_marks_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- begin x -->\nold\n<!-- end x -->\nb\n", encoding="utf-8")
    replace_marked(page, "x", "new")
    assert marked(page, "x") == "new"
    assert page.read_text("utf-8").startswith("a\n")
    assert page.read_text("utf-8").endswith("\nb\n")
    with pytest.raises(SystemExit, match="begin y"):
        replace_marked(page, "y", "new")
