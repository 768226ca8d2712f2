"""The case file as the desk changes it: only what was asked for, comments kept, or nothing."""

import numpy as np
import pytest

import cmfsim
from cmfsim.desk.case_text import (
    answered,
    open_questions,
    read_as,
    with_keys,
    with_plan,
    with_tables,
)
from cmfsim.io.files.reading_writing import toml_module

CASE = """# Mine.
format = "cmfsim-case"
version = 1

[image]
file = "ct.nrrd"  # of Tuesday

[landmarks]  # there is no file of landmarks
automatic = true
# a note on landmarks

[[osteotomies]]
procedure = "le_fort_1"
height = 4.0

[[osteotomies]]
bone = "mandible"
name = "chin"

[osteotomies.plane]
point = [0, 0, 0]
normal = [0, 0, -1]

[plan.maxilla]
# It moves 5 mm forwards.
# agreed with the orthodontist
translation = [
  0, -5,
  0,
]

[plan."odd name"]
translation = [0, 1, 0]

# of the mesh
[mesh]
edge_length = 9.0
"""
MOTION = cmfsim.rigid_motion((0.1, -4, 1), 3, (1, 0, 0), (3, -100, 1450))


def loads(text):
    return toml_module().loads(text)


def test_a_plan_takes_the_place_of_another_and_everything_else_stays():
    new = with_plan(CASE, {"maxilla"}.__contains__, {"maxilla": MOTION}, "here")
    before, after = loads(CASE), loads(new)
    assert after["plan"].pop("maxilla") == {"frame": "LPS", "matrix": MOTION.tolist()}
    assert before["plan"].pop("maxilla")
    assert after == before
    kept = [row for row in CASE.split("\n") if row.startswith("#") and "It moves" not in row]
    assert [row for row in new.split("\n") if row.startswith("#")] == kept
    assert new.index("[plan.maxilla]") < new.index('[plan."odd name"]') < new.index("[mesh]")
    # Once more: the text is then the same, byte for byte.
    assert with_plan(new, {"maxilla"}.__contains__, {"maxilla": MOTION}, "here") == new


def test_tables_are_added_at_the_end_where_there_were_none():
    text = (
        'format = "cmfsim-case"\n\n# No plan was found. To move a segment, state how.\n# [plan.x]\n'
    )
    new = with_plan(text, bool, {"maxilla": np.eye(4)}, "here")
    assert loads(new)["plan"] == {"maxilla": {"frame": "LPS", "matrix": np.eye(4).tolist()}}
    assert "No plan was found" not in new


def test_keys_of_a_table_are_set_and_the_others_stay():
    new = with_keys(CASE, "landmarks", {"skull": '"a.mrk.json"', "automatic": '"missing"'})
    assert loads(new)["landmarks"] == {"skull": "a.mrk.json", "automatic": "missing"}
    assert "# a note on landmarks" in new
    assert {**loads(new), "landmarks": 0} == {**loads(CASE), "landmarks": 0}
    bare = with_keys('name = "x"\n', "landmarks", {"automatic": "true"})
    assert loads(bare) == {"name": "x", "landmarks": {"automatic": True}}


@pytest.mark.parametrize(
    "plan", ['plan = "achieved"\n', "plan = { maxilla = { translation = [0, 1, 0] } }\n"]
)
def test_a_plan_in_another_form_is_refused_and_nothing_lost(tmp_path, plan):
    text = plan + CASE.partition("[plan.maxilla]")[0]
    new = with_plan(text, bool, {"maxilla": MOTION}, "here")
    with pytest.raises(cmfsim.CaseError, match=r"cannot change .* as `cmfsim init` does"):
        read_as(new, tmp_path / "case.toml", ("plan",), text)


def test_a_change_of_another_table_is_refused(tmp_path):
    new = with_tables(CASE, lambda path, _: path == ("mesh",), {})
    with pytest.raises(cmfsim.CaseError, match="mesh would change"):
        read_as(new, tmp_path / "case.toml", ("plan",), CASE)


QUESTIONS = """[image]
file = "?"  # a.nrrd or b: which one is before the operation?
#   "a.nrrd": CT, values 0 to 10
#   "b" with series = "1.2.3" on a line of its own: CT, values 0 to 20
rescale = "?"  # values are 0 to 4000. How do they become HU?
#   [1, -1024], if 1024 was added to HU, as this range suggests
#   [slope, intercept] of the program that wrote it; or remove the line: they are HU
[plan.maxilla]
transform = { file = "m.h5", direction = "?" }  # which way?
#   "to-parent": the motion itself
"""


def test_questions_have_their_choices_and_answers_are_written_in_place():
    image, rescale, way = open_questions(QUESTIONS)
    assert [c["toml"] for c in image["choices"]] == ['"a.nrrd"', '"b"\nseries = "1.2.3"']
    assert [c["toml"] for c in rescale["choices"]] == ["[1, -1024]", ""]
    text = answered(QUESTIONS, way["line"], '"to-parent"')
    text = answered(text, rescale["line"], "")
    text = answered(text, image["line"], image["choices"][1]["toml"])
    assert loads(text) == {
        "image": {"file": "b", "series": "1.2.3"},
        "plan": {"maxilla": {"transform": {"file": "m.h5", "direction": "to-parent"}}},
    }
    assert open_questions(text) == []
    assert loads(answered(QUESTIONS, rescale["line"], "[2, -5.5]"))["image"]["rescale"] == [2, -5.5]


@pytest.mark.parametrize(
    "toml", ["nonsense", '"?"', "1\n[mesh]", "1 # x\n[mesh]", "1\nfile = 2", '"a']
)
def test_an_answer_that_is_not_one_value_is_refused(toml):
    line = open_questions(QUESTIONS)[1]["line"]
    with pytest.raises(cmfsim.CaseError, match="no value"):
        answered(QUESTIONS, line, toml)
    with pytest.raises(cmfsim.CaseError, match="no longer open"):
        answered(QUESTIONS, line + 1, "1")
