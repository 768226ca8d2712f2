"""The page for the chart: nothing overlaps and nothing is cut, however much there is to state."""

import io
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
import dicom_series
import phantom_case
import shared_values
from cmfsim.cli import main
from cmfsim.io.images.dicom_series import write_dicom_pdf
from cmfsim.pipeline.building.inputs import input_hash
from cmfsim.report.chart_page import A4, SITES, draw_chart_page

matplotlib = pytest.importorskip("matplotlib")
agg = pytest.importorskip("matplotlib.backends.backend_agg")
figures = pytest.importorskip("matplotlib.figure")
image = pytest.importorskip("matplotlib.image")

# Texts may touch by this, points: the box of a line includes room for accents and descenders.
TOUCH = 1.5


def png(height, width):
    file = io.BytesIO()
    image.imsave(file, [[0.5] * width] * height, format="png")
    return file.getvalue()


def measure(number, absent):
    value = None if absent else -123.4
    return {
        "label": f"A measure with a rather long name {number}"
        if number
        else "Mandibular plane to FH",
        "unit": "mm",
        "norm": "men −1.2 ± 1.9, women −0.1 ± 1.8",
        "source": "Author 1953",
        "before": value,
        "planned": value,
        "absent": "S, Po: not given or found" if absent else "",
    }


def full(many):
    """A summary with as much as there can be, or with next to nothing."""
    words = f"12.3 mm forwards, 4.5 mm up {'at the upper incisors ' * 4}; pitch +2.0°"
    clinical = {"text": words, "source": "$x^2_{ " + "a long source " * 5}
    entry = {
        "case": "$\\frac{a}{ patient " + "with a long name " * (12 if many else 0),
        "model": "M+S",
        "skin": {"largest": 12.3},
        "versions": {"cmfsim": "0.1.0", **({f"library{i}": "1.2.3" for i in range(30 * many)})},
        "case_key": "0" * 64,
        "patient": "$4711$ " * (1 + 30 * many),
        "written_at": "2026-11-28 13:30 +0100",
        "inputs": {f"folder/a_file_{i}.nii.gz": "f" * 64 for i in range(40 * many)},
        "plan": {f"segment_{i}": {"clinical": clinical} for i in range(1 + 12 * many)},
    }
    if not many:
        return entry
    region = dict.fromkeys(("half_width_mean_mm", "half_width_p95_mm", "half_width_largest_mm"), 1)
    regions = {f"a region of the face {i}": region for i in range(20)}
    shift = {"forwards_mm": -12.3, "up_mm": 4.5, "left_mm": 0.5}
    sites = [{"name": name, "moves_with": "maxilla", **shift} for name in SITES]
    return entry | {
        "plan_digits": "12345678",
        "band": {"state": "uncalibrated", "coverage": 0.9, "regions": regions},
        "clinical": {
            "cephalometry": [measure(i, i % 8 == 7) for i in range(19)],
            "face": [measure(i, absent=False) for i in range(14)],
            "sites": sites,
        },
    }


@pytest.fixture
def unhinted():
    """Letters that are not moved to whole pixels, as in a PDF."""
    with matplotlib.rc_context({"text.hinting": "none"}):
        yield


@pytest.mark.usefixtures("unhinted")
@pytest.mark.parametrize(("many", "drawn"), [(False, False), (False, True), (True, True)])
def test_texts_stay_on_the_page_and_apart(many, drawn):
    codes = ("of-doctor", "of-solving", "of-lips", "of-bones", "of-teeth") * 3
    findings = [
        cmfsim.Finding(f"{code}-{i}", "something $is$ wrong " * 9, severity="warning")
        for i, code in enumerate(codes[: len(codes) * many])
    ]
    figure = figures.Figure(figsize=A4, dpi=360)
    renderer = agg.FigureCanvasAgg(figure).get_renderer()
    pictures = {"prediction": png(1240, 1650), "lateral": png(700, 1400)} if drawn else {}
    pictures |= {"plan": png(800, 1600)} if drawn else {}
    draw_chart_page(figure, full(many), pictures, findings)
    scale = 72.0 / figure.dpi
    page, *shown = figure.axes
    boxes = [text.get_window_extent(renderer) for text in page.texts]
    boxes += [axes.get_window_extent() for axes in shown]
    assert len(shown) == 3 * drawn
    width, height = (72.0 * size for size in A4)
    for box in boxes:
        assert scale * box.x0 >= 35.0
        assert scale * box.x1 <= width - 35.0
        assert scale * box.y0 >= 30.0
        assert scale * box.y1 <= height - 30.0
    for one, other in itertools.combinations(boxes, 2):
        across = min(one.x1, other.x1) - max(one.x0, other.x0)
        along = min(one.y1, other.y1) - max(one.y0, other.y0)
        assert scale * min(across, along) <= TOUCH
    texts = [text.get_text() for text in page.texts]
    assert any("not a medical device" in text for text in texts)
    assert any("0" * 64 in text for text in texts)
    assert any("2026-11-28 13:30 +0100. Patient: $4711$" in text for text in texts)
    # A label that is a little too wide is shrunk, not shortened.
    assert ("Mandibular plane to FH, mm" in texts) == many
    assert ("… more in report.html" in texts) == many


@pytest.mark.parametrize("code", ["landmarks-proposed", "landmarks-filled"])
def test_the_page_states_that_nobody_placed_the_points_it_measures(code):
    found = "46 landmarks were found; expected error 2.9 mm"
    figure = figures.Figure(A4)
    findings = [
        cmfsim.Finding(code, found),
        cmfsim.Finding("rest-removed", "a note of another kind"),
        cmfsim.Finding("ct-noise", "a warning", severity="warning"),
    ]
    draw_chart_page(figure, full(many=False), {}, findings)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert [t for t in texts if t.startswith(("note:", "warning:"))] == [
        f"note: {found}",
        "warning: a warning",
    ]


def test_the_command_writes_the_page_beside_the_report(case_results, capsys):
    assert main(["report", str(case_results), "--pdf"]) == 0
    assert "report.pdf" in capsys.readouterr().out
    written = (case_results / "report.pdf").read_bytes()
    assert written.startswith(b"%PDF")
    assert written.count(b"/Type /Page\n") + written.count(b"/Type /Page ") == 1
    assert main(["report", str(case_results), "--pdf"]) == 0
    assert (case_results / "report.pdf").read_bytes() == written


def test_a_case_that_was_changed_gets_no_report_of_its_earlier_plan(
    case_results, tmp_path, tmp_path_factory, capsys, caplog
):
    case = phantom_case.surface_case(
        tmp_path, cmfsim.make_head(), shared_values.drawn_levels(tmp_path_factory, 2.0)
    )
    inputs = {name: input_hash(case.parent / name) for name in (case.name, "cranium.ply")}
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    summary = {**patient.summary, "inputs": inputs}
    prediction = cmfsim.predict_patient(replace(patient, summary=summary), "H")
    cmfsim.write_prediction(case_results, prediction)
    assert main(["report", str(case.parent), "--pdf"]) == 0
    bone = (case.parent / "cranium.ply").read_bytes()
    (case.parent / "cranium.ply").write_bytes(bone + b" ")
    assert main(["report", str(case.parent)]) == 2
    assert "another cranium.ply" in capsys.readouterr().err
    (case.parent / "cranium.ply").write_bytes(bone)
    case.write_text(case.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert main(["report", str(case.parent), "--pdf"]) == 2
    assert main(["view", str(case.parent), "--screenshot", str(tmp_path / "a.png")]) == 2
    assert capsys.readouterr().err.count("report-older") == 2
    # Whoever names the results means them; a line says that the case has gone on.
    assert main(["report", str(case_results)]) == 0
    assert "or of this one as it was" in caplog.text


@pytest.fixture
def case_results(tmp_path, tmp_path_factory):
    """The folder of a coarse prediction, without pictures."""
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    cmfsim.write_prediction(tmp_path / "out", cmfsim.predict_patient(patient, "H"))
    return tmp_path / "out"


@pytest.fixture
def ct_results(tmp_path, tmp_path_factory):
    """Results as of a case whose image is a folder of DICOM, and that folder."""
    pytest.importorskip("pydicom")
    folder = tmp_path / "ct"
    image = cmfsim.ImageData(np.zeros((4, 4, 3), dtype=np.int16), [1.0] * 3, [0.0] * 3)
    slices = [one.with_tags(t0010_0010="Smith^Ada") for one in dicom_series.axial(image)]
    dicom_series.write_series(folder, slices)
    patient = shared_values.coarse_demo_patient(tmp_path_factory)
    summary = {**patient.summary, "inputs": {"ct": input_hash(folder)}}
    prediction = cmfsim.predict_patient(replace(patient, summary=summary), "H")
    cmfsim.write_prediction(tmp_path / "out", prediction)
    return tmp_path / "out", folder


def test_the_page_as_dicom_is_filed_in_the_study_of_its_ct(ct_results, capsys):
    results, ct = ct_results
    assert main(["report", str(results), "--dicom", str(ct)]) == 0
    assert "report.dcm" in capsys.readouterr().out
    pydicom = pytest.importorskip("pydicom")
    page, one = (pydicom.dcmread(f) for f in (results / "report.dcm", next(ct.iterdir())))
    assert page.file_meta.MediaStorageSOPClassUID.name == "Encapsulated PDF Storage"
    for name in ("PatientName", "PatientID", "StudyInstanceUID"):
        assert page[name].value == one[name].value
    assert page.SeriesInstanceUID != one.SeriesInstanceUID
    assert page.SOPInstanceUID == page.file_meta.MediaStorageSOPInstanceUID
    pdf = page.EncapsulatedDocument[: page.EncapsulatedDocumentLength]
    assert pdf == (results / "report.pdf").read_bytes()


def test_the_page_is_filed_under_no_other_patient(ct_results, capsys):
    results, ct = ct_results
    image = cmfsim.ImageData(np.ones((4, 4, 3), dtype=np.int16), [1.0] * 3, [0.0] * 3)
    other = results.parent / "other"
    dicom_series.write_series(other, dicom_series.axial(image), study="1.9")
    assert main(["report", str(results), "--dicom", str(other), "--json"]) == 2
    assert "dicom-other-ct" in json.loads(capsys.readouterr().out)["error"]["text"]
    # Two studies in one folder, which is that of the case.
    names = [f"other{k}.dcm" for k in range(3)]
    dicom_series.write_series(ct, dicom_series.axial(image), uid="1.9.1", names=names, study="1.9")
    with pytest.raises(cmfsim.ImageError, match="2 patients and studies"):
        write_dicom_pdf(results / "report.dcm", b"%PDF", ct, "page")
    assert not (results / "report.dcm").exists()
