"""Images on other grids, compared with ITK."""

import numpy as np
import pytest

from cmfsim.imaging.morphology import as_array, as_itk, binned, resampled_to, simpleitk

pytest.importorskip("SimpleITK")


def by_itk(values, spacing, shift, shape, target):
    filters = simpleitk()
    image = as_itk(values, spacing)
    image.SetOrigin(shift.tolist())
    resampler = filters.ResampleImageFilter()
    resampler.SetSize(list(shape))
    resampler.SetOutputSpacing(target.tolist())
    resampler.SetInterpolator(filters.sitkLinear)
    resampler.UseNearestNeighborExtrapolatorOn()
    resampler.SetOutputPixelType(filters.sitkFloat32)
    return as_array(resampler.Execute(image))


@pytest.mark.parametrize("kind", [np.float32, np.int16, np.uint8])
@pytest.mark.parametrize("seed", range(8))
def test_resampling_is_that_of_itk_inside_and_beyond_the_borders(seed, kind):
    rng = np.random.default_rng(seed)
    values = np.asfortranarray((100.0 * rng.random(rng.integers(1, 30, 3))).astype(kind))
    spacing, target = rng.uniform(0.5, 3.0, (2, 3))
    shift = rng.uniform(-4.0, 4.0, 3) if seed % 2 else 0.5 * (spacing - target)
    shape = tuple(rng.integers(1, 50, 3).tolist())
    found = resampled_to(values, spacing, shift, shape, target)
    expected = by_itk(values, spacing, shift, shape, target)
    assert found.dtype == expected.dtype == np.float32
    # The same bits on x86; where ITK fuses products and sums, the last one may differ.
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int16, np.uint8])
@pytest.mark.parametrize("seed", range(6))
def test_means_of_blocks_are_those_of_itk(seed, kind):
    rng = np.random.default_rng(seed)
    values = np.asfortranarray((100.0 * rng.normal(size=rng.integers(1, 30, 3))).astype(kind))
    factors, spacing = tuple(rng.integers(1, 5, 3).tolist()), rng.uniform(0.5, 3.0, 3)
    means, steps, shift = binned(values, factors, spacing)
    blocks = [min(f, n) for f, n in zip(factors, values.shape, strict=True)]
    image = simpleitk().BinShrink(as_itk(values, spacing), blocks)
    assert means.dtype == values.dtype
    np.testing.assert_allclose(means, as_array(image), rtol=1e-14)
    np.testing.assert_allclose(steps, image.GetSpacing(), rtol=1e-14)
    np.testing.assert_allclose(shift, image.GetOrigin(), atol=1e-12)
