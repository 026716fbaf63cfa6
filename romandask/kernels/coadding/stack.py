"""Coverage, inverse variance and source noise of a stack of exposures, from their footprints alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Stack:
    """Sums over the exposures that cover each pixel of a tile."""

    count: np.ndarray
    """Number of exposures, (ny, nx) uint16."""
    weight: np.ndarray
    """Sum of the inverse variances of an empty pixel, (ny, nx) float32, 1/flux^2."""
    source: np.ndarray
    """Poisson variance of the weighted mean per unit flux of the sources, (ny, nx) float32: variance (flux^2) over
    flux."""
    shares: np.ndarray
    """Weight of each exposure, summed over the tile, (exposures,)."""


def stack(polygons: np.ndarray, variances: np.ndarray, gains: np.ndarray, shape: tuple[int, int]) -> Stack:
    """Return the sums over exposures with inverse-variance weights.

    Parameters
    ----------
    polygons : ndarray, shape (n, k, 2), tile pixels
        Corners (x, y) of the convex footprints of the exposures, in order along the outline; 0 is the centre of the
        first pixel.
    variances : ndarray, shape (n,), flux^2
        Variance of an empty pixel in each exposure.
    gains : ndarray, shape (n,), electrons per unit flux
        Gain of each exposure.
    shape : tuple of int
        Rows and columns of the tile.
    """
    count = np.zeros(shape, np.uint16)
    weight = np.zeros(shape, np.float32)
    source = np.zeros(shape, np.float32)
    shares = np.zeros(len(polygons))
    x, y = np.arange(shape[1]), np.arange(shape[0])[:, None]
    for k, (polygon, variance, gain) in enumerate(zip(polygons, variances, gains, strict=True)):
        inside = np.ones(shape, bool)
        centre = polygon.mean(axis=0)
        for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            # sign of the half plane, bounded by this edge, that holds the centre
            sign = np.sign((x1 - x0) * (centre[1] - y0) - (y1 - y0) * (centre[0] - x0))
            inside &= sign * ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) >= 0
        count += inside
        weight += inside * np.float32(1 / variance)
        source += inside * np.float32(1 / (variance**2 * gain))
        shares[k] = inside.sum() / variance
    safe = np.where(weight > 0, weight, 1)
    return Stack(count, weight, source / safe**2, shares)
