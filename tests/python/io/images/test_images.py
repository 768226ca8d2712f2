"""Images in and out: formats, frames, and files that are not what they should be."""

import numpy as np
import pytest

import cmfsim
from cmfsim import ImageData, ImageError
from cmfsim.io.images.image_files import read_image, read_image_file, write_image

sitk = pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")
SHAPE = (12, 10, 8)
SPACING = (0.5, 0.75, 2.0)
ORIGIN = (-20.0, 7.0, 100.0)


def _values(dtype=np.int16):
    return np.random.default_rng(3).integers(-1000, 2000, SHAPE).astype(dtype)


def _itk(values=None, direction=None):
    image = sitk.GetImageFromArray((_values() if values is None else values).T)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    if direction is not None:
        image.SetDirection(np.ravel(direction).tolist())
    return image


def _refused(path, *words):
    with pytest.raises(ImageError) as caught:
        read_image(path)
    assert isinstance(caught.value, ValueError)
    for word in (path.name, *words):
        assert word in str(caught.value)


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".nii.gz", ".mha"])
@pytest.mark.parametrize("dtype", [np.int16, np.uint16, np.float32, np.uint8])
def test_what_was_written_is_read(tmp_path, suffix, dtype):
    values = np.abs(_values()).astype(dtype)
    write_image(ImageData(values, SPACING, ORIGIN), tmp_path / f"a{suffix}")
    image = read_image(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(image.values, values)
    np.testing.assert_allclose(image.spacing, SPACING, rtol=1e-6)
    np.testing.assert_allclose(image.origin, ORIGIN, rtol=1e-6)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 0, 2)])
@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1)])
def test_each_voxel_keeps_its_place_in_any_axis_order(tmp_path, order, signs):
    direction = np.zeros((3, 3))
    for axis, (to, sign) in enumerate(zip(order, signs, strict=True)):
        direction[to, axis] = sign
    turned = _itk(direction=direction)
    sitk.WriteImage(turned, str(tmp_path / "a.nii.gz"))
    found = read_image_file(tmp_path / "a.nii.gz")
    index = (3, 7, 2)
    place = turned.TransformIndexToPhysicalPoint(index)
    assert found.image.sample([place])[0] == turned[index]
    assert not found.findings


def test_an_oblique_image_is_resampled_and_said(tmp_path):
    x, y, z = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    angle = np.radians(12.0)
    c, s = np.cos(angle), np.sin(angle)
    direction = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    turned = _itk((10.0 * x + 3.0 * y + 5.0 * z).astype(np.float32), direction)
    sitk.WriteImage(turned, str(tmp_path / "a.nrrd"))
    found = read_image_file(tmp_path / "a.nrrd")
    assert [f.code for f in found.findings] == ["image-oblique"]
    assert "12.0°" in found.findings[0].what
    # Linear values survive linear interpolation, away from the border.
    for index in [(4, 4, 3), (6, 5, 4)]:
        place = turned.TransformIndexToPhysicalPoint(index)
        assert found.image.sample([place])[0] == pytest.approx(turned[index], abs=1e-3)


def _write_series(folder, values=None, *, drop=(), modality="CT", uid="1.2.3", name="head"):
    folder.mkdir(exist_ok=True)
    values = _values() if values is None else values
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(values.shape[2]):
        if k in drop:
            continue
        image = sitk.GetImageFromArray(values[:, :, k].T)
        image.SetSpacing(SPACING[:2])
        tags = {
            "0008|0060": modality,
            "0008|103e": name,
            "0020|000e": uid,
            "0020|000d": "1.2",
            "0008|0018": f"{uid}.{k + 1}",
            "0020|0013": str(k + 1),
            "0020|0032": f"{ORIGIN[0]}\\{ORIGIN[1]}\\{ORIGIN[2] + k * SPACING[2]}",
            "0020|0037": "1\\0\\0\\0\\1\\0",
            "0028|1052": "-1024",
            "0028|1053": "1",
        }
        for tag, text in tags.items():
            image.SetMetaData(tag, text)
        writer.SetFileName(str(folder / f"{uid}_{k:03d}.dcm"))
        writer.Execute(image)


def test_a_dicom_folder_is_read_with_rescale_and_place(tmp_path):
    _write_series(tmp_path / "ct")
    found = read_image_file(tmp_path / "ct")
    np.testing.assert_array_equal(found.image.values, _values())
    np.testing.assert_allclose(found.image.spacing, SPACING)
    np.testing.assert_allclose(found.image.origin, ORIGIN)
    assert found.modality == "CT"


def test_the_largest_of_several_series_is_taken_and_said(tmp_path):
    _write_series(tmp_path / "ct", uid="1.2.3", name="thin")
    _write_series(tmp_path / "ct", _values()[:, :, :3], uid="1.2.4", name="scout")
    found = read_image_file(tmp_path / "ct")
    assert found.image.values.shape == SHAPE
    assert [f.code for f in found.findings] == ["dicom-series"]
    assert "'thin' (number -, 8 slices" in found.findings[0].what


def test_equal_series_are_refused(tmp_path):
    _write_series(tmp_path / "ct", uid="1.2.3", name="soft")
    _write_series(tmp_path / "ct", uid="1.2.4", name="sharp")
    _refused(tmp_path / "ct", "'soft'", "'sharp'")


def test_missing_slices_are_named(tmp_path):
    _write_series(tmp_path / "ct", drop=(3,))
    _refused(tmp_path / "ct", "4 mm between 104.00 and 108.00 mm")


def test_mr_is_refused(tmp_path):
    _write_series(tmp_path / "mr", modality="MR")
    _refused(tmp_path / "mr", "'MR'")
    with pytest.raises(ImageError, match="'MR'"):
        read_image(next((tmp_path / "mr").glob("*.dcm")))


def test_files_that_are_no_volume_are_refused(tmp_path):
    (tmp_path / "empty.nrrd").write_bytes(b"")
    _refused(tmp_path / "empty.nrrd", "empty")
    (tmp_path / "text.nii").write_text("not an image")
    _refused(tmp_path / "text.nii", "not a readable image")
    (tmp_path / "folder").mkdir()
    _refused(tmp_path / "folder", "no DICOM")
    sitk.WriteImage(sitk.JoinSeries([_itk(), _itk()]), str(tmp_path / "four.nii"))
    _refused(tmp_path / "four.nii", "4 axes")
    sitk.WriteImage(sitk.Compose(_itk(), _itk(), _itk()), str(tmp_path / "rgb.nrrd"))
    _refused(tmp_path / "rgb.nrrd", "3 numbers per voxel")
    sitk.WriteImage(_itk()[:, :, :1], str(tmp_path / "slice.nrrd"))
    _refused(tmp_path / "slice.nrrd", "single slice")
    bad = _values(np.float32)
    bad[1, 2, 3] = np.inf
    sitk.WriteImage(_itk(bad), str(tmp_path / "inf.nrrd"))
    _refused(tmp_path / "inf.nrrd", "1 voxels are NaN")
    with pytest.raises(FileNotFoundError, match="gone"):
        read_image(tmp_path / "gone.nrrd")


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".nii.gz", ".mha"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.9])
def test_truncated_files_are_refused(tmp_path, suffix, part):
    path = tmp_path / f"a{suffix}"
    write_image(ImageData(_values(), SPACING, ORIGIN), path)
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(ImageError, match=r"a\."):
        read_image(path)


def test_zero_spacing_is_refused(tmp_path):
    path = tmp_path / "a.mha"
    write_image(ImageData(_values(), SPACING, ORIGIN), path)
    path.write_bytes(path.read_bytes().replace(b"ElementSpacing = 0.5", b"ElementSpacing = 0.0"))
    with pytest.raises(ImageError, match=r"a\.mha"):
        read_image(path)


def test_nothing_is_printed(tmp_path, capfd):
    (tmp_path / "text.nii").write_text("not an image")
    with pytest.raises(ImageError):
        read_image(tmp_path / "text.nii")
    _write_series(tmp_path / "ct")
    read_image(tmp_path / "ct")
    assert capfd.readouterr() == ("", "")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.nrrd"
    path.write_bytes(b"old")

    def fail(*_args, **_kwargs):
        raise RuntimeError("disk full")

    monkeypatch.setattr(sitk, "WriteImage", fail)
    with pytest.raises(ImageError, match="disk full"):
        write_image(ImageData(_values(), SPACING, ORIGIN), path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.nrrd"]


def test_other_endings_are_not_written(tmp_path):
    with pytest.raises(ImageError, match=r"\.nrrd"):
        write_image(ImageData(_values(), SPACING, ORIGIN), tmp_path / "a.png")
    with pytest.raises(FileNotFoundError):
        write_image(ImageData(_values(), SPACING, ORIGIN), tmp_path / "no" / "a.nrrd")


def test_reading_is_part_of_the_package():
    assert cmfsim.read_image is read_image
