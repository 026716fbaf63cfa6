"""Number counts of objects against magnitude, and the magnitude at which they become incomplete."""

from __future__ import annotations

import numpy as np

BRIGHTEST, FAINTEST = 21.0, 26.0
"""Magnitudes between which counts follow a power law (Troxel et al. 2023, section 6)."""
LIMIT_COMPLETENESS = 0.8
"""Completeness at the limiting magnitude."""
MIN_OBJECTS = 100
"""Smallest number of objects to which a power law is fitted."""


def counts_limit(counts: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Return the magnitude at which counts fall to 80% of a power law, and the slope of the power law.

    The power law is a straight line in log10 of the counts against magnitude. It is fitted to bins between 21 and 26
    mag that are at least half a magnitude brighter than the limit, and to no fewer than the four brightest. Fit and
    limit are iterated.

    Parameters
    ----------
    counts : ndarray, shape (n,)
        Number of objects in each bin.
    edges : ndarray, shape (n + 1,), mag
        Edges of the bins.

    Returns
    -------
    limit : float, mag
        Infinite if there are too few objects, or if the counts do not fall below 80% before the last bin.
    slope : float, 1/mag
        NaN if there are too few objects.
    """
    middle = (edges[1:] + edges[:-1]) / 2
    in_range = (middle >= BRIGHTEST) & (middle <= FAINTEST) & (counts > 0)
    if counts[in_range].sum() < MIN_OBJECTS or in_range.sum() < 4:
        return np.inf, np.nan
    # start from the peak of the counts: fainter bins are incomplete, whatever the slope
    peak = middle[in_range][np.argmax(np.convolve(counts[in_range], np.ones(3), "same"))]
    limit, slope = float(peak), np.nan
    for _ in range(20):
        fitted = in_range & (middle <= max(limit - 0.5, middle[in_range][3]))
        slope, intercept = np.polyfit(middle[fitted], np.log10(counts[fitted]), 1, w=np.sqrt(counts[fitted]))
        completeness = counts / 10 ** (intercept + slope * middle)
        # require two neighbouring low bins: a single one may be a fluctuation
        low = np.flatnonzero(
            (completeness[:-1] < LIMIT_COMPLETENESS)
            & (completeness[1:] < LIMIT_COMPLETENESS)
            & (middle[:-1] > middle[fitted][-1])
        )
        if not len(low) or counts[low[0] :].sum() == 0:
            return np.inf, float(slope)
        k = low[0]
        before, after = completeness[k - 1], completeness[k]
        crossing = middle[k - 1] + (before - LIMIT_COMPLETENESS) / (before - after) * (middle[k] - middle[k - 1])
        new = float(np.clip(crossing, middle[k - 1], middle[k]))
        if abs(new - limit) < 1e-6:
            break
        limit = new
    return limit, float(slope)
