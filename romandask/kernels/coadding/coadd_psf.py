"""PSFs of resampled exposures: the PSF of an exposure, drizzled or interpolated onto the pixels of a tile."""

from __future__ import annotations

import numba
import numpy as np
from scipy import fft

LANCZOS_ORDER = 5
"""Half the width of the interpolation kernel, samples (Troxel et al. 2023, section 5.2)."""


def drizzled_psf(
    fine: np.ndarray, oversampling: int, jacobian: np.ndarray, pixfrac: float, side: int, step: float = 1.0
) -> np.ndarray:
    """Return the PSF of a drizzled exposure, averaged over all positions of a star within a native pixel.

    Parameters
    ----------
    fine : ndarray, shape (n, n)
        Oversampled PSF of the exposure, of unit flux. Each sample is the share of the light in a native pixel that is
        centred on the sample. The star is centred on sample n / 2.
    oversampling : int
        Samples of `fine` per native pixel.
    jacobian : ndarray, shape (2, 2), tile pixels per native pixel
        Derivative of x and y on the tile with respect to x and y on the exposure.
    pixfrac : float
        Side of a drop over the side of a native pixel.
    side : int
        Samples along a side of the result.
    step : float, tile pixels
        Distance between samples of the result.

    Returns
    -------
    ndarray, shape (side, side)
        Each sample is the share of the light in a tile pixel that is centred on the sample. The star is centred on the
        middle sample.
    """
    n = len(fine)
    frequency = fft.fftfreq(n, 1 / oversampling)
    kx, ky = fft.rfftfreq(n, 1 / oversampling)[None, :], frequency[:, None]
    # transform of the tile pixel in the coordinates of the exposure: k x = (J^-T k) (J x)
    inverse = np.linalg.inv(jacobian)
    qx, qy = inverse[0, 0] * kx + inverse[1, 0] * ky, inverse[0, 1] * kx + inverse[1, 1] * ky
    spread = np.sinc(pixfrac * kx) * np.sinc(pixfrac * ky) * np.sinc(qx) * np.sinc(qy)
    smooth = fft.irfft2(fft.rfft2(np.asarray(fine, float)) * spread, s=fine.shape)
    return warped_psf(smooth, oversampling, jacobian, side, step)


def warped_psf(fine: np.ndarray, oversampling: int, jacobian: np.ndarray, side: int, step: float = 1.0) -> np.ndarray:
    """Return the PSF of an exposure that is interpolated onto a tile.

    Parameters
    ----------
    fine, oversampling, jacobian, side, step
        As in `drizzled_psf`.

    Returns
    -------
    ndarray, shape (side, side)
        The star is centred on the middle sample.
    """
    inverse, middle = np.linalg.inv(jacobian), len(fine) // 2
    offset = (np.arange(side) - (side - 1) / 2) * step
    u, v = np.meshgrid(offset, offset)
    x, y = inverse[0, 0] * u + inverse[0, 1] * v, inverse[1, 0] * u + inverse[1, 1] * v
    psf = lanczos(np.asarray(fine, float), x.ravel() * oversampling + middle, y.ravel() * oversampling + middle)
    return psf.reshape(side, side) / abs(np.linalg.det(jacobian))


def native_star(fine: np.ndarray, oversampling: int, half: int, x: float, y: float) -> np.ndarray:
    """Return the image of a star of unit flux on native pixels.

    Parameters
    ----------
    fine, oversampling
        As in `drizzled_psf`.
    half : int
        The image is `2 * half + 1` pixels wide and high.
    x, y : float, pixels
        Offset of the star from the centre of the middle pixel.

    Returns
    -------
    ndarray, shape (2 * half + 1, 2 * half + 1)
    """
    offset, middle = np.arange(-half, half + 1), len(fine) // 2
    u, v = np.meshgrid((offset - x) * oversampling + middle, (offset - y) * oversampling + middle)
    return lanczos(np.asarray(fine, float), u.ravel(), v.ravel()).reshape(2 * half + 1, 2 * half + 1)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def lanczos(image, x, y):
    """Interpolate an image at positions (n,) with Lanczos weights that are normalised to a sum of 1.

    Positions are in pixels, 0 at the centre of the first pixel. The image is taken to be 0 beyond its edges.
    """
    out = np.empty(len(x))
    wx, wy = np.empty(2 * LANCZOS_ORDER), np.empty(2 * LANCZOS_ORDER)
    for k in range(len(x)):
        i, j = int(np.floor(x[k])) - LANCZOS_ORDER + 1, int(np.floor(y[k])) - LANCZOS_ORDER + 1
        _weights(x[k] - i, wx)
        _weights(y[k] - j, wy)
        total = 0.0
        for b in range(2 * LANCZOS_ORDER):
            if 0 <= j + b < image.shape[0]:
                for a in range(2 * LANCZOS_ORDER):
                    if 0 <= i + a < image.shape[1]:
                        total += wy[b] * wx[a] * image[j + b, i + a]
        out[k] = total
    return out


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _weights(position, out):
    """Write the normalised Lanczos weights of the samples at 0, 1, 2, ... for a position among them."""
    total = 0.0
    for k in range(2 * LANCZOS_ORDER):
        t = np.pi * (position - k)
        out[k] = 1.0 if abs(t) < 1e-9 else LANCZOS_ORDER * np.sin(t) * np.sin(t / LANCZOS_ORDER) / (t * t)
        total += out[k]
    for k in range(2 * LANCZOS_ORDER):
        out[k] /= total
