"""Landmark files give points in LPS mm by label; what is wrong with one is named by its point."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest

import cmfsim
from cmfsim.io import read_landmark_file

DATA = Path(os.environ.get("CMFSIM_DATA") or Path(__file__).parents[4] / "shared/data")
FCSV = """# Markups fiducial file version = 4.11
# CoordinateSystem = {frame}
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_0,1.5,-2,3e1,0,0,0,1,1,1,0,nasion,,
vtkMRMLMarkupsFiducialNode_1,4,5,6,0,0,0,1,1,1,0,"menton, low",,
"""


def markups(points=None, **markup):
    points = {"nasion": [1.5, -2, 30], "menton": [4, 5, 6]} if points is None else points
    controls = [{"label": label, "position": place} for label, place in points.items()]
    return {"markups": [{"coordinateSystem": "LPS", "controlPoints": controls} | markup]}


def saved(folder, content, name="points.mrk.json"):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("frame", "sign"), [("LPS", 1), ("RAS", -1), ("1", 1), ("0", -1), (1, 1), (0, -1)]
)
def test_both_frames_and_their_numbers_become_lps(frame, sign, tmp_path):
    """RAS turns by half a turn about the long axis; 0 and 1 are Slicer's older names."""
    expected = [1.5 * sign, -2.0 * sign, 30.0]
    path = saved(tmp_path, markups(coordinateSystem=frame))
    assert cmfsim.read_landmarks(path)["nasion"].tolist() == expected
    path = saved(tmp_path, FCSV.format(frame=frame), "points.fcsv")
    found = cmfsim.read_landmarks(path)
    assert found["nasion"].tolist() == expected
    assert list(found) == ["nasion", "menton, low"]
    assert read_landmark_file(path).findings == ()


def test_points_of_a_fcsv_that_were_never_placed_are_skipped_with_a_note(tmp_path):
    """Slicer 5 writes two values more than it names columns: the first is 2 if it is placed."""
    rows = FCSV.format(frame="LPS").replace("nasion,,", "nasion,,,2,0")
    rows = rows.replace('"menton, low",,', '"menton, low",,,0,0')
    found = read_landmark_file(saved(tmp_path, rows, "points.fcsv"))
    assert list(found.points) == ["nasion"]
    assert found.unset == ("menton, low",)
    assert [f.code for f in found.findings] == ["landmark-unset"]
    # A description that is a number is none.
    old = FCSV.format(frame="LPS").replace("nasion,,", "nasion,0,0")
    old = "\n".join(line for line in old.splitlines() if "columns" not in line)
    assert len(read_landmark_file(saved(tmp_path, old, "points.fcsv")).points) == 2


@pytest.mark.parametrize(
    ("units", "length"), [("mm", 1.0), ("m", 1000.0), (["cm", "UCUM", "centimeter"], 10.0)]
)
def test_units_become_mm(units, length, tmp_path):
    """As a text, or as Slicer's coded unit."""
    path = saved(tmp_path, markups(coordinateUnits=units))
    assert cmfsim.read_landmarks(path)["menton"].tolist() == [4 * length, 5 * length, 6 * length]


def test_an_unstated_frame_is_said_and_never_guessed_in_silence(tmp_path, caplog):
    """The format's own rule with a warning; the caller's word with a note."""
    bare = FCSV.format(frame="LPS").replace("# CoordinateSystem = LPS\n", "")
    path = saved(tmp_path, bare, "points.fcsv")
    found = read_landmark_file(path)
    assert (found.frame, found.stated) == ("RAS", False)
    assert [(f.severity, f.code) for f in found.findings] == [("warning", "frame-unstated")]
    with caplog.at_level(logging.WARNING):
        cmfsim.read_landmarks(path)
    assert "does not state its frame" in caplog.text
    told = read_landmark_file(path, frame="LPS")
    assert told.points["nasion"].tolist() == [1.5, -2.0, 30.0]
    assert [f.severity for f in told.findings] == ["note"]


def test_a_stated_frame_wins_over_the_callers(tmp_path):
    """What the file says of itself is not overruled."""
    path = saved(tmp_path, markups(coordinateSystem="RAS"))
    assert cmfsim.read_landmarks(path, frame="LPS")["nasion"].tolist() == [-1.5, 2.0, 30.0]


def test_points_that_were_never_placed_are_left_out_and_said(tmp_path):
    """Slicer writes them with a position of nothing."""
    document = markups()
    document["markups"][0]["controlPoints"].append(
        {"label": "pogonion", "position": [], "positionStatus": "undefined"}
    )
    found = read_landmark_file(saved(tmp_path, document))
    assert list(found.points) == ["nasion", "menton"]
    assert [f.code for f in found.findings] == ["landmark-unset"]
    assert "pogonion" in found.findings[0].what


def test_landmarks_survive_a_round_trip_to_the_last_bit(tmp_path):
    """Written and read, the same numbers; an existing file is replaced."""
    points = {"a": np.array([0.1, -1 / 3, 1e-300]), "ä b": np.array([1e300, 0.0, -0.0])}
    path = tmp_path / "points.mrk.json"
    path.write_text("old", encoding="utf-8")
    cmfsim.write_landmarks(path, points)
    found = cmfsim.read_landmarks(path)
    assert list(found) == list(points)
    assert all(np.array_equal(found[n], points[n]) for n in points)
    assert [p.name for p in tmp_path.iterdir()] == ["points.mrk.json"]


BAD = {
    "not JSON": ("{", "is not JSON"),
    "not markups": ({"points": []}, "no list 'markups'"),
    "a list": ([1], "no list 'markups'"),
    "no points": (markups({}), "contains no placed points"),
    "two numbers": (markups({"a": [1, 2]}), "point 1 is at"),
    "a text": (markups({"a": [1, 2, "3"]}), r"point 1 has the coordinate '3'"),
    "a flag": (markups({"a": [1, 2, True]}), "point 1 has the coordinate True"),
    "nothing": (markups({"a": [0, 0, 0], "b": None}), "point 2 is at None"),
    "nan": ('{"markups": [{"controlPoints": [{"label": "a", "position": [NaN, 0, 0]}]}]}', "NaN"),
    "too large": (
        '{"markups": [{"controlPoints": [{"label": "a", "position": [1e999, 0, 0]}]}]}',
        "point 1 has the coordinate inf",
    ),
    "empty label": (markups({" ": [1, 2, 3]}), "point 1 has no label"),
    "label twice": (markups({"a": [1, 2, 3], "a ": [1, 2, 4]}), "points 1 and 2 are both .*'a'"),
    "frame": (markups(coordinateSystem="IJK"), "is in the frame 'IJK'"),
    "units": (markups(coordinateUnits="furlong"), "'furlong'"),
    "points no list": (markups(controlPoints=3), "'controlPoints' is not a list"),
    "point no table": (markups(controlPoints=[3]), "point 1 is not a table"),
    "nested": ("[" * 100_000, "is not JSON"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_faulty_markups_file_is_refused_with_its_point(name, tmp_path):
    """A LandmarkError that is a ValueError too and names the file."""
    content, pattern = BAD[name]
    with pytest.raises(cmfsim.LandmarkError, match=pattern) as caught:
        cmfsim.read_landmarks(saved(tmp_path, content))
    assert isinstance(caught.value, ValueError)
    assert "points.mrk.json" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "pattern"),
    [
        ("3e1", "three", "point 1 has the coordinate 'three'"),
        ("3e1", "nan", "point 1 has the coordinate nan"),
        (",nasion,,", "", r"point 1 \(line 4\) has 11 of 14 columns"),
        ('"menton, low"', "nasion", "points 1 and 2 are both called 'nasion'"),
        ("nasion", "", "point 1 has no label"),
        ("id,x,y,z", "id,a,b,c", "lacks the column x, y, z"),
        ("{frame}", "scanner", "'scanner'"),
    ],
)
def test_a_faulty_fcsv_file_is_refused_with_its_point(old, new, pattern, tmp_path):
    """The same for the older format."""
    path = saved(tmp_path, FCSV.replace(old, new).replace("{frame}", "LPS"), "points.fcsv")
    with pytest.raises(cmfsim.LandmarkError, match=pattern):
        cmfsim.read_landmarks(path)


def test_other_files_are_refused(tmp_path):
    """Another ending, a folder, no file, bytes that are no text."""
    with pytest.raises(FileNotFoundError):
        cmfsim.read_landmarks(tmp_path / "no.mrk.json")
    with pytest.raises(cmfsim.LandmarkError, match=r"\.mrk\.json or \.fcsv"):
        cmfsim.read_landmarks(saved(tmp_path, "", "points.txt"))
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(cmfsim.LandmarkError, match="folder"):
        cmfsim.read_landmarks(tmp_path / "folder.json")
    (tmp_path / "raw.fcsv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(cmfsim.LandmarkError, match="UTF-8"):
        cmfsim.read_landmarks(tmp_path / "raw.fcsv")


@pytest.mark.parametrize(
    ("name", "points", "pattern"),
    [
        ("points.json", {"a": (0, 0, 0)}, r"\.mrk\.json"),
        ("points.mrk.json", {}, "contains no placed points"),
        ("points.mrk.json", {"": (0, 0, 0)}, "point 1 has no label"),
        ("points.mrk.json", {"a": (0, 0)}, "three numbers"),
        ("points.mrk.json", {"a": (0, np.nan, 0)}, "point 1 has the coordinate nan"),
    ],
)
def test_faulty_landmarks_are_not_written(name, points, pattern, tmp_path):
    """Refused before the file is touched."""
    with pytest.raises(cmfsim.LandmarkError, match=pattern):
        cmfsim.write_landmarks(tmp_path / name, points)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no real data at {DATA}")
def test_real_landmarks_are_read():
    """Of the atlas head and the phantom, 32 on the skull and 14 on the skin, face along −P."""
    for folder in ("atlas_head", "ct_phantom"):
        skull = cmfsim.read_landmarks(DATA / folder / "skull_landmarks.mrk.json")
        skin = cmfsim.read_landmarks(DATA / folder / "skin_landmarks.mrk.json")
        assert (len(skull), len(skin)) == (32, 14)
        assert skull["nasion"][1] < skull["gonion_L"][1]
        assert skull["gonion_L"][0] > skull["gonion_R"][0]
