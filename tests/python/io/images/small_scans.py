"""Small scans, and how their series must be read or refused."""

import numpy as np
import pytest

from cmfsim import ImageData, ImageError
from cmfsim.io.images.image_files import read_image_file

SHAPE = (12, 10, 8)


def smooth(shape=SHAPE, spacing=(0.5, 0.75, 2.0), origin=(-20.0, 7.0, 100.0)):
    """Values linear in space, which linear interpolation keeps."""
    image = ImageData(np.zeros(shape), spacing, origin)
    x, y, z = image.axes()
    return image.with_values(np.round(20.0 * x + 10.0 * y - 15.0 * z).astype(np.int16))


def noisy():
    values = np.random.default_rng(3).integers(-1000, 2000, SHAPE).astype(np.int16)
    return ImageData(values, (0.5, 0.75, 2.0), (-20.0, 7.0, 100.0))


def codes(found):
    return {f.code for f in found.findings}


def refused(folder, *words, **options):
    with pytest.raises(ImageError) as caught:
        read_image_file(folder, **options)
    assert isinstance(caught.value, ValueError)
    for word in words:
        assert word in str(caught.value)


def same(found, image):
    np.testing.assert_array_equal(found.image.values, image.values)
    np.testing.assert_allclose(found.image.spacing, image.spacing, atol=1e-6)
    np.testing.assert_allclose(found.image.lowest, image.lowest, atol=1e-6)
