"""Numbers of a stack of exposures that is not resampled: coverage, inverse variance, source noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Stack:
    """Sums over the exposures that cover each pixel of a tile."""

    count: np.ndarray
    """(ny, nx) uint16, exposures."""
    weight: np.ndarray
    """(ny, nx) float32, sum of inverse variances of an empty pixel, 1/flux^2."""
    source: np.ndarray
    """(ny, nx) float32: variance (flux^2) of the weighted mean for a unit flux of the objects."""
    shares: np.ndarray
    """(exposures,) weight of each exposure, summed over the tile."""


def stack(polygons: np.ndarray, variances: np.ndarray, gains: np.ndarray, shape: tuple[int, int]) -> Stack:
    """Return the sums of exposures with inverse-variance weights.

    Parameters
    ----------
    polygons : (n, k, 2) footprints in pixels of the tile, convex, in order; x and y, 0 at the first pixel's centre
    variances : (n,) variance of an empty pixel, flux^2
    gains : (n,) electrons per unit flux, of each exposure
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
            side = np.sign((x1 - x0) * (centre[1] - y0) - (y1 - y0) * (centre[0] - x0))
            inside &= side * ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) >= 0
        count += inside
        weight += inside * np.float32(1 / variance)
        source += inside * np.float32(1 / (variance**2 * gain))
        shares[k] = inside.sum() / variance
    safe = np.where(weight > 0, weight, 1)
    return Stack(count, weight, source / safe**2, shares)
