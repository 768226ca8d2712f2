"""Runs that are killed while they write leave one set of results, and stop no later run."""

import os
import subprocess
import sys

import numpy as np
import pytest
from folder_states import state_of

import cmfsim
from cmfsim.io import finish_writing

pytest.importorskip("meshio")
pytest.importorskip("pyvista")
pytest.importorskip("jinja2")
pytest.importorskip("scipy")

OLD = ("a.vtp", "M/b.vtp", "M/prediction.json", "prediction.json")
OLD_ALONE = ("metrics.json", "error-H.png", "H/prediction.json", "H/c.vtp")
# Replaces the results in a folder by others, in a process for each step at which it is killed.
KILLED = """
import os, shutil, sys
from pathlib import Path
from cmfsim.io import replacing_files
count, last = 0, 0
def stepping(owner, name):
    real = getattr(owner, name)
    def step(*words, **named):
        global count
        count += 1
        if count == last:
            os._exit(9)
        return real(*words, **named)
    setattr(owner, name, step)
for name in ("replace", "unlink", "mkdir", "hardlink_to", "write_text", "rmdir"):
    stepping(Path, name)
stepping(os, "fsync")
stepping(shutil, "rmtree")
def write(folder, names, text):
    for name in names:
        os.makedirs((folder / name).parent, exist_ok=True)
        with open(folder / name, "w") as file:
            file.write(text)
def fill(fresh):
    write(fresh, {new!r}, "new")
    return {new!r}
{more}
base, code = Path(sys.argv[1]), 9
while code == 9:
    last += 1
    folder = base / f"{{last:03d}}"
    write(folder, [*{new!r}, *{alone!r}, "mine.txt"], "old")
    child = os.fork()
    if not child:
        try:
            replacing_files(folder, None, lambda name: True, fill, lambda: {alone!r})
        except OSError:
            os._exit(1)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
print(code)
"""
BEFORE = {**dict.fromkeys((*OLD, *OLD_ALONE), "old"), "mine.txt": "old"}
AFTER = {**dict.fromkeys(OLD, "new"), "mine.txt": "old"}


def killed_at_each_step(base, more=""):
    """The code that the run ends in where it is not killed, and the folder of each run."""
    text = KILLED.format(new=[*OLD], alone=[*OLD_ALONE], more=more)
    words = [sys.executable, "-c", text, str(base)]
    code = int(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    return code, sorted(base.iterdir())


def is_statement(name):
    return name.endswith(".json")


def check_consistent(folder):
    """No statement of one run lies next to files of another; the next run makes one whole."""
    seen = state_of(folder)
    stated = {value for name, value in seen.items() if is_statement(name)}
    files = {name: value for name, value in seen.items() if not is_statement(name)}
    if stated == {"old"}:
        assert files == {name: value for name, value in BEFORE.items() if not is_statement(name)}
    elif stated == {"new"}:
        assert files == {name: value for name, value in AFTER.items() if not is_statement(name)}
    else:
        assert not stated, seen
    finish_writing(folder)
    assert state_of(folder) in (BEFORE, AFTER)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    return state_of(folder) == AFTER


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_run_killed_at_any_step_leaves_one_set_of_results(tmp_path):
    """At each rename, removal and sync in turn; 1 of 30 kills left a mixture before."""
    code, folders = killed_at_each_step(tmp_path)
    assert code == 0
    assert len(folders) > 25
    done = [check_consistent(folder) for folder in folders]
    # Up to some step all is as before, from then on as after.
    assert done == sorted(done)
    assert set(done) == {True, False}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_run_killed_while_it_puts_the_old_files_back_leaves_them_whole(tmp_path):
    """A file that cannot take its place, and then a kill at each step of going back."""
    full = (
        "stepped = Path.replace\n"
        "def full(self, target):\n"
        "    if self.parent.name.startswith('.writing-') and self.name == 'prediction.json':\n"
        "        raise OSError(28, 'No space left on device')\n"
        "    return stepped(self, target)\n"
        "Path.replace = full\n"
    )
    code, folders = killed_at_each_step(tmp_path, full)
    assert code == 1
    assert len(folders) > 35
    done = [check_consistent(folder) for folder in folders]
    assert not done[-1]
    assert state_of(folders[-1]) == BEFORE


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_pipes_and_folders_with_names_of_leftovers_stop_no_run(tmp_path):
    """A pipe that nobody writes to would be waited for."""
    path = tmp_path / "a.ply"
    os.mkfifo(tmp_path / ".a.ply.x.part")
    (tmp_path / ".a.ply.y.part").mkdir()
    os.mkfifo(tmp_path / ".writing-pipe")
    (tmp_path / ".writing-a").mkdir()
    os.mkfifo(tmp_path / ".writing-a" / "ready.json")
    finish_writing(tmp_path)
    cmfsim.write_surface(path, cmfsim.SurfaceData(np.eye(3), [[0, 1, 2]]))
    assert path.stat().st_size > 0
