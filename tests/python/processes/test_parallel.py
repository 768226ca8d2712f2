"""Jobs in processes of their own: answers, errors, and none that outlives its parent."""

import os
import signal
import subprocess
import sys
import time

import pytest

from cmfsim.errors import CaseError, CaseInputError
from cmfsim.processes.parallel import answers


def test_each_job_has_its_answer():
    """More jobs than processes, with their indices; one thread each."""
    jobs = [{"key": name} for name in ("RAYON_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NOT_SET")]
    assert dict(answers("os:getenv", jobs, 2)) == {0: "1", 1: "1", 2: None}


def test_errors_keep_their_class_and_text():
    """An error of the package is raised as it is; another one with its trace."""
    job = {"seed": -1, "index": 1}
    with pytest.raises(CaseInputError, match="seed is -1"):
        list(answers("cmfsim.lab.virtual.population:drawn_patient", [job], 1))
    with pytest.raises(CaseError, match=r"FileNotFoundError in a worker process"):
        list(answers("os:listdir", [{"path": "/no/such/folder"}], 1))


def test_a_process_that_dies_is_an_error():
    """Not a wait without end, and not an answer."""
    with pytest.raises(CaseError, match=r"exit code 7.*fewer workers"):
        list(answers("os:_exit", [{"status": 7}], 1))


def test_a_cluster_gives_the_same_and_survives_a_lost_machine(tmp_path):
    """Two machines, one of which dies with a job in hand: its job is done by the other."""
    distributed = pytest.importorskip("distributed")
    marks = [str(tmp_path / f"mark{k}") for k in range(4)]
    # The first to come makes the mark and waits to be killed; whoever comes later finds it.
    script = (
        "import os,sys,time; mark=sys.argv[1]; there=os.path.exists(mark); open(mark,'w').close();"
        "time.sleep(0 if there or not mark.endswith('mark0') else 60)"
    )
    jobs = [{"args": [sys.executable, "-c", script, mark]} for mark in marks]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        found = answers("subprocess:call", jobs, 1, cluster.scheduler_address)
        first = [next(found) for _ in range(3)]
        assert soon((tmp_path / "mark0").exists)
        with distributed.Client(cluster.scheduler_address) as client:
            busy = client.processing()
            pids = client.run(os.getpid)
        holding = next(address for address, tasks in busy.items() if tasks)
        os.kill(pids[holding], signal.SIGKILL)
        assert sorted([*first, *found]) == [(0, 0), (1, 0), (2, 0), (3, 0)]
        bad, address = [{"seed": -1, "index": 1}], cluster.scheduler_address
        with pytest.raises(CaseInputError, match="seed is -1"):
            list(answers("cmfsim.lab.virtual.population:drawn_patient", bad, 1, address))


def test_a_cluster_that_does_not_answer_is_bad_input(monkeypatch):
    """Nothing listens there."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("cmfsim.processes.parallel.ANSWER_TIME", 1.0)
    with pytest.raises(CaseInputError, match="no Dask scheduler answers at"):
        list(answers("os:getpid", [{}], 1, "tcp://127.0.0.1:9"))


@pytest.mark.skipif(os.name == "nt", reason="looks for processes as Unix shows them")
def test_no_process_outlives_a_killed_command(tmp_path):
    """Killed without warning in the middle of a job; the script has no guard, as users write it."""
    told = tmp_path / "pids"
    job = {"args": ["sh", "-c", f"echo $PPID $$ > {told}.new; mv {told}.new {told}; sleep 30"]}
    script = tmp_path / "script.py"
    script.write_text(
        "from cmfsim.processes.parallel import answers\n"
        f"list(answers('subprocess:call', [{job!r}], 1))\n"
    )
    command = subprocess.Popen([sys.executable, str(script)])
    assert soon(told.exists)
    worker, job_process = map(int, told.read_text().split())
    assert is_there(worker)
    command.kill()
    command.wait()
    try:
        assert soon(lambda: not is_there(worker))
    finally:
        os.kill(job_process, signal.SIGKILL)


def soon(happened):
    """Whether something happens within twenty seconds."""
    for _ in range(200):
        if happened():
            return True
        time.sleep(0.1)
    return False


def is_there(pid):
    """Whether there is a process of this number."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
