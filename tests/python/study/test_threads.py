"""A case of a study gets the threads that it may use, and no library takes more."""

from cmfsim.study.cohort import CaseJob, run_job


class Recorder:
    """Stands for the processes of a study."""

    def run(self, command, environment, log):
        """Notes the environment, and fails."""
        del command, log
        self.environment = environment
        return 1


def test_a_case_has_the_threads_of_its_job_in_the_core_and_in_numpy(tmp_path):
    recorder = Recorder()
    job = CaseJob("one", str(tmp_path / "case.toml"), str(tmp_path / "out"), ("H",), threads=3)
    assert run_job(job, recorder).status == "failed"
    assert recorder.environment["RAYON_NUM_THREADS"] == "3"
    assert recorder.environment["OPENBLAS_NUM_THREADS"] == "3"
