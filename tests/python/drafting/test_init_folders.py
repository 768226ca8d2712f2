"""What `cmfsim init` makes of folders and names: links, parts of a series, bytes of any kind."""

import os
import sys

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.drafting import init_case
from cmfsim.drafting.choices import quoted
from cmfsim.drafting.roles import name_role
from cmfsim.io.files.reading_writing import toml_module
from dicom_series import axial, write_series

pytest.importorskip("SimpleITK")


needs_bytes = pytest.mark.skipif(
    sys.platform != "linux", reason="names of any bytes are those of Linux"
)


@needs_bytes
def test_a_folder_whose_name_is_not_utf_8_gets_a_case_that_is_read(head, capsys):
    """An umlaut in Latin-1, as archives of Windows unpack it."""
    folder = head / os.fsdecode(b"Pati\xe9nt")
    folder.mkdir()
    for name in ("skin.ply", "cranium.ply", "mandible.ply"):
        (head / name).rename(folder / name)
    assert main(["init", str(folder)]) == 0
    assert "Pati\\udce9nt" in capsys.readouterr().out
    assert cmfsim.Case.load(folder).name == "Pati\xe9nt"


@needs_bytes
def test_a_file_that_no_case_can_name_is_reported_with_a_remedy(head):
    (head / "mandible.ply").rename(head / os.fsdecode(b"Unterkiefer m\xfcde mandible.ply"))
    draft = init_case(head)
    (why,) = [entry.why for entry in draft.taken if "Unterkiefer" in entry.label]
    assert "not UTF-8" in why
    assert "rename it" in why
    assert set(cmfsim.Case.load(head).surfaces.bones) == {"cranium"}


@pytest.mark.parametrize("text", ["\N{SNOWMAN} \U0001f600 \U0010fffd\u2028", 'a"b\\c\n\t'])
def test_texts_are_written_as_toml_reads_them(text):
    assert toml_module().loads(f"name = {quoted(text)}") == {"name": text}


def test_a_name_of_other_bytes_is_no_text_of_a_case():
    with pytest.raises(ValueError, match="surrogates"):
        quoted("Pati\udce9nt")


def test_links_into_a_store_are_read_and_broken_ones_reported(head):
    """As DataLad leaves a data set, with some of its files not fetched."""
    (head / "store").mkdir()
    folder = head / "patient"
    folder.mkdir()
    for name in ("skin.ply", "cranium.ply", "mandible.ply"):
        (head / name).rename(head / "store" / name)
        (folder / name).symlink_to(f"../store/{name}")
    (head / "store" / "mandible.ply").unlink()
    draft = init_case(folder)
    case = cmfsim.Case.load(folder)
    assert case.surfaces.skin == folder / "skin.ply"
    assert set(case.surfaces.bones) == {"cranium"}
    (why,) = [entry.why for entry in draft.taken if entry.label == "mandible.ply"]
    assert "datalad get" in why


def test_links_to_folders_are_followed_once_and_never_upwards(head):
    """To the folder of surfaces, to itself, and to the folder of all patients."""
    folder = head / "patient"
    (head / "store").mkdir()
    folder.mkdir()
    for name in ("skin.ply", "cranium.ply", "mandible.ply"):
        (head / name).rename(head / "store" / name)
    (folder / "a").symlink_to("../store")
    (folder / "b").symlink_to("../store")
    (folder / "up").symlink_to("..")
    (folder / "round").symlink_to("round")
    draft = init_case(folder)
    assert cmfsim.Case.load(folder).surfaces.skin == folder / "a" / "skin.ply"
    whys = {entry.label: entry.why for entry in draft.taken}
    assert "that holds this one" in whys["up"]
    assert "was read already" in whys["b"]
    assert "datalad" in whys["round"]


def series_of_a_head(folder, uid="1.2.3", study="1.2", places=(".",)):
    """A small CT of which each part of the slices lies in a folder of its own."""
    values = np.full((24, 24, 12), -1000, dtype=np.int16)
    values[4:20, 4:20] = 40
    slices = axial(cmfsim.ImageData(values, (8.0, 8.0, 12.0)))
    size = -(-len(slices) // len(places))
    for k, place in enumerate(places):
        part = slices[k * size : (k + 1) * size]
        names = [f"{uid}_{k}_{n}" for n in range(len(part))]
        write_series(folder / place, part, uid=uid, study=study, names=names)


@pytest.mark.parametrize("places", [(".", "MORE"), ("a", "b/c")])
def test_parts_of_one_series_are_one_ct_and_no_question(tmp_path, places):
    """`init` asked which of the two parts is before the operation."""
    series_of_a_head(tmp_path, places=places)
    draft = init_case(tmp_path)
    assert not draft.questions
    case = cmfsim.Case.load(tmp_path)
    assert case.image.file.resolve() == tmp_path.resolve()
    assert cmfsim.read_image(case.image.file).values.shape[2] == 12


def test_a_series_in_parts_beside_another_is_named_by_its_uid(tmp_path):
    series_of_a_head(tmp_path, places=("a", "b"))
    series_of_a_head(tmp_path / "after_surgery", uid="1.2.4", study="1.5")
    draft = init_case(tmp_path)
    assert not draft.questions
    case = cmfsim.Case.load(tmp_path)
    assert case.image.series == "1.2.3"
    read = cmfsim.read_image(case.image.file, series=case.image.series)
    assert read.values.shape[2] == 12
    assert case.postoperative.image == tmp_path / "after_surgery"


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("Maxilla & Upper Skull", "cranium"),
        ("LeFort1_segment", "maxilla"),
        ("BSSO distal", "mandible_body"),
        ("proximal segment left", "ramus_left"),
        ("RamusR", "ramus_right"),
        ("Genioplasty", "chin"),
        ("lowerJaw", "mandible"),
        ("Lower teeth", "lower teeth"),
        ("softTissue", "skin"),
        ("Segment_7", ""),
        ("ramus", ""),
    ],
)
def test_names_say_parts(name, part):
    assert name_role(name).part == part


def test_a_name_says_what_is_after_the_operation():
    assert name_role("Mandible_postOp").is_after
    assert not name_role("posterior_mandible").is_after
