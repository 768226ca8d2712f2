"""A case of a study gets the threads that it may use, and no library takes more."""

from cmfsim.processes.worker import Worker
from cmfsim.study.cohort import CaseJob, run_job


def test_a_case_has_the_threads_of_its_job_in_the_core_and_in_numpy(tmp_path):
    found = []

    def start(**options):
        worker = Worker(**options)
        keys = ("RAYON_NUM_THREADS", "OPENBLAS_NUM_THREADS")
        found.extend(worker.ask("os:getenv", {"key": key}).values for key in keys)
        return worker

    job = CaseJob("one", str(tmp_path / "case.toml"), str(tmp_path / "out"), ("H",), threads=3)
    assert run_job(job, start).status == "failed"
    assert found == ["3", "3"]
