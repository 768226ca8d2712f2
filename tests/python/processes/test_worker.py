"""One process that calls functions: its log, its time, and how its errors travel."""

import pickle

import pytest

from cmfsim.errors import CaseError
from cmfsim.processes.worker import SILENT, Worker, WorkerEndedError, WorkerFailedError


def test_what_a_function_prints_is_in_the_log_once_it_has_answered(tmp_path):
    with (tmp_path / "log.txt").open("xb") as log, Worker(log=log) as worker:
        assert worker.ask("builtins:print", {"end": "no answer"}).values is None
        assert (tmp_path / "log.txt").read_text() == "no answer"


def test_a_function_that_takes_too_long_is_ended_as_late():
    """Also one that computes: the time is that of the clock. Nothing answers afterwards."""
    with Worker(log=SILENT) as worker:
        with pytest.raises(WorkerEndedError) as ended:
            worker.ask("child_tasks:spin", {}, seconds=1.0)
        assert ended.value.late
        with pytest.raises(WorkerEndedError):
            worker.ask("os:getpid", {})


def test_errors_outlive_a_journey_to_another_machine():
    """A cluster pickles them."""
    for error in (WorkerEndedError(-9), WorkerFailedError(["KeyError"], "'a'", "Traceback …")):
        twin = pickle.loads(pickle.dumps(error))
        assert isinstance(twin, CaseError)
        assert str(twin) == str(error)


def test_what_cannot_be_written_as_json_is_an_error_and_the_process_goes_on():
    with Worker() as worker:
        with pytest.raises(WorkerFailedError, match="not JSON serializable"):
            worker.ask("builtins:set", {})
        assert worker.ask("builtins:int", {}).values == 0
