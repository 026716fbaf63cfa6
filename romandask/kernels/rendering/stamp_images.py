"""Compiled operations on the images of stamps: subtraction of periodic images, and addition to the full image."""

from __future__ import annotations

import numba
import numpy as np

from romandask.kernels.rendering.profiles import surface_brightness

_COARSE_POINTS, _DENSE_POINTS = 9, 33
"""Points along a side of the coarse grid of `subtract_periodic_images`, for most galaxies and for those that are bright
beyond the edges of their stamps."""
_GAUSS = 1 / np.sqrt(3.0)
"""Distance between the points of a two-point quadrature, in units of the interval."""
_MAX_PERIODS = 64
"""Distance of the outermost periodic images that are subtracted, in periods."""


@numba.njit(nogil=True, cache=True)
def subtract_periodic_images(stamps, chosen, x, y, first, kind, matrix, light, extent, bright, tables):
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
    extent : array, shape (components,), pixels
        Radii of the components. Nothing is subtracted for a component that fits into the stamp.
    bright : array, shape (components,), pixels
        Radii within which the components are bright.
    tables : float64 array
        Result of `profile_tables`.
    """
    size = stamps.shape[1]
    for s in range(chosen.shape[0]):
        k = chosen[s]
        largest, any_light = 0.0, False
        for c in range(first[k], first[k + 1]):
            if size / 2 < extent[c] and light[c] != 0:
                any_light = True
                largest = max(largest, bright[c])
        if not any_light:
            continue
        dense = largest > size / 2
        n = _DENSE_POINTS if dense else _COARSE_POINTS
        coarse = np.zeros((n, n))
        for c in range(first[k], first[k + 1]):
            if size / 2 < extent[c] and light[c] != 0:
                _add_periodic_images(
                    coarse, x[k], y[k], kind[c], matrix[c], light[c], extent[c], size, 4 if dense else 1, tables
                )
        _conserve(coarse)
        _conserve(coarse.T)
        _subtract(stamps[s], coarse)


@numba.njit(nogil=True, cache=True)
def _conserve(coarse):
    """Change the values of each row of a grid such that their linear interpolation has the integral of the function.

    A chord of a convex function lies above it, on average by a twelfth of its second difference.
    """
    n = coarse.shape[1]
    for b in range(coarse.shape[0]):
        row = coarse[b]
        before = row[0]
        second = row[0] - 2 * row[1] + row[2]
        for a in range(n):
            if 0 < a < n - 1:
                second = before - 2 * row[a] + row[a + 1]
            before = row[a]
            row[a] -= second / 12


@numba.njit(nogil=True, cache=True)
def _add_periodic_images(coarse, x, y, kind, m, light, extent, size, near, tables):
    """Add the light of the periodic images of a component to a coarse grid over its stamp.

    Images more than `near` periods away are taken as constant over the stamp, with the mean of a two-point quadrature.
    """
    n = coarse.shape[0]
    step = (size - 1) / (n - 1)
    x0, y0 = x - np.floor(x) + size // 2, y - np.floor(y) + size // 2
    xx, yy = m[0, 0] ** 2 + m[0, 1] ** 2, m[1, 0] ** 2 + m[1, 1] ** 2
    xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1]
    area = np.sqrt(max(xx * yy - xy * xy, 1e-30))
    ixx, ixy, iyy = yy / area**2, -xy / area**2, xx / area**2
    periods = min(int(extent / size + 0.5) + 1, _MAX_PERIODS)
    near = min(periods, near)
    far = 0.0
    for j in range(-periods, periods + 1):
        for i in range(-periods, periods + 1):
            if abs(i) > near or abs(j) > near:
                for q in range(4):
                    dx, dy = (i + (q % 2 - 0.5) * _GAUSS) * size, (j + (q // 2 - 0.5) * _GAUSS) * size
                    square = ixx * dx * dx + 2 * ixy * dx * dy + iyy * dy * dy
                    far += surface_brightness(tables, kind, square) / 4
    for b in range(n):
        for a in range(n):
            total = far
            for j in range(-near, near + 1):
                for i in range(-near, near + 1):
                    if i != 0 or j != 0:
                        dx, dy = a * step - x0 + i * size, b * step - y0 + j * size
                        square = ixx * dx * dx + 2 * ixy * dx * dy + iyy * dy * dy
                        total += surface_brightness(tables, kind, square)
            coarse[b, a] += light / area * total


@numba.njit(nogil=True, cache=True)
def _subtract(stamp, coarse):
    """Subtract the linear interpolation of a coarse grid, which reaches from edge to edge, from a stamp."""
    size, n = stamp.shape[0], coarse.shape[0]
    step = (size - 1) / (n - 1)
    line = np.empty(size, np.float32)
    cell, share = np.empty(size, np.int64), np.empty(size, np.float32)
    for i in range(size):
        cell[i] = min(int(i / step), n - 2)
        share[i] = i / step - cell[i]
    values = np.empty(n, np.float32)
    for j in range(size):
        b, up = cell[j], share[j]
        for a in range(n):
            values[a] = coarse[b, a] + up * (coarse[b + 1, a] - coarse[b, a])
        for i in range(size):
            a = cell[i]
            line[i] = values[a] + share[i] * (values[a + 1] - values[a])
        row = stamp[j]
        for i in range(size):
            row[i] -= line[i]


@numba.njit(nogil=True, cache=True)
def add_stamps(image, stamps, chosen, x, y):
    """Add the stamps of the chosen objects, shape (n, size, size), to the image where they overlap it."""
    ny, nx = image.shape
    size = stamps.shape[1]
    for s in range(chosen.shape[0]):
        x0 = int(np.floor(x[chosen[s]])) - size // 2
        y0 = int(np.floor(y[chosen[s]])) - size // 2
        begin, end = max(0, -x0), min(size, nx - x0)
        if begin >= end:
            continue
        for j in range(max(0, -y0), min(size, ny - y0)):
            target, source = image[y0 + j, x0 + begin : x0 + end], stamps[s, j, begin:end]
            for i in range(end - begin):
                target[i] += source[i]
