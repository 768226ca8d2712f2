"""The band around a prediction: what it adds up, what calibrates it, what is refused."""

import functools
import json
import re

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.io.results.predictions import read_prediction
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.pipeline import banding, predicting
from cmfsim.pipeline.outputs.results import _pictures_of, write_results
from cmfsim.surfaces.depth import tissue_depth
from shared_values import COARSE_EDGE, coarse_demo_patient, without_drawings


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_demo_case(tmp_path_factory.mktemp("band"), edge_length=COARSE_EDGE)


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    return coarse_demo_patient(tmp_path_factory)


@pytest.fixture(scope="module", autouse=True)
def solved_once():
    """One solution of the patient for all bands, which differ by what calibrates them.

    And no pictures but the one of the band itself, which test_a_band_is_drawn looks at.
    """
    with pytest.MonkeyPatch.context() as patch:
        without_drawings(patch)
        for name in ("solved_patient", "skin_rates"):
            patch.setattr(banding, name, functools.cache(getattr(banding, name)))
        yield


@pytest.fixture(scope="module")
def plain(patient):
    return cmfsim.predict_with_band(patient, "M+S")


def calibration_for(prediction, n=19, **changes):
    """Scores 1, 2, …, n of every region: the factor of 90 % of 19 is the 18th."""
    cases = tuple(
        cmfsim.CalibrationCase(
            f"P{i}", {name: float(i + 1) for name in prediction.band.regions}, f"g{i % 2}"
        )
        for i in range(n)
    )
    values = {
        "model": prediction.model,
        "settings": cmfsim.band_settings(prediction),
        "cases": cases,
        "note": "made up",
    }
    return cmfsim.Calibration(**{**values, **changes})


def test_a_band_changes_nothing_of_the_prediction(patient, plain):
    bare = cmfsim.predict_patient(patient, "M+S")
    np.testing.assert_array_equal(plain.skin_displacements, bare.skin_displacements)
    assert bare.band is None
    assert plain.summary["case_key"] == bare.summary["case_key"]


def test_the_standard_deviation_is_the_quadrature_of_its_parts(patient, plain):
    band = plain.band
    squares = sum(np.square(part) for part in band.parts.values())
    np.testing.assert_allclose(band.sd, np.sqrt(squares), rtol=1e-12)
    floor = np.sqrt(0.25**2 + 0.2**2 + 0.5**2)
    assert band.sd.min() >= floor
    depth = tissue_depth(patient.skin.vertices, [s.surface for s in patient.segments])
    assert depth.max() > 12.0
    depth = np.minimum(depth, 12.0)
    np.testing.assert_allclose(band.parts["thickness change"], 0.05 * depth)
    # The forehead is far from every bone that moves: what is added without a solve remains.
    far = np.linalg.norm(plain.skin_displacements, axis=1) < 1e-4
    assert far.any()
    added = np.sqrt(floor**2 + (0.05 * depth) ** 2)
    np.testing.assert_allclose(band.sd[far], added[far], atol=0.02)
    assert band.sd[band.regions["chin"]].mean() > 1.5 * added[band.regions["chin"]].mean()


def test_without_a_calibration_every_name_says_so(plain, tmp_path):
    band = plain.band
    assert not band.calibrated
    assert all(name.endswith("uncalibrated") for name in band.arrays())
    values = band.as_dict()
    assert values["state"] == "uncalibrated"
    assert values["calibration"] is None
    np.testing.assert_allclose(band.half_width, 1.6448536 * band.sd, rtol=1e-6)
    written = write_results(tmp_path, [plain], ["M+S"], stage=lambda _: None)
    vtp = (tmp_path / "prediction.vtp").read_bytes()
    for name in band.arrays():
        assert name.encode() in vtp
    assert read_prediction(tmp_path)["band"]["state"] == "uncalibrated"
    if written.report is not None:
        page = (tmp_path / written.report).read_text(encoding="utf-8")
        assert "How far to trust it (uncalibrated)" in page
        assert "UNCALIBRATED" in page


def test_a_band_is_drawn(patient, plain, tmp_path):
    pytest.importorskip("pyvista")
    path = tmp_path / "band.png"
    dict(_pictures_of(patient, {}, plain))[path.name](path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_calibrated_band_has_the_factor_of_its_region(patient, plain, tmp_path):
    found = calibration_for(plain)
    options = cmfsim.BandOptions(0.9, found, source="made.json")
    prediction = cmfsim.predict_with_band(patient, "M+S", options)
    band = prediction.band
    assert band.calibrated
    assert band.factors["chin"].factor == 18.0
    face = band.regions["face"]
    np.testing.assert_allclose(band.half_width[face], 18.0 * band.sd[face])
    assert np.ma.getmaskarray(band.half_width)[~face].all()
    assert not any("uncalibrated" in name for name in band.arrays())
    assert np.isnan(band.arrays()["band_half_width_90_percent_mm"][~face]).all()
    write_results(tmp_path, [prediction], ["M+S"], stage=lambda _: None)
    values = read_prediction(tmp_path)["band"]
    assert values["calibration"]["file"] == "made.json"
    assert values["regions"]["chin"]["calibration"]["n"] == 19
    assert json.dumps(values).count("uncalibrated") == 1  # the null factor of one
    one = cmfsim.BandOptions(0.8, found, group="g1", source="made.json")
    assert cmfsim.predict_with_band(patient, "M+S", one).band.factors["chin"].n == 9


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"model": "M"}, {}, "is for model M, but the prediction uses M\\+S"),
        ({"settings": {"contact": "unilateral"}}, {}, "contact is 'unilateral' there"),
        ({"coverage": 0.8}, {}, "is for a coverage of 0.8, but 0.9 was requested"),
        ({}, {"coverage": 0.97}, "at least 33 calibration cases, and there are 19"),
        ({}, {"group": "g7"}, "has no group 'g7'; it has: 'g0', 'g1'"),
        ({}, {"group": "g1", "coverage": 0.95}, "region face: .* at least 19"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(patient, plain, change, options, message):
    found = calibration_for(plain, **change)
    asked = {"coverage": 0.9, "calibration": found, **options}
    with pytest.raises(cmfsim.CalibrationError, match=message):
        cmfsim.predict_with_band(patient, "M+S", cmfsim.BandOptions(**asked))


def test_a_calibration_without_a_region_of_the_face_is_refused(patient, plain):
    cases = tuple(cmfsim.CalibrationCase(f"P{i}", {"face": 1.0}) for i in range(9))
    found = calibration_for(plain, cases=cases)
    with pytest.raises(cmfsim.CalibrationError, match="no score of nose, upper lip"):
        cmfsim.predict_with_band(patient, "M+S", cmfsim.BandOptions(0.9, found))


def test_the_case_file_asks_for_a_band(made):
    text = made.case.file.read_text(encoding="utf-8")
    path = made.case.file.with_name("banded.toml")
    path.write_text(f'{text}\n[band]\ncalibration = "c.json"\ncoverage = 0.8\n', encoding="utf-8")
    found = cmfsim.Case.load(path).band
    assert (found.asked, found.coverage) == (True, 0.8)
    assert found.calibration == made.case.file.parent / "c.json"
    path.write_text(f"{text}\n[band]\ncoverage = 90\n", encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"coverage.*90"):
        cmfsim.Case.load(path)
    assert not made.case.band.asked


def test_the_command_line_refuses_a_band_before_any_work(made, plain, tmp_path, capsys):
    case, path = str(made.case.file), tmp_path / "calibration.json"
    assert main(["predict", case, "--calibration", str(tmp_path / "none.json"), "-q"]) == 2
    assert "none.json" in capsys.readouterr().err
    assert main(["predict", case, "--coverage", "90", "-q"]) == 2
    assert "coverage is 90" in capsys.readouterr().err
    assert main(["predict", case, "--group", "bimaxillary", "-q"]) == 2
    assert "group is 'bimaxillary', but there is no calibration" in capsys.readouterr().err
    cmfsim.write_calibration(path, calibration_for(plain))
    assert main(["predict", case, "--calibration", str(path), "--model", "H", "-q"]) == 2
    assert "calibration is for model M+S" in capsys.readouterr().err
    assert not made.case.output.exists()


def test_the_command_line_states_a_band_and_what_it_is_worth(
    made, patient, plain, tmp_path, capsys, monkeypatch
):
    """On the patient that is built already."""
    monkeypatch.setattr(predicting, "build_patient", lambda *_: patient)
    path = tmp_path / "calibration.json"
    cmfsim.write_calibration(path, calibration_for(plain))
    output = tmp_path / "out"
    command = ["predict", str(made.case.file), "-o", str(output), "--no-report", "--no-doctor"]
    assert main([*command, "--calibration", str(path), "-q"]) == 0
    text = capsys.readouterr().out
    assert "Calibrated with calibration.json (made up). Each region" in text
    assert re.search(r"chin .* 18\.00 +19 +77 to 98 %", text)
    assert read_prediction(output)["band"]["state"] == "calibrated"
    assert main([*command, "--band", "--json", "-q"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["predictions"][0]["band"]["state"] == "uncalibrated"
    assert "band_sd_mm_uncalibrated" in (output / "prediction.vtp").read_bytes().decode("latin-1")
