"""Positions, redshifts and magnitudes of generated galaxies, and the random numbers for their other properties.

Each small HEALPix cell has its own random generators, for its host galaxies and for their satellites, so the galaxies
do not depend on how the catalog is partitioned. To be complete, a region also needs the cells around it, whose
satellites may lie inside the region.
"""

from __future__ import annotations

from dataclasses import dataclass

import astropy.units as u
import cdshealpix.nested as healpix
import numpy as np
from scipy.special import ndtri

from romandask.kernels.universe.population import (
    CONCENTRATION,
    GROUP_RADIUS,
    Population,
    mean_satellites,
    poisson_from_uniform,
    population,
    redshift_within,
    richness,
    satellite_magnitude,
)
from romandask.kernels.universe.structure import Structure
from romandask.model.cosmology import Cosmology
from romandask.model.seeds import rng
from romandask.model.sky import ARCSEC, cell_area, offset_positions

CELL_ORDER = 12
"""HEALPix order of the cells that have their own random generators; they are 51.5 arcsec wide."""
REACH = 80.0
"""Largest distance of a satellite from its host, arcsec."""
TEMPLATES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im", "flat_fnu")
"""Spectral templates, from red to blue."""
STEPS = 3
"""Number of spectral types per interval between two TEMPLATES; the types in between are blends."""
SHAPE_NOISE = 0.247
"""Rms ellipticity per component (paper: 0.35 in total)."""
# columns of Galaxies.uniform, named after what they decide; a satellite uses RICHNESS for its distance from the host
# and SATELLITES for its position angle
POSITION, MAGNITUDE, REDSHIFT, RICHNESS, SATELLITES = range(5)
EARLY, BULGE_FRACTION, TYPE, SIZE, BULGE_SIZE, SHAPE_1, SHAPE_2, ANGLE, DUST = range(5, 14)
HAS_KNOTS, KNOT_FRACTION, KNOT_COUNT = range(14, 17)
COLUMNS = 17
"""Number of columns of `Galaxies.uniform`."""


@dataclass(frozen=True, kw_only=True)
class Galaxies:
    """Generated galaxies, n in number, with the random numbers that decide their other properties."""

    id: np.ndarray
    """Cell number times 2^24, plus the number of the galaxy in the cell; a satellite counts in the cell of its host."""
    ra: np.ndarray
    """Right ascension, degrees."""
    dec: np.ndarray
    """Declination, degrees."""
    redshift: np.ndarray
    magnitude: np.ndarray
    """AB magnitude in r, with all dust and without lensing magnification."""
    uniform: np.ndarray
    """Uniform random numbers in [0, 1), shape (n, COLUMNS)."""

    def take(self, rows: np.ndarray) -> Galaxies:
        """Return the galaxies of some rows."""
        return Galaxies(**{name: value[rows] for name, value in vars(self).items()})


def with_surroundings(cells: np.ndarray) -> np.ndarray:
    """Return cells of CELL_ORDER and all cells from which a satellite may reach into them, sorted."""
    for _ in range(3):
        neighbours = healpix.neighbours(cells.astype(np.uint64), CELL_ORDER)
        cells = np.unique(neighbours[neighbours >= 0])
    return cells.astype(np.int64)


def draw(cells: np.ndarray, seed: int, density: float, structure: Structure) -> Galaxies:
    """Return the host galaxies of some cells and their satellites, which may lie outside the cells.

    Parameters
    ----------
    cells : int array
        HEALPix cells of order CELL_ORDER, nested scheme.
    seed : int
        Seed of the survey.
    density : float, 1/arcmin2
        Mean density over the sky of galaxies with r < 29.
    structure : Structure
        Relative density of galaxies on the sky; must cover the cells.
    """
    model = population(density)
    lon, lat = healpix.healpix_to_lonlat(np.asarray(cells, np.uint64), CELL_ORDER)
    relative = structure.densities(lon.to_value(u.deg), lat.to_value(u.deg))
    means = relative * model.host_density * cell_area(CELL_ORDER)
    counts, uniforms = [], []
    for cell, mean in zip(cells, means, strict=True):
        random = rng(seed, "truth", "galaxies", int(cell))
        count = random.poisson(mean)
        counts.append(count)
        uniforms.append(random.random((int(count.sum()), COLUMNS)))
    hosts, cell_index = _hosts(
        np.asarray(cells), np.array(counts, int).reshape(len(cells), len(model.host_density)), uniforms, model
    )
    satellite_counts = poisson_from_uniform(
        hosts.uniform[:, SATELLITES],
        mean_satellites(hosts.magnitude) * richness(hosts.uniform[:, RICHNESS]),
    )
    satellites = _satellites(hosts, satellite_counts, cell_index, np.asarray(cells), seed)
    return Galaxies(**{name: np.concatenate([value, getattr(satellites, name)]) for name, value in vars(hosts).items()})


def _hosts(
    cells: np.ndarray, counts: np.ndarray, uniforms: list[np.ndarray], model: Population
) -> tuple[Galaxies, np.ndarray]:
    """Return the hosts, given their counts, shape (cells, shells), and the index of each host's cell."""
    uniform = np.concatenate(uniforms) if uniforms else np.empty((0, COLUMNS))
    cell_counts = counts.sum(axis=1)
    cell_index = np.repeat(np.arange(len(cells)), cell_counts)
    shell = np.concatenate([np.repeat(np.arange(counts.shape[1]), count) for count in counts] or [np.empty(0, int)])
    number = np.arange(len(uniform)) - np.repeat(np.cumsum(cell_counts) - cell_counts, cell_counts)
    ra, dec = positions(cells[cell_index], uniform[:, POSITION])
    magnitude = model.host_magnitude(uniform[:, MAGNITUDE], shell)
    hosts = Galaxies(
        id=(cells[cell_index] << 24) + number,
        ra=ra,
        dec=dec,
        redshift=redshift_within(uniform[:, REDSHIFT], shell, magnitude),
        magnitude=magnitude,
        uniform=uniform,
    )
    return hosts, cell_index


def _satellites(
    hosts: Galaxies, satellite_counts: np.ndarray, cell_index: np.ndarray, cells: np.ndarray, seed: int
) -> Galaxies:
    """Return the satellites of hosts, given their number for each host; `cell_index` is that of the hosts' cells."""
    host = np.repeat(np.arange(len(satellite_counts)), satellite_counts)
    cell_counts = np.bincount(cell_index, weights=satellite_counts, minlength=len(cells)).astype(int)
    uniforms = [
        rng(seed, "truth", "satellites", int(cell)).random((count, COLUMNS))
        for cell, count in zip(cells, cell_counts, strict=True)
        if count
    ]
    uniform = np.concatenate(uniforms) if uniforms else np.empty((0, COLUMNS))
    # in each cell, satellites are numbered after the hosts
    host_counts = np.bincount(cell_index, minlength=len(cells))
    number = np.arange(len(host)) - np.repeat(np.cumsum(cell_counts) - cell_counts, cell_counts)
    number = number + np.repeat(host_counts, cell_counts)
    distance = Cosmology().angular_diameter_distance(hosts.redshift[host])
    separation = np.minimum(GROUP_RADIUS / distance, REACH * ARCSEC) * uniform[:, RICHNESS] ** CONCENTRATION
    position_angle = 2 * np.pi * uniform[:, SATELLITES]
    ra, dec = offset_positions(hosts.ra[host], hosts.dec[host], separation, position_angle)
    # velocity dispersion of 300 km/s around the host
    redshift = hosts.redshift[host]
    redshift = np.clip(redshift + (1 + redshift) * 1e-3 * ndtri(uniform[:, REDSHIFT]), 0.005, 3.0)
    return Galaxies(
        id=(cells[cell_index[host]] << 24) + number,
        ra=ra,
        dec=dec,
        redshift=redshift,
        magnitude=satellite_magnitude(uniform[:, MAGNITUDE], hosts.magnitude[host]),
        uniform=uniform,
    )


def positions(cells: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return random positions in cells of CELL_ORDER, one for each uniform random number.

    A position is the centre of a random HEALPix cell of order 29 (0.4 mas wide) inside the given cell. HEALPix cells
    have equal areas, so the positions are uniform on the sky.

    Parameters
    ----------
    cells : int array, shape (n,)
        Cell of each position.
    uniform : array, shape (n,)
        Random numbers in [0, 1).

    Returns
    -------
    tuple of arrays, shape (n,)
        Right ascension and declination, degrees.
    """
    if not len(cells):
        return np.empty(0), np.empty(0)
    depth = 2 * (29 - CELL_ORDER)
    inside = (cells.astype(np.int64) << depth) + (uniform * (1 << depth)).astype(np.int64)
    lon, lat = healpix.healpix_to_lonlat(inside.astype(np.uint64), 29)
    return lon.to_value(u.deg), lat.to_value(u.deg)
