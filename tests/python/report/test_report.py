"""A report is one page with everything inside, and no name of a stranger's becomes markup."""

from dataclasses import asdict

import pytest

import cmfsim
from benches.scenes import meshes
from cmfsim.report.clinical import clinical_sections
from cmfsim.report.document import Document, Figure, Note, Section
from cmfsim.report.page import MESH, MUSCLES, labelled, render_page
from cmfsim.values.table import Table, number

pytest.importorskip("jinja2")

PNG = b"\x89PNG\r\n\x1a\n"


def test_text_is_escaped_everywhere():
    evil = "<img src=x onerror=alert(1)>"
    page = render_page(
        Document(
            evil,
            evil,
            {evil: evil},
            [
                Section(evil, (Note(evil), Table((evil, evil), ((evil, evil),), evil))),
                Section("figures", (Figure(PNG, evil), Figure(f"<svg>{evil}</svg>", evil))),
            ],
            evil,
        )
    )
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x") >= 10
    assert page.count("data:image/png;base64,") == 1
    assert page.count("data:image/svg+xml;base64,") == 1


def test_a_page_needs_nothing_beside_it():
    page = render_page(Document("title", "subtitle"))
    assert "default-src 'none'" in page
    assert "<script" not in page
    assert "<link" not in page
    assert "not a medical device" in page


def test_rows_fit_their_head():
    with pytest.raises(cmfsim.CaseError, match="row 1 of a table has 1 cells"):
        Table(("a", "b"), (("1", "2"), ("3",)))


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.0, "0.00"),
        (1.234, "1.23"),
        (3e-9, "3.0e-09"),
        (-1e-5, "-1.0e-05"),
        ("a", "a"),
    ],
)
def test_numbers_never_pass_for_zero(value, text):
    assert number(value) == text


def test_figures_of_mesh_and_muscles_have_labels_and_units():
    """Every number of both summaries is called by a name, and mm³ become cm³."""
    nodes, tets = meshes.box((3, 3, 3), (30.0, 30.0, 30.0))
    mesh = cmfsim.TetMesh(nodes, tets)
    found = labelled(cmfsim.mesh_report(mesh).as_dict(), MESH)
    assert found["volume, cm³"] == pytest.approx(27.0)
    assert found["nodes"] == 64
    ball = cmfsim.SurfaceData(*meshes.icosphere(2, 10.0))
    muscle = cmfsim.MuscleSurface("masseter", "L", ball)
    used = {**asdict(cmfsim.CaseMuscles()), **cmfsim.equivalent_material(mesh, [muscle]).summary}
    shown = labelled(used, MUSCLES)
    assert shown["points in each of these"] == 64
    assert not [label for label in (*found, *shown) if "_" in label]
    assert {k for k, v in used.items() if isinstance(v, str | int | float)} <= set(MUSCLES)
    assert labelled({"new_figure": 1.5}, MUSCLES) == {"new figure": 1.5}


def measure(label, before, planned, absent=""):
    return {
        "label": label,
        "unit": "°",
        "norm": "2",
        "source": "Steiner 1953",
        "before": before,
        "planned": planned,
        "absent": absent,
    }


def site(name, forwards, moves_with="maxilla"):
    return {
        "name": name,
        "moves_with": moves_with,
        "forwards_mm": forwards,
        "up_mm": 0.0,
        "left_mm": -0.01,
    }


CLINICAL = {
    "cephalometry": [measure("ANB", -1.04, 2.46), measure("SNA", None, None, "S: not given")],
    "face": [],
    "sites": [site("pogonion", -3.5), site("nasion", 0.0)],
}


def test_measures_and_landmarks_are_shown_before_planned_and_changed():
    measures, landmarks = clinical_sections({"clinical": CLINICAL})
    assert measures.blocks[0].rows == (
        ("ANB,\N{NO-BREAK SPACE}°", "−1.0", "2.5", "+3.5", "2", "Steiner 1953"),
    )
    assert measures.blocks[1].text == "Not available: SNA, ° (S: not given)."
    assert landmarks.blocks[0].rows == (("pogonion", "maxilla", "−3.5", "0.0", "0.0", "3.5"),)
    assert landmarks.blocks[1].text == "Stay: nasion."
    assert clinical_sections({}) == []
