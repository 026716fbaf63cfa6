"""Milky Way stars in one direction: counts, magnitudes and temperatures from a model of the disks and the halo."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import astropy.units as u
import numpy as np
import pandas as pd
from astropy.coordinates import SkyCoord

from romandask.kernels.universe.dust import ALL_DUST, Dust, no_dust
from romandask.kernels.universe.galaxies import CELL_ORDER, positions
from romandask.kernels.universe.galaxy_rows import REFERENCE_BAND, flux_columns
from romandask.kernels.universe.synthetic_photometry import band_photons, njy
from romandask.model.seeds import rng
from romandask.model.sky import cell_area
from romandask.model.spectra import NJY_ZERO_POINT, Bandpass, LibrarySpectra, SpectrumLibrary

LUMINOSITY_FUNCTION = np.array(
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
"""Luminosity function of the solar neighbourhood: M_r, and stars per 1000 pc3 and magnitude, rounded.

Wielen, Jahreiss and Krueger 1983 to M_r = 7, Bochanski et al. 2010 beyond."""
DWARF_TEMPERATURES = np.array(
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
"""M_r, and effective temperature in K, of dwarfs (Pecaut and Mamajek 2013)."""
TEMPERATURES = tuple(int(round(2400 * (15000 / 2400) ** (k / 39), -1)) for k in range(40))
"""Temperatures, K, of the blackbody spectra of stars, which are used if no library of spectra is given."""
BRIGHTEST, FAINTEST = 12.0, 29.0
"""Range of r magnitudes of generated stars."""
SUN_RADIUS, SUN_HEIGHT = 8000.0, 25.0
"""Distance of the Sun from the Galactic centre, and height above the plane, pc."""


@dataclass(frozen=True)
class Sightline:
    """Star counts in one direction, in m bins of r magnitude and k bins of absolute magnitude."""

    edges: np.ndarray
    """Edges of the bins of r, shape (m + 1,), mag."""
    absolute_magnitudes: np.ndarray
    """Centres of the bins of M_r, shape (k,), mag."""
    counts: np.ndarray
    """Stars per square arcminute, shape (m, k)."""


@lru_cache(maxsize=4)
def sightline(ra: float, dec: float) -> Sightline:
    """Return the star counts in a direction (degrees), for r from BRIGHTEST to FAINTEST.

    The model consists of a thin and a thick exponential disk and an oblate halo, with the parameters of Juric et al.
    2008 (table 10, corrected for binaries) and the local luminosity function everywhere. It has no dust.
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
    absolute_magnitudes = np.arange(LUMINOSITY_FUNCTION[0, 0], LUMINOSITY_FUNCTION[-1, 0] + 0.05, 0.1)
    local_density = np.interp(absolute_magnitudes, *LUMINOSITY_FUNCTION.T) * 1e-3 * 0.1
    counts = np.zeros((len(edges) - 1, len(absolute_magnitudes)))
    for k, (absolute, number) in enumerate(zip(absolute_magnitudes, local_density, strict=True)):
        apparent = absolute + 5 * np.log10(distance / 10)
        counts[:, k] = np.histogram(apparent, edges, weights=number * density * distance**2 * steps * solid_angle)[0]
    return Sightline(edges, absolute_magnitudes, counts)


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
    """Return the stars of some cells as rows of the truth catalog (catalogs/stars.yaml).

    Parameters
    ----------
    cells : int array
        HEALPix cells of order CELL_ORDER, nested scheme.
    seed : int
        Seed of the survey.
    density : float, 1/arcmin2
        Stars with r < 29; the model gives their distribution over magnitude only.
    line : Sightline
        Star counts of the model.
    library : SpectrumLibrary
        Spectra.
    spectra : range
        Indices of the star spectra in the library.
    temperatures : array, K
        Temperatures of these spectra; each star gets the spectrum nearest in ln(temperature).
    bandpasses : tuple of Bandpass
        Bands in which fluxes are computed; must include REFERENCE_BAND and `bands`.
    bands : tuple of str
        Bands of the flux columns.
    milky_way_av : float, mag
        A_V of the Milky Way.
    """
    uniforms, star_cells, numbers = [], [], []
    for cell in cells:
        random = rng(seed, "truth", "stars", int(cell))
        n = random.poisson(density * cell_area(CELL_ORDER))
        uniforms.append(random.random((n, 4)))
        star_cells.append(np.full(n, cell))
        numbers.append(np.arange(n))
    uniform = np.concatenate(uniforms) if uniforms else np.empty((0, 4))
    cell = np.concatenate(star_cells).astype(np.int64) if uniforms else np.empty(0, np.int64)
    ra, dec = positions(cell, uniform[:, 0])
    magnitude, absolute = _magnitudes(line, uniform[:, 1], uniform[:, 2])
    temperature = np.interp(absolute, *DWARF_TEMPERATURES.T)
    sed = spectra.start + np.abs(np.log(temperatures)[None] - np.log(temperature)[:, None]).argmin(axis=1)
    n = len(sed)
    dust = Dust(np.full(n, milky_way_av), np.full(n, 3.1))
    star_spectra = LibrarySpectra(library, sed)
    at_magnorm_0 = band_photons(np.zeros(n), star_spectra, np.zeros(n), no_dust(n), dust, bandpasses)
    names = [bandpass.name for bandpass in bandpasses]
    r_band = names.index(REFERENCE_BAND)
    r_flux = njy(at_magnorm_0[ALL_DUST, :, r_band], bandpasses[r_band])
    magnorm = magnitude + 2.5 * np.log10(r_flux / NJY_ZERO_POINT)
    frame = {
        # bit 23 distinguishes stars from the galaxies of the same cell
        "id": (cell << 24) + (1 << 23) + np.concatenate(numbers or [np.empty(0, int)]),
        "ra": ra,
        "dec": dec,
        "magnorm": magnorm,
        "sed": sed,
        "MW_av": dust.av,
        "MW_rv": dust.rv,
    }
    for band in bands:
        k = names.index(band)
        frame |= flux_columns(band, njy(at_magnorm_0[:, :, k] * 10 ** (-0.4 * magnorm), bandpasses[k]))
    return pd.DataFrame(frame)


def _magnitudes(line: Sightline, uniform_1: np.ndarray, uniform_2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return random r and M_r from their joint distribution, from two uniform random numbers per star."""
    cumulative = np.concatenate([[0.0], np.cumsum(line.counts.ravel())])
    position = np.interp(uniform_1, cumulative / cumulative[-1], np.arange(len(cumulative)))
    bin_index = np.minimum(position.astype(int), len(cumulative) - 2)
    row, column = np.divmod(bin_index, line.counts.shape[1])
    apparent = line.edges[row] + uniform_2 * np.diff(line.edges)[row]
    # the fractional part of the position is the position of the star in its bin of M_r
    return apparent, line.absolute_magnitudes[column] + 0.1 * (position - bin_index - 0.5)
