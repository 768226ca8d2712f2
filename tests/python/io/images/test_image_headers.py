"""Headers of image files: what they state is checked, and nothing in them ends the process."""

import bz2
import gzip
import os
import tracemalloc
import zlib

import numpy as np
import pytest
from header_files import VALUES, codes, refused, write_meta, write_nifti, write_nrrd

from cmfsim import ImageData, ImageError
from cmfsim.io.images.image_files import read_image, read_image_file, write_image
from cmfsim.io.images.image_headers import stored_voxels
from real_heads import data_folder

pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")

# Files that crash or hang readers --------------------------------------------------------------


@pytest.mark.parametrize("name", ["segv.nrrd", "hang.nii"])
@pytest.mark.parametrize("packed", [False, True])
def test_files_that_crash_or_hang_a_reader_are_refused(tmp_path, name, packed):
    path = tmp_path / (name + ".gz" * packed)
    data = (data_folder() / "hostile" / name).read_bytes()
    path.write_bytes(gzip.compress(data) if packed else data)
    # Without our own look at the header this ends the process, or never.
    assert refused(path) < 10.0


@pytest.mark.parametrize(
    ("field", "text", "words"),
    [
        ("sizes", "4 5 -6", "sizes"),
        ("sizes", "4 5 999999999999999999999999", "sizes"),
        ("sizes", "60000 60000 60000", "voxels"),
        ("sizes", "4 5", "dimension"),
        ("space directions", "(1,0,0) (0,1,0) (0,0,nan)", "not a finite number"),
        ("space directions", "(1,0,0) (0,1,0) (0,0,1e400)", "no head"),
        ("space directions", "(1,0,0) (0,1,0) (0,1,0)", "not a set of axes"),
        ("space directions", "(1,0,0) (0,1,0) (0,0,0)", "spacing"),
        ("space directions", "(1,0,0) (0,1,0)", "three vectors"),
        ("space origin", "(1,2,1e9)", "no head"),
        ("type", "block", "type"),
        ("space units", '"mm" "mm" "parsec"', "space units"),
        ("encoding", "raw", "cut short"),
    ],
)
def test_impossible_nrrd_headers_are_refused(tmp_path, field, text, words):
    path = write_nrrd(tmp_path / "a.nrrd", **{field: text}, data=field != "encoding")
    refused(path, words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rows": np.full((3, 4), np.inf)}, "finite"),
        ({"spacing": (1.0, np.nan, 2.0), "qform": 1}, "finite"),
        ({"spacing": (1.0, 0.0, 2.0), "qform": 1}, "spacing"),
        ({"quaternion": (0.0, np.nan, 0.0), "qform": 1}, "finite"),
        ({"shape": (3, 4, 5, -6, 1, 1, 1, 1)}, "axes"),
        ({"shape": (9, 4, 5, 6, 1, 1, 1, 1)}, "axes"),
        ({"shape": (3, 30000, 30000, 30000, 1, 1, 1, 1)}, "voxels"),
        ({"shape": (3, 900, 900, 900, 1, 1, 1, 1)}, "cut short"),
        ({"kind": (16, 32)}, "cut short"),
        ({"kind": (128, 24)}, "3 numbers per voxel"),
        ({"start": 1e20}, "data begin"),
        ({"scale": (1.0, np.nan)}, "finite"),
        ({"magic": b"ni1\0"}, "pair"),
        ({"magic": b"\0\0\0\0"}, "Analyze"),
        ({"rows": np.zeros((3, 4))}, "voxels are"),
        ({"rows": [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 3, 7]]}, "by its sform"),
    ],
)
@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_impossible_nifti_headers_are_refused(tmp_path, change, words, suffix):
    refused(write_nifti(tmp_path / f"a{suffix}", **change), words)


STRAIGHT = [[-1, 0, 0, 5], [0, -1, 0, 6], [0, 0, 2, 7]]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scale": (np.nan, np.nan)}, "scl_slope nan"),
        ({"scale": (np.inf, 0.0)}, "scl_slope inf"),
        ({"kind": (4, 32)}, "bitpix 32"),
        ({"start": 0.0}, "vox_offset 0"),
        ({"spacing": (1.0, np.nan, 2.0)}, "pixdim"),
        ({"spacing": (0.0, 0.0, 0.0)}, "pixdim"),
    ],
)
def test_fields_of_a_nifti_that_are_not_needed_are_ignored_and_reported(tmp_path, change, words):
    found = read_image_file(write_nifti(tmp_path / "a.nii", rows=STRAIGHT, **change))
    np.testing.assert_array_equal(found.image.values[::-1, ::-1], VALUES[::-1, ::-1])
    np.testing.assert_allclose(found.image.spacing, (1.0, 1.0, 2.0))
    (finding,) = found.findings
    assert (finding.severity, finding.code) == ("warning", "field-ignored")
    assert words in finding.what
    # What a code of 0 declares void is not looked at.
    void = write_nifti(tmp_path / "b.nii", rows=STRAIGHT, quaternion=(np.nan, 0.0, 0.0))
    assert not codes(void)


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz"])
def test_bytes_after_the_voxels_are_ignored_if_they_are_less_than_a_row(tmp_path, suffix):
    for more, words in ((7, None), (8, "longer than its header states")):
        path = write_nifti(tmp_path / f"a{suffix}", rows=STRAIGHT)
        data = path.read_bytes()
        data = gzip.decompress(data) if suffix == ".nii.gz" else data
        data += bytes(more)
        path.write_bytes(gzip.compress(data) if suffix == ".nii.gz" else data)
        if words:
            refused(path, words)
        else:
            assert codes(path) == ["field-ignored"]


@pytest.mark.parametrize(
    ("field", "text", "words"),
    [
        ("DimSize", "4 5 6.5", "DimSize"),
        ("DimSize", "60000 60000 60000", "voxels"),
        ("ElementSpacing", "1 1 -2", "above 0"),
        ("ElementSpacing", "1 1 inf", "not a finite number"),
        ("Offset", "1 2 " + "9" * 400, "not a finite number"),
        ("TransformMatrix", "1 0 0 1 0 0 0 0 1", "not a set of axes"),
        ("TransformMatrix", "1 0 0", "numbers"),
        ("ElementType", "MET_OTHER", "ElementType"),
        ("ElementNumberOfChannels", "3", "3 numbers per voxel"),
        ("DistanceUnits", "parsec", "DistanceUnits"),
    ],
)
def test_impossible_meta_headers_are_refused(tmp_path, field, text, words):
    refused(write_meta(tmp_path / "a.mha", **{field: text}), words)


def test_a_packed_file_is_unpacked_no_further_than_its_header_states(tmp_path):
    path = tmp_path / "bomb.nii.gz"
    straight = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 2, 7]]
    data = gzip.decompress(write_nifti(path, rows=straight).read_bytes())
    with gzip.open(path, "wb", compresslevel=1) as file:
        file.write(data)
        for _ in range(64):
            file.write(bytes(2**22))
    tracemalloc.start()
    refused(path, "longer than its header states")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**24


@pytest.mark.parametrize("change", ["tail", "checksum", "short", "long"])
@pytest.mark.parametrize("kind", ["gzip", "zlib", "bzip2"])
def test_packed_voxels_are_held_against_their_checksum_and_length(tmp_path, kind, change):
    """ITK pads, drops and takes damaged voxels without a word."""
    voxels = VALUES.T.tobytes()
    voxels = {"short": voxels[:-2], "long": voxels + b"ab"}.get(change, voxels)
    pack = {"gzip": gzip.compress, "zlib": zlib.compress, "bzip2": bz2.compress}[kind]
    packed = pack(voxels)
    if change == "tail":
        packed += b"more"
    elif change == "checksum":
        middle = len(packed) // 2
        packed = packed[:middle] + bytes([packed[middle] ^ 4]) + packed[middle + 1 :]
    path = tmp_path / "voxels"
    path.write_bytes(b"head" + packed)
    layer = VALUES[:, :, 0].nbytes
    given = (path, 4, VALUES.dtype, VALUES.shape, "bzip2" if kind == "bzip2" else "zlib")
    if change in {"tail", "long"}:
        read, (finding,) = stored_voxels(*given)
        np.testing.assert_array_equal(read, VALUES)
        assert finding.what.startswith(f"{4 if change == 'tail' else 2} bytes after its voxels")
    else:
        with pytest.raises(ImageError, match="voxels"):
            stored_voxels(*given)
    path.write_bytes(b"head" + pack(VALUES.T.tobytes()))
    assert stored_voxels(*given)[1] == ()
    # As many more as a slice has may be one that the header misses.
    path.write_bytes(b"head" + pack(VALUES.T.tobytes() + bytes(layer)))
    with pytest.raises(ImageError, match="longer than its header states"):
        stored_voxels(*given)


@pytest.mark.parametrize("kind", ["raw", "gzip", "bzip2"])
def test_a_nrrd_file_is_read_whatever_packs_it_and_with_bytes_after_it(tmp_path, kind):
    pack = {"raw": bytes, "gzip": gzip.compress, "bzip2": bz2.compress}[kind]
    path = write_nrrd(tmp_path / "a.nrrd", data=False, encoding=kind)
    header = path.read_bytes()
    apart = write_nrrd(tmp_path / "b.nhdr", data=False, encoding=kind, data_file="b.bin")
    for tail, expected in ((b"", []), (b"\0\n", ["field-ignored"])):
        path.write_bytes(header + pack(VALUES.T.tobytes()) + tail)
        (tmp_path / "b.bin").write_bytes(pack(VALUES.T.tobytes()) + tail)
        for file in (path, apart):
            found = read_image_file(file)
            assert np.array_equal(found.image.values, VALUES)
            assert [f.code for f in found.findings] == expected


@pytest.mark.parametrize("stated", [True, False])
def test_packed_voxels_of_a_meta_file_are_read_without_their_length(tmp_path, stated):
    """Without it, ITK read the text of the header as the begin of the voxels: other values."""
    packed = zlib.compress(VALUES.T.tobytes())
    size = {"CompressedDataSize": str(len(packed))} if stated else {}
    path = write_meta(tmp_path / "a.mha", data=False, CompressedData="True", **size)
    header = path.read_bytes()
    for tail, expected in ((b"", []), (b"\0\n", ["field-ignored"])):
        path.write_bytes(header + packed + tail)
        found = read_image_file(path)
        assert np.array_equal(found.image.values, VALUES)
        assert [f.code for f in found.findings] == expected


# Files elsewhere -------------------------------------------------------------------------------

ELSEWHERE = ["../secret.raw", "/etc/passwd", "below/../../secret.raw", "LIST", "%03d.raw 1 4 1"]


# No file is called so, on any system; a link in a circle leads nowhere.
NAMELESS = ["a" * 300 + ".raw", "[" * 5000, "a/" * 4000, "circle.raw", "\0.raw"]


@pytest.mark.parametrize(
    "name",
    [*ELSEWHERE, "link.raw", "linked/secret.raw", "absent.raw", *NAMELESS],
    ids=lambda name: repr(name[:20]),
)
@pytest.mark.parametrize("kind", ["nhdr", "mhd"])
def test_a_header_does_not_lead_out_of_its_folder(tmp_path, name, kind):
    (tmp_path / "secret.raw").write_bytes(VALUES.T.tobytes())
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "link.raw").symlink_to("../secret.raw")
    (folder / "linked").symlink_to("..")
    (folder / "circle.raw").symlink_to("circle.raw")
    if kind == "nhdr":
        path = write_nrrd(folder / "a.nhdr", data=False, data_file=name)
    else:
        path = write_meta(folder / "a.mhd", data=False, ElementDataFile=name)
    refused(path, "data file", name.split()[0][:20].removeprefix("\0"))


@pytest.mark.parametrize("kind", ["nhdr", "mhd"])
def test_a_data_file_in_the_store_of_git_annex_is_read(tmp_path, kind):
    """As DataLad keeps files: links into its own data set, above the folder of the patient."""
    store = tmp_path / ".git" / "annex" / "objects" / "x1"
    store.mkdir(parents=True)
    (store / "MD5E-s240").write_bytes(VALUES.T.tobytes())
    folder = tmp_path / "sub-01"
    folder.mkdir()
    (folder / "a.raw").symlink_to("../.git/annex/objects/x1/MD5E-s240")
    if kind == "nhdr":
        path = write_nrrd(folder / "a.nhdr", data=False, data_file="a.raw")
    else:
        path = write_meta(folder / "a.mhd", data=False, ElementDataFile="a.raw")
    np.testing.assert_array_equal(read_image(path).values, VALUES)
    # Another data set's store is elsewhere.
    other = tmp_path / "other" / ".git" / "annex" / "objects"
    other.mkdir(parents=True)
    (other / "b").write_bytes(VALUES.T.tobytes())
    (folder / "a.raw").unlink()
    (folder / "a.raw").symlink_to("../other/.git/annex/objects/b")
    refused(path, "data file")


@pytest.mark.parametrize("kind", ["nhdr", "mhd"])
def test_a_data_file_beside_or_below_its_header_is_read(tmp_path, kind):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "a.raw").write_bytes(VALUES.T.tobytes())
    if kind == "nhdr":
        path = write_nrrd(tmp_path / "a.nhdr", data=False, data_file="data/a.raw")
    else:
        path = write_meta(tmp_path / "a.mhd", data=False, ElementDataFile="data/a.raw")
    np.testing.assert_array_equal(read_image(path).values, VALUES)
    (tmp_path / "data" / "a.raw").write_bytes(VALUES.T.tobytes()[:-1])
    with pytest.raises(ImageError, match=r"a\.raw: is cut short"):
        read_image(path)


def test_an_image_is_read_by_its_content_whatever_its_name(tmp_path):
    image = ImageData(VALUES, (1.0, 1.0, 2.0))
    write_image(image, tmp_path / "a.nrrd")
    os.rename(tmp_path / "a.nrrd", tmp_path / "a.nii")  # noqa: PTH104
    np.testing.assert_array_equal(read_image(tmp_path / "a.nii").values, VALUES)


@pytest.mark.skipif(not hasattr(os, "sysconf"), reason="Windows does not tell its memory so")
@pytest.mark.parametrize("suffix", [".nrrd", ".nii.gz", ".mha"])
def test_voxels_beyond_the_memory_of_the_machine_are_refused_before_they_are_unpacked(
    tmp_path, monkeypatch, suffix
):
    """Some MB unpack to many GB: the system would end the process."""
    path = tmp_path / f"a{suffix}"
    write_image(ImageData(VALUES, (1.0, 1.0, 2.0)), path)
    np.testing.assert_array_equal(read_image(path).values, VALUES)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 1, "SC_PHYS_PAGES": 479}[name])
    refused(path, "240 bytes of voxels", "479 of memory")
