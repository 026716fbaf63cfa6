"""Fits of the PSF to an image at many positions: fluxes of point sources."""

from __future__ import annotations

import numba
import numpy as np
from scipy import ndimage

WINDOW_HALF_WIDTH = 12
"""Half the width of the window of a fit, pixels."""
_SPLINE_HALF_WIDTH = 3
"""Half the width of the quintic B-spline with which the PSF is interpolated, pixels."""


def fit(image: np.ndarray, psf: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the flux of the PSF, without weights, to an image at some positions.

    The PSF P is shifted to each position with a quintic spline; beyond its own image it is 0.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        The data d.
    psf : ndarray, shape (side, side)
        PSF of unit flux, centred on the middle of the image.
    x, y : ndarray, shape (n,), pixels

    Returns
    -------
    flux : ndarray, shape (n,)
        sum(P d) / sum(P^2) over the window; NaN where the window is not inside the image.
    norm : ndarray, shape (n,)
        sum(P^2); 0 where the window is not inside the image.
    """
    coefficients = ndimage.spline_filter(np.asarray(psf, float), order=5)
    padded = np.pad(np.pad(coefficients, _SPLINE_HALF_WIDTH, mode="reflect"), WINDOW_HALF_WIDTH + _SPLINE_HALF_WIDTH)
    return _fit(image, padded, len(psf), np.asarray(x, float), np.asarray(y, float))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _fit(image, coefficients, side, x, y):
    """Fit a PSF of `side` pixels, given its spline coefficients, padded for windows that extend beyond the PSF."""
    width, padding = 2 * WINDOW_HALF_WIDTH + 1, WINDOW_HALF_WIDTH + 2 * _SPLINE_HALF_WIDTH
    flux, norm = np.full(len(x), np.nan), np.zeros(len(x))
    rows = np.empty((width + 2 * _SPLINE_HALF_WIDTH - 1, width))
    wx, wy = np.empty(2 * _SPLINE_HALF_WIDTH), np.empty(2 * _SPLINE_HALF_WIDTH)
    ny, nx = image.shape
    middle = (side - 1) / 2
    for n in range(len(x)):
        if not (np.isfinite(x[n]) and np.isfinite(y[n])):
            continue
        ix, iy = int(np.rint(x[n])), int(np.rint(y[n]))
        if (
            ix < WINDOW_HALF_WIDTH
            or iy < WINDOW_HALF_WIDTH
            or ix >= nx - WINDOW_HALF_WIDTH
            or iy >= ny - WINDOW_HALF_WIDTH
        ):
            continue
        # the position on the PSF has the same fractional part for all pixels of the window
        u, v = middle + ix - x[n], middle + iy - y[n]
        left, low = int(np.floor(u)), int(np.floor(v))
        _spline(u - left, wx)
        _spline(v - low, wy)
        first_column, first_row = (
            left - WINDOW_HALF_WIDTH - _SPLINE_HALF_WIDTH + 1 + padding,
            low - WINDOW_HALF_WIDTH - _SPLINE_HALF_WIDTH + 1 + padding,
        )
        for j in range(rows.shape[0]):
            for i in range(width):
                value = 0.0
                for k in range(2 * _SPLINE_HALF_WIDTH):
                    value += wx[k] * coefficients[first_row + j, first_column + i + k]
                rows[j, i] = value
        total, square = 0.0, 0.0
        for j in range(width):
            if not 0 <= v + j - WINDOW_HALF_WIDTH <= side - 1:
                continue
            for i in range(width):
                if not 0 <= u + i - WINDOW_HALF_WIDTH <= side - 1:
                    continue
                model = 0.0
                for k in range(2 * _SPLINE_HALF_WIDTH):
                    model += wy[k] * rows[j + k, i]
                square += model * model
                total += model * image[iy + j - WINDOW_HALF_WIDTH, ix + i - WINDOW_HALF_WIDTH]
        norm[n] = square
        if square > 0:
            flux[n] = total / square
    return flux, norm


@numba.njit(nogil=True, cache=True)
def _spline(fraction, weights):
    """Write the weights of the six spline coefficients around a position `fraction` of a pixel right of the third."""
    for k in range(6):
        d = abs(fraction + 2 - k)
        if d < 1:
            weights[k] = 11 / 20 - d**2 / 2 + d**4 / 4 - d**5 / 12
        elif d < 2:
            weights[k] = 17 / 40 + 5 * d / 8 - 7 * d**2 / 4 + 5 * d**3 / 4 - 3 * d**4 / 8 + d**5 / 24
        else:
            weights[k] = (3 - d) ** 5 / 120
