"""Counts of objects against magnitude, and where they are no longer complete."""

from __future__ import annotations

import numpy as np

FIRST, LAST = 21.0, 26.0
"""Magnitudes between which counts follow a power law (Troxel et al. 2023, section 6)."""
SHARE = 0.8
"""Completeness at the limit."""
LEAST = 100
"""Objects without which nothing is fitted."""


def counts_limit(counts: np.ndarray, edges: np.ndarray) -> tuple[float, float]:
    """Return the magnitude at which counts (n,) in bins (n + 1 edges) fall to 80% of a power law, and its slope.

    The power law, log10 of counts against magnitude, is fitted between 21 and 26 mag to what is brighter by half a
    magnitude than where counts fall below it: the limit itself decides what is complete enough to be fitted. Infinite,
    and NaN, where there are too few objects, or where counts do not fall before the last bin.
    """
    middle = (edges[1:] + edges[:-1]) / 2
    used = (middle >= FIRST) & (middle <= LAST) & (counts > 0)
    if counts[used].sum() < LEAST or used.sum() < 4:
        return np.inf, np.nan
    # counts have passed their peak where they are incomplete, whatever the slope
    peak = middle[used][np.argmax(np.convolve(counts[used], np.ones(3), "same"))]
    limit, slope = float(peak), np.nan
    for _ in range(20):
        fitted = used & (middle <= max(limit - 0.5, middle[used][3]))
        slope, zero = np.polyfit(middle[fitted], np.log10(counts[fitted]), 1, w=np.sqrt(counts[fitted]))
        share = counts / 10 ** (zero + slope * middle)
        # from here on every bin of two together is below: one low bin is chance
        low = np.flatnonzero((share[:-1] < SHARE) & (share[1:] < SHARE) & (middle[:-1] > middle[fitted][-1]))
        if not len(low) or counts[low[0] :].sum() == 0:
            return np.inf, float(slope)
        k = low[0]
        before, after = share[k - 1], share[k]
        place = middle[k - 1] + (before - SHARE) / (before - after) * (middle[k] - middle[k - 1])
        new = float(np.clip(place, middle[k - 1], middle[k]))
        if abs(new - limit) < 1e-6:
            break
        limit = new
    return limit, float(slope)
