"""Damaged files of every format are read as they say or refused: the small twin of fuzz/readers.py.

Readers run in a process of their own, so that a crash fails one test and not all.
"""

import random

import numpy as np
import pytest

pytest.importorskip("meshio")
pytest.importorskip("SimpleITK")

import cmfsim
import oracles
from mutations import mutated, mutated_inside
from reader_table import READERS, changed_in_silence
from readers import Tally, markdown, run

FAST = [reader for reader in READERS if not reader.slow]
MUTANTS, SEED = 60, 1


@pytest.fixture(scope="module")
def tallies(tmp_path_factory):
    found = run(FAST, MUTANTS, SEED, tmp_path_factory.mktemp("faults"))
    return {tally.name: tally for tally in found}


@pytest.mark.parametrize("name", [reader.name for reader in FAST])
def test_no_damage_crashes_hangs_or_changes_in_silence(name, tallies):
    tally = tallies[name]
    assert sum(tally.counts.values()) == MUTANTS
    assert tally.is_sound, "\n".join(tally.faults)


def test_the_same_seed_makes_the_same_mutants():
    data = b"v 1 2 3\nf 1 2 3\n" * 9
    made = [[mutated(data, random.Random(k)) for k in range(50)] for _ in range(2)]
    assert made[0] == made[1]
    assert len(set(made[0])) > 40


def test_a_fault_of_each_kind_is_found():
    """What the fuzzer is for: it must not pass readers that guess."""
    obj = next(reader for reader in READERS if reader.name == "OBJ")
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    text = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    right = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 1, 3]])
    assert changed_in_silence(obj, text, right) is None
    shorter = cmfsim.SurfaceData(corners, [[0, 1, 2]])
    other = cmfsim.SurfaceData(corners, [[0, 1, 2], [0, 2, 3]])
    assert "1 triangles where the file holds 2" in changed_in_silence(obj, text, shorter)
    assert "other vertices" in changed_in_silence(obj, text, other)
    assert "not valid" in changed_in_silence(obj, text + b"f 1 2 0\n", right)
    assert "not finite" in changed_in_silence(obj, text, {"a": np.array([np.nan])})
    with pytest.raises(ValueError, match=r"0, 1, 8"):
        oracles.obj(text.replace(b"f 1 2 4", b"f 1 2 9"))


def test_the_rules_of_images_are_those_of_their_formats(tmp_path):
    """NRRD's names in any case, MetaImage's blanks, and oblique axes on another grid."""
    by_name = {reader.name: reader for reader in READERS}
    image = cmfsim.ImageData(np.zeros((6, 7, 8), dtype=np.int16), (0.5, 0.75, 1.5))
    other = cmfsim.ImageData(np.zeros((6, 7, 9), dtype=np.int16), (0.5, 0.75, 1.5))
    for name, old, new in (
        ("NRRD", b"sizes:", b"sizEs:"),
        ("MetaImage", b"DimSize =", b"DimSize="),
    ):
        reader = by_name[name]
        assert reader.make(tmp_path, 0)
        data = (tmp_path / reader.target).read_bytes()
        assert old in data
        for text in (data, data.replace(old, new)):
            assert changed_in_silence(reader, text, image) is None
            assert "by its header" in changed_in_silence(reader, text, other)
            assert "fewer" in changed_in_silence(reader, text[:-1], image)
    reader = by_name["NRRD"]
    assert reader.make(tmp_path, 0)
    data = (tmp_path / reader.target).read_bytes()
    sheared = data.replace(b"(0,0.75,0)", b"(0,0.75,0.1)")
    assert sheared != data
    assert changed_in_silence(reader, sheared, other) is None


def test_packed_files_are_changed_inside(tmp_path):
    """The checksums of most are right, so that readers see the change."""
    archive = next(reader for reader in READERS if reader.name == "scene .npz")
    archive.make(tmp_path, 0)
    data = (tmp_path / archive.target).read_bytes()
    changed = 0
    for number in range(40):
        (tmp_path / archive.target).write_bytes(mutated_inside(data, random.Random(number)))
        try:
            archive.read(tmp_path / archive.target)
        except cmfsim.CmfsimError as error:
            changed += "CRC" not in str(error)
    assert changed > 20


def test_the_table_lists_every_reader():
    tally = Tally("OBJ")
    tally.counts.update(["refused", "refused", "same", "crash"])
    table = markdown([tally], 4, 0)
    assert "| OBJ | 2 | 1 | 0 | 0 | 0 | 0 | 1 | 0.00 |" in table
    assert not tally.is_sound
    assert len({reader.name for reader in READERS}) == len(READERS) >= 25
