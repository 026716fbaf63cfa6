"""Peaks of a PSF-smoothed image: their signal to noise, false ones, and the pixels that belong to each."""

import galsim
import numpy as np
import pytest

from romandask.kernels.measurement.extract import detect_peaks
from romandask.kernels.measurement.measurement_image import MeasurementImage
from romandask.kernels.measurement.peaks import KERNEL_HALF_WIDTH, find_peaks, point_source_snr
from romandask.model.seeds import rng

PSF = galsim.Convolve(galsim.Kolmogorov(fwhm=3.5), galsim.Pixel(1.0)).drawImage(
    nx=41, ny=41, scale=1, method="no_pixel"
)
RMS = 2.0


def layer(image: np.ndarray, mask: np.ndarray | None = None, ratio: float = 1.0) -> MeasurementImage:
    mask = np.zeros(image.shape, bool) if mask is None else mask
    error = np.where(mask, 0, RMS).astype(np.float32)
    return MeasurementImage(image.astype(np.float32), error, mask, np.ones(10), PSF.array, ratio)


def stars(shape, places, fluxes) -> np.ndarray:
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    for (x, y), flux in zip(places, fluxes, strict=True):
        (galsim.Kolmogorov(fwhm=3.5) * flux).drawImage(image, center=galsim.PositionD(x, y), add_to_image=True)
    return image.array


def noise_of_a_point() -> float:
    """Return the error of the flux of a point source that is fitted with the PSF."""
    middle = PSF.array.shape[0] // 2
    part = slice(middle - KERNEL_HALF_WIDTH, middle + KERNEL_HALF_WIDTH + 1)
    return RMS / np.sqrt((PSF.array[part, part].astype(float) ** 2).sum())


def test_the_signal_to_noise_is_that_of_a_fit_of_the_psf():
    shape, fluxes = (200, 200), [5 * noise_of_a_point(), 40 * noise_of_a_point()]
    image = stars(shape, [(60, 60), (140, 120)], fluxes)
    snr = point_source_snr(layer(image))
    assert snr[60, 60] == pytest.approx(5, rel=0.01)
    assert snr[120, 140] == pytest.approx(40, rel=0.01)
    np.testing.assert_allclose(point_source_snr(layer(image, ratio=1.25)) * 1.25, snr, rtol=1e-5, atol=1e-5)
    noise = point_source_snr(layer(rng(1, "noise").normal(0, RMS, (600, 600))))
    assert noise[20:-20, 20:-20].std() == pytest.approx(1, abs=0.02)


def test_noise_alone_has_no_peaks_of_five_sigma_and_faint_stars_are_found():
    shape = (900, 900)
    noise = rng(2, "noise").normal(0, RMS, shape)
    assert len(find_peaks(layer(noise), 2.5, 5, 5.0).snr) <= 1
    places = [(30 + 42 * i, 30 + 42 * j) for i in range(20) for j in range(20)]
    bright = stars(shape, places, [8 * noise_of_a_point()] * 400)
    found, segments = detect_peaks(layer(noise + bright), 2.5, 5, 5.0)
    # three sigma above the limit; a peak is the highest of some, and so a little higher than the star
    assert 390 <= len(found.x) <= 402
    assert np.median(found.snr) == pytest.approx(8.2, abs=0.4)
    assert found.flags.max() & 1 == 0
    nearest = np.array([np.hypot(found.x - x, found.y - y).min() for x, y in places])
    assert np.median(nearest) < 0.6
    assert np.unique(segments[segments > 0]).tolist() == list(range(1, segments.max() + 1))


def test_pixels_belong_to_the_peak_that_the_way_up_leads_to():
    """Against the same climb, a pixel at a time."""
    shape = (60, 70)
    places = rng(3, "places").uniform(8, 52, (14, 2))
    image = stars(shape, places, np.full(14, 900.0)) + rng(3, "noise").normal(0, RMS, shape)
    one = layer(image)
    snr, peaks = point_source_snr(one), find_peaks(one, 2.5, 3, 6.0)
    expected = np.zeros(shape, int)
    for start in zip(*np.nonzero(snr > np.float32(2.5)), strict=True):
        here = start
        while True:
            rows, columns = (range(max(k - 1, 0), min(k + 2, n)) for k, n in zip(here, shape, strict=True))
            best = max(((y, x) for y in rows for x in columns), key=lambda place: snr[place])
            if snr[best] <= snr[here]:
                break
            here = best
        expected[start] = here[0] * shape[1] + here[1] + 1
    roots = [root for root in np.unique(expected[expected > 0]) if snr.ravel()[root - 1] >= 6]
    roots = [root for root in roots if (expected == root).sum() >= 3]
    wanted = np.zeros(shape, int)
    for number, root in enumerate(roots, start=1):
        wanted[expected == root] = number
    np.testing.assert_array_equal(peaks.segments, wanted)
    np.testing.assert_allclose(peaks.snr, [snr.ravel()[root - 1] for root in roots])
    assert peaks.touching.any()


def test_two_stars_apart_by_more_than_the_psf_are_two_and_flagged():
    shape = (120, 120)
    image = stars(shape, [(50, 60), (58, 60)], [4000.0, 1500.0]) + rng(4, "noise").normal(0, RMS, shape)
    found, _ = detect_peaks(layer(image), 2.5, 5, 5.0)
    near = np.hypot(found.x - 58, found.y - 60) < 1.5
    assert near.sum() == 1
    assert (found.flags[np.hypot(found.x - 54, found.y - 60) < 6] & 1 == 1).all()
    assert 0.005 < found.blendedness[near][0] < 0.05
    assert found.blendedness[~near][0] < 0.005


def test_where_there_is_no_data_nothing_is_found():
    shape = (150, 150)
    mask = np.zeros(shape, bool)
    mask[:, 80:] = True
    image = stars(shape, [(40, 60), (110, 60)], [3000.0, 3000.0])
    found, segments = detect_peaks(layer(image, mask), 2.5, 5, 5.0)
    assert len(found.x) == 1
    assert not segments[:, 80:].any()
    nothing, segments = detect_peaks(layer(np.zeros(shape), np.ones(shape, bool)), 2.5, 5, 5.0)
    assert len(nothing.x) == 0
    assert not segments.any()
