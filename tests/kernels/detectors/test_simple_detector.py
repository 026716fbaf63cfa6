"""The simple detector model: moments of the noise, saturation and reproducibility."""

from functools import partial

import numpy as np
import pytest

from romandask.kernels.detectors.simple_detector import (
    NOT_DRAWN,
    NOT_DRAWN_VALUE,
    SATURATED,
    Detector,
    observe,
    usable,
)
from romandask.model.seeds import rng

DETECTOR = Detector(saturation=1000.0, read_noise=8.5)


def test_noise_has_the_moments_of_poisson_and_read_noise():
    expected, background = np.full((600, 600), 40.0, np.float32), np.float32(110.0)
    image, dq = observe(expected, background, DETECTOR, partial(rng, 1, "t"))
    assert image.dtype == np.int32
    assert not dq.any()
    assert image.mean() == pytest.approx(150.0, abs=0.15)
    assert image.var() == pytest.approx(150.0 + 8.5**2 + 1 / 12, rel=0.01)
    residual = image - image.mean()
    assert np.abs(np.mean(residual[:, 1:] * residual[:, :-1])) < 2.0, "neighbours are correlated"


def test_bright_pixels_are_clipped_and_flagged():
    expected = np.zeros((64, 64), np.float32)
    expected[10, 20] = 1e6
    image, dq = observe(expected, np.float32(100.0), DETECTOR, partial(rng, 2, "t"))
    assert image[10, 20] < 1000 + 6 * 8.5
    assert dq[10, 20] == SATURATED
    assert (dq > 0).sum() == 1


def test_negative_expected_values_give_a_finite_image():
    image, _ = observe(np.full((20, 20), -5.0, np.float32), np.float32(1.0), DETECTOR, partial(rng, 3, "t"))
    assert np.isfinite(image).all()


def test_the_same_seed_gives_the_same_image():
    pair = [
        observe(np.zeros((300, 50), np.float32), np.float32(9.0), DETECTOR, partial(rng, 4, "t", 7))[0]
        for _ in range(2)
    ]
    np.testing.assert_array_equal(*pair)


@pytest.mark.parametrize("window", [(slice(256, 512), slice(0, 256)), (slice(0, 700), slice(512, 900))])
def test_a_window_has_the_pixels_of_the_whole_detector_and_the_rest_is_not_drawn(window):
    light = np.zeros((700, 900), np.float32)
    # means with and without a table of Poisson numbers
    light[::7, ::5] = np.geomspace(1, 5e5, light[::7, ::5].size).reshape(light[::7, ::5].shape)
    detector, generator = Detector(saturation=1e5, read_noise=8.5), partial(rng, 6, "t")
    image, dq = observe(light, np.float32(90.0), detector, generator)
    part, part_dq = observe(light, np.float32(90.0), detector, generator, window)
    np.testing.assert_array_equal(part[window], image[window])
    np.testing.assert_array_equal(part_dq[window], dq[window])
    outside = np.ones(light.shape, bool)
    outside[window] = False
    assert (part[outside] == NOT_DRAWN_VALUE).all()
    assert (part_dq[outside] == NOT_DRAWN).all()
    assert not usable(part_dq[outside]).any()
    assert (dq & SATURATED > 0).any()
    assert not (dq & NOT_DRAWN).any()
