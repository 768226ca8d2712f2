"""Changes of a case's settings, and the file that names variants of them."""

import re

import pytest

import cmfsim

CASE = """format = "cmfsim-case"
version = 1
[surfaces]
skin = "skin.ply"
[surfaces.bones]
cranium = "cranium.ply"
[tissue]
preset = "kim2010"
[muscles]
samples = 8
[[osteotomies]]
procedure = "le_fort_1"
[[osteotomies]]
procedure = "bsso"
"""


def case_file(folder):
    folder.mkdir(exist_ok=True)
    path = folder / "case.toml"
    path.write_text(CASE, encoding="utf-8")
    return path


def variants(folder, text):
    path = folder / "variants.toml"
    path.write_text(text, encoding="utf-8")
    return cmfsim.Variants.load(path, ("H", "M+S"))


def changed(folder, text):
    """The case under the only variant of a text."""
    variant = list(variants(folder, text).variants.values())[1]
    return cmfsim.Case.load(case_file(folder / "P1"), changes=variant.changes)


def test_tables_are_merged_and_other_values_replaced(tmp_path):
    found = changed(
        tmp_path,
        "[variants.a]\n"
        "muscles.blur = 0\n"
        'osteotomies = [{procedure = "genioplasty"}]\n'
        '[variants.a.node_kinds]\ncontact_surface = "bone"\n',
    )
    assert found.muscles.samples == 8
    assert found.muscles.blur == 0.0
    assert dict(found.node_kinds) == {"contact_surface": "bone"}
    assert [cut.procedure for cut in found.osteotomies] == ["genioplasty"]
    given = cmfsim.Case.load(tmp_path / "P1")
    assert [cut.procedure for cut in given.osteotomies] == ["le_fort_1", "bsso"]
    assert not given.node_kinds


def test_paths_are_those_from_the_folder_of_the_case(tmp_path):
    found = changed(tmp_path, '[variants.a.surfaces]\nskin = "smooth/skin.ply"\n')
    assert found.surfaces.skin == tmp_path / "P1" / "smooth" / "skin.ply"
    assert found.surfaces.bones["cranium"] == tmp_path / "P1" / "cranium.ply"


def test_a_key_can_be_removed(tmp_path):
    text = '[variants.a]\nwithout = ["tissue.preset"]\ntissue = {young = 0.003, poisson = 0.3}\n'
    assert changed(tmp_path, text).tissue.poisson == 0.3
    with pytest.raises(cmfsim.CaseError, match="together with young"):
        changed(tmp_path, text.replace('without = ["tissue.preset"]', "without = []"))
    with pytest.raises(cmfsim.CaseError, match=r"'tissue.ν': case.toml has no such key"):
        changed(tmp_path, text.replace("tissue.preset", "tissue.ν"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[variants.a]\nmuscles.blurr = 0\n", r"variants.toml:2: muscles.blurr .*mean 'blur'"),
        ("[variants.a.muscls]\nblur = 0\n", r"variants.toml:1: muscls .*mean 'muscles'"),
        ("\n[variants.a]\nmuscles.young_along = 0\n", r"variants.toml:3: muscles.young_along is 0"),
        ("[variants.a]\ntissue = {poisson = 0.6}\n", r"variants.toml:2: tissue.poisson is 0.6"),
        # What the case file itself states is its own fault, whatever else is changed.
        ("[variants.a.muscles]\npreset = 3\n", r"variants.toml:2: muscles.preset is 3"),
    ],
)
def test_a_fault_of_a_change_has_its_place_in_the_file_of_variants(tmp_path, text, message):
    with pytest.raises(cmfsim.CaseError, match=message):
        changed(tmp_path, text)


def test_a_fault_of_the_case_keeps_its_own_place(tmp_path):
    changes = cmfsim.CaseChanges({"muscles": {"blur": 0.0}})
    path = case_file(tmp_path)
    path.write_text(CASE.replace("samples = 8", "samples = 0"), encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=r"^case.toml:10: muscles.samples is 0"):
        cmfsim.Case.load(path, changes=changes)


def test_findings_name_the_file_in_which_a_key_stands(tmp_path):
    found = changed(tmp_path, "\n[variants.a]\nmuscles.blur = 0\n")
    assert found.where("muscles.blur") == "variants.toml:3 muscles.blur"
    assert found.where("muscles.samples") == "case.toml:10 muscles.samples"
    # A list is replaced as a whole: the lines of its old entries are gone.
    found = changed(tmp_path, '[variants.a]\nosteotomies = [{procedure = "bsso"}]\n')
    assert found.where("osteotomies.1") == "variants.toml:2 osteotomies.1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no variant"),
        ("[variants.a]\n", r"variants.toml:1: variants.a changes nothing"),
        ("[variants.as-given]\nmuscles.blur = 0\n", r"variants.toml:1: .*is always there"),
        ('[variants."a b"]\nmuscles.blur = 0\n', r"variants.toml:1: .*is no name"),
        ('[variants.a]\noutput.folder = "b"\n', r"variants.toml:2: .*cannot change it"),
        (
            'models = ["M"]\n[variants.a]\nmodels = ["H"]\nmesh.refine = true\n',
            r"variants.toml:3: .*list of M is",
        ),
        ("[variant.a]\nmuscles.blur = 0\n", r"variants.toml:1: variant .*mean 'variants'"),
    ],
)
def test_faults_of_a_file_of_variants_are_named_with_their_line(tmp_path, text, message):
    with pytest.raises(cmfsim.CaseError, match=message):
        variants(tmp_path, text)


def test_a_variant_has_the_models_of_its_cohort_unless_it_names_some(tmp_path):
    text = 'description = "why"\n[variants.a]\nmodels = ["M+S"]\nmuscles.blur = 0\n'
    found = variants(tmp_path, text + "[variants.b]\ntissue = {young = 1.0, poisson = 0.2}\n")
    assert {name: v.models for name, v in found.variants.items()} == {
        "as-given": ("H", "M+S"),
        "a": ("M+S",),
        "b": ("H", "M+S"),
    }
    assert found.description == "why"
    assert found.variants["a"].words == "muscles.blur = 0"
    assert found.variants["b"].words == "tissue.young = 1.0, tissue.poisson = 0.2"


def test_changes_survive_the_way_to_another_process(tmp_path):
    text = '[variants.a]\nwithout = ["tissue.preset"]\nmuscles.blurr = 0\n'
    changes = variants(tmp_path, text).variants["a"].changes
    again = cmfsim.CaseChanges.from_json(changes.as_json())
    assert again == changes
    with pytest.raises(cmfsim.CaseError, match=re.escape("variants.toml:3: muscles.blurr")):
        cmfsim.Case.load(case_file(tmp_path / "P1"), changes=again)
