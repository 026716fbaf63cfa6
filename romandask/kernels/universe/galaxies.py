"""Galaxies of a patch of the universe: where they are, and everything else about them that is drawn.

Small HEALPix cells are the unit of randomness: each has its own hosts and their satellites, so the rows do not depend
on how the catalog is partitioned. A patch asks the cells around it too, for satellites that reach into it.
"""

from __future__ import annotations

from dataclasses import dataclass

import astropy.units as u
import cdshealpix.nested as healpix
import numpy as np
from scipy.special import ndtri

from romandask.kernels.universe import population as counts
from romandask.kernels.universe.population import Population, population
from romandask.kernels.universe.structure import Structure
from romandask.model.cosmology import Cosmology
from romandask.model.seeds import rng
from romandask.model.sky import ARCSEC, cell_area, offset_positions

CELL_ORDER = 12
"""HEALPix order of the cells that are generated at a time, 51.5 arcsec wide."""
REACH = 80.0
"""Satellites lie no further from their host, arcsec."""
TEMPLATES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im", "flat_fnu")
STEPS = 3
"""Templates from one of TEMPLATES (included) to the next: types between are blends."""
SHAPE_NOISE = 0.247
"""Ellipticity dispersion a component (paper: 0.35 in total)."""
POSITION, MAGNITUDE, REDSHIFT, RICHNESS, SATELLITES = range(5)
EARLY, SHARE, TYPE, SIZE, BULGE_SIZE, SHAPE_1, SHAPE_2, ANGLE, DUST, KNOTTY, KNOT_SHARE, KNOTS = range(5, 17)
COLUMNS = 17


@dataclass(frozen=True)
class Galaxies:
    """Galaxies with the uniform numbers from which the rest of them follows."""

    id: np.ndarray
    ra: np.ndarray
    """degrees"""
    dec: np.ndarray
    """degrees"""
    redshift: np.ndarray
    magnitude: np.ndarray
    """r, AB, with all dust and without magnification."""
    uniform: np.ndarray
    """(n, COLUMNS)"""

    def take(self, rows: np.ndarray) -> Galaxies:
        """Return some of them."""
        return Galaxies(*(value[rows] for value in vars(self).values()))


def with_surroundings(cells: np.ndarray) -> np.ndarray:
    """Return cells with all those from which a satellite may reach into them, sorted."""
    for _ in range(3):
        found = healpix.neighbours(cells.astype(np.uint64), CELL_ORDER)
        cells = np.unique(found[found >= 0])
    return cells.astype(np.int64)


def draw(cells: np.ndarray, seed: int, density: float, structure: Structure) -> Galaxies:
    """Return the hosts of some cells (order CELL_ORDER) and their satellites, which may lie outside the cells.

    Parameters
    ----------
    density : galaxies to r < 29 a square arcminute, in the mean over the sky
    """
    people = population(density)
    lon, lat = healpix.healpix_to_lonlat(np.asarray(cells, np.uint64), CELL_ORDER)
    relative = structure.densities(lon.to_value(u.deg), lat.to_value(u.deg))
    means = relative * people.host_density * cell_area(CELL_ORDER)
    numbers, rows = [], []
    for cell, mean in zip(cells, means, strict=True):
        random = rng(seed, "truth", "galaxies", int(cell))
        number = random.poisson(mean)
        numbers.append(number)
        rows.append(random.random((int(number.sum()), COLUMNS)))
    hosts, in_cell = _hosts(
        np.asarray(cells), np.array(numbers, int).reshape(len(cells), len(people.host_density)), rows, people
    )
    members = counts.poisson(
        hosts.uniform[:, SATELLITES],
        counts.mean_satellites(hosts.magnitude) * counts.richness(hosts.uniform[:, RICHNESS]),
    )
    satellites = _satellites(hosts, members, in_cell, np.asarray(cells), seed)
    return Galaxies(
        *(np.concatenate(pair) for pair in zip(vars(hosts).values(), vars(satellites).values(), strict=True))
    )


def _hosts(
    cells: np.ndarray, numbers: np.ndarray, rows: list[np.ndarray], people: Population
) -> tuple[Galaxies, np.ndarray]:
    uniform = np.concatenate(rows) if rows else np.empty((0, COLUMNS))
    each = numbers.sum(axis=1)
    in_cell = np.repeat(np.arange(len(cells)), each)
    shell = np.concatenate([np.repeat(np.arange(numbers.shape[1]), number) for number in numbers] or [np.empty(0, int)])
    index = np.arange(len(uniform)) - np.repeat(np.cumsum(each) - each, each)
    ra, dec = positions(cells[in_cell], uniform[:, POSITION])
    magnitude = people.host_magnitude(uniform[:, MAGNITUDE], shell)
    redshift = counts.redshift_within(uniform[:, REDSHIFT], shell, magnitude)
    return Galaxies((cells[in_cell] << 24) + index, ra, dec, redshift, magnitude, uniform), in_cell


def _satellites(hosts: Galaxies, members: np.ndarray, in_cell: np.ndarray, cells: np.ndarray, seed: int) -> Galaxies:
    host = np.repeat(np.arange(len(members)), members)
    of_cell = np.bincount(in_cell, weights=members, minlength=len(cells)).astype(int)
    drawn = [
        rng(seed, "truth", "satellites", int(cell)).random((number, COLUMNS))
        for cell, number in zip(cells, of_cell, strict=True)
        if number
    ]
    uniform = np.concatenate(drawn) if drawn else np.empty((0, COLUMNS))
    first = np.bincount(in_cell, minlength=len(cells))
    index = np.arange(len(host)) - np.repeat(np.cumsum(of_cell) - of_cell, of_cell) + np.repeat(first, of_cell)
    distance = Cosmology().angular_diameter_distance(hosts.redshift[host])
    radius = np.minimum(counts.GROUP_RADIUS / distance, REACH * ARCSEC) * uniform[:, RICHNESS] ** counts.CONCENTRATION
    bearing = 2 * np.pi * uniform[:, SATELLITES]
    ra, dec = offset_positions(hosts.ra[host], hosts.dec[host], radius, bearing)
    # velocities about the host's, 300 km/s
    redshift = hosts.redshift[host]
    redshift = np.clip(redshift + (1 + redshift) * 1e-3 * ndtri(uniform[:, REDSHIFT]), 0.005, 3.0)
    magnitude = counts.satellite_magnitude(uniform[:, MAGNITUDE], hosts.magnitude[host])
    return Galaxies((cells[in_cell[host]] << 24) + index, ra, dec, redshift, magnitude, uniform)


def positions(cells: np.ndarray, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Uniform in the cells: random cells of order 29 (0.4 mas) inside them, for HEALPix cells have equal areas."""
    if not len(cells):
        return np.empty(0), np.empty(0)
    depth = 2 * (29 - CELL_ORDER)
    inside = (cells.astype(np.int64) << depth) + (uniform * (1 << depth)).astype(np.int64)
    lon, lat = healpix.healpix_to_lonlat(inside.astype(np.uint64), 29)
    return lon.to_value(u.deg), lat.to_value(u.deg)
