"""Fits of the PSF to an image at many places: fluxes of point sources, and how they scatter in noise."""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

from romandask.kernels.measurement.measurement_image import TRIALS, at

RADIUS = 12
"""Half the side of the window of a fit, pixels."""
_REACH = 3
"""Half the width of the quintic B-spline between whose coefficients the PSF is interpolated, pixels."""


def fit(image: np.ndarray, psf: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return sum(P d) / sum(P^2) and sum(P^2), both (n,), with the PSF shifted to each position by a quintic spline.

    NaN and 0 where the window does not lie in the image; beyond its own image the PSF is 0.

    Parameters
    ----------
    image : (ny, nx)
    psf : (side, side) unit star in the middle
    x, y : (n,) pixels
    """
    coefficients = ndimage.spline_filter(np.asarray(psf, float), order=5)
    padded = np.pad(np.pad(coefficients, _REACH, mode="reflect"), RADIUS + _REACH)
    return _fit(image, padded, len(psf), np.asarray(x, float), np.asarray(y, float))


def scatter(noise: np.ndarray, psf: np.ndarray, error: np.ndarray) -> float:
    """Return how much larger the scatter of PSF fits to a noise realisation is than that of white noise.

    `error` (ny, nx) is the rms of a pixel, 0 for no data.
    """
    random = np.random.default_rng(0)
    ny, nx = noise.shape
    x, y = (random.uniform(RADIUS, n - 1 - RADIUS, TRIALS) for n in (nx, ny))
    trial, norm = fit(noise, psf, x, y)
    pixel = at(error, x, y)
    good = (pixel > 0) & (norm > 0)
    return float(np.std(trial[good] * np.sqrt(norm[good]) / pixel[good])) if good.sum() > 50 else 1.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _fit(image, coefficients, side, x, y):
    """`coefficients` are those of a PSF of `side` pixels, with room around them for a window that reaches beyond it."""
    width, room = 2 * RADIUS + 1, RADIUS + 2 * _REACH
    flux, norm = np.full(len(x), np.nan), np.zeros(len(x))
    rows = np.empty((width + 2 * _REACH - 1, width))
    wx, wy = np.empty(2 * _REACH), np.empty(2 * _REACH)
    ny, nx = image.shape
    middle = (side - 1) / 2
    for n in range(len(x)):
        if not (np.isfinite(x[n]) and np.isfinite(y[n])):
            continue
        ix, iy = int(np.rint(x[n])), int(np.rint(y[n]))
        if ix < RADIUS or iy < RADIUS or ix >= nx - RADIUS or iy >= ny - RADIUS:
            continue
        # of every pixel of the window the place on the PSF has the same fraction
        u, v = middle + ix - x[n], middle + iy - y[n]
        left, low = int(np.floor(u)), int(np.floor(v))
        _spline(u - left, wx)
        _spline(v - low, wy)
        first_column, first_row = left - RADIUS - _REACH + 1 + room, low - RADIUS - _REACH + 1 + room
        for j in range(rows.shape[0]):
            for i in range(width):
                value = 0.0
                for k in range(2 * _REACH):
                    value += wx[k] * coefficients[first_row + j, first_column + i + k]
                rows[j, i] = value
        total, square = 0.0, 0.0
        for j in range(width):
            if not 0 <= v + j - RADIUS <= side - 1:
                continue
            for i in range(width):
                if not 0 <= u + i - RADIUS <= side - 1:
                    continue
                model = 0.0
                for k in range(2 * _REACH):
                    model += wy[k] * rows[j + k, i]
                square += model * model
                total += model * image[iy + j - RADIUS, ix + i - RADIUS]
        norm[n] = square
        if square > 0:
            flux[n] = total / square
    return flux, norm


@numba.njit(nogil=True, cache=True)
def _spline(fraction, weights):
    """Fill `weights` with those of the six coefficients around a place, `fraction` of a pixel right of the third."""
    for k in range(6):
        d = abs(fraction + 2 - k)
        if d < 1:
            weights[k] = 11 / 20 - d**2 / 2 + d**4 / 4 - d**5 / 12
        elif d < 2:
            weights[k] = 17 / 40 + 5 * d / 8 - 7 * d**2 / 4 + 5 * d**3 / 4 - 3 * d**4 / 8 + d**5 / 24
        else:
            weights[k] = (3 - d) ** 5 / 120
