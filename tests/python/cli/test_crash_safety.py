"""Killed at any moment, on a full disk, in a folder that cannot be written: results stay whole."""

import contextlib
import functools
import hashlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.io import finish_writing, replacing, replacing_files
from head_case import HeadCase
from shared_values import without_pictures

pytest.importorskip("meshio")
pytest.importorskip("scipy")

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs signals and locks")

NAMES = tuple(f"{n}.txt" for n in range(6))
# Writes versions of the files one after another; slowly, so that a kill may fall anywhere.
WRITER = """
import sys, time
from pathlib import Path
from cmfsim.io import replacing_files
replace = Path.replace
def slowly(self, target):
    time.sleep(0.002)
    return replace(self, target)
Path.replace = slowly
version = int(sys.argv[2])
print("ready", flush=True)
while True:
    version += 1
    def fill(folder):
        for n in range(6):
            (folder / f"{n}.txt").write_text(str(version) * 500)
            time.sleep(0.001)
        return [f"{n}.txt" for n in range(6)]
    replacing_files(Path(sys.argv[1]), "none.json", lambda name: True, fill)
"""


def leftovers(folder: Path) -> list[str]:
    return [str(p) for p in folder.rglob("*") if ".writing-" in p.name or p.name.endswith(".part")]


def contents(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_files_written_together_stay_together_whenever_the_writer_is_killed(tmp_path):
    """Every kill leaves the six files of one version, once what it left is finished."""
    rng = np.random.default_rng(0)
    seen = set()
    for number in range(12):
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path), str(100 * number)], stdout=subprocess.PIPE
        )
        assert writer.stdout.readline() == b"ready\n"
        time.sleep(0.02 + 0.15 * rng.random())
        writer.kill()
        writer.wait()
        writer.stdout.close()
        left = leftovers(tmp_path)
        seen.add(bool(left))
        finish_writing(tmp_path)
        assert not leftovers(tmp_path)
        versions = {(tmp_path / name).read_text() for name in NAMES if (tmp_path / name).exists()}
        assert len(versions) <= 1
    assert True in seen


def test_what_another_run_is_writing_is_let_be(tmp_path):
    """Its lock tells; a folder that nobody holds goes."""

    def fill(folder):
        (folder / "a.txt").write_text("a")
        finish_writing(tmp_path)
        assert (folder / "a.txt").exists()
        return ["a.txt"]

    (tmp_path / ".writing-old").mkdir()
    (tmp_path / ".writing-old" / "b.txt").write_text("b")
    replacing_files(tmp_path, "none.json", lambda _: True, fill)
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("text", ['{"names": ["../b.txt"], "gone": []}', "[", '{"names": 3}', "3"])
def test_a_journal_that_leads_elsewhere_moves_nothing(text, tmp_path):
    folder = tmp_path / "out"
    left = folder / ".writing-x"
    left.mkdir(parents=True)
    (left / "ready.json").write_text(text)
    (folder / "b.txt").write_text("b")
    finish_writing(folder)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert [p.name for p in folder.iterdir()] == ["b.txt"]


def test_one_file_that_was_being_written_is_swept_by_the_next_writer(tmp_path):
    code = (
        "import os, sys, signal\nfrom pathlib import Path\nfrom cmfsim.io import replacing\n"
        "with replacing(Path(sys.argv[1])) as file:\n"
        "    file.write(b'half')\n    file.flush()\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = tmp_path / "plan.ply"
    path.write_text("whole")
    subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert len(leftovers(tmp_path)) == 1
    assert path.read_text() == "whole"
    cmfsim.write_surface(path, cmfsim.SurfaceData(np.eye(3), [[0, 1, 2]]))
    assert [p.name for p in tmp_path.iterdir()] == ["plan.ply"]


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The ellipsoids, coarse, with a face after the operation: seconds from files to figures."""
    folder = tmp_path_factory.mktemp("head")
    head = HeadCase(rounds=2)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 16.0")
    after = np.asarray(head.surfaces["skin"].vertices) + [0.0, -1.0, 0.0]
    head.surfaces["after"] = cmfsim.SurfaceData(after, head.surfaces["skin"].triangles)
    head.toml += '\n[postoperative]\nskin = "after.ply"\n'
    return head.write(folder)


@pytest.fixture(autouse=True)
def no_pictures(tmp_path_factory, monkeypatch):
    """Processes without PyVista: pictures take most of the time."""
    without_pictures(monkeypatch, tmp_path_factory.mktemp("without"))


def command(case, words, **options):
    """A command in a process of its own."""
    line = [sys.executable, "-m", "cmfsim", *words, str(case), "-q", "--no-doctor"]
    return subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, **options)


def succeed(process):
    _, err = process.communicate()
    assert process.returncode == 0, err


@pytest.fixture(scope="module")
def predicted(case, tmp_path_factory):
    """The folder of an earlier prediction."""
    out = tmp_path_factory.mktemp("predicted") / "out"
    succeed(command(case, ["predict", "--model", "H", "-o", str(out)]))
    return out


@pytest.mark.parametrize(
    "words", [["build"], pytest.param(["evaluate", "--model", "H"], marks=pytest.mark.slow)]
)
def test_a_killed_command_leaves_the_results_of_the_one_before(words, case, tmp_path):
    """Old and new results are the same but for their times; none is mixed, none is left over."""
    out = tmp_path / "out"
    words = [*words, "-o", str(out)]
    begun = time.perf_counter()
    succeed(command(case, words))
    seconds = time.perf_counter() - begun
    names = set(contents(out))
    steady = {n for n in names if n.endswith((".ply", ".stl", ".vtu", ".vtp"))}
    before = contents(out)
    for share in (0.6, 0.9):
        killed = command(case, words)
        time.sleep(share * seconds)
        killed.kill()
        killed.communicate()
        now = contents(out)
        whole = {n: h for n, h in now.items() if ".writing-" not in n and not n.endswith(".part")}
        assert set(whole) == names
        assert {n: whole[n] for n in steady} == {n: before[n] for n in steady}
    succeed(command(case, words))
    assert set(contents(out)) == names
    assert not leftovers(out)


@pytest.mark.parametrize("limit", [2_000, 60_000])
def test_a_disk_that_fills_up_is_an_error_and_changes_nothing(limit, case, predicted, tmp_path):
    """At the first and at a later file: exit 1, the folder named, the old files whole."""
    out = tmp_path / "out"
    shutil.copytree(predicted, out)
    before = contents(out)
    assert max(path.stat().st_size for path in out.iterdir()) > limit
    full = functools.partial(resource.setrlimit, resource.RLIMIT_FSIZE, (limit, limit))
    second = command(case, ["predict", "--model", "H", "-o", str(out)], preexec_fn=full)
    _, err = second.communicate()
    assert second.returncode == 1
    assert re.search(rb"File too large|No space left", err)
    assert str(out).encode() in err
    assert b"Traceback" not in err
    assert contents(out) == before


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 300 kB; skips where none can be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount, unmount = shutil.which("mount"), shutil.which("umount")
    if mount is None or unmount is None:
        pytest.skip("there is no mount command")
    words = [mount, "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(disk)]
    if subprocess.run(words, check=False, capture_output=True).returncode:
        pytest.skip("a small disk cannot be mounted here")
    yield disk
    subprocess.run([unmount, str(disk)], check=True)


def test_a_full_disk_is_named_and_left_clean(small_disk, case, capsys):
    out = small_disk / "out"
    assert main(["predict", str(case), "-q", "--no-doctor", "--model", "H", "-o", str(out)]) == 1
    err = capsys.readouterr().err
    assert "No space left on device" in err
    assert str(out) in err
    assert not list(small_disk.iterdir())


def test_a_disk_that_is_read_only_is_said_before_the_work(small_disk, case, capsys):
    subprocess.run([shutil.which("mount"), "-o", "remount,ro", str(small_disk)], check=True)
    for name in ("build", "predict", "evaluate"):
        # Before the doctor reads a file: root may write everywhere, so only trying tells.
        for words in ([], ["--no-doctor"]):
            assert main([name, str(case), *words, "-o", str(small_disk / "out")]) == 1
            err = capsys.readouterr().err
            assert f"{small_disk}: the output folder is not writable" in err
            assert "checking the case" not in err
            assert "reading" not in err


def test_a_folder_that_is_deleted_meanwhile_is_a_failure_with_its_reason(tmp_path):
    """Not bad input, exit code 2, as a missing file is."""
    folder = tmp_path / "out"

    def fill(fresh):
        (fresh / "a.txt").write_text("a")
        shutil.rmtree(folder)
        (fresh / "b.txt").write_text("b")
        return ["a.txt", "b.txt"]

    with pytest.raises(cmfsim.CmfsimError, match=r"out: was deleted or moved while") as caught:
        replacing_files(folder, None, lambda _: True, fill)
    assert not isinstance(caught.value, ValueError | OSError)
    (tmp_path / "page").mkdir()
    with (
        pytest.raises(cmfsim.CmfsimError, match=r"page: was deleted or moved while"),
        replacing(tmp_path / "page" / "plan.html"),
    ):
        shutil.rmtree(tmp_path / "page")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: p.write_text("x"), "is a file"),
        (lambda p: p.symlink_to(p.parents[1]), "is a link"),
    ],
)
def test_a_subfolder_that_is_none_is_named_as_what_it_is(make, said, tmp_path):
    make(tmp_path / "M")

    def fill(fresh):
        (fresh / "M").mkdir()
        (fresh / "M" / "a.txt").write_text("a")
        return ["M/a.txt"]

    with pytest.raises(cmfsim.CaseError, match=f"M: {said}.*, but a folder of results is needed"):
        replacing_files(tmp_path, None, lambda _: True, fill)


def test_a_file_in_the_place_of_the_folder_and_a_broken_case_are_bad_input(case, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    for name in ("build", "predict", "evaluate"):
        for words in ([], ["--no-doctor"]):
            assert main([name, str(case), "-q", *words, "-o", str(tmp_path / "out")]) == 2
            assert "is a file" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"
    broken = tmp_path / "case.toml"
    broken.write_text(case.read_text(encoding="utf-8")[:80], encoding="utf-8")
    for name in ("build", "predict", "evaluate", "sensitivity"):
        assert main([name, str(broken), "-q"]) == 2
        assert "case.toml" in capsys.readouterr().err


def cohort_of(folder, case, names=("one", "two")):
    text = 'format = "cmfsim-cohort"\nversion = 1\nname = "all"\nmodels = ["H"]\n'
    text += "".join(f'[[cases]]\nname = "{name}"\nfile = "{case}"\n' for name in names)
    path = folder / "cohort.toml"
    path.write_text(text, encoding="utf-8")
    return cmfsim.Cohort.load(path)


def _kill_worker_of(output: Path, killed: list[int]) -> None:
    """Kills the first process that works on a case, as a machine out of memory would."""
    for _ in range(2000):
        for entry in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if (entry / "fd" / "2").readlink() == output / "log.txt":
                    os.kill(int(entry.name), signal.SIGKILL)
                    killed.append(int(entry.name))
                    return
        time.sleep(0.005)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="needs /proc")
def test_a_killed_worker_is_reported_and_does_not_stop_the_rest(case, tmp_path):
    cohort = cohort_of(tmp_path, case)
    killed: list[int] = []
    thread = threading.Thread(target=_kill_worker_of, args=(cohort.output / "one", killed))
    thread.start()
    report = cmfsim.run_study(cohort, workers=1)
    thread.join()
    assert killed
    assert [outcome.status for outcome in report.outcomes] == ["failed", "done"]
    assert "killed by signal 9" in report.failed[0].error
    again = cmfsim.run_study(cohort, workers=1)
    assert [outcome.status for outcome in again.outcomes] == ["done", "kept"]
    assert not leftovers(cohort.output)


@pytest.mark.slow
def test_a_study_on_a_dask_cluster_gives_what_one_machine_gives(case, tmp_path):
    distributed = pytest.importorskip("distributed")
    cohort = cohort_of(tmp_path, case, ("one",))
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        report = cmfsim.run_study(cohort, scheduler=cluster.scheduler_address)
    assert [outcome.status for outcome in report.outcomes] == ["done"]
    local = cmfsim.run_study(cohort, fresh=True)
    assert local.outcomes[0].evaluation["models"] == report.outcomes[0].evaluation["models"]


@pytest.mark.slow
def test_a_cluster_that_does_not_answer_is_bad_input(case, tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(cmfsim.CaseError, match="no Dask scheduler answers at"):
        cmfsim.run_study(cohort_of(tmp_path, case), scheduler="tcp://127.0.0.1:9")
