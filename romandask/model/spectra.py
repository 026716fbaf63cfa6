"""Spectra and bandpasses as arrays on a common wavelength grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

PLANCK_C = 1.98644586e-16
"""h c, erg cm; the energy of a photon of wavelength `wave` in nm is PLANCK_C / (1e-7 wave) erg."""

NJY_ZERO_POINT = 3.631e12
"""Flux density of AB magnitude 0, nJy."""

MAGNORM_WAVE = 500.0
"""Rest-frame wavelength, nm, of the narrow top-hat band in which `magnorm` is the AB magnitude."""

LOG_STEP = 1e-3
"""Step of the common grid in ln(wavelength). Cell j is centred on exp(j LOG_STEP) nm, so a redshift shifts all
wavelengths of a spectrum by the same number of cells."""


def log_grid(low: float, high: float) -> np.ndarray:
    """Return the centres, nm, of the cells from the one that contains `low` to the one that contains `high`."""
    first, last = (int(round(np.log(value) / LOG_STEP)) for value in (low, high))
    return np.exp(np.arange(first, last + 1) * LOG_STEP)


def cell_widths(wave: np.ndarray) -> np.ndarray:
    """Return the widths, nm, of the cells of the common grid with the given centres, nm."""
    return wave * 2 * np.sinh(LOG_STEP / 2)


@dataclass(frozen=True, kw_only=True)
class Bandpass:
    """A bandpass averaged over the cells of the common grid."""

    name: str
    wave: np.ndarray
    """Centres of the cells, shape (n,), nm."""
    throughput: np.ndarray
    """Effective area divided by `area`, shape (n,), dimensionless."""
    area: float
    """Collecting area, cm2."""
    nodes: np.ndarray
    """Wavelengths at which the PSF is computed, shape (k,), nm; it is interpolated linearly between them."""

    @property
    def first(self) -> int:
        """Index of the first cell on the common grid."""
        return int(round(np.log(self.wave[0]) / LOG_STEP))

    @property
    def weights(self) -> np.ndarray:
        """Weights of the cells, shape (n,), cm2 nm.

        The photon rate, 1/s, is the sum of the weights times a photon flux density in 1/s/cm2/nm.
        """
        return self.throughput * cell_widths(self.wave) * self.area

    def node_weights(self) -> np.ndarray:
        """Return the fraction of each cell's photons that is assigned to each PSF node, shape (n, k); rows sum to 1."""
        position = np.interp(self.wave, self.nodes, np.arange(len(self.nodes)))
        return np.clip(1 - np.abs(position[:, None] - np.arange(len(self.nodes))), 0, 1)

    def ab_photons(self) -> float:
        """Return the photon rate, 1/s, of a source of AB magnitude 0 (flat f_nu = 3631 Jy)."""
        return float(ab_photon_density(self.wave) @ self.weights)


def ab_photon_density(wave: np.ndarray) -> np.ndarray:
    """Return the photon flux density, 1/s/cm2/nm, of AB magnitude 0 at wavelengths in nm: f_nu / (h lambda)."""
    planck = 6.62607015e-27  # erg s
    return 3.631e-20 / planck / wave


def ab_magnitude(flux: ArrayLike) -> np.ndarray:
    """Return the AB magnitudes of flux densities in nJy; NaN where the flux density is not positive."""
    flux = np.asarray(flux, float)
    return np.where(flux > 0, 31.4 - 2.5 * np.log10(np.where(flux > 0, flux, 1.0)), np.nan)


@dataclass(frozen=True)
class SpectrumLibrary:
    """Spectra on the common grid, as photon densities relative to the density at 500 nm in the rest frame."""

    names: tuple[str, ...]
    """Names of the s spectra."""
    wave: np.ndarray
    """Rest-frame wavelengths of the cells of the common grid, shape (n,), nm; spectra are zero outside."""
    photons: np.ndarray
    """Photons per nm, shape (s, n), 1 at 500 nm."""
    limits: np.ndarray
    """Shortest and longest tabulated wavelength of each spectrum, shape (s, 2), nm."""

    @property
    def first(self) -> int:
        """Index of the first cell on the common grid."""
        return int(round(np.log(self.wave[0]) / LOG_STEP))


@dataclass(frozen=True)
class LibrarySpectra:
    """Spectra of n objects as indices into a library."""

    library: SpectrumLibrary
    index: np.ndarray
    """Index of each object's spectrum, shape (n,); -1 for an object without a spectrum."""

    def rows(self, chosen: np.ndarray) -> LibrarySpectra:
        """Return the spectra of the chosen objects."""
        return LibrarySpectra(self.library, self.index[chosen])


@dataclass(frozen=True)
class TophatSpectra:
    """Top-hat spectra of n objects, as in cosmoDC2.

    Within a bin f_lambda is constant: L_nu times the bin's width in frequency over its width in wavelength, the
    convention of skyCatalogs. Redward of the last bin the last value of L_nu is continued, because at low redshift the
    bins of the catalog end short of the red edge of F184. Blueward of the first bin the spectrum is zero.
    """

    values: np.ndarray
    """L_nu in any unit, shape (n, bins); zeros for an object without light."""
    edges: np.ndarray
    """Rest-frame edges of the bins, shape (bins + 1,), nm."""

    def rows(self, chosen: np.ndarray) -> TophatSpectra:
        """Return the spectra of the chosen objects."""
        return TophatSpectra(self.values[chosen], self.edges)


def library_from(names: list[str], spectra: list[tuple[np.ndarray, np.ndarray]], grid: np.ndarray) -> SpectrumLibrary:
    """Resample tabulated spectra to a library.

    Parameters
    ----------
    names : list of str
        Names of the spectra.
    spectra : list of (array, array)
        Wavelengths in nm and f_lambda in any unit, for each spectrum.
    grid : array, nm
        Cell centres of the common grid, from `log_grid`.

    Raises
    ------
    ValueError
        If a spectrum has no light at 500 nm, where `magnorm` is defined.
    """
    rows = np.empty((len(names), len(grid)))
    for row, name, (wave, flambda) in zip(rows, names, spectra, strict=True):
        # the photon density is interpolated linearly between samples, as in GalSim: the templates are coarse enough
        # for the choice to matter
        photons = np.asarray(flambda) * wave
        # magnorm refers to a top-hat band 1 Angstrom wide: the width matters among the lines of cool stars
        at_500 = np.interp(MAGNORM_WAVE + np.linspace(-0.05, 0.05, 41), wave, photons).mean()
        if not at_500 > 0:
            raise ValueError(f"spectrum {name} has no light at 500 nm, where magnorm is defined")
        row[:] = _cell_means(np.asarray(wave, float), photons, grid) / at_500
    limits = np.array([[wave.min(), wave.max()] for wave, _ in spectra]).reshape(-1, 2)
    return SpectrumLibrary(tuple(names), grid, rows, limits)


def _cell_means(wave: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return the cell means of a function that is linear between samples and zero outside.

    Point samples would not do: lines in stellar spectra are narrower than a cell.
    """
    edges = np.concatenate([grid, grid[-1:] * np.exp(LOG_STEP)]) * np.exp(-LOG_STEP / 2)
    nodes = np.union1d(wave, edges)
    at_nodes = np.interp(nodes, wave, values, left=0.0, right=0.0)
    integral = np.concatenate([[0.0], np.cumsum((at_nodes[1:] + at_nodes[:-1]) / 2 * np.diff(nodes))])
    return np.diff(integral[np.searchsorted(nodes, edges)]) / np.diff(edges)


def default_grid() -> np.ndarray:
    """Return the rest-frame grid of spectrum libraries, 60 nm to 2600 nm."""
    return log_grid(60.0, 2600.0)
