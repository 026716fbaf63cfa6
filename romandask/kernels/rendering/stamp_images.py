"""Compiled operations on the images of stamps: subtraction of periodic images, and addition to the full image."""

from __future__ import annotations

import numba
import numpy as np

from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL

_EXPONENTIAL_B = 1.6783469900166605
"""b of the profile exp(-b r) of an exponential disk, where r is in half-light radii."""
_DEVAUCOULEURS_B = 7.669249442500805
"""b of the de Vaucouleurs profile exp(-b r^(1/4)), where r is in half-light radii."""
_DEVAUCOULEURS_FLUX = 5040 * 4 * 2 * np.pi / _DEVAUCOULEURS_B**8
"""Flux of the de Vaucouleurs profile exp(-b r^(1/4)) with half-light radius 1: 8 pi Gamma(8) / b^8."""
_EXPONENTIAL_EXTENT, _DEVAUCOULEURS_EXTENT = 6.5, 70.0
"""Radii, in half-light radii, beyond which less than 2e-4 of the light lies."""
_COARSE_POINTS = 9
"""Points along a side of the coarse grid of `subtract_periodic_images`."""


@numba.njit(nogil=True, cache=True)
def _surface_brightness(kind, xx, xy, yy, dx, dy):
    """Return the surface brightness, times |det M|, of a galaxy profile of flux 1 at an offset from its centre.

    [[xx, xy], [xy, yy]] is the inverse of M M^T, where M is the matrix of the component.
    """
    radius = np.sqrt(max(xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy, 0.0))
    if kind == EXPONENTIAL:
        return _EXPONENTIAL_B * _EXPONENTIAL_B / (2 * np.pi) * np.exp(-_EXPONENTIAL_B * radius)
    return np.exp(-_DEVAUCOULEURS_B * np.sqrt(np.sqrt(radius))) / _DEVAUCOULEURS_FLUX


@numba.njit(nogil=True, cache=True)
def subtract_periodic_images(stamps, chosen, x, y, first, kind, matrix, light):
    """Subtract the periodic images of large galaxies from their stamps.

    A transform sampled at the frequencies of a stamp is that of a profile repeated with the period of the stamp. On the
    stamp, only the smooth outer wings of the repeated profiles contribute. Their light is computed on a coarse grid and
    interpolated linearly.

    Parameters
    ----------
    stamps : float32 array, shape (n, size, size)
        Images of the chosen objects; modified in place.
    chosen, x, y, first, kind, matrix
        As for `fill_transforms`.
    light : array, shape (components,)
        Flux of each component times the fraction of the PSF on the stamp.
    """
    size = stamps.shape[1]
    n = _COARSE_POINTS
    step = (size - 1) / (n - 1)
    coarse = np.empty((n, n))
    for s in range(chosen.shape[0]):
        k = chosen[s]
        x0, y0 = x[k] - np.floor(x[k]) + size // 2, y[k] - np.floor(y[k]) + size // 2
        coarse[:] = 0
        any_light = False
        for c in range(first[k], first[k + 1]):
            if kind[c] != EXPONENTIAL and kind[c] != DEVAUCOULEURS:
                continue
            m = matrix[c]
            xx, yy = m[0, 0] ** 2 + m[0, 1] ** 2, m[1, 0] ** 2 + m[1, 1] ** 2
            xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1]
            area = np.sqrt(max(xx * yy - xy * xy, 1e-30))
            major_axis = np.sqrt((xx + yy + np.sqrt((xx - yy) ** 2 + 4 * xy * xy)) / 2)
            extent = _EXPONENTIAL_EXTENT if kind[c] == EXPONENTIAL else _DEVAUCOULEURS_EXTENT
            if size / 2 > extent * major_axis or light[c] == 0:
                continue
            any_light = True
            ixx, ixy, iyy = yy / area**2, -xy / area**2, xx / area**2
            scale = light[c] / area
            # images two periods away are taken as constant over the stamp
            outer = 0.0
            for j in range(-2, 3):
                for i in range(-2, 3):
                    if abs(i) == 2 or abs(j) == 2:
                        outer += _surface_brightness(kind[c], ixx, ixy, iyy, i * size, j * size)
            for b in range(n):
                for a in range(n):
                    total = outer
                    for j in range(-1, 2):
                        for i in range(-1, 2):
                            if i != 0 or j != 0:
                                dx, dy = a * step - x0 + i * size, b * step - y0 + j * size
                                total += _surface_brightness(kind[c], ixx, ixy, iyy, dx, dy)
                    coarse[b, a] += scale * total
        if any_light:
            _subtract(stamps[s], coarse, step)


@numba.njit(nogil=True, cache=True)
def _subtract(stamp, coarse, step):
    """Subtract the linear interpolation of a coarse grid, whose points are `step` pixels apart, from a stamp."""
    size, n = stamp.shape[0], coarse.shape[0]
    for j in range(size):
        b = min(int(j / step), n - 2)
        up = j / step - b
        for i in range(size):
            a = min(int(i / step), n - 2)
            across = i / step - a
            low = coarse[b, a] + across * (coarse[b, a + 1] - coarse[b, a])
            high = coarse[b + 1, a] + across * (coarse[b + 1, a + 1] - coarse[b + 1, a])
            stamp[j, i] -= low + up * (high - low)


@numba.njit(nogil=True, cache=True)
def add_stamps(image, stamps, chosen, x, y):
    """Add the stamps of the chosen objects, shape (n, size, size), to the image where they overlap it."""
    ny, nx = image.shape
    size = stamps.shape[1]
    for s in range(chosen.shape[0]):
        x0 = int(np.floor(x[chosen[s]])) - size // 2
        y0 = int(np.floor(y[chosen[s]])) - size // 2
        for j in range(max(0, -y0), min(size, ny - y0)):
            for i in range(max(0, -x0), min(size, nx - x0)):
                image[y0 + j, x0 + i] += stamps[s, j, i]
