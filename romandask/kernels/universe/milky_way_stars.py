"""Stars of the Galaxy in one direction: how many, how bright and how hot, from a model of its disks and halo."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import astropy.units as u
import numpy as np
import pandas as pd
from astropy.coordinates import SkyCoord

from romandask.kernels.universe.galaxies import CELL_ORDER, positions
from romandask.kernels.universe.galaxy_rows import REFERENCE, flux_columns
from romandask.kernels.universe.synthetic_photometry import SEEN, Dust, LibrarySpectra, band_photons, njy, no_dust
from romandask.model.seeds import rng
from romandask.model.sky import cell_area
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass, SpectrumLibrary

LUMINOSITY = np.array(
    [
        [-1, 0.03],
        [0, 0.1],
        [1, 0.3],
        [2, 0.6],
        [3, 1.1],
        [4, 2.3],
        [5, 3.0],
        [6, 3.0],
        [7, 3.2],
        [8, 4.2],
        [9, 5.5],
        [10, 7.5],
        [11, 8.0],
        [12, 6.0],
        [13, 4.5],
        [14, 3.5],
        [15, 3.0],
        [16, 2.5],
    ]
)
"""M_r against stars of the solar neighbourhood a 1000 pc3 and magnitude, rounded: Wielen, Jahreiss and Krueger 1983 to
M_r = 7, Bochanski et al. 2010 beyond."""
TEMPERATURE = np.array(
    [
        [-1, 15000],
        [0, 10500],
        [1, 9000],
        [2, 8000],
        [3, 7000],
        [4, 6150],
        [5, 5650],
        [6, 5150],
        [7, 4650],
        [8, 4200],
        [9, 3900],
        [10, 3650],
        [11, 3450],
        [12, 3250],
        [13, 3080],
        [14, 2900],
        [15, 2700],
        [16, 2450],
    ]
)
"""M_r against the effective temperature, K, of dwarfs (Pecaut and Mamajek 2013)."""
TEMPERATURES = tuple(int(round(2400 * (15000 / 2400) ** (k / 39), -1)) for k in range(40))
"""Of the blackbodies that stand for stars where no library is given, K."""
BRIGHTEST, FAINTEST = 12.0, 29.0
SUN_RADIUS, SUN_HEIGHT = 8000.0, 25.0
"""pc"""


@dataclass(frozen=True)
class Sightline:
    """Stars in one direction."""

    edges: np.ndarray
    """(m + 1,) r magnitude."""
    luminosities: np.ndarray
    """(k,) M_r."""
    counts: np.ndarray
    """(m, k) stars a square arcminute."""


@lru_cache(maxsize=4)
def sightline(ra: float, dec: float) -> Sightline:
    """Return the stars in a direction (degrees), r from BRIGHTEST to FAINTEST.

    Thin and thick exponential disks and an oblate halo with the parameters of Juric et al. 2008 (table 10, corrected
    for binaries), the local luminosity function everywhere; no dust along the line.
    """
    galactic = SkyCoord(ra * u.deg, dec * u.deg).galactic
    distance = np.geomspace(5, 2e5, 1200)
    x = SUN_RADIUS - distance * np.cos(galactic.b.rad) * np.cos(galactic.l.rad)
    y = -distance * np.cos(galactic.b.rad) * np.sin(galactic.l.rad)
    z = distance * np.sin(galactic.b.rad) + SUN_HEIGHT
    radius = np.hypot(x, y)

    def disk(length: float, height: float) -> np.ndarray:
        return np.exp((SUN_RADIUS - radius) / length - (np.abs(z) - SUN_HEIGHT) / height)

    halo = (np.hypot(radius, z / 0.64) / SUN_RADIUS) ** -2.77
    density = disk(2600, 300) + 0.12 * disk(3600, 900) + 0.0051 * halo
    steps = np.gradient(distance)
    solid_angle = (np.pi / 180 / 60) ** 2
    edges = np.arange(BRIGHTEST, FAINTEST + 0.05, 0.1)
    luminosities = np.arange(LUMINOSITY[0, 0], LUMINOSITY[-1, 0] + 0.05, 0.1)
    local = np.interp(luminosities, *LUMINOSITY.T) * 1e-3 * 0.1
    counts = np.zeros((len(edges) - 1, len(luminosities)))
    for k, (absolute, number) in enumerate(zip(luminosities, local, strict=True)):
        seen = absolute + 5 * np.log10(distance / 10)
        counts[:, k] = np.histogram(seen, edges, weights=number * density * distance**2 * steps * solid_angle)[0]
    return Sightline(edges, luminosities, counts)


def star_rows(
    cells: np.ndarray,
    seed: int,
    density: float,
    line: Sightline,
    library: SpectrumLibrary,
    spectra: range,
    temperatures: np.ndarray,
    bandpasses: tuple[Bandpass, ...],
    bands: tuple[str, ...],
    milky_way_av: float,
) -> pd.DataFrame:
    """Return the stars of some cells of order CELL_ORDER as rows of catalogs/stars.yaml.

    Parameters
    ----------
    density : stars to r < 29 a square arcminute; the model gives their distribution
    spectra : the library's rows of stars, whose temperatures, K, are `temperatures`: each star takes the nearest
    """
    drawn, cell_of_star, index = [], [], []
    for cell in cells:
        random = rng(seed, "truth", "stars", int(cell))
        n = random.poisson(density * cell_area(CELL_ORDER))
        drawn.append(random.random((n, 4)))
        cell_of_star.append(np.full(n, cell))
        index.append(np.arange(n))
    uniform = np.concatenate(drawn) if drawn else np.empty((0, 4))
    cell = np.concatenate(cell_of_star).astype(np.int64) if drawn else np.empty(0, np.int64)
    ra, dec = positions(cell, uniform[:, 0])
    magnitude, absolute = _brightness(line, uniform[:, 1], uniform[:, 2])
    heat = np.interp(absolute, *TEMPERATURE.T)
    sed = spectra.start + np.abs(np.log(temperatures)[None] - np.log(heat)[:, None]).argmin(axis=1)
    n = len(sed)
    dust = Dust(np.full(n, milky_way_av), np.full(n, 3.1))
    chosen = LibrarySpectra(library, sed)
    unit = band_photons(np.zeros(n), chosen, np.zeros(n), no_dust(n), dust, bandpasses)
    names = [bandpass.name for bandpass in bandpasses]
    r_band = names.index(REFERENCE)
    magnorm = magnitude + 2.5 * np.log10(njy(unit[SEEN, :, r_band], bandpasses[r_band]) / NJY_ZERO_POINT)
    frame = {
        "id": (cell << 24) + (1 << 23) + np.concatenate(index or [np.empty(0, int)]),
        "ra": ra,
        "dec": dec,
        "magnorm": magnorm,
        "sed": sed,
        "MW_av": dust.av,
        "MW_rv": dust.rv,
    }
    for band in bands:
        k = names.index(band)
        frame |= flux_columns(band, njy(unit[:, :, k] * 10 ** (-0.4 * magnorm), bandpasses[k]))
    return pd.DataFrame(frame)


def _brightness(line: Sightline, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return r and M_r from their joint distribution."""
    flat = np.concatenate([[0.0], np.cumsum(line.counts.ravel())])
    position = np.interp(first, flat / flat[-1], np.arange(len(flat)))
    bin_of = np.minimum(position.astype(int), len(flat) - 2)
    row, column = np.divmod(bin_of, line.counts.shape[1])
    within = line.edges[row] + second * np.diff(line.edges)[row]
    # within its bin of luminosity a star is where the position fell
    return within, line.luminosities[column] + 0.1 * (position - bin_of - 0.5)
