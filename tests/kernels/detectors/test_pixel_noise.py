"""Gaussian noise that is a function of the pixel: its distribution, and the independence of pixels and keys."""

import numpy as np
import pytest
from scipy import stats

from romandask.kernels.detectors.pixel_noise import _TAIL, pixel_noise

SIDE = 1500


def noise(key, rows=slice(0, SIDE), columns=slice(0, SIDE), variance=1.0):
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    plane = np.full(shape, variance, np.float32)
    return pixel_noise(plane, SIDE, rows.start, columns.start, np.uint64(key))


def test_a_window_has_the_noise_of_the_whole_detector():
    whole = noise(77)
    np.testing.assert_array_equal(noise(77, slice(300, 600), slice(37, 90)), whole[300:600, 37:90])


def test_the_noise_is_normal_also_in_its_tails():
    values = noise(5).ravel().astype(float)
    count = len(values)
    assert values.mean() == pytest.approx(0, abs=4 / np.sqrt(count))
    assert values.std() == pytest.approx(1, abs=4 / np.sqrt(2 * count))
    assert stats.skew(values) == pytest.approx(0, abs=4 * np.sqrt(6 / count))
    assert stats.kurtosis(values) == pytest.approx(0, abs=4 * np.sqrt(24 / count))
    assert stats.kstest(values, "norm").pvalue > 1e-3
    for limit in (3.0, _TAIL, 4.5):
        expected = 2 * stats.norm.sf(limit) * count
        assert (np.abs(values) > limit).sum() == pytest.approx(expected, abs=4 * np.sqrt(expected))
    tail = np.abs(values[np.abs(values) > _TAIL])
    cut = stats.truncnorm(_TAIL, np.inf)
    assert stats.kstest(tail, cut.cdf).pvalue > 1e-3


def test_pixels_and_keys_are_independent():
    first = noise(123456789)
    limit = 4 / np.sqrt(first.size)
    for other in (noise(123456790), np.roll(first, 1, 0), np.roll(first, 1, 1), np.roll(first, (1, 1), (0, 1))):
        assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < limit
        assert abs(np.corrcoef(first.ravel() ** 2, other.ravel() ** 2)[0, 1]) < limit


def test_the_noise_has_the_variance_of_each_pixel():
    ramp = np.broadcast_to(np.linspace(1, 100, SIDE, dtype=np.float32), (SIDE, SIDE)).copy()
    found = pixel_noise(ramp, SIDE, 0, 0, np.uint64(9))
    np.testing.assert_allclose((found**2 / ramp).mean(axis=0).reshape(-1, 100).mean(axis=1), 1, atol=0.03)
