"""How many galaxies there are by magnitude and redshift, and how many of them are satellites of others.

Counts of hosts are the observed counts less their satellites, so that the sum is the observed counts exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.special import gammainc, gammaincinv

from romandask.kernels.universe.structure import MIN_REDSHIFT, shells

GALAXY_COUNTS = np.array(
    [
        [14, -4.2],
        [16, -3.0],
        [18, -1.75],
        [20, -0.55],
        [22, 0.42],
        [23, 0.82],
        [24, 1.21],
        [25, 1.55],
        [26, 1.86],
        [27, 2.165],
        [28, 2.475],
        [29, 2.776],
    ]
)
"""r (AB) against log10 of the galaxies a square arcminute brighter than it: SDSS (Yasuda et al. 2001) to 18, COSMOS2020
(Weaver et al. 2022; HSC r, masked area taken out) to 26, beyond it the slope of the deep fields (0.31 a magnitude,
Metcalfe et al. 2001) to the paper's 2.15 million a square degree at r < 29."""
FAINTEST = 29.0
REFERENCE_DENSITY = 10 ** GALAXY_COUNTS[-1, 1]
SATELLITES_A_MAGNITUDE = 0.3
"""Satellites of a host a magnitude, at the host's own; the number rises as 10^(0.1 dm), a Schechter slope of -1.25
(conditional luminosity functions of Yang et al. 2008)."""
SATELLITE_SLOPE = 0.1
RICHNESS_SHAPE = 0.03
"""Shape of the gamma distribution of richness about its mean: most hosts have none, few have many."""
GROUP_RADIUS = 0.6
"""Mpc, physical: satellites lie within it."""
CONCENTRATION = 1.25
"""c of their surface density, R^(1/c - 2)."""
_STEP = 0.05


@dataclass(frozen=True)
class Population:
    """Galaxies a square arcminute by r magnitude and shell of redshift."""

    edges: np.ndarray
    """(m + 1,) r magnitude."""
    every: np.ndarray
    """(m, s) galaxies a square arcminute."""
    hosts: np.ndarray
    """(m, s) those that are not satellites."""

    @cached_property
    def host_density(self) -> np.ndarray:
        """(s,) hosts a square arcminute, by shell."""
        return self.hosts.sum(axis=0)

    @cached_property
    def _cumulative(self) -> np.ndarray:
        total = np.cumsum(np.vstack([np.zeros(self.hosts.shape[1]), self.hosts]), axis=0)
        return total / np.maximum(total[-1], 1e-30)

    def host_magnitude(self, uniform: np.ndarray, shell: np.ndarray) -> np.ndarray:
        """Return r magnitudes of hosts in their shells."""
        out = np.empty(len(uniform))
        for s in np.unique(shell):
            rows = shell == s
            out[rows] = np.interp(uniform[rows], self._cumulative[:, s], self.edges)
        return out


@lru_cache(maxsize=2)
def population(density: float) -> Population:
    """Return the population whose galaxies to r < 29 number `density` a square arcminute.

    Redshift: p(z | r) ~ z^2 exp(-z / z0), z0 = 0.0417 r - 0.744 (LSST Science Book, section 3.7.2), below 3.
    """
    edges = np.arange(GALAXY_COUNTS[0, 0], FAINTEST + _STEP / 2, _STEP)
    cumulative = 10 ** PchipInterpolator(GALAXY_COUNTS[:, 0], GALAXY_COUNTS[:, 1])(edges)
    counts = np.diff(cumulative) * density / REFERENCE_DENSITY
    counts[0] += cumulative[0] * density / REFERENCE_DENSITY
    middle = (edges[1:] + edges[:-1]) / 2
    limits = np.maximum(shells().edges, MIN_REDSHIFT)
    share = np.diff(gammainc(3, limits[None] / redshift_scale(middle)[:, None]), axis=1)
    every = counts[:, None] * share / share.sum(axis=1, keepdims=True)
    kernel = SATELLITES_A_MAGNITUDE * _STEP * 10 ** (SATELLITE_SLOPE * (np.arange(len(middle)) + 0.25) * _STEP)
    kernel[0] /= 2
    hosts = np.zeros_like(every)
    for i in range(len(middle)):
        satellites = kernel[i:0:-1] @ hosts[:i]
        hosts[i] = np.maximum(every[i] - satellites, 0) / (1 + kernel[0])
    return Population(edges, every, hosts)


def redshift_scale(magnitude) -> np.ndarray:
    """Return z0 of p(z | r) ~ z^2 exp(-z / z0)."""
    return np.maximum(0.0417 * np.asarray(magnitude) - 0.744, 0.02)


def redshift_within(uniform: np.ndarray, shell: np.ndarray, magnitude: np.ndarray) -> np.ndarray:
    """Return redshifts inside shells: p(z | r) taken as linear across each."""
    edges = np.maximum(shells().edges, MIN_REDSHIFT)
    low, high = edges[shell], edges[shell + 1]
    scale = redshift_scale(magnitude)
    at_low, at_high = low**2 * np.exp(-low / scale), high**2 * np.exp(-high / scale)
    slope = (at_high - at_low) / np.maximum(at_high + at_low, 1e-300)
    # inverse of the integral of 1 + slope (2 x - 1) over x in 0..1, stable as the slope vanishes
    x = 2 * uniform / (1 - slope + np.sqrt((1 - slope) ** 2 + 4 * slope * uniform))
    return low + (high - low) * np.clip(x, 0, 1)


def mean_satellites(magnitude: np.ndarray) -> np.ndarray:
    """Return the mean number of satellites, to r < 29, of hosts."""
    reach = np.maximum(FAINTEST - magnitude, 0)
    return SATELLITES_A_MAGNITUDE * (10 ** (SATELLITE_SLOPE * reach) - 1) / (SATELLITE_SLOPE * np.log(10))


def satellite_magnitude(uniform: np.ndarray, host: np.ndarray) -> np.ndarray:
    """Return r magnitudes of satellites of hosts of a magnitude."""
    reach = FAINTEST - host
    return host + np.log10(1 + uniform * (10 ** (SATELLITE_SLOPE * reach) - 1)) / SATELLITE_SLOPE


def richness(uniform: np.ndarray) -> np.ndarray:
    """Return the richness of hosts relative to the mean."""
    grid, values = _richness_table()
    return np.interp(uniform, grid, values)


@lru_cache(maxsize=1)
def _richness_table() -> tuple[np.ndarray, np.ndarray]:
    # dense where the tail is
    grid = 1 - np.geomspace(1, 1e-6, 4000)
    values = gammaincinv(RICHNESS_SHAPE, grid) / RICHNESS_SHAPE
    steps = np.diff(grid)
    mean = ((values[1:] + values[:-1]) / 2 * steps).sum() + values[-1] * (1 - grid[-1])
    return grid, values / mean


def poisson(uniform: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return Poisson numbers by inverting their distribution, one uniform number each."""
    count = np.zeros(len(mean), np.int64)
    term = np.exp(-mean)
    total = term.copy()
    open_rows = np.flatnonzero(uniform > total)
    k = 0
    while len(open_rows) and k < 1000:
        k += 1
        term[open_rows] *= mean[open_rows] / k
        total[open_rows] += term[open_rows]
        count[open_rows] = k
        open_rows = open_rows[uniform[open_rows] > total[open_rows]]
    return count
