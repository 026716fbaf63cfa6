"""Galaxy counts by magnitude and redshift, divided into host galaxies and satellites.

The counts of hosts are the observed counts minus the counts of their satellites, so the sum of the two equals the
observed counts exactly.
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
"""Cumulative galaxy counts: r magnitude (AB), and log10 of the number of brighter galaxies per square arcminute.

SDSS (Yasuda et al. 2001) to r = 18; COSMOS2020 (Weaver et al. 2022; HSC r, without the masked area) to r = 26; beyond,
the slope of the deep fields (0.31 dex per magnitude, Metcalfe et al. 2001) to the paper's 2.15 million per square
degree at r < 29."""
FAINTEST = 29.0
"""Faintest r magnitude of generated galaxies."""
REFERENCE_DENSITY = 10 ** GALAXY_COUNTS[-1, 1]
"""Galaxies with r < FAINTEST per square arcminute, from GALAXY_COUNTS."""
SATELLITES_PER_MAGNITUDE = 0.3
"""Mean number of satellites of a host per magnitude, at the magnitude of the host."""
SATELLITE_SLOPE = 0.1
"""Slope of the satellite counts, dex per magnitude, which corresponds to a Schechter slope of -1.25 (conditional
luminosity functions of Yang et al. 2008)."""
RICHNESS_SHAPE = 0.03
"""Shape parameter of the gamma distribution of richness around its mean: most hosts have no satellites, few have many.
"""
GROUP_RADIUS = 0.6
"""Largest physical distance of a satellite from its host, Mpc."""
CONCENTRATION = 1.25
"""Exponent c of the surface density of satellites, R^(1/c - 2)."""
_STEP = 0.05
"""Width of the magnitude bins, mag."""


@dataclass(frozen=True)
class Population:
    """Mean density of galaxies in m bins of r magnitude and s shells of redshift."""

    edges: np.ndarray
    """Edges of the magnitude bins, shape (m + 1,), mag."""
    galaxies: np.ndarray
    """All galaxies per square arcminute, shape (m, s)."""
    hosts: np.ndarray
    """Galaxies that are not satellites, per square arcminute, shape (m, s)."""

    @cached_property
    def host_density(self) -> np.ndarray:
        """Hosts per square arcminute in each shell, shape (s,)."""
        return self.hosts.sum(axis=0)

    @cached_property
    def _cumulative(self) -> np.ndarray:
        """Cumulative distribution over magnitude of the hosts of each shell, shape (m + 1, s)."""
        total = np.cumsum(np.vstack([np.zeros(self.hosts.shape[1]), self.hosts]), axis=0)
        return total / np.maximum(total[-1], 1e-30)

    def host_magnitude(self, uniform: np.ndarray, shell: np.ndarray) -> np.ndarray:
        """Return random r magnitudes of hosts, from uniform random numbers and the shell of each host."""
        out = np.empty(len(uniform))
        for s in np.unique(shell):
            rows = shell == s
            out[rows] = np.interp(uniform[rows], self._cumulative[:, s], self.edges)
        return out


@lru_cache(maxsize=2)
def population(density: float) -> Population:
    """Return the population with a given density of galaxies with r < 29.

    The redshift distribution is p(z | r) ~ z^2 exp(-z / z0) with z0 = 0.0417 r - 0.744 (LSST Science Book, section
    3.7.2), cut at redshift 3.

    Parameters
    ----------
    density : float, 1/arcmin2
        Mean density of galaxies with r < 29.
    """
    edges = np.arange(GALAXY_COUNTS[0, 0], FAINTEST + _STEP / 2, _STEP)
    cumulative = 10 ** PchipInterpolator(GALAXY_COUNTS[:, 0], GALAXY_COUNTS[:, 1])(edges)
    counts = np.diff(cumulative) * density / REFERENCE_DENSITY
    counts[0] += cumulative[0] * density / REFERENCE_DENSITY
    middle = (edges[1:] + edges[:-1]) / 2
    limits = np.maximum(shells().edges, MIN_REDSHIFT)
    fraction = np.diff(gammainc(3, limits[None] / redshift_scale(middle)[:, None]), axis=1)
    galaxies = counts[:, None] * fraction / fraction.sum(axis=1, keepdims=True)
    # satellites per host, by the number of bins by which they are fainter than the host
    kernel = SATELLITES_PER_MAGNITUDE * _STEP * 10 ** (SATELLITE_SLOPE * (np.arange(len(middle)) + 0.25) * _STEP)
    kernel[0] /= 2
    hosts = np.zeros_like(galaxies)
    for i in range(len(middle)):
        satellites = kernel[i:0:-1] @ hosts[:i]
        hosts[i] = np.maximum(galaxies[i] - satellites, 0) / (1 + kernel[0])
    return Population(edges, galaxies, hosts)


def redshift_scale(magnitude) -> np.ndarray:
    """Return z0 of p(z | r) ~ z^2 exp(-z / z0) at r magnitudes; at least 0.02."""
    return np.maximum(0.0417 * np.asarray(magnitude) - 0.744, 0.02)


def redshift_within(uniform: np.ndarray, shell: np.ndarray, magnitude: np.ndarray) -> np.ndarray:
    """Return random redshifts inside shells; p(z | r) is approximated as linear across a shell.

    Parameters
    ----------
    uniform : array, shape (n,)
        Uniform random numbers in [0, 1).
    shell : int array, shape (n,)
        Index of the shell of each galaxy.
    magnitude : array, shape (n,), mag
        r magnitude of each galaxy.
    """
    edges = np.maximum(shells().edges, MIN_REDSHIFT)
    low, high = edges[shell], edges[shell + 1]
    scale = redshift_scale(magnitude)
    at_low, at_high = low**2 * np.exp(-low / scale), high**2 * np.exp(-high / scale)
    slope = (at_high - at_low) / np.maximum(at_high + at_low, 1e-300)
    # inverse of the integral of 1 + slope (2 x - 1) over x in 0..1, in a form that is stable for small slopes
    x = 2 * uniform / (1 - slope + np.sqrt((1 - slope) ** 2 + 4 * slope * uniform))
    return low + (high - low) * np.clip(x, 0, 1)


def mean_satellites(magnitude: np.ndarray) -> np.ndarray:
    """Return the mean number of satellites with r < 29 of hosts with given r magnitudes."""
    span = np.maximum(FAINTEST - magnitude, 0)
    return SATELLITES_PER_MAGNITUDE * (10 ** (SATELLITE_SLOPE * span) - 1) / (SATELLITE_SLOPE * np.log(10))


def satellite_magnitude(uniform: np.ndarray, host: np.ndarray) -> np.ndarray:
    """Return random r magnitudes of satellites, from uniform random numbers and the r magnitudes of their hosts."""
    span = FAINTEST - host
    return host + np.log10(1 + uniform * (10 ** (SATELLITE_SLOPE * span) - 1)) / SATELLITE_SLOPE


def richness(uniform: np.ndarray) -> np.ndarray:
    """Return random richnesses of hosts, in units of the mean, from uniform random numbers."""
    grid, values = _richness_table()
    return np.interp(uniform, grid, values)


@lru_cache(maxsize=1)
def _richness_table() -> tuple[np.ndarray, np.ndarray]:
    """Return cumulative probabilities and the richness at each, in units of the mean."""
    # dense in the tail of high richness
    grid = 1 - np.geomspace(1, 1e-6, 4000)
    values = gammaincinv(RICHNESS_SHAPE, grid) / RICHNESS_SHAPE
    steps = np.diff(grid)
    mean = ((values[1:] + values[:-1]) / 2 * steps).sum() + values[-1] * (1 - grid[-1])
    return grid, values / mean


def poisson_from_uniform(uniform: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return Poisson random numbers by inversion of the distribution, one for each uniform random number and mean."""
    count = np.zeros(len(mean), np.int64)
    term = np.exp(-mean)
    total = term.copy()
    unfinished = np.flatnonzero(uniform > total)
    k = 0
    while len(unfinished) and k < 1000:
        k += 1
        term[unfinished] *= mean[unfinished] / k
        total[unfinished] += term[unfinished]
        count[unfinished] = k
        unfinished = unfinished[uniform[unfinished] > total[unfinished]]
    return count
