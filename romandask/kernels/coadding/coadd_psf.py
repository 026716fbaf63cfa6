"""PSFs of drizzled images: those of the exposures, spread over their drops and the pixels of the tile."""

from __future__ import annotations

import numba
import numpy as np
from scipy import fft

LANCZOS = 5
"""Half the reach of the interpolation, samples (Troxel et al. 2023, section 5.2)."""


def drizzled_psf(
    fine: np.ndarray, oversampling: int, jacobian: np.ndarray, pixfrac: float, side: int, step: float = 1.0
) -> np.ndarray:
    """Return a unit star as it is on average in a drizzled exposure, (side, side), centred on the pixel in the middle.

    Where in its pixels an exposure catches a star is left to chance: it is the mean over all places.

    Parameters
    ----------
    fine : (n, n) unit star, `oversampling` samples a native pixel, each the share of light in a native pixel centred
        there; the star on sample n / 2
    jacobian : (2, 2) tile pixels a native pixel: d(x, y on the tile) / d(x, y on the exposure)
    pixfrac : side of a drop over that of a native pixel
    step : tile pixels between samples; each is the share of light in a tile pixel centred there
    """
    n = len(fine)
    frequency = fft.fftfreq(n, 1 / oversampling)
    kx, ky = fft.rfftfreq(n, 1 / oversampling)[None, :], frequency[:, None]
    # the tile's pixel seen from the exposure: k x = (J^-T k) (J x)
    inverse = np.linalg.inv(jacobian)
    qx, qy = inverse[0, 0] * kx + inverse[1, 0] * ky, inverse[0, 1] * kx + inverse[1, 1] * ky
    spread = np.sinc(pixfrac * kx) * np.sinc(pixfrac * ky) * np.sinc(qx) * np.sinc(qy)
    smooth = fft.irfft2(fft.rfft2(np.asarray(fine, float)) * spread, s=fine.shape)
    return warped_psf(smooth, oversampling, jacobian, side, step)


def warped_psf(fine: np.ndarray, oversampling: int, jacobian: np.ndarray, side: int, step: float = 1.0) -> np.ndarray:
    """Return a unit star as it is in an exposure that is interpolated onto a tile, (side, side); the rest as above."""
    inverse, middle = np.linalg.inv(jacobian), len(fine) // 2
    offset = (np.arange(side) - (side - 1) / 2) * step
    u, v = np.meshgrid(offset, offset)
    x, y = inverse[0, 0] * u + inverse[0, 1] * v, inverse[1, 0] * u + inverse[1, 1] * v
    found = lanczos(np.asarray(fine, float), x.ravel() * oversampling + middle, y.ravel() * oversampling + middle)
    return found.reshape(side, side) / abs(np.linalg.det(jacobian))


def native_star(fine: np.ndarray, oversampling: int, half: int, x: float, y: float) -> np.ndarray:
    """Return a unit star (2 half + 1, square) on native pixels, its centre (x, y) pixels from that of the middle one.

    `fine` is as in `drizzled_psf`.
    """
    offset, middle = np.arange(-half, half + 1), len(fine) // 2
    u, v = np.meshgrid((offset - x) * oversampling + middle, (offset - y) * oversampling + middle)
    return lanczos(np.asarray(fine, float), u.ravel(), v.ravel()).reshape(2 * half + 1, 2 * half + 1)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lanczos(image, x, y):
    """Return an image at places (n,), 0 at the first sample, by Lanczos interpolation whose weights sum to one.

    Beyond the image there is nothing.
    """
    out = np.empty(len(x))
    wx, wy = np.empty(2 * LANCZOS), np.empty(2 * LANCZOS)
    for k in range(len(x)):
        i, j = int(np.floor(x[k])) - LANCZOS + 1, int(np.floor(y[k])) - LANCZOS + 1
        _weights(x[k] - i, wx)
        _weights(y[k] - j, wy)
        total = 0.0
        for b in range(2 * LANCZOS):
            if 0 <= j + b < image.shape[0]:
                for a in range(2 * LANCZOS):
                    if 0 <= i + a < image.shape[1]:
                        total += wy[b] * wx[a] * image[j + b, i + a]
        out[k] = total
    return out


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _weights(place, out):
    total = 0.0
    for k in range(2 * LANCZOS):
        t = np.pi * (place - k)
        out[k] = 1.0 if abs(t) < 1e-9 else LANCZOS * np.sin(t) * np.sin(t / LANCZOS) / (t * t)
        total += out[k]
    for k in range(2 * LANCZOS):
        out[k] /= total
