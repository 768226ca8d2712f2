"""`cmfsim splint` and `make_splint` on a case of a synthetic head's surfaces."""

import json
from importlib import import_module

import pytest

import cmfsim
import phantom_case
import shared_values
from cmfsim.cli import main
from cmfsim.values.motion import plan_digits

# Degrees that make room in the closed bite of the synthetic head, as its refusal advises.
OPENING = 4.0


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("splint")
    levels = shared_values.drawn_levels(tmp_path_factory, 2.0)
    return phantom_case.surface_case(folder, cmfsim.make_head(), levels)


def test_the_command_writes_a_splint_and_its_figures(case, capsys, monkeypatch):
    # Voxels of 0.5 mm: how well teeth seat in those of 0.3 mm is measured by test_splint.py.
    monkeypatch.setattr(import_module("cmfsim.planning.occlusion.splint"), "SPACING", 0.5)
    words = ["splint", str(case), "--intermediate", "--open", str(OPENING), "--json", "-q"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["splint"] == "intermediate"
    digits = plan_digits(
        {
            "maxilla": cmfsim.rigid_motion((0, -4, 0)),
            "mandible_body": cmfsim.rigid_motion((0, 3, 0)),
        }
    )
    assert (found["first"], found["plan_digits"]) == ("maxilla", digits)
    assert found["file"].endswith(f"splint-intermediate-maxilla-{digits}.stl")
    assert found["opening_degrees"] == OPENING
    assert found["thickness_mm"] >= 2.0
    assert found["seat_mm"] <= 0.1
    written = cmfsim.read_surface(found["file"])
    assert len(written.triangles) > 10_000


def test_a_closed_bite_ends_with_the_opening_that_makes_room(case, capsys):
    assert main(["splint", str(case), "--json", "-q", "--no-doctor"]) == 2
    text = json.loads(capsys.readouterr().out)["error"]["text"]
    assert "splint-bite-closed" in text or "splint-rows-overlap" in text
    assert not [*(case.parent / "out").glob("splint-final*")]


def test_a_splint_of_a_plan_for_another_head_is_warned_of(case, capsys):
    plan = case.with_name("strange.toml")
    cmfsim.write_plan(plan, {"maxilla": cmfsim.rigid_motion((0, -4, 0))}, made_for="0" * 64)
    words = ["splint", str(case), "--intermediate", "mandible", "--plan", str(plan), "-q"]
    assert main([*words, "--no-doctor"]) == 2
    printed = capsys.readouterr().err
    assert "splint-not-moved" in printed
    assert "the plan was made for another case" in printed


def test_a_jaw_that_stays_needs_no_splint(case, tmp_path_factory):
    text = case.read_text(encoding="utf-8").split("[plan.mandible_body]")[0]
    other = case.with_name("maxilla.toml")
    other.write_text(text, encoding="utf-8")
    anatomy = shared_values.drawn_levels(tmp_path_factory, 2.0)
    with pytest.raises(cmfsim.CaseError, match=r"does not move mandible_body \(splint-not-moved\)"):
        cmfsim.make_splint(other, intermediate="mandible", anatomy=anatomy, check=False)
    with pytest.raises(cmfsim.CaseError, match="intermediate is 'chin'"):
        cmfsim.make_splint(other, intermediate="chin")


def test_a_splint_replaces_no_input(case, capsys):
    given = case.parent / "cranium.ply"
    before = given.read_bytes()
    assert main(["splint", str(case), "-o", str(given), "--json", "-q"]) == 2
    assert "cranium.ply" in json.loads(capsys.readouterr().out)["error"]["text"]
    assert given.read_bytes() == before
