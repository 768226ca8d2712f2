"""How much of a work is done, from the names of its stages alone."""

from pathlib import Path

import pytest

import cmfsim
from cmfsim.values import progress
from cmfsim.values.progress import (
    AFTER,
    BUILDING,
    PLANNING,
    TimeLeft,
    expected_stages,
    no_progress,
    shown_progress,
)

TWO = {"cutting the bones": 3.0, "assembling the scene": 2.0}


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test sets."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def test_a_stage_that_takes_its_typical_time_leaves_that_of_the_others(clock):
    left = TimeLeft(TWO)
    first, second = TWO.values()
    left.begin("cutting the bones")
    assert left.estimate()[0] == 0.0
    assert left.estimate()[1] == pytest.approx(first + second)
    clock[0] = first
    left.begin("assembling the scene")
    assert left.estimate()[1] == pytest.approx(second)
    assert left.estimate()[0] == pytest.approx(first / (first + second))


def test_a_slow_machine_is_expected_to_stay_slow(clock):
    left = TimeLeft(TWO)
    left.begin("cutting the bones")
    clock[0] = 10.0 * TWO["cutting the bones"]
    left.begin("assembling the scene")
    assert left.estimate()[1] > 2.0 * TWO["assembling the scene"]


def test_stages_that_are_skipped_take_no_time(clock):
    left = TimeLeft(expected_stages("solving H"))
    clock[0] = 1.0
    left.begin("solving H")
    assert left.estimate()[1] < 2.0 * AFTER


def test_counted_steps_show_how_long_their_stage_takes(clock):
    """After 40 of 100 steps in 20 s, 30 s are left, whatever is typical."""
    left = TimeLeft({"solving a nearby plan exactly": 8.0})
    left.begin("solving a nearby plan exactly (1 of 100)")
    clock[0] = 20.0
    left.begin("solving a nearby plan exactly (41 of 100)")
    assert left.estimate()[1] == pytest.approx(30.0, abs=3.0)
    assert left.estimate()[0] == pytest.approx(0.4, abs=0.04)


def test_a_stage_that_takes_ever_longer_does_not_end_the_work(clock):
    left = TimeLeft(TWO)
    left.begin("cutting the bones")
    left.begin("a stage that nobody expects")
    clock[0] = 1000.0
    assert 0.5 < left.estimate()[0] < 1.0
    assert left.estimate()[1] > 10.0


def test_a_function_is_called_and_nothing_shows_nothing():
    def listen(stage):
        del stage

    for given, called in ((listen, listen), (None, no_progress), (False, no_progress)):
        with shown_progress(given, {}) as found:
            assert found is called


def test_true_shows_a_bar_that_ends_full(capsys):
    pytest.importorskip("tqdm")
    with shown_progress(progress=True, expected=expected_stages("solving H")) as shown:
        shown("cutting the bones")
        shown("solving H")
    text = capsys.readouterr().err
    assert "solving H" in text
    assert "100 %" in text


@pytest.mark.parametrize("stage", [*BUILDING, *PLANNING])
def test_every_typical_time_is_of_a_stage(stage):
    """A stage that is renamed would count as one that takes a second."""
    files = Path(cmfsim.__file__).parent.rglob("*.py")
    texts = [path.read_text(encoding="utf-8") for path in files if path.name != "progress.py"]
    assert any(f'"{stage}' in text for text in texts)
