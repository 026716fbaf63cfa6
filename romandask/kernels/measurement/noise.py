"""Noise of an image, measured from a realisation: rms of a pixel, and scatter of apertures and PSF fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sep

from romandask.kernels.measurement.measurement_image import NOISE_RADII, errors, pixel_values
from romandask.kernels.measurement.psf_fit import WINDOW_HALF_WIDTH, fit

TRIALS = 2000
"""Number of apertures of each radius, and of PSF fits."""
_RMS_PIXELS = 4_000_000
"""Approximate number of pixels from which the rms of the noise is measured."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Noise of an image."""

    rms: float
    """Rms of a pixel of unit weight; 0 if no pixel has weight."""
    aperture_ratios: np.ndarray
    """Scatter of aperture fluxes in the noise over that in white noise, (len(NOISE_RADII),)."""
    psf_ratio: float
    """Scatter of fluxes from PSF fits to the noise over that in white noise."""


def measured_noise(noise: np.ndarray, weight: np.ndarray, psf: np.ndarray) -> Noise:
    """Return the noise of an image.

    Parameters
    ----------
    noise, weight : ndarray, shape (windows, ny, nx)
        Realisation of the noise, and weight of a pixel, in one or more windows of the image. The weight is overwritten.
    psf : ndarray, shape (side, side)
        PSF of unit flux; a PSF of zeros is not fitted.
    """
    rms = rms_of(noise, weight)
    error, mask = errors(weight, rms)
    return Noise(
        rms=rms,
        aperture_ratios=noise_ratios(noise, error, mask),
        psf_ratio=scatter(noise, psf, error),
    )


def rms_of(noise: np.ndarray, weight: np.ndarray) -> float:
    """Return the robust rms of a noise realisation times the square root of its weight.

    Parameters
    ----------
    noise, weight : ndarray, shape (..., ny, nx)

    Returns
    -------
    float
        1.4826 times the median absolute deviation; 0 if no pixel has weight.
    """
    step = max(1, int(np.sqrt(noise.size / _RMS_PIXELS)))
    sampled = weight[..., ::step, ::step]
    scaled = noise[..., ::step, ::step][sampled > 0] * np.sqrt(sampled[sampled > 0])
    if not len(scaled):
        return 0.0
    return float(1.4826 * np.median(np.abs(scaled - np.median(scaled))))


def noise_ratios(noise: np.ndarray, error: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the scatter of aperture fluxes in a noise realisation over that in white noise.

    Parameters
    ----------
    noise, error, mask : ndarray, shape (windows, ny, nx)
        Noise realisation, rms of a pixel, and True for no data, in one or more windows of an image.

    Returns
    -------
    ndarray, shape (len(NOISE_RADII),)
        Ratio for each radius. For radii too large for a window, it is that of the largest radius that fits; 1
        where too few apertures have data.
    """
    ratios = np.ones(len(NOISE_RADII))
    windows, ny, nx = noise.shape
    # the positions only sample the realisation, so any fixed sequence is good enough
    random = np.random.default_rng(0)
    for k, radius in enumerate(NOISE_RADII):
        if min(ny, nx) < 4 * radius:
            ratios[k:] = ratios[max(k - 1, 0)]
            break
        trials = []
        for window in range(windows):
            x, y = (random.uniform(radius, n - 1 - radius, -(-TRIALS // windows)) for n in (nx, ny))
            flux, white, flag = sep.sum_circle(
                noise[window], x, y, radius, err=error[window], mask=mask[window], subpix=5
            )
            good = (flag == 0) & (white > 0)
            trials.append(flux[good] / white[good])
        scaled = np.concatenate(trials)
        if len(scaled) > 50:
            ratios[k] = np.std(scaled)
    return ratios


def scatter(noise: np.ndarray, psf: np.ndarray, error: np.ndarray) -> float:
    """Return the scatter of fluxes from PSF fits to a noise realisation over that in white noise.

    Parameters
    ----------
    noise : ndarray, shape (windows, ny, nx)
        Noise realisation in one or more windows of an image.
    psf : ndarray, shape (side, side)
    error : ndarray, shape (windows, ny, nx)
        Rms of a pixel; 0 for no data.

    Returns
    -------
    float
        1 if there are too few pixels with data.
    """
    random = np.random.default_rng(0)
    windows, ny, nx = noise.shape
    if min(ny, nx) <= 2 * WINDOW_HALF_WIDTH + 1:
        return 1.0
    trials = []
    for window in range(windows):
        x, y = (random.uniform(WINDOW_HALF_WIDTH, n - 1 - WINDOW_HALF_WIDTH, -(-TRIALS // windows)) for n in (nx, ny))
        trial, norm = fit(noise[window], psf, x, y)
        rms = pixel_values(error[window], x, y)
        good = (rms > 0) & (norm > 0)
        trials.append(trial[good] * np.sqrt(norm[good]) / rms[good])
    scaled = np.concatenate(trials)
    return float(np.std(scaled)) if len(scaled) > 50 else 1.0
