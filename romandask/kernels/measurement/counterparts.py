"""Counterparts of measured objects among the true ones: near on the sky, then alike in magnitude."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 3
"""True objects, the nearest, among which the counterpart is chosen (Troxel et al. 2023, section 5.3)."""


@dataclass(frozen=True)
class Counterparts:
    """Of each measured object, arrays (n,)."""

    row: np.ndarray
    """Row of its counterpart in the true ones; -1 where there is none."""
    separation: np.ndarray
    """Radians; NaN where there is none."""
    candidates: np.ndarray
    """True objects within the radius, at most NEIGHBOURS."""


def counterparts(
    measured: np.ndarray, magnitude: np.ndarray, true: np.ndarray, true_magnitude: np.ndarray, radius: float
) -> Counterparts:
    """Return the counterpart of each object: of its nearest neighbours within a radius the closest in magnitude.

    Parameters
    ----------
    measured, true : (n, 3) and (m, 3) unit vectors
    magnitude, true_magnitude : (n,) and (m,); where one is not known, the nearest is taken
    radius : radians
    """
    n = len(measured)
    if not n or not len(true):
        return Counterparts(np.full(n, -1), np.full(n, np.nan), np.zeros(n, int))
    chord = 2 * np.sin(radius / 2)
    distance, row = cKDTree(true).query(measured, k=NEIGHBOURS, distance_upper_bound=chord)
    near = np.isfinite(distance)
    candidate = np.where(near, row, 0)
    apart = np.abs(true_magnitude[candidate] - magnitude[:, None])
    # a magnitude that is not known decides nothing: the order of distance does
    apart = np.where(near, np.where(np.isfinite(apart), apart, 1e3 + distance), np.inf)
    best = np.argmin(apart, axis=1)[:, None]
    found = near.any(axis=1)
    chosen = np.take_along_axis(candidate, best, 1)[:, 0]
    separation = 2 * np.arcsin(np.take_along_axis(np.where(near, distance, 0), best, 1)[:, 0] / 2)
    return Counterparts(np.where(found, chosen, -1), np.where(found, separation, np.nan), near.sum(axis=1))
