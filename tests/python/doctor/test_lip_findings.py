"""What the doctor finds about the lips of a case, before any of it is built."""

import pytest

import cmfsim
from head_case import HeadCase


def found(folder, lips, more=""):
    """Severity and code of the findings about lips, for a case whose skin has no lip landmarks."""
    head = HeadCase().without_mouth()
    head.toml += f"\n[lips]\n{lips}\n{more}"
    findings = cmfsim.diagnose(cmfsim.Case.load(head.write(folder)))
    return [
        (f.severity, f.code) for f in findings if f.code.startswith(("lip", "file", "landmark-m"))
    ]


def test_lips_that_are_not_asked_for_are_not_checked(tmp_path):
    assert found(tmp_path, 'contact = false\nseam = "landmarks"') == []


@pytest.mark.parametrize(
    ("lips", "more", "expected"),
    [
        ("contact = true", "", [("note", "landmark-missing")]),
        ('contact = true\nseam = "landmarks"', "", [("error", "landmark-missing")]),
        (
            "contact = true",
            '[solver]\nmethod = "cholesky"\n',
            [("error", "lips-contact"), ("note", "landmark-missing")],
        ),
        (
            "contact = true",
            "[node_kinds]\nsliding = false\n",
            [("warning", "lips-contact"), ("note", "landmark-missing")],
        ),
    ],
)
def test_what_keeps_lips_from_being_separated_is_found(tmp_path, lips, more, expected):
    assert found(tmp_path, lips, more) == expected


def test_a_surface_between_the_lips_that_is_missing_is_an_error(tmp_path):
    head = HeadCase()
    head.toml += '\n[lips]\ncontact = true\nseam = "seam.ply"\n'
    findings = cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path)))
    (finding,) = (f for f in findings if f.severity == "error")
    assert "seam.ply" in finding.what + finding.where


def test_a_case_with_lip_landmarks_has_no_finding(tmp_path):
    head = HeadCase()
    head.toml += "\n[lips]\ncontact = true\n"
    assert cmfsim.diagnose(cmfsim.Case.load(head.write(tmp_path))) == ()
