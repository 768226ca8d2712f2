"""Every text that people read comes from the catalogue; what programs read stays English."""

import html
import importlib.util
import json
import re
import shutil
import struct
import subprocess
from pathlib import Path

import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.desk.server import desk_text
from cmfsim.desk.session import Session
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.planning.face_measures.definitions import MEASURES
from cmfsim.planning.page.content import PageContent
from cmfsim.planning.page.document import page_text
from cmfsim.report.case import findings_of
from cmfsim.report.chart_page import A4, draw_chart_page
from cmfsim.values import language
from cmfsim.values.landmark_sites import SKIN_LANDMARKS, SKULL_LANDMARKS
from cmfsim.values.language import translated
from shared_values import COARSE_EDGE

PACKAGE = Path(cmfsim.__file__).parent
SCRIPT = PACKAGE.parents[1] / "scripts/extract_texts.py"
NODE = shutil.which("node")
VALUE = re.compile(r"(\{\d+\})")
# Names that the case, its files and the paper give; units, formats and names of measures.
NAMES = re.compile(
    r"\b(?:\w+_\w+|U6-\w+|L6-\w+|\w+\.\w+|demo|cranium|mandible|maxilla|M\+S|cmfsim"
    r"|mm|MPa|[SLPU]\d?|[NA-]+-Pog|[A-Z]{2,3}|Gn|Pog?|[UL]\dR|SHA-256|GBR|python|numpy"
    r"|Yes|True|False|cholesky|pcg|winding|passive|moduli|default|toml|plan)\b"
)
FILE = re.compile(
    r"\S+\.(?:html|json|toml|ply|vt[pu]|stl|npz|png|pdf)\b|\S*/\S*|\[[\w-]+\]|\b[0-9a-f]{8,}\b"
)


def in_brackets(message):
    """A message with everything but its values in brackets."""
    parts = VALUE.split(message)
    return "".join(
        f"⟦{p}⟧" if any(map(str.isalpha, p)) and not VALUE.fullmatch(p) else p for p in parts
    )


def compiled(messages):
    """The catalogue as msgfmt compiles it (GNU gettext manual, "The Format of GNU MO Files")."""
    pairs = sorted((key.encode(), value.encode()) for key, value in messages.items())
    columns = [[pair[i] + b"\0" for pair in pairs] for i in (0, 1)]
    place = 28 + 16 * len(pairs)
    tables = b""
    for column in columns:
        for text in column:
            tables += struct.pack("<2I", len(text) - 1, place)
            place += len(text)
    head = struct.pack("<7I", 0x950412DE, 0, len(pairs), 28, 28 + 8 * len(pairs), 0, 0)
    return head + tables + b"".join(b"".join(column) for column in columns)


@pytest.fixture(scope="module")
def messages():
    """Every message, in brackets."""
    spec = importlib.util.spec_from_file_location("extract_texts", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return {text: in_brackets(text) for text, _, _ in script.found_texts()}


@pytest.fixture
def bracketed(messages, tmp_path, monkeypatch):
    """The language in which every message stands in brackets."""
    folder = tmp_path / "locale/xx/LC_MESSAGES"
    folder.mkdir(parents=True)
    header = {"": "Content-Type: text/plain; charset=UTF-8\nLanguage: xx\n"}
    (folder / "cmfsim.mo").write_bytes(compiled({**messages, **header}))
    monkeypatch.setenv("CMFSIM_LOCALE", str(tmp_path / "locale"))
    monkeypatch.setenv("CMFSIM_LANGUAGE", "xx")
    kept = (language.catalogue, language.translated, language._templates)
    for function in kept:
        function.cache_clear()
    yield
    for function in kept:
        function.cache_clear()


def english(text):
    """What of a text is neither in brackets nor a name, a figure or a unit."""
    before = None
    while before != text:
        before, text = text, re.sub(r"⟦[^⟦⟧]*(?:⟧|…|(?= ⟦… ))", " ", text)
    text = FILE.sub(" ", text)
    names = "|".join(map(re.escape, sorted({*SKULL_LANDMARKS, *SKIN_LANDMARKS}, key=len)))
    return re.findall(r"[^\W\d_]{2,}", NAMES.sub(" ", re.sub(rf"\b(?:{names})\b", " ", text)))


def visible(page):
    """What a page shows without its scripts, each text for itself."""
    page = re.sub(r"<(script|style)\b.*?</\1>|data:image[^\"]*", "", page, flags=re.DOTALL)
    labels = re.findall(r'(?:alt|title|aria-label)="([^"]*)"', page)
    return [html.unescape(text) for text in (*re.sub(r"<[^>]*>", "\n", page).split("\n"), *labels)]


def test_without_a_catalogue_texts_are_what_the_code_has(messages):
    assert len(messages) > 3000
    assert [message for message in messages if translated(message) != message] == []


@pytest.mark.usefixtures("bracketed")
def test_a_text_is_found_by_its_message_whatever_its_values_are():
    assert translated("Plan") == "⟦Plan⟧"
    assert translated("checking odd-name.{0}") == "⟦checking ⟧odd-name.{0}"
    assert translated("8.1 mm on average.") == "8.1⟦ mm on average⟧."
    assert translated("nothing that anybody wrote") == "nothing that anybody wrote"


def test_an_absent_language_is_reported(monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("CMFSIM_LOCALE", str(tmp_path))
    monkeypatch.setenv("CMFSIM_LANGUAGE", "tlh")
    language.catalogue.cache_clear()
    with caplog.at_level("WARNING"):
        assert language.catalogue() == {}
    language.catalogue.cache_clear()
    assert "CMFSIM_LANGUAGE=tlh" in caplog.text


@pytest.mark.parametrize("data", [b"", b"junk", b"\xde\x12\x04\x95" + bytes([1, 0, 0, 0, 9])])
def test_a_damaged_catalogue_is_reported_and_texts_are_english(monkeypatch, tmp_path, caplog, data):
    place = tmp_path / "tlh" / "LC_MESSAGES" / "cmfsim.mo"
    place.parent.mkdir(parents=True)
    place.write_bytes(data)
    monkeypatch.setenv("CMFSIM_LOCALE", str(tmp_path))
    monkeypatch.setenv("CMFSIM_LANGUAGE", "tlh")
    language.catalogue.cache_clear()
    assert language.catalogue() == {}
    language.catalogue.cache_clear()
    assert "is no catalogue of GNU gettext" in caplog.text


@pytest.mark.usefixtures("bracketed")
def test_predict_prints_and_reports_in_the_language_and_writes_english(tmp_path, capfd):
    case = write_demo_case(tmp_path / "case", edge_length=COARSE_EDGE).case.file
    assert main(["predict", str(case), "--model", "H"]) == 0
    printed, progress = capfd.readouterr()
    lines = [*printed.split("\n"), *progress.split("\n")]
    assert "⟦skin moves  ⟧" in printed
    assert "⟦writing the report⟧" in progress
    assert {line: english(line) for line in lines if english(line)} == {}
    output = case.parent / "out"
    page = (output / "report.html").read_text(encoding="utf-8")
    assert '<html lang="xx">' in page
    assert {text: english(text) for text in visible(page) if english(text)} == {}
    for path in (*output.glob("*.json"), *output.glob("*.csv")):
        assert "⟦" not in path.read_text(encoding="utf-8")
    chart_is_in_brackets(json.loads((output / "prediction.json").read_text(encoding="utf-8")))
    assert main(["report", str(output), "--json"]) == 0
    assert "⟦" not in capfd.readouterr().out


def chart_is_in_brackets(prediction):
    figure = pytest.importorskip("matplotlib.figure").Figure(A4)
    draw_chart_page(figure, prediction, {}, findings_of([prediction], None))
    texts = " ".join(text.get_text() for axes in figure.axes for text in axes.texts)
    assert "⟦Movement of landmarks⟧" in texts
    assert english(texts) == []


@pytest.mark.usefixtures("bracketed")
def test_the_desk_and_the_planning_page_are_in_the_language(messages, tmp_path):
    (tmp_path / "case").mkdir()
    about = {"label": MEASURES[0].label, "key": MEASURES[0].key, "about": MEASURES[0].about}
    values = {"case": "demo", "model": "H", "version": "0.1.0", "built_for": "0" * 64}
    planning = page_text(PageContent({**values, "measures": [about]}, {}))
    for page in (planning, desk_text(Session(tmp_path / "case"), ())):
        assert {text: english(text) for text in visible(page) if english(text)} == {}
        shown = json.loads(re.search(r'id="page-values">(.*?)</script>', page, re.DOTALL)[1])
        script = re.search(r'<script type="module">(.*?)</script>', page, re.DOTALL)[1]
        tagged = re.findall(r"(?<![\w$])_`([^`$]*)`", script)
        assert len(tagged) > 30
        assert {text for text in tagged if shown["texts"].get(text) != messages[text]} == set()
    assert shown_measure(planning) == {
        "key": MEASURES[0].key,
        **{name: in_brackets(about[name]) for name in ("label", "about")},
    }


def shown_measure(page):
    values = re.search(r'id="page-values">(.*?)</script>', page, re.DOTALL)[1]
    return json.loads(values)["measures"][0]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.js")), ids=lambda path: path.stem)
def test_scripts_mark_what_they_show(path):
    """Literals that go into the document are tagged; a template around tagged texts is none."""
    shown = re.compile(
        r"(?:textContent|title|\"aria-label\")(?::| =) (?:\"([^\"]*)\"|`([^`]*)`)"
        r"|(?<!\w)(?:button|report|fail)\((?:\"([^\"]*)\"|`([^`]*)`)"
    )
    found = [next(filter(None, m.groups()), "") for m in shown.finditer(path.read_text("utf-8"))]
    plain = [re.sub(r"\$\{[^}]*(\}|$)|^cmfsim .*", "", text) for text in found]
    assert [text for text in plain if re.search(r"[A-Za-z]{2}", text)] == []


@pytest.mark.skipif(NODE is None, reason="Node is missing")
def test_a_tagged_text_is_looked_up_and_filled(tmp_path):
    script = (PACKAGE / "planning/page/scripts/elements.js").read_text("utf-8")
    (tmp_path / "elements.mjs").write_text(script, encoding="utf-8")
    (tmp_path / "asked.mjs").write_text(
        "globalThis.document = { getElementById: () => ({ textContent: JSON.stringify({ texts: {"
        '"{0} of {1} sites": "{1} Orte, davon {0}" } }) }) };'
        'const { _ } = await import("./elements.mjs");'
        'console.log(JSON.stringify([_`${"{1}"} of ${7} sites`, _`${3} others`, _`Undo`]));',
        encoding="utf-8",
    )
    done = subprocess.run([NODE, "asked.mjs"], cwd=tmp_path, capture_output=True, check=True)
    assert json.loads(done.stdout) == ["7 Orte, davon {1}", "3 others", "Undo"]
