"""Pictures that need no solution are begun before it, once, and show what they would after it."""

from concurrent.futures import Future

import pytest

import cmfsim
from cmfsim.pipeline.outputs.results import _Drawing
from cmfsim.solving.models import planned_motions
from head_case import HeadCase

pytest.importorskip("meshio")
pytest.importorskip("scipy")


class Painter:
    """Keeps what it is asked to draw."""

    def __init__(self):
        self.begun = []

    def begin(self, picture, path):
        """Notes a picture."""
        self.begun.append((path.parent.name, path.name, picture))
        return Future()


def test_the_plan_is_drawn_before_its_solution_and_once(tmp_path):
    head = HeadCase(rounds=2)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 16.0")
    told, painter = [], Painter()
    drawing = _Drawing(painter, tmp_path, ["H", "H+S"], lambda _: True)

    def built(patient):
        told.append(patient)
        drawing.begin_planned(patient)

    case = cmfsim.Case.load(head.write(tmp_path))
    first, second = cmfsim.predict_models(case, ["H", "H+S"], check=False, on_built=built)
    early = {name for _, name, _ in painter.begun}
    assert "plan.png" in early
    assert early <= {"plan.png", "contacts.png"}
    assert {folder for folder, _, _ in painter.begun} == {"H"}
    for prediction in (first, second):
        assert prediction.patient is told[0]
        motions = planned_motions(told[0], told[0].scene)
        assert prediction.summary["plan"] == motions
        assert {"plan.png", "prediction.png", "lateral.png"} <= set(drawing.begin(prediction))
    drawn = [(folder, name) for folder, name, _ in painter.begun]
    assert len(drawn) == len(set(drawn)) == 2 * (len(early) + 2)
