"""The dates of two scans: the one after the operation is not the earlier one."""

import numpy as np
import pytest

import cmfsim
from cmfsim.io.images.dicom_series import study_date
from cmfsim.pipeline.building.surgery import postoperative
from cmfsim.pipeline.building.surgery.postoperative import read_postoperative
from dicom_series import axial, write_enhanced, write_series

pytest.importorskip("SimpleITK")

SHAPE = (24, 24, 12)


@pytest.fixture
def scans(tmp_path):
    """Writes the scans before and after, each of a date, and gives the case."""

    def written(before, after, more=""):
        noise = np.random.default_rng(0).normal(0.0, 10.0, SHAPE)
        values = np.round(np.where(np.indices(SHAPE)[0] < 4, -1000.0, 40.0) + noise)
        slices = axial(cmfsim.ImageData(values.astype(np.int16), (8.0, 8.0, 8.0), (0, 0, 0)))
        for name, date in (("before", before), ("after", after)):
            dated = [one.with_tags(t0008_0020=date) for one in slices]
            write_series(tmp_path / name, dated, uid=f"1.2.{len(name)}")
        sites = {name: [90.0, 90.0, 40.0] for name in ("nasion", "menton")}
        cmfsim.write_landmarks(tmp_path / "skull.mrk.json", sites)
        case = tmp_path / "case.toml"
        case.write_text(
            'format = "cmfsim-case"\nversion = 1\n[image]\nfile = "before"\n'
            '[landmarks]\nskull = "skull.mrk.json"\n'
            f'[postoperative]\nimage = "after"\n{more}',
            encoding="utf-8",
        )
        return cmfsim.Case.load(case)

    return written


def test_exchanged_scans_are_named_with_both_dates(scans):
    with pytest.raises(cmfsim.CaseError, match=r"after .* of 20230504 .* \[image\], of 20231109"):
        read_postoperative(scans("20231109", "20230504"))


@pytest.mark.parametrize(
    ("before", "after", "more"),
    [
        ("20230504", "20231109", ""),
        ("20230504", "20230504", ""),
        ("20231109", "2023.05.04", ""),
        ("20231109", "20230504", "verified = true\n"),
    ],
)
def test_dates_in_order_unknown_or_stated_to_be_wrong_pass(scans, before, after, more, monkeypatch):
    def reading(*_, **__):
        raise RuntimeError("the scan is read")

    monkeypatch.setattr(postoperative, "read_image_file", reading)
    with pytest.raises(RuntimeError, match="the scan is read"):
        read_postoperative(scans(before, after, more))


def test_a_folder_states_its_date_and_other_files_none(tmp_path, scans):
    scans("20230504", "20231109")
    assert study_date(tmp_path / "before", None) == "20230504"
    values = np.zeros(SHAPE, dtype=np.int16)
    slices = axial(cmfsim.ImageData(values, (8.0, 8.0, 8.0), (0, 0, 0)))
    write_enhanced(tmp_path / "frames.dcm", slices)
    assert study_date(tmp_path / "frames.dcm", None) == ""
    assert study_date(tmp_path / "case.toml", None) == ""
