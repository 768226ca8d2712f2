"""Summaries that were changed are refused: no traceback, no wrong report, no foreign file."""

import copy
import dataclasses
import hashlib
import json
import random

import pytest
from test_stale_results import PNG, as_model, case, evaluation, no_pictures, prediction, write  # noqa: F401 (fixtures)

import cmfsim
from cmfsim.cli import main
from cmfsim.io.results.predictions import read_prediction
from cmfsim.io.results.result_files import EVALUATION_FILE, read_evaluation
from shared_values import without_drawings

MUTANTS = 150
HIDDEN = "of the reader alone"


@pytest.fixture(scope="module")
def originals(prediction, evaluation, tmp_path_factory):  # noqa: F811
    """A folder of results with two models and a comparison, and its two summaries."""
    with pytest.MonkeyPatch.context() as patch:
        without_drawings(patch)
        for name in ("picture_distances", "chart_errors"):
            patch.setattr(
                f"cmfsim.pipeline.outputs.results.{name}",
                lambda path, *_, **__: path.write_bytes(PNG),
            )
        folder = tmp_path_factory.mktemp("results")
        noticed = dataclasses.asdict(
            cmfsim.Finding("x", "a thing", severity="warning", where="here", why="so", fix="do")
        )
        summary = {**prediction.summary, "findings": [noticed], "note": "a note"}
        write(folder, dataclasses.replace(prediction, summary=summary), evaluation=evaluation)
    return folder


def sealed(content):
    """The text of a summary by someone who computes its digest again."""
    content = {name: value for name, value in content.items() if name != "digest"}
    try:
        plain = json.dumps(content, sort_keys=True)
    except (ValueError, RecursionError):
        return None
    content["digest"] = hashlib.sha256(plain.encode()).hexdigest()
    return json.dumps(content)


VALUES = [
    None,
    True,
    "",
    "x" * 50_000,
    "\ud800",
    "../../secret.png",
    "/etc/passwd",
    -1,
    -1.0,
    10**400,
    1e308,
    float("nan"),
    float("inf"),
    [],
    {},
    [[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]],
    {"a": {"b": None}},
    ["a", None],
    3.5,
    "H+S",
]


def mutant(content, rng):
    """A copy with one value replaced, removed, repeated or moved."""
    content = copy.deepcopy(content)
    place, path = content, []
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        if not keys:
            break
        key = rng.choice(keys)
        path.append((place, key))
        if not isinstance(place[key], dict | list) or rng.random() < 0.25:
            break
        place = place[key]
    place, key = path[-1]
    kind = rng.random()
    if kind < 0.7:
        place[key] = rng.choice(VALUES)
    elif kind < 0.85:
        del place[key]
    elif isinstance(place, dict):
        place[f"{key}x"] = place.pop(key)
    else:
        place.append(place[key])
    return content


def bytes_mutant(data, rng):
    """The text with a few bytes changed, cut off or doubled."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(data))
        kind = rng.random()
        if kind < 0.5:
            data[at] = rng.randrange(256)
        elif kind < 0.75:
            del data[at : at + rng.randint(1, 40)]
        else:
            data[at:at] = data[at : at + rng.randint(1, 40)]
    return bytes(data)


@pytest.mark.parametrize("name", ["prediction.json", EVALUATION_FILE])
def test_no_mutant_ends_in_a_traceback_or_a_wrong_report(name, originals, capsys):
    """Bytes changed: refused. Values changed and sealed again: refused, or as good as any."""
    path = originals / name
    data = path.read_bytes()
    content = json.loads(data)
    rng = random.Random(0)
    refused = 0
    try:
        for number in range(MUTANTS):
            if number % 2:
                changed = bytes_mutant(data, rng)
            else:
                text = sealed(mutant(content, rng))
                if text is None:
                    continue
                changed = text.encode("utf-8", "surrogatepass")
            if changed == data:
                continue
            path.write_bytes(changed)
            code = main(["report", str(originals), "-q"])
            err = capsys.readouterr().err
            assert code in (0, 2), (number, err)
            assert code == 0 or str(originals) in err, (number, err)
            # A digest is of all content, whatever the reader would make of it.
            same = number % 2 and _same(changed, content)
            assert code == 2 or not number % 2 or same, number
            refused += code == 2
    finally:
        path.write_bytes(data)
    assert refused > 0.5 * MUTANTS
    assert main(["report", str(originals), "-q"]) == 0


def _same(changed, content):
    """Whether bytes hold the same values: another blank, say."""
    try:
        return json.loads(changed) == content
    except ValueError:
        return False


@pytest.mark.parametrize("name", ["prediction.json", EVALUATION_FILE])
def test_a_summary_that_was_edited_is_named_with_what_to_do(name, originals, capsys):
    path = originals / name
    data = path.read_bytes()
    try:
        for old, new, said in [
            (b"ellipsoids", b"cylinders", "was changed after it was written"),
            (b'"digest"', b'"x"', "has no digest"),
            (b"{", b"", "is not JSON"),
        ]:
            path.write_bytes(data.replace(old, new, 1))
            assert main(["report", str(originals), "-q"]) == 2
            err = capsys.readouterr().err
            assert str(path) in err
            assert said in err
            assert "again" in err
            assert "Traceback" not in err
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize("lead", ["absolute", "link", "up", "other"])
def test_no_file_but_the_results_own_pictures_comes_into_a_report(
    lead, originals, tmp_path, capsys
):
    """metrics.json named any file on the disk, and the report embedded it."""
    secret = tmp_path / "secret.png"
    secret.write_bytes(PNG + HIDDEN.encode())
    path = originals / EVALUATION_FILE
    data = path.read_bytes()
    content = json.loads(data)
    mine = originals / "error-H.png"
    picture = mine.read_bytes()
    try:
        if lead == "link":
            mine.unlink()
            mine.symlink_to(secret)
            content["sha256"]["error-H.png"] = hashlib.sha256(secret.read_bytes()).hexdigest()
        elif lead == "other":
            mine.write_bytes(b"no picture")
            content["sha256"]["error-H.png"] = hashlib.sha256(b"no picture").hexdigest()
        else:
            name = str(secret) if lead == "absolute" else f"../{secret.name}"
            content["files"].append(name)
            content["sha256"][name] = hashlib.sha256(secret.read_bytes()).hexdigest()
        path.write_text(sealed(content))
        assert main(["report", str(originals), "-q"]) == 2
        assert HIDDEN not in (originals / "report.html").read_text("utf-8")
        err = capsys.readouterr().err
        assert "another text is needed" in err or "error-H.png" in err
    finally:
        path.write_bytes(data)
        mine.unlink()
        mine.write_bytes(picture)


def test_what_is_written_is_what_is_read(originals, prediction, evaluation):  # noqa: F811
    found = read_prediction(originals)
    assert found["case_key"] == prediction.summary["case_key"]
    assert found["solution"] == json.loads(json.dumps(prediction.summary["solution"]))
    assert read_evaluation(originals)["models"].keys() == evaluation.as_dict()["models"].keys()
    with pytest.raises(FileNotFoundError, match=r"prediction\.json: no such file"):
        read_prediction(originals / "nowhere")


def test_a_summary_that_is_a_link_or_a_pipe_is_refused(originals, tmp_path):
    (tmp_path / "prediction.json").symlink_to(originals / "prediction.json")
    with pytest.raises(cmfsim.CaseError, match="is a link"):
        read_prediction(tmp_path)


def test_a_model_is_read_in_its_own_name(prediction, tmp_path):  # noqa: F811
    cmfsim.write_prediction(tmp_path, as_model(prediction, "M"))
    assert read_prediction(tmp_path)["model"] == "M"
