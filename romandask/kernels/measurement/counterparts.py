"""Counterparts of measured objects among true objects, chosen by separation and magnitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 3
"""Number of nearest true objects among which the counterpart is chosen (Troxel et al. 2023, section 5.3)."""


@dataclass(frozen=True)
class Counterparts:
    """Counterparts of n measured objects."""

    row: np.ndarray
    """Row of the counterpart among the true objects, (n,); -1 for none."""
    separation: np.ndarray
    """Separation from the counterpart, (n,), radians; NaN for none."""
    candidates: np.ndarray
    """Number of true objects within the radius, (n,), at most NEIGHBOURS."""


def counterparts(
    measured: np.ndarray, magnitude: np.ndarray, true: np.ndarray, true_magnitude: np.ndarray, radius: float
) -> Counterparts:
    """Return the counterpart of each object: the closest in magnitude among its nearest neighbours within a radius.

    Parameters
    ----------
    measured, true : ndarray, shape (n, 3) and (m, 3)
        Unit vectors of the measured and of the true objects.
    magnitude, true_magnitude : ndarray, shape (n,) and (m,), mag
        A true object without a finite difference in magnitude is chosen only if no other has one, the nearest first.
    radius : float, radians
        Largest separation of a counterpart.
    """
    n = len(measured)
    if not n or not len(true):
        return Counterparts(np.full(n, -1), np.full(n, np.nan), np.zeros(n, int))
    chord = 2 * np.sin(radius / 2)
    distance, row = cKDTree(true).query(measured, k=NEIGHBOURS, distance_upper_bound=chord)
    near = np.isfinite(distance)
    candidate = np.where(near, row, 0)
    difference = np.abs(true_magnitude[candidate] - magnitude[:, None])
    # candidates without a magnitude are ordered by distance
    difference = np.where(near, np.where(np.isfinite(difference), difference, 1e3 + distance), np.inf)
    best = np.argmin(difference, axis=1)[:, None]
    matched = near.any(axis=1)
    chosen = np.take_along_axis(candidate, best, 1)[:, 0]
    separation = 2 * np.arcsin(np.take_along_axis(np.where(near, distance, 0), best, 1)[:, 0] / 2)
    return Counterparts(np.where(matched, chosen, -1), np.where(matched, separation, np.nan), near.sum(axis=1))
