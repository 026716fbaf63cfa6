"""Peaks of a PSF-smoothed image: signal to noise, false detections, and the pixels of each peak."""

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


def measurement(image: np.ndarray, mask: np.ndarray | None = None, ratio: float = 1.0) -> MeasurementImage:
    mask = np.zeros(image.shape, bool) if mask is None else mask
    error = np.where(mask, 0, RMS).astype(np.float32)
    return MeasurementImage(
        image=image.astype(np.float32),
        error=error,
        mask=mask,
        aperture_ratios=np.ones(10),
        psf=PSF.array,
        psf_ratio=ratio,
    )


def stars(shape, positions, fluxes) -> np.ndarray:
    """Draw stars with GalSim at positions (x, y) in pixels."""
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    for (x, y), flux in zip(positions, fluxes, strict=True):
        (galsim.Kolmogorov(fwhm=3.5) * flux).drawImage(image, center=galsim.PositionD(x, y), add_to_image=True)
    return image.array


def point_source_error() -> float:
    """Return the error of the flux of a point source from a fit of the PSF."""
    middle = PSF.array.shape[0] // 2
    part = slice(middle - KERNEL_HALF_WIDTH, middle + KERNEL_HALF_WIDTH + 1)
    return RMS / np.sqrt((PSF.array[part, part].astype(float) ** 2).sum())


def test_the_signal_to_noise_agrees_with_that_of_a_psf_fit():
    shape, fluxes = (200, 200), [5 * point_source_error(), 40 * point_source_error()]
    image = stars(shape, [(60, 60), (140, 120)], fluxes)
    snr = point_source_snr(measurement(image))
    assert snr[60, 60] == pytest.approx(5, rel=0.01)
    assert snr[120, 140] == pytest.approx(40, rel=0.01)
    np.testing.assert_allclose(point_source_snr(measurement(image, ratio=1.25)) * 1.25, snr, rtol=1e-5, atol=1e-5)
    noise = point_source_snr(measurement(rng(1, "noise").normal(0, RMS, (600, 600))))
    assert noise[20:-20, 20:-20].std() == pytest.approx(1, abs=0.02)


@pytest.mark.slow
def test_noise_alone_has_no_peaks_of_five_sigma_and_faint_stars_are_found():
    shape = (900, 900)
    noise = rng(2, "noise").normal(0, RMS, shape)
    assert len(find_peaks(measurement(noise), 2.5, 5, 5.0).snr) <= 1
    positions = [(30 + 42 * i, 30 + 42 * j) for i in range(20) for j in range(20)]
    bright = stars(shape, positions, [8 * point_source_error()] * 400)
    objects, segments = detect_peaks(measurement(noise + bright), 2.5, 5, 5.0)
    # stars are three sigma above the limit; a peak is the highest of several pixels, so it is biased high
    assert 390 <= len(objects.x) <= 402
    assert np.median(objects.snr) == pytest.approx(8.2, abs=0.4)
    assert objects.flags.max() & 1 == 0
    nearest = np.array([np.hypot(objects.x - x, objects.y - y).min() for x, y in positions])
    assert np.median(nearest) < 0.6
    assert np.unique(segments[segments > 0]).tolist() == objects.label.tolist()
    # an object has the number of the pixel of its peak
    row, column = np.divmod(objects.label - 1, shape[1])
    assert (segments[row, column] == objects.label).all()
    assert np.hypot(column - objects.x, row - objects.y).max() < 3


def test_pixels_belong_to_the_peak_uphill_of_them():
    """Compare with a climb from each pixel in plain Python."""
    shape = (60, 70)
    positions = rng(3, "places").uniform(8, 52, (14, 2))
    image = stars(shape, positions, np.full(14, 900.0)) + rng(3, "noise").normal(0, RMS, shape)
    detection_image = measurement(image)
    snr, peaks = point_source_snr(detection_image), find_peaks(detection_image, 2.5, 3, 6.0)
    expected = np.zeros(shape, int)
    for start in zip(*np.nonzero(snr > np.float32(2.5)), strict=True):
        pixel = start
        while True:
            rows, columns = (range(max(k - 1, 0), min(k + 2, n)) for k, n in zip(pixel, shape, strict=True))
            best = max(((y, x) for y in rows for x in columns), key=lambda neighbour: snr[neighbour])
            if snr[best] <= snr[pixel]:
                break
            pixel = best
        expected[start] = pixel[0] * shape[1] + pixel[1] + 1
    roots = [root for root in np.unique(expected[expected > 0]) if snr.ravel()[root - 1] >= 6]
    roots = [root for root in roots if (expected == root).sum() >= 3]
    segments = np.zeros(shape, int)
    for number, root in enumerate(roots, start=1):
        segments[expected == root] = number
    np.testing.assert_array_equal(peaks.segments, segments)
    np.testing.assert_allclose(peaks.snr, [snr.ravel()[root - 1] for root in roots])
    assert peaks.touching.any()


def test_two_stars_further_apart_than_the_psf_are_separate_and_flagged():
    shape = (120, 120)
    image = stars(shape, [(50, 60), (58, 60)], [4000.0, 1500.0]) + rng(4, "noise").normal(0, RMS, shape)
    objects, _ = detect_peaks(measurement(image), 2.5, 5, 5.0)
    near = np.hypot(objects.x - 58, objects.y - 60) < 1.5
    assert near.sum() == 1
    assert (objects.flags[np.hypot(objects.x - 54, objects.y - 60) < 6] & 1 == 1).all()
    assert 0.005 < objects.blendedness[near][0] < 0.05
    assert objects.blendedness[~near][0] < 0.005


def test_nothing_is_detected_where_there_is_no_data():
    shape = (150, 150)
    mask = np.zeros(shape, bool)
    mask[:, 80:] = True
    image = stars(shape, [(40, 60), (110, 60)], [3000.0, 3000.0])
    objects, segments = detect_peaks(measurement(image, mask), 2.5, 5, 5.0)
    assert len(objects.x) == 1
    assert not segments[:, 80:].any()
    empty, segments = detect_peaks(measurement(np.zeros(shape), np.ones(shape, bool)), 2.5, 5, 5.0)
    assert len(empty.x) == 0
    assert not segments.any()
