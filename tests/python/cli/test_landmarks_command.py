"""`cmfsim landmarks`: files, findings and JSON of a case of surfaces."""

import json

import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.registration.proposed.template_head import average_head

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


def test_doctor_reports_that_muscles_are_left_out_where_finding_landmarks_is_off(case, capsys):
    text = (case / "case.toml").read_text(encoding="utf-8")
    for name, more, refused in (
        ("with.toml", "", False),
        ("without.toml", "[landmarks]\nautomatic = false\n", True),
    ):
        (case / name).write_text(f"{text}[muscles]\n{more}", encoding="utf-8")
        main(["doctor", str(case / name), "--json", "-q"])
        report = json.loads(capsys.readouterr().out)
        codes = {finding["code"] for finding in report["findings"]}
        assert ("muscles-left-out" in codes) is refused


def test_a_page_is_written_and_missing_sites_are_filled_in_from_the_files(case, capsys):
    """Menton is given by its abbreviation and off by 6 mm: it stays, and the others follow it."""
    place = average_head().skull["menton"] + [0.0, -6.0, 0.0]
    cmfsim.write_landmarks(case / "few.mrk.json", {"Me": place})
    text = (case / "case.toml").read_text(encoding="utf-8")
    more = '[landmarks]\nskull = "few.mrk.json"\nautomatic = "missing"\n'
    (case / "few.toml").write_text(text + more, encoding="utf-8")
    options = ["-o", str(case / "few"), "--names", "ali", "--page", "--no-open", "--json", "-q"]
    assert main(["landmarks", str(case / "few.toml"), *options]) == 0
    report = json.loads(capsys.readouterr().out)
    assert "landmarks.html" in report["files"]
    (finding,) = (f for f in report["findings"] if f["code"] == "landmarks-filled")
    assert "1 landmarks were placed by hand" in finding["what"]
    assert "pogonion (" in finding["what"]
    assert len(report["skull"]) == 32
    read = cmfsim.read_landmarks(case / "few" / "skull_landmarks.mrk.json")
    assert read["Me"].tolist() == place.tolist()
    assert {"LGo", "RGo", "N", "A", "Pog", "supraglabella"} <= read.keys()
    page = (case / "few" / "landmarks.html").read_text(encoding="utf-8")
    values = json.loads(page.partition('id="page-values">')[2].partition("<")[0])
    placed = {s["name"]: s["placed"] for s in values["sites"] if s["placed"]}
    assert placed == {"menton": place.tolist()}


@pytest.mark.parametrize("given", ['"missing"', "true", "false"])
def test_automatic_landmarks_are_asked_for_in_three_ways(case, given):
    text = (case / "case.toml").read_text(encoding="utf-8")
    (case / "asked.toml").write_text(f"{text}[landmarks]\nautomatic = {given}\n", "utf-8")
    found = cmfsim.Case.load(case / "asked.toml").landmarks
    assert found.proposed == (given != "false")
    assert found.fills == (given == '"missing"')
    (case / "asked.toml").write_text(f'{text}[landmarks]\nautomatic = "all"\n', "utf-8")
    with pytest.raises(cmfsim.CaseError, match='"missing" is needed'):
        cmfsim.Case.load(case / "asked.toml")
