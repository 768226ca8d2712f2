"""What every test starts from."""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A shell that runs the suite in the background has it ignore Ctrl-C, which some tests send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The suite runs a process per core, and NumPy's products here are of thin matrices: threads of BLAS
# in every process wait for one another a hundred times as long as such a product takes. NumPy reads
# this when it is imported, which no plugin has done yet; commands that tests start inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The processes of xdist share the cores: threads of the core, of ITK and of Mesa's software
# renderer for every core in every process would wait for one another as well. No result depends on
# their number; the tests of that set it themselves.
if processes := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
    threads = str(max(1, (os.cpu_count() or 1) // processes))
    for name in ("RAYON_NUM_THREADS", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS", "LP_NUM_THREADS"):
        os.environ.setdefault(name, threads)

# A commit passes or fails whenever it is run: hypothesis draws the same examples every time, unless
# CMFSIM_TEST_RANDOM=1 asks for new ones.
settings.register_profile(
    "cmfsim",
    deadline=None,
    derandomize=os.environ.get("CMFSIM_TEST_RANDOM") != "1",
    max_examples=40,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("cmfsim")

# The files that take longest, first: a process that meets one of them last works on it alone, while
# the others have nothing left to do. `make test` keeps this order (--no-loadscope-reorder).
LONGEST = (
    "planning/occlusion/test_splint.py",
    "project/test_examples.py",
    "planning/occlusion/test_final_bite.py",
    "lab/virtual/test_demo.py",
    "registration/test_jaw_evidence.py",
    "desk/test_desk_page.py",
    "bones/test_motion_by_shape.py",
    "pipeline/test_prediction.py",
    "pipeline/test_hard_heads.py",
    "registration/test_proposed.py",
    "desk/test_desk_work.py",
    "pipeline/test_case_lips.py",
    "cli/test_crash_safety.py",
    "lab/virtual/test_population.py",
    "pipeline/building/test_build.py",
    "solving/test_contact_plans.py",
    "study/test_variants.py",
    "bones/test_achieved.py",
    "study/test_study_outputs.py",
    "bones/test_coherent_motion.py",
    "imaging/test_real_ct.py",
    "imaging/test_plates.py",
    "pipeline/test_banding.py",
    "core/test_extreme.py",
    "imaging/test_imaging.py",
    "cli/test_splint_command.py",
    "pipeline/test_achieved_case.py",
    "lab/virtual/test_virtual_patients.py",
    "project/test_tutorials.py",
    "project/test_documented_code.py",
    "planning/page/test_planning_page.py",
    "phantom/test_phantom.py",
    "pipeline/building/test_build_outputs.py",
    "doctor/test_landmark_places.py",
    "planning/page/test_planning_model.py",
    "meshing/lips/test_seam.py",
    "doctor/test_doctor.py",
    "lab/benchmark/test_benchmark.py",
    "cli/test_landmarks_command.py",
    "muscles/test_morphing.py",
    "bones/test_planned_surfaces.py",
    "pipeline/test_turned_image.py",
    "pipeline/outputs/test_stale_results.py",
    "imaging/test_alignment.py",
    "drafting/test_init_ledger.py",
    "bones/test_segment_checks.py",
    "processes/test_parallel.py",
)


def pytest_sessionstart():
    """Arrays reuse the memory of earlier ones, as in a command: their pages need not be cleared."""
    # It loads NumPy, whose threads are set above.
    from cmfsim.processes.memory import keep_freed_memory  # noqa: PLC0415

    keep_freed_memory()


# Collecting makes millions of objects and no garbage; looking for some took a third of its time.
gc.disable()


def pytest_collection_finish():
    """What was collected stays to the end, and is not looked at again."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items):
    """Puts the longest files first; each file keeps its order."""
    here = Path(__file__).parent
    rank = {here / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(item.path, len(rank)))


@pytest.fixture(scope="module", autouse=True)
def _remembered(request, tmp_path_factory):
    """Equal heads are drawn, read and searched once in a run, but where tests are about that."""
    # It loads NumPy, whose threads are set above.
    from shared_values import keep_muscles, remember  # noqa: PLC0415

    about = request.path.parent.name
    with pytest.MonkeyPatch.context() as patch:
        if about not in ("registration", "building", "surfaces", "meshing", "phantom"):
            remember(patch, tmp_path_factory)
        if about != "muscles":
            keep_muscles(patch)
        yield
