"""DICOM series are chosen, put together from frames and folders, or refused by name."""

import os
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from small_scans import SHAPE, codes, noisy, refused, same, smooth

import cmfsim
from cmfsim.io.images.dicom_series import dicom_files, dicom_places
from cmfsim.io.images.image_files import read_image_file
from dicom_series import axial, write_classic_frames, write_enhanced, write_series

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")


# Series ----------------------------------------------------------------------------------------


def test_a_series_is_chosen_by_number_or_uid(tmp_path):
    write_series(tmp_path / "ct", axial(noisy()), uid="1.2.3", number="4", description="soft")
    other = noisy().with_values(noisy().values + np.int16(5))
    write_series(tmp_path / "ct", axial(other), uid="1.2.4", number="5", description="sharp")
    refused(tmp_path / "ct", "'soft'", "'sharp'", "number 4", "8 slices", "2 mm apart", "series =")
    for wanted in ("5", "1.2.4"):
        same(read_image_file(tmp_path / "ct", series=wanted), other)
    refused(tmp_path / "ct", "'6'", "'soft'", series="6")


def test_series_of_two_patients_or_studies_are_never_chosen_from(tmp_path):
    long = smooth((6, 5, 40))
    write_series(tmp_path / "ct", axial(long), uid="1.2.3", study="1.2")
    write_series(tmp_path / "ct", axial(long)[:12], uid="1.2.4", study="1.5")
    refused(tmp_path / "ct", "2 CT series")


def test_other_modalities_under_one_series_are_skipped_and_reported(tmp_path):
    write_series(tmp_path / "ct", axial(noisy()))
    write_series(tmp_path / "ct", axial(noisy())[:2], modality="OT", names=["a", "b"])
    found = read_image_file(tmp_path / "ct")
    same(found, noisy())
    assert codes(found) == {"dicom-series"}


def test_a_series_asked_for_in_a_file_is_an_error(tmp_path):
    cmfsim.write_image(noisy(), tmp_path / "a.nrrd")
    refused(tmp_path / "a.nrrd", "series = '3'", series="3")


# Frames ----------------------------------------------------------------------------------------


def test_frames_are_placed_by_what_each_states(tmp_path):
    slices = axial(noisy())
    write_enhanced(tmp_path / "ct.dcm", [slices[i] for i in (3, 1, 0, 2, 7, 5, 6, 4)])
    same(read_image_file(tmp_path / "ct.dcm"), noisy())
    (tmp_path / "folder").mkdir()
    (tmp_path / "ct.dcm").rename(tmp_path / "folder" / "ct")
    same(read_image_file(tmp_path / "folder"), noisy())


def test_missing_frames_and_frames_of_several_scales_are_refused(tmp_path):
    slices = axial(noisy())
    write_enhanced(tmp_path / "gap.dcm", [s for k, s in enumerate(slices) if k != 3])
    refused(tmp_path / "gap.dcm", "1 slice missing", "104.00 and 108.00 mm")
    slices[2] = replace(slices[2], intercept=-1000.0)
    write_enhanced(tmp_path / "scales.dcm", slices)
    refused(tmp_path / "scales.dcm", "different rescale")


@pytest.mark.parametrize("gap", [{0x00180088: "2"}, {0x00180050: "2"}, {0x3004000C: "offsets"}])
def test_frames_of_a_classic_image_follow_the_first(tmp_path, gap):
    """As cone-beam scanners write it; a warning where the file does not state the places."""
    if 0x3004000C in gap:
        gap = {0x3004000C: "\\".join(str(2.0 * k) for k in range(SHAPE[2]))}
    write_classic_frames(tmp_path / "ct.dcm", axial(noisy()), gap)
    found = read_image_file(tmp_path / "ct.dcm")
    same(found, noisy())
    assert codes(found) == (set() if 0x3004000C in gap else {"dicom-frames-assumed"})
    (tmp_path / "folder").mkdir()
    (tmp_path / "ct.dcm").rename(tmp_path / "folder" / "ct")
    same(read_image_file(tmp_path / "folder"), noisy())


def test_frames_of_a_classic_image_without_place_or_distance_are_refused(tmp_path):
    write_classic_frames(tmp_path / "a.dcm", axial(noisy()), {})
    refused(tmp_path / "a.dcm", "SpacingBetweenSlices", "one file per slice")
    write_classic_frames(tmp_path / "b.dcm", axial(noisy()), {0x00180088: "2"}, placed=False)
    refused(tmp_path / "b.dcm", "position and orientation", "one file per slice")


# Folders ---------------------------------------------------------------------------------------


def parted(folder, places, **options):
    """A series of which each slice lies in the folder of its place."""
    write_series(folder / "all", axial(noisy()), **options)
    for path, place in zip(sorted((folder / "all").iterdir()), places, strict=True):
        (folder / place).mkdir(parents=True, exist_ok=True)
        path.rename(folder / place / path.name)
    (folder / "all").rmdir()


@pytest.mark.parametrize("places", [["."] * 4 + ["MORE"] * 4, ["a"] * 3 + ["b/c"] * 5])
def test_a_series_goes_on_in_folders_below(tmp_path, places):
    parted(tmp_path / "ct", places)
    found = read_image_file(tmp_path / "ct")
    same(found, noisy())
    (finding,) = found.findings
    assert finding.code == "dicom-folders"
    assert f"{places[-1]} ({places.count(places[-1])})" in finding.what


def test_other_series_below_a_folder_are_none_of_its_own(tmp_path):
    """A scan after the operation, in a folder below, unless it is asked for."""
    after = noisy().with_values(noisy().values + np.int16(5))
    write_series(tmp_path / "ct", axial(noisy()))
    write_series(tmp_path / "ct" / "after", axial(after), uid="1.2.4", study="1.5")
    found = read_image_file(tmp_path / "ct")
    same(found, noisy())
    assert not found.findings
    same(read_image_file(tmp_path / "ct", series="1.2.4"), after)
    assert dicom_places([tmp_path / "ct", tmp_path / "ct" / "after"]) == [
        (tmp_path / "ct", None),
        (tmp_path / "ct" / "after", None),
    ]


def test_folders_with_parts_of_one_series_are_one_place(tmp_path):
    parted(tmp_path, ["a"] * 3 + ["b"] * 5)
    folders = [tmp_path / "a", tmp_path / "b"]
    assert dicom_places(folders) == [(tmp_path, None)]
    write_series(tmp_path / "after", axial(noisy()), uid="1.2.4", study="1.5")
    # The folder of both holds another series now: which one is meant, its UID says.
    assert dicom_places([*folders, tmp_path / "after"]) == [
        (tmp_path, "1.2.3"),
        (tmp_path / "after", None),
    ]
    same(read_image_file(tmp_path, series="1.2.3"), noisy())
    refused(tmp_path, "2 CT series")


def test_a_change_in_a_folder_below_changes_the_hash_of_a_series(tmp_path):
    parted(tmp_path / "ct", ["."] * 4 + ["MORE"] * 4)
    before = dicom_files(tmp_path / "ct")
    assert [p.parent.name for p in before] == ["ct"] * 4 + ["MORE"] * 4
    (tmp_path / "ct" / "MORE" / "notes.txt").write_text("by hand")
    assert dicom_files(tmp_path / "ct") == before


def test_slices_that_are_links_are_read_and_broken_links_reported(tmp_path):
    """As DataLad leaves a folder: each file links into a store, some of it not fetched."""
    write_series(tmp_path / "store", axial(noisy()))
    (tmp_path / "ct").mkdir()
    for path in (tmp_path / "store").iterdir():
        (tmp_path / "ct" / path.name).symlink_to(f"../store/{path.name}")
    same(read_image_file(tmp_path / "ct"), noisy())
    (tmp_path / "store" / "1.2.3_0007.dcm").unlink()
    found = read_image_file(tmp_path / "ct")
    assert found.image.values.shape[2] == SHAPE[2] - 1
    (finding,) = found.findings
    assert (finding.severity, finding.code) == ("warning", "dicom-skipped")
    assert "1.2.3_0007.dcm" in finding.what
    assert "datalad get" in finding.fix


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes are those of Linux")
def test_names_that_are_not_utf_8_keep_no_library_from_a_file(tmp_path):
    """SimpleITK ended the process, and readers failed, in a folder with an umlaut in Latin-1."""
    folder = tmp_path / os.fsdecode(b"Pati\xe9nt")
    folder.mkdir()
    for ending in (".nrrd", ".nii.gz", ".mha"):
        path = folder / (os.fsdecode(b"gr\xfcn") + ending)
        cmfsim.write_image(noisy(), path)
        same(read_image_file(path), noisy())
    write_series(tmp_path / "ct", axial(noisy()))
    (tmp_path / "ct").rename(folder / "ct")
    same(read_image_file(folder / "ct"), noisy())
    write_classic_frames(folder / "ct.dcm", axial(noisy()), {0x00180088: "2"})
    same(read_image_file(folder / "ct.dcm"), noisy())


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize("nested", [False, True])
def test_a_file_of_endless_items_ends_in_an_error(tmp_path, monkeypatch, stated, nested):
    """Of a million, pydicom would make 1.3 GB of objects in 19 s."""
    monkeypatch.setattr("cmfsim.io.images.dicom_headers.MOST_READS", 20_000)
    write_classic_frames(tmp_path / "a.dcm", axial(noisy())[:1], {})
    mark = struct.pack("<HHI", 0xFFFE, 0xE000, 0xFFFFFFFF if nested else 0)
    inner = struct.pack("<HH2s2xI", 0x5200, 0x9230, b"SQ", 0xFFFFFFFF)
    items = (mark + inner) * 20_000 if nested else mark * 1_000_000
    length = len(items) if stated else 0xFFFFFFFF
    data = (tmp_path / "a.dcm").read_bytes()
    at = data.index(b"\xe0\x7f\x10\x00")
    head = struct.pack("<HH2s2xI", 0x5200, 0x9230, b"SQ", length)
    (tmp_path / "b.dcm").write_bytes(data[:at] + head + items + data[at:])
    refused(tmp_path / "b.dcm", "b.dcm", "is cut short or damaged")
