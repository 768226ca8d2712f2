"""`cmfsim landmarks`: files, findings and JSON of a case of surfaces."""

import json

import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.registration.proposed.average_head import average_head

pytest.importorskip("scipy")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("head")
    head = average_head()
    for name, surface in {**head.bones, "skin": head.skin}.items():
        cmfsim.write_surface(folder / f"{name}.ply", surface)
    (folder / "case.toml").write_text(
        'format = "cmfsim-case"\nversion = 1\n[surfaces]\nskin = "skin.ply"\n[surfaces.bones]\n'
        'cranium = "cranium.ply"\nmandible = "mandible.ply"\n[mesh]\nedge_length = 8.0\n',
        encoding="utf-8",
    )
    return folder


def test_files_say_that_a_person_did_not_place_them(case, capsys):
    assert main(["landmarks", str(case), "--json", "-q"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert len(report["skull"]) == 32
    assert len(report["skin"]) == 14
    assert "landmarks-proposed" in {f["code"] for f in report["findings"]}
    written = case / "out" / "skull_landmarks.mrk.json"
    points = json.loads(written.read_text(encoding="utf-8"))["markups"][0]["controlPoints"]
    assert all("not placed by a person" in point["description"] for point in points)
    places = cmfsim.read_landmarks(written)
    assert places["menton"].tolist() == report["skull"]["menton"]["point"]


def test_doctor_accepts_muscles_without_landmarks_unless_finding_them_is_off(case, capsys):
    text = (case / "case.toml").read_text(encoding="utf-8")
    for name, more, refused in (
        ("with.toml", "", False),
        ("without.toml", "[landmarks]\nautomatic = false\n", True),
    ):
        (case / name).write_text(f"{text}[muscles]\n{more}", encoding="utf-8")
        main(["doctor", str(case / name), "--json", "-q"])
        report = json.loads(capsys.readouterr().out)
        codes = {finding["code"] for finding in report["findings"]}
        assert ("landmark-missing" in codes) is refused
